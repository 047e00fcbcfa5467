"""Run a session: estimate the poses of a recording, frame by frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from mixpose.density import Observation
from mixpose.errors import SessionError
from mixpose.extraction import Window, extract_together
from mixpose.frames import SensorKind, Source, SourceSpec, open_source, pair, paired_by_stamp
from mixpose.limits import MOST_DETECTIONS
from mixpose.objective import View
from mixpose.records import (
    Estimate,
    Floats,
    FrameSet,
    GridPattern,
    PointPattern,
    RawFrame,
    SensorReport,
    replace,
)
from mixpose.selection import Selection
from mixpose.sensors import CloudSensor, perturbed
from mixpose.threads import one_blas_thread, prompt_switching
from mixpose.tracking import (
    DelayEvidence,
    Scene,
    Track,
    Tracker,
    WindowedScene,
    labelled,
    plane_names,
    plane_views,
    with_clouds,
)

if TYPE_CHECKING:
    from mixpose.body import Body
    from mixpose.sensors import Sensor
    from mixpose.session import SensorSetup, Session, Start

Watch: TypeAlias = Callable[[FrameSet, Sequence[View], Estimate], None]
Starts: TypeAlias = Mapping[str, Floats]

LEAST_DELAY_S = 1e-6
"""Frames of sensors that differ by less are simultaneous."""

_KINDS: dict[str, SensorKind] = {"lateration": "lateration", "cloud": "cloud"}
"""Kind of source of sensors that are no cameras, by their model."""


@dataclass(frozen=True)
class Memory:
    """The state of a run between two frames."""

    tracks: tuple[Track, ...]  # one per body


Remember: TypeAlias = Callable[[Memory], None]


def run(
    session: Session,
    *,
    sources: Mapping[str, str | PathLike[str]] | None = None,
    opened: Mapping[str, Source] | None = None,
    selection: Selection = Selection(),
    T_start: Floats | Starts | None = None,
    watch: Watch | None = None,
    memory: Memory | None = None,
    remember: Remember | None = None,
    labels: bool = False,
) -> Generator[Estimate, None, None]:
    """Estimate the poses of every frame of a recording, one per body.

    The recording is opened at once; frames are read when the next estimate is requested.

    Parameters
    ----------
    session : Session
    sources : mapping of str to str or path, or None
        Recordings that replace those of the session, by sensor name; relative to the working
        directory.
    opened : mapping of str to Source or None
        Recordings that `open_sources` opened already, in place of `sources`.
    selection : Selection
    T_start : (4, 4) array, mapping of str to (4, 4) array, or None
        Start pose that replaces the session's ``[start]``; of several bodies by their labels.
    watch : callable or None
        Called as ``watch(frame_set, views, estimate)`` before each estimate is yielded, with the
        raw frames and the features extracted from them, while tracking around the bodies only; its
        time is not in the latency.
    memory : Memory or None
        State of a run after the frame before the first of `selection`; None to begin anew.
    remember : callable or None
        Called with the state after a frame, before its first estimate is yielded.
    labels : bool
        Whether estimates hold the detection of each feature (`SensorReport.labels`), and the
        positions of features in space by these alone (`Estimate.points`).

    Returns
    -------
    generator of Estimate
        Yielded when a frame is done, by ascending frame number; bodies in the session's order.

    Raises
    ------
    SessionError
        If the session names no source for a sensor or lacks a body of `T_start`, or frames are
        selected by other than whole numbers.
    ValueError
        If `T_start` is no rotation and translation.
    RecordingError
        At once, if a recording cannot be opened or its table of times lacks rows; later, in place
        of the first frame that cannot be read.
    """
    if opened is None:
        opened = open_sources(session, sources or {})
    if session.estimator.search is None:
        live = all(source.kind == "live" for source in opened.values())
        options = replace(session.estimator, search="live" if live else "thorough")
        session = replace(session, estimator=options)
    if T_start is None or isinstance(T_start, Mapping):
        starts = T_start or {}
    else:
        starts = {session.labels[0]: T_start}
    if unknown := sorted(set(starts) - set(session.labels)):
        allowed = ", ".join(session.labels)
        raise SessionError(f"T_start: no body {unknown[0]!r}; allowed: {allowed}")
    scene = scene_of(session, starts)
    frames = pair(opened, selection.start, selection.stop, selection.step)
    initial = Memory(scene.begin()) if memory is None else memory
    return _estimates(session, scene, initial, frames, watch, remember, labels=labels)


def scene_of(session: Session, starts: Starts | None = None) -> Scene:
    """Make the scene of a session's bodies; `starts` replace its start poses, by label."""
    bodies = []
    for setup in session.objects:
        for instance, label in zip(setup.instances, setup.labels, strict=True):
            start, T_start = setup.start if not instance else None, (starts or {}).get(label)
            T_held = None if setup.start is None else setup.start.T_world_object
            inputs = session, setup.body, start, T_start
            bodies.append(_tracker(Tracker.about_centre, *inputs, instance=instance, T_held=T_held))
    return Scene(tuple(bodies))


