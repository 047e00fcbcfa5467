"""Find out during a run which sensor, marker or frames of the recording are at fault.

All is kept as sums and stretches of frames, so that a run of any length needs little memory.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from statistics import median
from typing import Any

from numpy.typing import NDArray

from mixpose.body import ASIDE, TURNED
from mixpose.checking import CAUSES, explanation, judge, late_sensor
from mixpose.cli import marker_offsets as offsets
from mixpose.cli.marker_offsets import BodySize, Marker
from mixpose.frames.source import is_same, shown_by
from mixpose.judgement import APART
from mixpose.objective import View
from mixpose.records import DelayEstimate, Estimate, FrameSet
from mixpose.session import Session
from mixpose.tracking import CHANGED, OUT_OF_STEP, TWICE, plane_views

_LONG = 3  # frames in a row that are no accident
_OFTEN = 0.2  # share of all frames that is no accident either, in a row or not
_FEWEST = 10  # frames with residuals of a sensor before it is judged
_FAR = 10.0  # times the usual residual of a sensor: its features are met far off
_AT_LEAST = 0.2  # smallest residual for that, in sigma
_USUAL = 100  # latest frames whose median residual is the usual one
_KEPT = 3  # frames kept to be tried with changed sessions
_SHOWN = 3  # stretches that are named in a message
_SURELY_LATE = 6.0  # standard deviations
_LATE_S = 5e-4  # smaller delays are rarely worth a key in the session


@dataclass
class Stretches:
    """Frames with a property: their number, the longest stretches and the last, in their order."""

    count: int = 0  # frames
    kept: list[list[int]] = field(default_factory=list)  # first and last frame, number of frames
    dropped: int = 0  # stretches that are not kept
    last_place: int = -2  # of the last frame, in the run

    def add(self, frame: int, place: int) -> None:
        """Add a frame, the `place`-th of the run."""
        if place == self.last_place:
            return
        if self.kept and place == self.last_place + 1:
            self.kept[-1][1:] = [frame, self.kept[-1][2] + 1]
        else:
            if len(self.kept) > _SHOWN:  # the shortest will not be named any more
                self.kept.remove(min(reversed(self.kept), key=lambda stretch: stretch[2]))
                self.dropped += 1
            self.kept.append([frame, frame, 1])
        self.count, self.last_place = self.count + 1, place

    @property
    def longest(self) -> int:
        """Number of frames of the longest stretch."""
        return max((stretch[2] for stretch in self.kept), default=0)

    def are_no_accident(self, total: int) -> bool:
        """Test whether the frames are in a row, or many of the `total` frames of a run."""
        return self.longest >= _LONG or self.count > _OFTEN * total

    def text(self) -> str:
        """Return the frames in words; only the longest stretches if there are many."""
        chosen = sorted(sorted(self.kept, key=lambda stretch: -stretch[2])[:_SHOWN])
        parts = [f"{a}" if a == b else f"{a} to {b}" for a, b, _ in chosen]
        others = self.dropped + len(self.kept) - len(chosen)
        return ", ".join(parts) + (f" and {others} more" if others else "")


class Findings:
    """Statistics over the frames of a run, and the messages that follow from them."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._places = -1
        self.statuses = Counter[str]()  # of all poses
        self._setups = {setup.name: setup for setup in session.sensors}
        self._bodies = session.bodies
        stretches = [{name: Stretches() for name in self._setups} for _ in range(5)]
        self._no_frame, self._no_feature, self._flooded, self._repeated, self._far = stretches
        self._most = dict.fromkeys(self._setups, 0)  # features of one frame
        self._expected = sum(map(len, self._bodies.values()))
        self._usual = {name: deque[float](maxlen=_USUAL) for name in self._setups}
        self._shown: dict[str, NDArray[Any]] = {}
        self._repeating: set[str] = set()  # sensors that show the same as in the frame before
        self._doubts: dict[str, Stretches] = {}
        self._doubted = Stretches()  # frames that are ambiguous, or with any doubt
        self._markers: dict[str, dict[int, Marker]] = {}
        self._sizes = {label: BodySize(session, body.means) for label, body in self._bodies.items()}
        self._frames: list[tuple[int, list[View]]] = []
        self._agreed_before = 0
        self.stated_delays = {setup.name: setup.delay for setup in session.sensors}
        self.delays: Mapping[str, DelayEstimate] = {}  # of the last frame that has any

    @property
    def late(self) -> dict[str, float]:
        """The stated delays of sensors whose estimated delay is surely another."""
        return {
            name: stated
            for name, delay in self.delays.items()
            if not isinstance(stated := self.stated_delays.get(name, 0.0), str)
            and abs(delay.seconds) > max(_SURELY_LATE * delay.deviation, _LATE_S)
        }

    def watch(self, frame_set: FrameSet, views: Sequence[View], estimate: Estimate) -> None:
        """Record frames and features of the sensors; called before `add`."""
        if estimate.label != self._session.labels[0]:
            return
        self._repeating = set()
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
                    self._repeating.add(name)
                self._shown[name] = shown
        is_lost = estimate.status == "lost"
        is_telling = (bool(seen) and not flooded) if is_lost else len(seen) > 1
        if estimate.status != "ok" and len(self._frames) < _KEPT and is_telling:
            planes = [plane for view in views for plane in plane_views(view)]
            self._frames.append((frame_set.number, planes))

    def _too_many(self, views: Sequence[View]) -> dict[str, int]:
        counts = {
            view.name: view.observation.found
            for view in views
            if view.name in self._flooded and view.observation.points is not None
        }
        return {n: k for n, k in counts.items() if judge(k, self._expected) == "too many"}

    def add(self, estimate: Estimate) -> None:
        """Add the estimate of a body in a frame to the statistics."""
        if estimate.label == self._session.labels[0]:
            self._places += 1
        self.delays = estimate.delays or self.delays
        self.statuses[estimate.status] += 1
        self._add_repeats(estimate)
        if estimate.doubt or estimate.status == "ambiguous":
            self._doubted.add(estimate.frame, self._places)
        if estimate.doubt:
            self._doubts.setdefault(estimate.doubt, Stretches()).add(estimate.frame, self._places)
        elif estimate.status == "ok":
            self._agreed_before += not self._doubts
            self._add_residuals(estimate)
            offsets.add_markers(self._markers.setdefault(estimate.label, {}), estimate)
            if estimate.label in self._sizes:
                self._sizes[estimate.label].add(estimate)

    def _add_repeats(self, estimate: Estimate) -> None:
        """Count repeated frames of sensors that contradict others, once for all bodies."""
        out_of_step = {n for n, report in estimate.sensors.items() if report.why == OUT_OF_STEP}
        contradicting = self._repeating if estimate.doubt else self._repeating & out_of_step
        for name in contradicting:
            self._repeated[name].add(estimate.frame, self._places)
        self._repeating = self._repeating - contradicting

    def _add_residuals(self, estimate: Estimate) -> None:
        if estimate.label != self._session.labels[0]:
            return
        rms_by_sensor = estimate.weighted_rms
        for name, report in estimate.sensors.items():
            usual, rms = self._usual[name], rms_by_sensor[name]
            if rms is None or not report.used:
                continue
            sigma = self._setups[name].extract.sigma
            is_judged = rms >= _AT_LEAST * sigma and len(usual) >= _FEWEST
            if is_judged and rms > _FAR * median(usual):
                self._far[name].add(estimate.frame, self._places)
            else:
                usual.append(rms)

    def causes(self) -> list[str]:
        """Return lines about likely faults of the session and the bodies."""
        sizes = offsets.size_warnings(self._sizes)
        # if the size of a body is wrong, all of its markers seem displaced
        return [*self._doubt_lines(), *(sizes or self._marker_lines())]

    def explain_idle(self, causes: Iterable[str]) -> bool:
        """Test whether causes say why a sensor explains nothing."""
        return self.change is not None or any(APART in line for line in causes)

    def sensor_lines(self) -> list[str]:
        """Return lines about missing, repeated or odd frames and features of sensors."""
        total = self._places + 1
        lines = [
            f"sensor {name!r} had {what} in {frames.count} of {total} frames: {frames.text()}"
            for what, by_sensor in (("no frame", self._no_frame), ("no feature", self._no_feature))
            for name, frames in by_sensor.items()
            if frames.are_no_accident(total)
        ]
        lines += [
            f"sensor {name!r} found up to {self._most[name]} features, where {self._expected} are "
            f"expected, in {frames.count} of {total} frames, none of them ok: {frames.text()}; "
            "mixpose check says which key of [extract] to change"
            for name, frames in self._flooded.items()
            if frames.are_no_accident(total)
        ]
        lines += [
            f"sensor {name!r} shows the same as the frame before in frames {frames.text()}, which "
            "contradicts the others: frozen, or frames doubled?"
            for name, frames in self._repeated.items()
            if frames.count
        ]
        far = {name: frames for name, frames in self._far.items() if frames.longest >= _LONG}
        if far and any(line.endswith(offsets.MOVED) for line in self._marker_lines()):
            far = {}  # a displaced marker is the cause, and is reported
        for name, frames in far.items():
            unit = "px" if self._setups[name].sensor.unit == "px" else self._session.unit
            lines.append(
                f"sensor {name!r} is met far off, against {median(self._usual[name]):.2g} {unit} "
                f"before, in {frames.count} of {total} frames: {frames.text()}: images torn or "
                "blurred, markers half hidden, or out of step?"
            )
        return lines

    def _doubt_lines(self) -> list[str]:
        if self.change is not None:
            line = f"{self.change}, frames that are not ok would be ok"
            if self._ends_in_doubt:
                line += f"; before frame {self._doubted.kept[-1][0]} it is not, or the body rests"
            return [line]
        total, lines = self._places + 1, []
        hints = {
            APART: ": one is out of step, as told below" if self.late else f": {CAUSES}",
            ASIDE: ": is a part of it hidden, or does it have more rows or fewer than told?",
        }
        if self._agreed_before:
            hints[TWICE] = ": poses before may be of its mirror image; is there a mirror?"
        first, text = self._changed_since() or (math.inf, "")
        lines += [text] if text else []
        for doubt, frames in self._doubts.items():
            if frames.count <= self._repeat_count or frames.kept[0][0] >= first:
                continue  # reported as a frozen or changed sensor
            if frames.count < _LONG and frames.count <= total / 2:
                continue  # clutter may cause single frames
            line = f"{doubt} in {frames.count} of {total} frames, {frames.text()}"
            line += hints.get(doubt, "")
            if doubt.startswith(TURNED) and frames.count > total / 2:
                line += ": is a feature of [object] missing, or one too many?"
            lines.append(line)
        return lines

    def _changed_since(self) -> tuple[int, str] | None:
        """Return the frame since which all are in doubt, with a text, if a sensor is the cause."""
        most = max(self._doubts, key=lambda doubt: self._doubts[doubt].count, default="")
        hints = {
            APART: "was one of them bumped?",
            CHANGED: "was a sensor bumped, or is it out of focus?",
        }
        if most not in hints or not self._ends_in_doubt:
            return None
        first = self._doubted.kept[-1][0]
        return first, f"{most} from frame {first} on: {hints[most]}"

    @property
    def _repeat_count(self) -> int:
        return sum(frames.count for frames in self._repeated.values())

    @property
    def _began_ok(self) -> bool:
        """Whether frames were ok at first, as if the body rested, which hides a delay."""
        return self._agreed_before >= _LONG

    @property
    def _ends_in_doubt(self) -> bool:
        """Whether frames were ok at first and are in doubt up to the last one."""
        lasts = self._doubted.last_place == self._places
        return self._began_ok and lasts and self._doubted.kept[-1][2] >= _LONG

    @cached_property
    def change(self) -> str | None:
        """The change of the session that explains why few frames are ok; None if none does."""
        doubted = sum(frames.count for frames in self._doubts.values())
        # if most doubts are about a second body that looks alike, the session is not at fault
        twice = self._doubts.get(TWICE, Stretches()).count
        twice = twice if 2 * twice > doubted else 0
        few = self.statuses["ok"] <= (self._places + 1) / 2
        is_asked = doubted > twice or self.statuses["lost"] >= _LONG
        bad = self._places + 1 - self.statuses["ok"] - twice if is_asked else 0
        if not few or bad < max(_LONG, self._repeat_count + 1) or len(self._session.labels) > 1:
            return None
        # other causes would have shown earlier, or are not needed beside a delay
        explain = late_sensor if self._began_ok or self.late else explanation
        return explain(self._session, self._frames)

    def _marker_lines(self) -> list[str]:
        lines = []
        for label, markers in self._markers.items():
            if (body := self._bodies.get(label)) is not None:
                of = f" of {label!r}" if len(self._bodies) > 1 else ""
                lines += offsets.marker_lines(markers, body.labels, of, self._session.unit)
        return lines
