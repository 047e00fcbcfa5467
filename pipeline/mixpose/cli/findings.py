"""What a run finds out about its recording on the way: which sensor, marker or frames are at fault.

Everything is kept as sums and stretches of frames, so that a run of any length takes little memory.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from statistics import median
from typing import Any

from numpy.typing import NDArray

from mixpose.body import ASIDE, TURNED
from mixpose.checking import CAUSES, explanation, judge, late_sensor
from mixpose.cli import marker_offsets as offsets
from mixpose.cli.marker_offsets import BodySize, Marker
from mixpose.frames.repeated import is_same, shown_by
from mixpose.judgement import APART
from mixpose.objective import View
from mixpose.records import Estimate, FrameSet
from mixpose.session import Session
from mixpose.tracking import CHANGED, OUT_OF_STEP, TWICE, plane_views

_LONG = 3  # frames in a row that are more than an accident
_OFTEN = 0.2  # of the frames: what comes in turns is no accident either
_FEWEST = 10  # frames that a sensor is met in before anything is said of it
_FAR = 10.0  # times what is usual for a sensor: its features are met far off
_AT_LEAST = 0.2  # of sigma, for that
_USUAL = 100  # frames by which it is told what is usual
_KEPT = 3  # frames that are tried with other sessions
_SHOWN = 3  # stretches that are named


@dataclass
class Stretches:
    """Frames in which something was so: the longest stretches, and the last, in their order."""

    count: int = 0
    found: list[list[int]] = field(default_factory=list)
    left_out: int = 0  # stretches
    last_place: int = -2  # in the run, of the last frame

    def add(self, frame: int, place: int) -> None:
        """Add a frame, which is the `place`-th of the run."""
        if place == self.last_place:
            return
        if place == self.last_place + 1:
            self.found[-1][1:] = [frame, self.found[-1][2] + 1]
        else:
            if len(self.found) > _SHOWN:  # the shortest can be named no more
                self.found.remove(min(reversed(self.found), key=lambda each: each[2]))
                self.left_out += 1
            self.found.append([frame, frame, 1])
        self.count, self.last_place = self.count + 1, place

    @property
    def longest(self) -> int:
        """Frames of the longest stretch."""
        return max((each[2] for each in self.found), default=0)

    def are_no_accident(self, total: int) -> bool:
        """Whether they come in a row, or in turns all over a run of so many frames."""
        return self.longest >= _LONG or self.count > _OFTEN * total

    def text(self) -> str:
        """The frames for people, the longest stretches if there are many."""
        chosen = sorted(sorted(self.found, key=lambda each: -each[2])[:_SHOWN])
        parts = [f"{a}" if a == b else f"{a} to {b}" for a, b, _ in chosen]
        more = self.left_out + len(self.found) - len(chosen)
        return ", ".join(parts) + (f" and {more} more" if more else "")


class Findings:
    """What is remembered of the frames of a run."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._places = -1
        self._ok = self._lost = 0
        self._setups = {setup.name: setup for setup in session.sensors}
        self._bodies = {label: one.body for one in session.objects for label in one.labels}
        kinds = [{name: Stretches() for name in self._setups} for _ in range(5)]
        self._no_frame, self._no_feature, self._flooded, self._same, self._far = kinds
        self._most = dict.fromkeys(self._setups, 0)  # features of one frame
        self._expected = sum(map(len, self._bodies.values()))
        self._usual = {name: deque[float](maxlen=_USUAL) for name in self._setups}
        self._shown: dict[str, NDArray[Any]] = {}
        self._again: set[str] = set()
        self._doubts: dict[str, Stretches] = {}
        self._doubted = Stretches()  # for whatever reason
        self._markers: dict[str, dict[int, Marker]] = {}
        self._sizes = {label: BodySize(session, body.means) for label, body in self._bodies.items()}
        self._frames: list[tuple[int, list[View]]] = []
        self._agreed_before = 0

    def watch(self, frame_set: FrameSet, views: Sequence[View], estimate: Estimate) -> None:
        """Look at what a frame was made from, before `add`."""
        if estimate.label != self._session.labels[0]:
            return
        self._again = set()
        place = self._places + 1
        seen = {view.name for view in views if not view.observation.is_empty}
        flooded = self._too_many(views) if estimate.status != "ok" else {}
        for name, count in flooded.items():
            self._flooded[name].add(frame_set.number, place)
            self._most[name] = max(self._most[name], count)
        for name in self._no_frame:
            frame = frame_set.frames.get(name)
            if frame is None:
                self._no_frame[name].add(frame_set.number, place)
            elif name not in seen and name not in flooded:
                self._no_feature[name].add(frame_set.number, place)
            shown = None if frame is None else shown_by(frame)
            if shown is not None:
                if name in seen and is_same(self._shown.get(name), shown):
                    self._again.add(name)
                self._shown[name] = shown
        is_lost = estimate.status == "lost"
        tells = (bool(seen) and not flooded) if is_lost else len(seen) > 1
        if estimate.status != "ok" and len(self._frames) < _KEPT and tells:
            known = [one for view in views for one in plane_views(view)]
            self._frames.append((frame_set.number, known))

    def _too_many(self, views: Sequence[View]) -> dict[str, int]:
        """How many features sensors found that found far more than there are."""
        seen = {one.name: one.observation for one in views if one.name in self._flooded}
        return {
            name: each.found
            for name, each in seen.items()
            if each.points is not None and judge(each.found, self._expected) == "too many"
        }

    def add(self, estimate: Estimate) -> None:
        """Count a frame."""
        if estimate.label == self._session.labels[0]:
            self._places += 1
        self._ok += estimate.status == "ok"
        self._lost += estimate.status == "lost"
        self._add_repeats(estimate)
        if estimate.doubt:
            self._doubts.setdefault(estimate.doubt, Stretches()).add(estimate.frame, self._places)
            self._doubted.add(estimate.frame, self._places)
        elif estimate.status == "ok":
            self._agreed_before += not self._doubts
            self._add_residuals(estimate)
            offsets.add_markers(self._markers.setdefault(estimate.label, {}), estimate)
            if estimate.label in self._sizes:
                self._sizes[estimate.label].add(estimate)

    def _add_repeats(self, estimate: Estimate) -> None:
        """What shows the same as before, where that contradicts others, once for all bodies."""
        out = {name for name, one in estimate.sensors.items() if one.why == OUT_OF_STEP}
        again = self._again if estimate.doubt else self._again & out
        for name in again:
            self._same[name].add(estimate.frame, self._places)
        self._again = self._again - again

    def _add_residuals(self, estimate: Estimate) -> None:
        if estimate.label != self._session.labels[0]:
            return
        found = estimate.weighted_rms
        for name, one in estimate.sensors.items():
            usual, off = self._usual[name], found[name]
            if off is None or not one.used:
                continue
            sigma = self._setups[name].extract.sigma
            counts = off >= _AT_LEAST * sigma and len(usual) >= _FEWEST
            if counts and off > _FAR * median(usual):
                self._far[name].add(estimate.frame, self._places)
            else:
                usual.append(off)

    def causes(self) -> list[str]:
        """What of the session or the bodies is most likely at fault, a line each."""
        sizes = offsets.size_warnings(self._sizes)
        # a body of another size is met off at all of its markers
        return [*self._of_doubts(), *(sizes or self._of_markers())]

    def tells_of_sensors(self, causes: Iterable[str]) -> bool:
        """Whether the causes say why a sensor explains nothing."""
        return self.change is not None or any(APART in line for line in causes)

    def of_sensors(self) -> list[str]:
        """What is odd about what sensors see, a line each."""
        total, lines = self._places + 1, []
        for what, found in (("no frame", self._no_frame), ("no feature", self._no_feature)):
            lines += [
                f"sensor {name!r} had {what} in {each.count} of {total} frames: {each.text()}"
                for name, each in found.items()
                if each.are_no_accident(total)
            ]
        lines += [
            f"sensor {name!r} found up to {self._most[name]} features, where {self._expected} are "
            f"expected, in {each.count} of {total} frames, none of them ok: {each.text()}; "
            "mixpose check says which key of [extract] to change"
            for name, each in self._flooded.items()
            if each.are_no_accident(total)
        ]
        lines += [
            f"sensor {name!r} shows the same as the frame before in frames {each.text()}, which "
            "contradicts the others: frozen, or frames doubled?"
            for name, each in self._same.items()
            if each.count
        ]
        far = {name: each for name, each in self._far.items() if each.longest >= _LONG}
        if far and any(line.endswith(offsets.MOVED) for line in self._of_markers()):
            far = {}  # what one marker makes is said of it
        for name, each in far.items():
            unit = "px" if self._setups[name].sensor.unit == "px" else self._session.unit
            lines.append(
                f"sensor {name!r} is met far off, against {median(self._usual[name]):.2g} {unit} "
                f"before, in {each.count} of {total} frames: {each.text()}: images torn or "
                "blurred, markers half hidden, or out of step?"
            )
        return lines

    def _of_doubts(self) -> list[str]:
        if self.change is not None:
            line = f"{self.change}, frames that are not ok would be ok"
            if self._goes_on:
                line += f"; before frame {self._doubted.found[-1][0]} it is not, or the body rests"
            return [line]
        total, lines = self._places + 1, []
        asked = {
            APART: f": {CAUSES}",
            ASIDE: ": is a part of it hidden, or does it have more rows or fewer than told?",
        }
        if self._agreed_before:
            asked[TWICE] = ": poses before may be of its mirror image; is there a mirror?"
        since = self._changed_since()
        if since is not None:
            lines.append(since[1])
        for doubt, each in self._doubts.items():
            if each.count <= self._frozen or (since is not None and each.found[0][0] >= since[0]):
                continue  # said of the sensor
            if each.count < _LONG and each.count <= total / 2:
                continue  # a frame here and there: clutter does that
            line = f"{doubt} in {each.count} of {total} frames, {each.text()}{asked.get(doubt, '')}"
            if doubt.startswith(TURNED) and each.count > total / 2:
                line += ": is a feature of [object] missing, or one too many?"
            lines.append(line)
        return lines

    def _changed_since(self) -> tuple[int, str] | None:
        """From which frame on all are in doubt, where it is most likely a sensor, and in words."""
        most = max(self._doubts, key=lambda doubt: self._doubts[doubt].count, default="")
        asked = {
            APART: "was one of them bumped?",
            CHANGED: "was a sensor bumped, or is it out of focus?",
        }
        if most not in asked or not self._goes_on:
            return None
        first = self._doubted.found[-1][0]
        return first, f"{most} from frame {first} on: {asked[most]}"

    @property
    def _frozen(self) -> int:
        """Frames in which sensors showed the same as before, and should not."""
        return sum(each.count for each in self._same.values())

    @property
    def _late(self) -> bool:
        """Whether frames were ok at first, as of a body at rest, which shows no delay."""
        return self._agreed_before >= _LONG

    @property
    def _goes_on(self) -> bool:
        """Whether frames were ok at first, and are in doubt up to the last one."""
        lasts = self._doubted.last_place == self._places
        return self._late and lasts and self._doubted.found[-1][2] >= _LONG

    @cached_property
    def change(self) -> str | None:
        """What the session should have said, where few frames are ok, and some doubted or lost."""
        doubted = sum(each.count for each in self._doubts.values())
        # a body that is there twice, most of the time, is no fault of the session
        twice = self._doubts.get(TWICE, Stretches()).count
        twice = twice if 2 * twice > doubted else 0
        few = self._ok <= (self._places + 1) / 2
        bad = self._places + 1 - self._ok - twice if doubted > twice or self._lost >= _LONG else 0
        if not few or bad < max(_LONG, self._frozen + 1) or len(self._session.labels) > 1:
            return None
        asked = late_sensor if self._late else explanation  # all else would have shown
        return asked(self._session, self._frames)

    def _of_markers(self) -> list[str]:
        lines = []
        for label, markers in self._markers.items():
            if (body := self._bodies.get(label)) is not None:
                of = f" of {label!r}" if len(self._bodies) > 1 else ""
                lines += offsets.marker_lines(markers, body.labels, of, self._session.unit)
        return lines
