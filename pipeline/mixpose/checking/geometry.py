"""Test whether the geometry of a session explains a few frames of its recording."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from mixpose.body import Body
from mixpose.checking.changes import Change, point_units, quoted
from mixpose.checking.evidence import Frames, are_sufficient, estimate_of, evidence_of, pose_near
from mixpose.checking.keys import judge
from mixpose.checking.placement import Camera, expected_count, fewest_count
from mixpose.checking.recordings import Survey
from mixpose.checking.rules import DiagnosisRules
from mixpose.checking.trials import IN_A_ROW, Diagnosis, Extracted, diagnosis, late_sensor
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
"""Questions about why sensors contradict each other."""

_SEEN = 0.1  # of a sensor's density, from which it shows the body, even among 60 false features
_LIKELY = 0.5  # confidence from which a pose that is not sure is more than clutter
_ROWS = 2  # tries to find a late sensor, each in a row of frames; the body may be at rest in one
_FIRST = 40  # frames of videos that are used: seeking far takes as long as reading all before


@dataclass(frozen=True)
class Doubts:
    """The doubts about a session that frames raise."""

    warnings: tuple[str, ...] = ()
    mended: Session | None = None  # explains the frames; other oddities may be consequences
    tried: str = ""  # how many frames the session explains as it is; empty if none was estimated
    unexplained: str = ""  # warning if nothing explains frames, unless their features are wrong


def geometry_doubts(
    session: Session, sources: Mapping[str, Source], surveys: Mapping[str, Survey]
) -> Doubts:
    """Find the likeliest error of a session of one body, without streams, by a few frames."""
    has_streams = any(
        source.kind == "live" or (isinstance(source, Video) and source.size is None)
        for source in sources.values()
    )
    is_sufficient = any(isinstance(setup.sensor, Camera | CloudSensor) for setup in session.sensors)
    if len(session.labels) > 1 or has_streams or not (is_sufficient or len(sources) > 1):
        return Doubts()
    recording, count = _Recording(session, sources, surveys), DiagnosisRules().frames
    frames = [(frame.number, observe(session, frame)) for frame in recording.shared(count)]
    if not frames:
        return Doubts()
    chosen = [number for number, _ in frames]
    others = _extracted(recording, chosen)
    tries = (frames, *(changed for _, changed in others))
    if not any(are_sufficient(views, len(session.body)) for tried in tries for _, views in tried):
        return _start_doubts(recording)

    def further() -> Frames:
        """Return as many frames again, between those chosen already."""
        frame_sets = islice(recording.shared(2 * count, set(chosen)), count)
        more = [(frame.number, observe(session, frame)) for frame in frame_sets]
        chosen.extend(number for number, _ in more)
        return more

    def extracted(is_good: bool) -> Extracted:
        """Return other extractions; if nothing is explained, also for counts as expected."""
        return others if others or is_good else _extracted(recording, chosen, are_odd=False)

    best = diagnosis(session, frames, extracted, further)
    if (reported := _reported(recording, frames, best)) is not None:
        return reported
    doubts = _start_doubts(recording) if best.explained or len(sources) == 1 else Doubts()
    numbers = ", ".join(map(str, sorted(chosen[: best.count])))
    met = f", features met to {best.rms:.2g} sigma in the median" if best.explained else ""
    tried = f"{best.explained} of {best.count} frames that were estimated ({numbers}) are explained"
    doubts = replace(doubts, tried=f"{tried}{met}")
    if not (best.explained or doubts.warnings):
        return _nothing_explained(session, frames, doubts)
    if 2 * best.explained < best.count:
        text = f"only {tried}: are the markers found there, and is the body in view?"
        doubts = replace(doubts, unexplained=f"{text} mixpose inspect shows a frame")
    return doubts


def _reported(recording: _Recording, frames: Frames, result: Diagnosis) -> Doubts | None:
    """Report a late sensor, by frames in a row, else the likeliest change; None without both."""
    session, change = recording.session, result.likeliest
    # a late sensor looks as if it stood elsewhere: some values may suit it
    if (change.values if change else not result.explained) and len(recording.sources) > 1:
        for number, _ in frames[:_ROWS]:
            row = [(frame.number, observe(session, frame)) for frame in recording.in_a_row(number)]
            if late := late_sensor(session, row):
                text = f"{late}, features are met far closer, as in frame {row[0][0]}"
                return Doubts((text,), tried=text)
    if change is None:
        return None
    # if a cloud is in another unit, its table has to be mended and not the session
    are_clouds = all(isinstance(setup.sensor, CloudSensor) for setup in session.sensors)
    mended = None if are_clouds else change.apply(session, frames[0][1])
    return Doubts((f"{result.change}, {result.gain}",), mended, tried=result.gain)


@dataclass(frozen=True)
class _Recording:
    """The frames of a session, and the surveys of its sensors."""

    session: Session
    sources: Mapping[str, Source]
    surveys: Mapping[str, Survey]

    def shared(self, count: int, known: Container[int] = ()) -> Iterator[FrameSet]:
        """Yield frames all over the recording, those that show most first, without known ones."""
        shown = self._shown()

        def richness(number: int) -> float:
            return sum(counts[number] for counts in shown)

        numbers = self.numbers()  # may be too large for NumPy
        parts = np.array_split(np.arange(len(numbers)), count)
        best = [max((numbers[k] for k in part), key=richness) for part in parts if len(part)]
        best = [number for number in best if number not in known]
        yield from self.read(sorted(best, key=lambda n: (-richness(n), n)))

    def numbers(self) -> list[int]:
        """Return the frames in which all sensors see something, or else that all have."""
        shown = self._shown()
        full = [{n for n, count in counts.items() if count} for counts in shown]
        numbers = sorted(set.intersection(*full) or set.intersection(*map(set, shown)))
        is_video = any(isinstance(source, Video) for source in self.sources.values())
        return numbers[:_FIRST] if is_video else numbers

    def in_a_row(self, number: int) -> Iterator[FrameSet]:
        """Yield a frame and the next ones, or the last ones, of those that all sensors have."""
        known = sorted(set.intersection(*({*s.numbers} for s in self.surveys.values())))
        first = max(min(known.index(number), len(known) - IN_A_ROW), 0)
        yield from self.read(known[first : first + IN_A_ROW])

    def _shown(self) -> list[dict[int, float]]:
        """Estimate how many features of the body each frame shows, for every sensor."""
        shown = []
        for setup in self.session.sensors:
            survey = self.surveys[setup.name]
            counts = survey.counts or [1] * len(survey.counted)
            most = expected_count(setup, self.session)
            empty = {*survey.empty, *(n for n, f in survey.features.items() if not f.data.size)}
            pairs = zip(survey.counted, counts, strict=True)
            shown.append({n: 0.0 if n in empty else float(min(k, most)) for n, k in pairs})
        return shown

    def read(self, numbers: Sequence[int]) -> Iterator[FrameSet]:
        """Yield frames, with features if these were extracted; end at one that cannot be read."""
        for number in numbers:
            frames = {}
            for name, source in self.sources.items():
                if name in self.surveys and number in self.surveys[name].features:
                    frames[name] = self.surveys[name].features[number]
                    continue
                try:
                    with closing(source.frames(number, number + 1)) as raw_frames:
                        frames[name] = next(raw_frames)
                except (RecordingError, StopIteration):  # the survey reports it
                    return
            times = (frame.time_s for frame in frames.values() if frame.time_s is not None)
            yield FrameSet(number, next(times, None), frames)  # as `pair` does


def _start_doubts(recording: _Recording) -> Doubts:
    """Warn if the first frame has the body at [start] only with points in another unit."""
    rules, session, start = DiagnosisRules(), recording.session, recording.session.start
    first = next(recording.read(recording.numbers()[:1]), None)
    if start is None or first is None:
        return Doubts()
    number, views, T = first.number, observe(session, first), start.T_world_object

    def evidence(body: Body) -> float:
        return evidence_of(pose_near(session, body, number, views, T))

    if evidence(session.body) > rules.sure:
        return Doubts()
    for change in point_units(session.body):
        if evidence(change.body(session.body)) > rules.sure + rules.margin:
            what = "points and translation of [start] are in two units of length"
            where = f"the body is at [start] in frame {number}"
            return Doubts((f"{what}: {change.remedy}, {where}",), change.apply(session, views))
    return Doubts()


def _nothing_explained(session: Session, frames: Frames, doubts: Doubts) -> Doubts:
    """Say why no frame is explained: contradicting sensors, few markers, or an unknown cause."""
    doubt, shown, frames = "", list[Estimate](), frames[:2]
    for number, views in frames:
        estimate = estimate_of(session, number, views)
        doubt = estimate.doubt or doubt
        weights = sum(rival.weight for rival in estimate.hypotheses) or estimate.confidence or 0.0
        if estimate.status == "ok" or (estimate.status == "ambiguous" and weights > _LIKELY):
            shown.append(estimate)
    numbers = " and ".join(str(number) for number, _ in sorted(frames, key=lambda frame: frame[0]))
    where = f"frame{'s' * (len(frames) > 1)} {numbers}"
    is_ok = any(estimate.status == "ok" for estimate in shown)
    if doubt and not is_ok:
        causes = f": {CAUSES}" if doubt == APART else ""
        return replace(doubts, warnings=(f"{where}: {doubt}{causes}",))
    if is_ok or len(shown) == len(frames):
        least = min(estimate.confidence or 0.0 for estimate in shown)
        unsure = (
            f"{where}: the body is found, but not surely (confidence {least:.3g}): so few features "
            "may as well be met by chance, or at another pose; more markers or another sensor "
            "would tell"
        )
        return replace(doubts, unexplained=_seen_by_some(shown[-1]) or ("" if is_ok else unsure))
    text = (
        f"{where}: the body is not found, by the session as it is or with any one change of it: is "
        "it in view, and are its markers found (mixpose inspect), or are several things wrong at "
        "once?"
    )
    return replace(doubts, unexplained=text)


def _seen_by_some(estimate: Estimate) -> str:
    """Say which sensors do not see the body at a pose; empty if all do, or none."""
    blind = [name for name, seen in estimate.sensors.items() if (seen.explained or 0.0) < _SEEN]
    alone = [name for name in estimate.sensors if name not in blind]
    if not blind or not alone:
        return ""
    return (
        f"frame {estimate.frame}: {quoted(alone)} alone {'shows' if len(alone) == 1 else 'show'} "
        f"the body where {quoted(blind)} {'does' if len(blind) == 1 else 'do'} not see it, by "
        "the session as it is or with any one change of it: is it in view of all, or are several "
        "calibrations, T_sensor_world or sources those of others?"
    )


def _extracted(recording: _Recording, numbers: Sequence[int], *, are_odd: bool = True) -> Extracted:
    """Extract images with other polarity or method; with `are_odd` only if all counts are odd."""
    session, surveys = recording.session, recording.surveys
    for setup in session.sensors:
        counts, expected = surveys[setup.name].counts, expected_count(setup, session)
        in_images = setup.extract.method in ("blobs", "log", "corners")
        if not (counts and in_images) or surveys[setup.name].size is None:
            return []
        verdict = judge(float(np.median(counts)), expected, fewest_count(setup, session))
        if are_odd and verdict is None:
            return []
    options, changes = session.sensors[0].extract, list[tuple[Change, Frames]]()
    if options.method == "corners":
        ways = [("method", "blobs", "spots and no corners")]
    else:
        polarity = "dark" if options.polarity == "bright" else "bright"
        ways = [("polarity", polarity, f"{polarity} in the images")]
        ways.append(("method", "corners", "corners and no spots"))
    raw_frames = list(replace(recording, surveys={}).read(numbers))
    for key, value, what in ways:
        names = [setup.name for setup in session.sensors if key in setup.overridden]
        tables = ["[extract]"] if len(names) < len(session.sensors) else []
        tables += [f"[sensor.extract] of {quoted(names)}"] if names else []
        where = " and in ".join(tables)
        change = Change(f"features {{are}} {what}", f'with {key} = "{value}" in {where}')
        option: dict[str, Any] = {key: value}
        setups = [replace(s, extract=replace(s.extract, **option)) for s in session.sensors]
        changed = replace(session, sensors=tuple(setups))
        changes.append((change, [(f.number, observe(changed, f)) for f in raw_frames]))
    return changes
