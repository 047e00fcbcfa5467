"""Read the frames of a calibration from a session and its recording."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import replace

import numpy as np
from scipy.signal import find_peaks

from mixpose.body import Body
from mixpose.calibration.rig import Rig
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.task import Progress, SeenFrame
from mixpose.errors import RecordingError, SessionError
from mixpose.frames import ImageSequence, Source, numbers_of, pair, spread_over
from mixpose.objective import View
from mixpose.records import Floats, FrameSet, GridPattern, Indices, PointPattern
from mixpose.runner import merge_clouds, observe, open_sources
from mixpose.search import is_pointlike, peaks
from mixpose.session import Session

_HIGHEST = 0.3  # of a profile's highest peak: a lower one is noise
_RUN = 8  # frames read together if motion between them matters
_HELD_RUN = 4  # frames held back together likewise
_FARTHEST = 2.5  # spreads from the median, to which descriptors are clipped: probably clutter
_MEANS = 1e-3  # information before the first frame, on descriptors in units of their spreads


def rig_of(session: Session) -> Rig:
    """Return sensors and body of a session; a delay that is to be estimated is 0."""
    setups = session.sensors
    rig = Rig.of([setup.name for setup in setups], [setup.sensor for setup in setups], session.body)
    delays = [setup.delay if isinstance(setup.delay, float | int) else 0.0 for setup in setups]
    readouts = np.array([setup.readout for setup in setups], dtype=np.float64)
    return replace(rig, delays=np.array(delays, dtype=np.float64), readouts=readouts)


def require_times(frames: Sequence[SeenFrame], finding: str) -> None:
    """Raise a SessionError, which begins with the finding, if any frame has no time."""
    if any(frame.time_s is None for frame in frames):
        raise SessionError(f"{finding}; allowed: fps or times for every sensor, or a video")


def require_points(body: Body) -> None:
    """Raise a SessionError if detections of a body are not points."""
    if not is_pointlike(body):
        raise SessionError(
            "calibrate: object: found segments or spread features; allowed: points, which leave "
            "one detection each"
        )


def read_frames(
    session: Session,
    sources: Mapping[str, str],
    rules: CalibrationRules,
    progress: Progress,
    *,
    runs: bool,
    known: Collection[int] | None,
) -> tuple[SeenFrame, ...]:
    """Read a recording, or frames spread evenly over a long one, and select the most informative.

    `sources` replace those of the session. `runs` says whether neighbouring frames are needed, as
    motion between them matters; `known` are the frames with a known pose, or None; others are
    dropped. Raises RecordingError if a source is live or cannot be read, or no frame has a
    detection.
    """
    opened = open_sources(session, sources)
    live = [name for name, source in opened.items() if source.kind == "live"]
    if live:
        raise RecordingError(
            f"sensor {live[0]!r}: source: is live; allowed: a recording, as frames are read twice"
        )
    frames: list[SeenFrame] = []
    index = {setup.name: k for k, setup in enumerate(session.sensors)}
    wanted = _selected_numbers(opened, rules, runs=runs)
    length = max((source.length or 0 for source in opened.values()), default=0)
    total = length if wanted is None else len(wanted)
    opened = {name: _with_frames(source, wanted) for name, source in opened.items()}
    with closing(pair(opened)) as sets:
        for frame_set in sets:
            if wanted is not None and frame_set.number not in wanted:
                continue
            progress("reading frames", len(frames), total)
            if known is None or frame_set.number in known:
                seen = _seen(session, frame_set, index)
                if any(len(points) for points in seen.points.values()):
                    frames.append(seen)
    if not frames:
        raise RecordingError(
            f"{session.path}: found no feature in any frame; see what mixpose check says"
        )
    return informative(frames, len(index), rules.most_candidates, runs=runs)


def _selected_numbers(
    opened: Mapping[str, Source], rules: CalibrationRules, *, runs: bool
) -> set[int] | None:
    """Return evenly spread frame numbers, or runs of them, of a long recording; None for all."""
    by_source = [numbers_of(source) or set() for source in opened.values()]
    numbers = sorted(set[int]().union(*by_source))
    if max(map(len, by_source), default=0) <= rules.most_read:
        return None
    return {*spread_over(numbers, rules.most_read, _RUN if runs else 1)}


def _with_frames(source: Source, wanted: Collection[int] | None) -> Source:
    """Return a source without unwanted images, which take long to decode."""
    if wanted is None or not isinstance(source, ImageSequence):
        return source
    pairs = zip(source.paths, source.numbers, strict=True)
    kept = [(path, number) for path, number in pairs if number in wanted]
    if not kept:
        return source
    paths, numbers = zip(*kept, strict=True)
    return replace(source, paths=paths, numbers=numbers)


def _seen(session: Session, frame_set: FrameSet, index: Mapping[str, int]) -> SeenFrame:
    views = merge_clouds(session, frame_set, observe(session, frame_set))
    points = {index[view.name]: _points(view) for view in views}
    times = {
        index[name]: frame.time_s
        for name, frame in frame_set.frames.items()
        if frame.time_s is not None
    }
    return SeenFrame(frame_set.number, frame_set.time_s, points, times)


def _points(view: View) -> Floats:
    pattern = view.observation.pattern
    if isinstance(pattern, PointPattern):
        return pattern.points[pattern.weights > 0]
    if view.observation.dimension == 2:
        return peaks(pattern, view.observation.sigma)
    return _profile_peaks(pattern)


def _profile_peaks(pattern: GridPattern) -> Floats:
    """Return ranges (M, 1) of the peaks of a profile, by parabolas through their tops."""
    values = np.asarray(pattern.values[0], dtype=np.float64)
    highest = float(values.max(initial=0.0))
    if highest <= 0:
        return np.zeros((0, 1))
    tops, _ = find_peaks(values, height=_HIGHEST * highest, prominence=_HIGHEST * highest / 2)
    before, peak, after = values[tops - 1], values[tops], values[tops + 1]  # never at an end
    shift = 0.5 * (after - before) / np.maximum(2 * peak - before - after, 1e-12)
    places = pattern.origin[0] + pattern.step * (tops + np.clip(shift, -0.5, 0.5))
    return np.asarray(places[:, None])


def folds_of(count: int, rules: CalibrationRules, *, runs: bool) -> Indices:
    """Return fold numbers (count,) of frames held back together, a fifth at a time; -1 for none.

    Every fifth frame is in the same fold, or every fifth run of four.
    """
    period = round(1 / rules.held_back)
    if count - -(-count // period) < rules.least_frames:
        return np.full(count, -1)
    size = _HELD_RUN if runs and count >= _HELD_RUN * period else 1
    return np.asarray((np.arange(count) // size) % period)


def informative(
    frames: Sequence[SeenFrame], sensors: int, most: int, *, runs: bool
) -> tuple[SeenFrame, ...]:
    """Return at most `most` frames that add most information, in their order.

    Poses are not known yet.  The information of a frame depends on where, how large and how turned
    the body is in each sensor's view, as medians and second moments of detections show; one after
    the other, the frame is taken that adds most to the information on a model that is linear in
    these (D-optimal design).  So a body at rest for most of a recording is taken only a few times.
    If motion matters, frames are taken in runs of neighbours.
    """
    if len(frames) <= most:
        return tuple(frames)
    described = _descriptors(frames, sensors)
    size = _RUN if runs else 1
    groups = np.array_split(np.arange(len(frames)), -(-len(frames) // size))
    rows = np.array([described[group].mean(axis=0) for group in groups])
    if runs:  # motion within a run shows delays
        changes = np.array([described[group[-1]] - described[group[0]] for group in groups])
        rows = np.column_stack([rows, changes])
    rows = np.column_stack([np.ones(len(rows)), rows])
    inverse = np.eye(rows.shape[1]) / _MEANS
    remaining = np.ones(len(rows), dtype=np.bool_)
    chosen: list[int] = []
    while remaining.any() and len(chosen) + size <= most:
        gains = np.einsum("ki,ij,kj->k", rows, inverse, rows, optimize=True)
        best = int(np.argmax(np.where(remaining, gains, -1.0)))
        remaining[best] = False
        chosen += groups[best].tolist()
        along = inverse @ rows[best]
        inverse = inverse - np.outer(along, along) / (1 + gains[best])
    return tuple(frames[k] for k in sorted(chosen))


def _descriptors(frames: Sequence[SeenFrame], sensors: int) -> Floats:
    """Return medians and second moments of detections (K, D), in their spreads; 0 for none."""
    columns = []
    for sensor in range(sensors):
        seen = [k for k, frame in enumerate(frames) if len(frame.points.get(sensor, ()))]
        if not seen:
            continue
        values = np.array([_moments(frames[k].points[sensor]) for k in seen])
        middle = np.median(values, axis=0)
        spread = np.median(np.abs(values - middle), axis=0) + 1e-3 * np.ptp(values, axis=0) + 1e-12
        column = np.zeros((len(frames), values.shape[1] + 1))
        column[seen, :-1] = np.clip((values - middle) / (1.5 * spread), -_FARTHEST, _FARTHEST)
        column[seen, -1] = 1.0
        columns.append(column)
    return np.concatenate(columns, axis=1)


def _moments(points: Floats) -> Floats:
    """Return the median and, in two dimensions, half the log spread, elongation and direction."""
    middle = np.median(points, axis=0)
    offsets = points - middle
    second = (offsets.T @ offsets) / len(points)
    size = float(np.trace(second)) + 1e-12
    if points.shape[1] == 1:
        return np.array([middle[0], np.log(size) / 2])
    shape = np.array([second[0, 0] - second[1, 1], 2 * second[0, 1]]) / size
    return np.array([*middle, np.log(size) / 2, *shape])
