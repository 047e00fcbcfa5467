"""Search the body before anything is adjusted: by one camera alone, or by all sensors together.

Sensors that determine no pose alone, ranges or parallel beams, are taken to stand about where the
session has them.  Blurs wider than σ_ε allow for their errors until the rig can be adjusted.
"""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.task import NOTHING, Hypotheses, Known, Progress, SeenFrame, Task, silent
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions
from mixpose.objective import View
from mixpose.records import Floats, PointPattern
from mixpose.rigid import TWIST_NAMES, inverse
from mixpose.tracking import Tracker, plane_views

_LEAST = 4  # detections: three leave four poses of any triangle
MARK = '{"mixpose-calibration": '


class PosedFrame(NamedTuple):
    """A frame and the pose of the body."""

    frame: SeenFrame
    T_world_object: Floats  # (4, 4)
    is_sure: bool = True  # whether the pose is ok


def search_cameras(task: Task, rules: CalibrationRules, progress: Progress, known: Known) -> Known:
    """Return hypotheses of every camera and frame; those in `known` are kept, others added."""
    wanted = [(f, sensor) for f in task.frames for sensor in task.cameras if sensor in f.points]
    for done, (frame, sensor) in enumerate(wanted):
        progress("searching the body in each camera alone", done, len(wanted))
        if (frame.number, sensor) not in known:
            known[frame.number, sensor] = _hypotheses(task, sensor, frame.points[sensor], rules)
    return known


def _hypotheses(task: Task, sensor: int, points: Floats, rules: CalibrationRules) -> Hypotheses:
    """Search the body in a camera's detections (M, m)."""
    if len(points) < _LEAST:
        return NOTHING
    view = _view(task, sensor, points, 1.0)
    # the world is put where the camera is, so that poses are relative to it
    camera = view.sensor.moved(inverse(view.sensor.T_sensor_world))  # type: ignore[attr-defined]
    views = plane_views(View(view.name, camera, view.observation))
    tracker = Tracker.create(task.rig.body, EstimatorOptions())
    ranked = tracker.explain(tracker.data(tracker.begin(), 0, None, views))
    strongest = ranked[0].log_evidence if ranked else 0.0
    likely = [pose for pose in ranked if pose.log_evidence > max(strongest - rules.margin, 0.0)]
    likely = likely[: rules.hypotheses]
    poses = np.array([pose.T_world_object for pose in likely]).reshape(-1, 4, 4)
    return Hypotheses(poses, np.array([pose.log_evidence for pose in likely]))


def posed_frames(task: Task, factor: float = 1.0, progress: Progress = silent) -> list[PosedFrame]:
    """Return frames with poses of all sensors together, at a blur of `factor` times σ_ε."""
    free = tuple(name for name, is_free in zip(TWIST_NAMES, task.pose_free, strict=True) if is_free)
    turn, distance = task.around
    options = EstimatorOptions(free=free, fuse=task.fuse)
    tracker = Tracker.create(
        task.rig.body, options, task.T_held, rotation_deg=turn, distance=distance
    )
    track, posed = tracker.begin(), list[PosedFrame]()
    for done, frame in enumerate(task.frames):
        seen = [_view(task, s, y, factor) for s, y in frame.points.items() if len(y)]
        views = [view for sensor_view in seen for view in plane_views(sensor_view)]
        track, estimate = tracker.advance(track, frame.number, frame.time_s, views)
        progress("searching the body with all sensors", done, len(task.frames))
        if estimate.T_world_object is not None:
            posed.append(PosedFrame(frame, estimate.T_world_object, estimate.status == "ok"))
    return posed


def _view(task: Task, sensor: int, points: Floats, factor: float) -> View:
    observed = Observation(PointPattern(points, np.ones(len(points))), factor * task.sigmas[sensor])
    return View(task.rig.names[sensor], task.rig.sensors[sensor], observed)


class Saved(Known):
    """Hypotheses that are appended to a file when they are set, a line of JSON each.

    Hypotheses of an interrupted calibration are read from the file, if it has the same key, which
    stands for session, recording and version.
    """

    def __init__(self, path: Path, session_key: str) -> None:
        super().__init__()
        self._path, first = path, f"{MARK}{json.dumps(session_key)}}}"
        lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
        known = Known()
        for line in lines[1:] if lines and lines[0] == first else []:
            with suppress(ValueError):  # the last line was cut off
                frame, sensor, poses, evidence = json.loads(line)
                T = np.array(poses, dtype=np.float64).reshape(-1, 4, 4)
                hypotheses = Hypotheses(T, np.array(evidence, dtype=np.float64))
                known[int(frame), int(sensor)] = hypotheses
        self.resumed = len(known)
        self._stream = path.open("w", encoding="utf-8", newline="\n")
        self._stream.write(first + "\n")
        for key, hypotheses in known.items():
            self[key] = hypotheses

    def __setitem__(self, key: tuple[int, int], new: Hypotheses) -> None:
        super().__setitem__(key, new)
        self._stream.write(json.dumps([*key, new.poses.tolist(), new.evidence.tolist()]) + "\n")
        self._stream.flush()

    def __enter__(self) -> Saved:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self._stream.close()
        if error is None:  # a finished calibration needs the file no more
            self._path.unlink(missing_ok=True)
