"""Whether the geometry of a session explains a few frames of its recording."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from mixpose.body import Body
from mixpose.checking.changes import Change, called, of_units
from mixpose.checking.evidence import Frames, can_tell, estimate_of, evidence_of, pose_near
from mixpose.checking.keys import judge
from mixpose.checking.placement import Camera, expected_count, fewest_count
from mixpose.checking.recordings import Survey
from mixpose.checking.rules import DiagnosisRules
from mixpose.checking.trials import IN_A_ROW, Diagnosis, Otherwise, diagnosis, late_sensor
from mixpose.errors import RecordingError
from mixpose.frames import Source
from mixpose.frames.video import Video
from mixpose.judgement import APART
from mixpose.records import Estimate, FrameSet
from mixpose.runner import observe
from mixpose.sensors import CloudSensor
from mixpose.session import Session

CAUSES = (
    "is one of them out of step, or its calibration, T_sensor_world or source that of another? Or "
    "are points of [object] and translations in another unit, or of another size?"
)
"""Why sensors may contradict each other."""

_SEEN = 0.1  # of a sensor's density, from which it shows the body, even beside 60 false features
_LIKELY = 0.5  # confidence from which a pose that is not sure is more than clutter
_ROWS = 2  # of frames in a row that are asked for a sensor that is late; the body may rest in one
_FIRST = 40  # frames of videos among which they are: to get far into one takes as long as all of it


@dataclass(frozen=True)
class Doubts:
    """What frames tell of a session."""

    warnings: tuple[str, ...] = ()
    mended: Session | None = None  # that explains them: what is odd without it may follow
    tried: str = ""  # what came of frames by the session as it is; empty where none was estimated
    unexplained: str = ""  # frames that nothing explains, unless their features are wrong


def geometry_doubts(
    session: Session, sources: Mapping[str, Source], surveys: Mapping[str, Survey]
) -> Doubts:
    """What of a session of one body, and not of streams, is most likely wrong, by a few frames."""
    streams = any(
        each.kind == "live" or (isinstance(each, Video) and each.size is None)
        for each in sources.values()
    )
    tells = any(isinstance(one.sensor, Camera | CloudSensor) for one in session.sensors)
    if len(session.labels) > 1 or streams or not (tells or len(sources) > 1):
        return Doubts()
    recording, count = _Recording(session, sources, surveys), DiagnosisRules().frames
    frames = [(each.number, observe(session, each)) for each in recording.shared(count)]
    if not frames:
        return Doubts()
    chosen = [number for number, _ in frames]
    odd = _otherwise(recording, chosen)
    seen = [views for each in (frames, *(changed for _, changed in odd)) for _, views in each]
    if not any(can_tell(views, len(session.body)) for views in seen):
        return _at_the_start(recording)

    def further() -> Frames:
        """As many frames again, between those."""
        more = recording.shared(2 * count, set(chosen))
        found = [(each.number, observe(session, each)) for each in islice(more, count)]
        chosen.extend(number for number, _ in found)
        return found

    def otherwise(is_good: bool) -> Otherwise:
        """Where nothing is explained, also of as many features as there should be."""
        return odd if odd or is_good else _otherwise(recording, chosen, are_odd=False)

    found = diagnosis(session, frames, otherwise, further)
    if (told := _told(recording, frames, found)) is not None:
        return told
    doubts = _at_the_start(recording) if found.good or len(sources) == 1 else Doubts()
    numbers = ", ".join(map(str, sorted(chosen[: found.count])))
    met = f", features met to {found.rms:.2g} sigma in the median" if found.good else ""
    tried = f"{found.good} of {found.count} frames that were estimated ({numbers}) are explained"
    doubts = replace(doubts, tried=f"{tried}{met}")
    if not (found.good or doubts.warnings):
        return _nothing_explained(session, frames, doubts)
    if 2 * found.good < found.count:
        text = f"only {tried}: are the markers found there, and is the body in view?"
        doubts = replace(doubts, unexplained=f"{text} mixpose inspect shows a frame")
    return doubts


def _told(recording: _Recording, frames: Frames, found: Diagnosis) -> Doubts | None:
    """What frames tell to be wrong, None of nothing; of a sensor that is late those in a row."""
    session, change = recording.session, found.likeliest
    # it does as if it stood elsewhere: some values may suit it
    if (change.values if change else not found.good) and len(recording.sources) > 1:
        for number, _ in frames[:_ROWS]:
            row = [(each.number, observe(session, each)) for each in recording.in_a_row(number)]
            if late := late_sensor(session, row):
                text = f"{late}, features are met far closer, as in frame {row[0][0]}"
                return Doubts((text,), tried=text)
    if change is None:
        return None
    # where a cloud is in another unit, it is the table that is to be mended
    are_clouds = all(isinstance(one.sensor, CloudSensor) for one in session.sensors)
    mended = None if are_clouds else change.of(session, frames[0][1])
    return Doubts((f"{found.change}, {found.gain}",), mended, tried=found.gain)


@dataclass(frozen=True)
class _Recording:
    """The frames of a session, and what was found in them."""

    session: Session
    sources: Mapping[str, Source]
    surveys: Mapping[str, Survey]

    def shared(self, count: int, known: Container[int] = ()) -> Iterator[FrameSet]:
        """A few frames all over the recording, those that show most first, without those known."""
        shown = self._shown()

        def richness(number: int) -> float:
            return sum(each[number] for each in shown)

        numbers = self.numbers()  # which may be larger than those of NumPy
        parts = np.array_split(np.arange(len(numbers)), count)
        best = [max((numbers[k] for k in part), key=richness) for part in parts if len(part)]
        best = [number for number in best if number not in known]
        yield from self.read(sorted(best, key=lambda n: (-richness(n), n)))

    def numbers(self) -> list[int]:
        """Frames in which all sensors see something, or that they have."""
        shown = self._shown()
        full = [{n for n, count in each.items() if count} for each in shown]
        numbers = sorted(set.intersection(*full) or set.intersection(*[{*each} for each in shown]))
        is_video = any(isinstance(source, Video) for source in self.sources.values())
        return numbers[:_FIRST] if is_video else numbers

    def in_a_row(self, number: int) -> Iterator[FrameSet]:
        """That frame and the next ones, or the last ones, of those that all sensors have."""
        known = sorted(set.intersection(*({*each.numbers} for each in self.surveys.values())))
        first = max(min(known.index(number), len(known) - IN_A_ROW), 0)
        yield from self.read(known[first : first + IN_A_ROW])

    def _shown(self) -> list[dict[int, float]]:
        """How much of the body each frame may show, by sensor."""
        shown = []
        for setup in self.session.sensors:
            found = self.surveys[setup.name]
            counts = found.counts or [1] * len(found.counted)
            most = expected_count(setup, self.session)
            empty = {*found.empty, *(n for n, each in found.found.items() if not each.data.size)}
            pairs = zip(found.counted, counts, strict=True)
            shown.append({n: 0.0 if n in empty else float(min(k, most)) for n, k in pairs})
        return shown

    def read(self, numbers: Sequence[int]) -> Iterator[FrameSet]:
        """Frames with what was found in them; none after one that cannot be read."""
        for number in numbers:
            frames = {}
            for name, source in self.sources.items():
                if name in self.surveys and number in self.surveys[name].found:
                    frames[name] = self.surveys[name].found[number]
                    continue
                try:
                    with closing(source.frames(number, number + 1)) as found:
                        frames[name] = next(found)
                except (RecordingError, StopIteration):  # said of the recording
                    return
            times = (each.time_s for each in frames.values() if each.time_s is not None)
            yield FrameSet(number, next(times, None), frames)  # as they are paired


def _at_the_start(recording: _Recording) -> Doubts:
    """Whether the first frame has the body at [start] only if points are in another unit."""
    rules, session, start = DiagnosisRules(), recording.session, recording.session.start
    first = next(recording.read(recording.numbers()[:1]), None)
    if start is None or first is None:
        return Doubts()
    number, views, T = first.number, observe(session, first), start.T_world_object

    def evidence(body: Body) -> float:
        return evidence_of(pose_near(session, body, number, views, T))

    if evidence(session.body) > rules.sure:
        return Doubts()
    for change in of_units(session.body):
        if evidence(change.body(session.body)) > rules.sure + rules.margin:
            what = "points and translation of [start] are in two units of length"
            where = f"the body is at [start] in frame {number}"
            return Doubts((f"{what}: {change.remedy}, {where}",), change.of(session, views))
    return Doubts()


def _nothing_explained(session: Session, frames: Frames, doubts: Doubts) -> Doubts:
    """Why no frame is explained: sensors that contradict each other, few markers, or unknown."""
    doubt, shown, frames = "", list[Estimate](), frames[:2]
    for number, views in frames:
        estimate = estimate_of(session, number, views)
        doubt = estimate.doubt or doubt
        weights = sum(rival.weight for rival in estimate.hypotheses) or estimate.confidence or 0.0
        if estimate.status == "ok" or (estimate.status == "ambiguous" and weights > _LIKELY):
            shown.append(estimate)
    numbers = " and ".join(str(number) for number, _ in sorted(frames, key=lambda each: each[0]))
    where = f"frame{'s' * (len(frames) > 1)} {numbers}"
    is_ok = any(estimate.status == "ok" for estimate in shown)
    if doubt and not is_ok:
        causes = f": {CAUSES}" if doubt == APART else ""
        return replace(doubts, warnings=(f"{where}: {doubt}{causes}",))
    if is_ok or len(shown) == len(frames):
        least = min(estimate.confidence or 0.0 for estimate in shown)
        found = (
            f"{where}: the body is found, but not surely (confidence {least:.3g}): so few features "
            "may as well be met by chance, or at another pose; more markers or another sensor "
            "would tell"
        )
        return replace(doubts, unexplained=_by_some(shown[-1]) or ("" if is_ok else found))
    text = (
        f"{where}: the body is not found, by the session as it is or with any one change of it: is "
        "it in view, and are its markers found (mixpose inspect), or are several things wrong at "
        "once?"
    )
    return replace(doubts, unexplained=text)


def _by_some(estimate: Estimate) -> str:
    """What of a pose that is sure does not explain its frame: sensors that see none of it."""
    others = [name for name, one in estimate.sensors.items() if (one.explained or 0.0) < _SEEN]
    alone = [name for name in estimate.sensors if name not in others]
    if not others or not alone:
        return ""
    return (
        f"frame {estimate.frame}: {called(alone)} alone {'shows' if len(alone) == 1 else 'show'} "
        f"the body where {called(others)} {'does' if len(others) == 1 else 'do'} not see it, by "
        "the session as it is or with any one change of it: is it in view of all, or are several "
        "calibrations, T_sensor_world or sources those of others?"
    )


def _otherwise(recording: _Recording, numbers: Sequence[int], *, are_odd: bool = True) -> Otherwise:
    """Other polarity, and spots for corners, of images; where they hold too few or too many."""
    session, surveys = recording.session, recording.surveys
    for setup in session.sensors:
        counts, expected = surveys[setup.name].counts, expected_count(setup, session)
        in_images = setup.extract.method in ("blobs", "log", "corners")
        if not (counts and in_images) or surveys[setup.name].size is None:
            return []
        odd = judge(float(np.median(counts)), expected, fewest_count(setup, session))
        if are_odd and odd is None:
            return []
    given, found = session.sensors[0].extract, list[tuple[Change, Frames]]()
    if given.method == "corners":
        ways = [("method", "blobs", "spots and no corners")]
    else:
        polarity = "dark" if given.polarity == "bright" else "bright"
        ways = [("polarity", polarity, f"{polarity} in the images")]
        ways.append(("method", "corners", "corners and no spots"))
    anew = list(replace(recording, surveys={}).read(numbers))
    for key, value, what in ways:
        own = [setup.name for setup in session.sensors if key in setup.overridden]
        tables = ["[extract]"] if len(own) < len(session.sensors) else []
        tables += [f"[sensor.extract] of {called(own)}"] if own else []
        where = " and in ".join(tables)
        change = Change(f"features {{are}} {what}", f'with {key} = "{value}" in {where}')
        option: dict[str, Any] = {key: value}
        setups = [replace(s, extract=replace(s.extract, **option)) for s in session.sensors]
        changed = replace(session, sensors=tuple(setups))
        found.append((change, [(each.number, observe(changed, each)) for each in anew]))
    return found