def begin(session: Session, T_start: Floats | None = None) -> tuple[Tracker, Track]:
    """Return the tracker of a session's first body, and its track before the first frame."""
    tracker = _tracker(Tracker.create, session, session.body, session.start, T_start)
    return tracker, tracker.begin()


def _tracker(
    make: Callable[..., Tracker],
    session: Session,
    body: Body,
    start: Start | None,
    T_start: Floats | None,
    **options: Any,
) -> Tracker:
    if T_start is None and start is not None:
        T_start = start.T_world_object
    return make(
        body,
        session.estimator,
        T_start,
        rotation_deg=start.rotation_deg if start else None,
        distance=start.distance if start else None,
        **options,
    )


def open_sources(
    session: Session, replaced: Mapping[str, str | PathLike[str]]
) -> dict[str, Source]:
    """Open the recordings of all sensors.

    Raises SessionError if a replaced sensor is not in the session, or a sensor has no source.
    Raises RecordingError if a recording cannot be opened.
    """
    names = [setup.name for setup in session.sensors]
    for name in replaced:
        if name not in names:
            raise SessionError(f"--source {name}=...: no such sensor, allowed: {', '.join(names)}")
    opened = {
        setup.name: open_source(source_spec(session, setup, replaced.get(setup.name)))
        for setup in session.sensors
    }
    return paired_by_stamp(opened)


def source_spec(
    session: Session, setup: SensorSetup, replaced: str | PathLike[str] | None
) -> SourceSpec:
    """Return the specification of the source that a sensor's frames are read from."""
    if replaced is None and not setup.source:
        raise SessionError(
            f"{session.path}: sensor {setup.name!r}: source: found none, name the recording here "
            f"or with --source {setup.name}=PATH"
        )
    return SourceSpec(
        sensor=setup.name,
        source=setup.source if replaced is None else fspath(replaced),
        base=session.folder if replaced is None else Path(),
        kind=_KINDS.get(setup.model, "camera"),
        resolution=setup.resolution,
        times=setup.times,
        fps=setup.fps,
        range_min=setup.range_min,
        bin_size=setup.bin_size,
    )


def _estimates(
    session: Session,
    scene: Scene,
    memory: Memory,
    frames: Generator[FrameSet, None, None],
    watch: Watch | None,
    remember: Remember | None,
    *,
    labels: bool,
) -> Generator[Estimate, None, None]:
    windowed, tracks = WindowedScene(scene, _windowed(session)), memory.tracks
    bodies = {setup.body.name: setup.body for setup in session.objects}
    clouds, names = clouds_of(session), [setup.name for setup in session.sensors]
    with closing(frames):
        for frame_set in frames:
            raw_frames = frame_set.frames.items()
            images = {name for name, frame in raw_frames if isinstance(frame.data, np.ndarray)}
            start_s = time.perf_counter()
            with one_blas_thread(), prompt_switching():
                tracks, estimates, views = windowed.advance(
                    tracks,
                    frame_set.number,
                    frame_set.time_s,
                    partial(observe, session, frame_set),
                    images,
                )
            latency_ms = 1e3 * (time.perf_counter() - start_s)
            views = merge_clouds(session, frame_set, views)
            observations = {view.name: view.observation for view in views}
            for k, by_planes in enumerate(estimates):
                estimate = with_clouds(by_planes, clouds)
                if labels:
                    estimate = labelled(estimate, observations, bodies[estimate.object])
                # sensors without a frame have a report, too
                reports = {name: estimate.sensors.get(name, SensorReport(False)) for name in names}
                tip = bodies[estimate.object].tip
                estimate = replace(estimate, latency_ms=latency_ms, tip_object=tip, sensors=reports)
                if watch is not None:
                    watch(frame_set, views, estimate)
                if remember is not None and k == 0:
                    remember(Memory(tracks))
                yield estimate


def _windowed(session: Session) -> dict[str, Sensor]:
    """Return the cameras whose features in a window are those of the whole frame.

    The other rules for a threshold depend on the whole image: on its histogram, or on its size.
    """
    return {
        setup.name: setup.sensor
        for setup in session.sensors
        if setup.model not in _KINDS
        and setup.extract.method == "blobs"
        and (setup.extract.threshold == "auto" or not isinstance(setup.extract.threshold, str))
    }


def observe(
    session: Session, frame_set: FrameSet, windows: Mapping[str, Window] | None = None
) -> list[View]:
    """Extract the features of every sensor that has a frame, only in its window if it has one."""
    views = []
    frames = frame_set.frames
    for setup, observation in _observations(session, session.sensors, frames, windows or {}):
        views += plane_views(_view(setup, observation, frame_set, frames[setup.name]))
    return views


def _view(
    setup: SensorSetup, observation: Observation, frame_set: FrameSet, frame: RawFrame
) -> View:
    """Make the view of a sensor, with its delay against the time of the frame set."""
    delay = 0.0
    if frame.time_s is not None and frame_set.time_s is not None:
        delay = frame.time_s - frame_set.time_s
    delay = delay if abs(delay) > LEAST_DELAY_S else 0.0
    stated_delay = 0.0 if setup.delay == "estimate" else setup.delay
    error = setup.calibration_error
    if (setup.delay or setup.readout) and frame_set.time_s is None:
        key = "delay" if setup.delay else "readout"
        raise SessionError(
            f"sensor {setup.name!r}: {key}: stands without times; add fps, or times with a row for "
            "each frame"
        )
    return View(
        setup.name,
        setup.sensor,
        observation,
        delay + stated_delay,
        setup.readout,
        DelayEvidence.unknown_s if setup.delay == "estimate" else None,
        doubts=perturbed(setup.sensor, error) if error else (),
    )


def observation_of(session: Session, setup: SensorSetup, frame: RawFrame) -> Observation:
    """Return the feature pattern of one sensor's frame, with the width of its features."""
    return _observations(session, [setup], {setup.name: frame}, {})[0][1]


def _observations(
    session: Session,
    setups: Sequence[SensorSetup],
    frames: Mapping[str, RawFrame],
    windows: Mapping[str, Window],
) -> list[tuple[SensorSetup, Observation]]:
    """Return the observations of all sensors that have a frame; images are extracted together."""
    images, observations = {}, []
    available = [(setup, frames[setup.name].data) for setup in setups if setup.name in frames]
    for setup, data in available:
        if isinstance(data, np.ndarray):
            _refuse_code(session, setup.extract.method)
            images[setup.name] = data, setup.extract, windows.get(setup.name)
    patterns = extract_together(images, base=session.folder)
    for setup, data in available:
        options = setup.extract
        pattern = patterns[setup.name] if isinstance(data, np.ndarray) else data
        if isinstance(pattern, GridPattern):
            # noise makes profiles negative in places; clipping would leave a floor of noise
            width = float(np.hypot(options.sigma, options.spot_sigma))
            observation = Observation(pattern, width, intrinsic=options.spot_sigma)
        elif setup.name in patterns and len(pattern.points) > MOST_DETECTIONS:
            # flooded with light or noise: no detection can be distinguished from others
            empty = PointPattern(pattern.points[:0], pattern.weights[:0])
            observation = Observation(empty, options.sigma, passed_over=pattern.size)
        else:
            observation = Observation(pattern, options.sigma)
        observations.append((setup, observation))
    return observations


def _refuse_code(session: Session, method: str) -> None:
    """Refuse code that a session file names unless that was allowed: the file may be anyone's."""
    if ":" in method and not session.allow_code:
        raise SessionError(
            f'{session.path}: extract.method: "{method}" runs code of a module that the session '
            "names; if you trust it, add --allow-code (in Python: load_session(..., "
            "allow_code=True))"
        )


def clouds_of(session: Session) -> dict[str, CloudSensor]:
    """Return the cloud sensors of a session by name."""
    sensors = {setup.name: setup.sensor for setup in session.sensors}
    return {name: sensor for name, sensor in sensors.items() if isinstance(sensor, CloudSensor)}


def merge_clouds(session: Session, frame_set: FrameSet, views: list[View]) -> list[View]:
    """Replace the three image views of each cloud by one view in space."""
    clouds = clouds_of(session)
    if not clouds:
        return views
    by_name = {view.name: view for view in views}
    for setup in session.sensors:
        frame = frame_set.frames.get(setup.name)
        if setup.name in clouds and frame is not None:
            observation = observation_of(session, setup, frame)
            by_name[setup.name] = _view(setup, observation, frame_set, frame)
            for name in plane_names(setup.name):
                by_name.pop(name)
    return list(by_name.values())
