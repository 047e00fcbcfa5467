"""Where the body is, before anything is adjusted: for one camera alone, or for all together.

Of sensors none of which knows a pose alone, ranges or parallel beams, all are believed to stand
about where the session has them.  Blurs wider than σ_ε forgive what they are off, until the rig can
be adjusted to what was found.
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


class Posed(NamedTuple):
    """A frame and where the body is."""

    frame: SeenFrame
    T_world_object: Floats  # (4, 4)
    is_sure: bool = True  # whether that is believed


def searched(task: Task, rules: CalibrationRules, progress: Progress, found: Known) -> Known:
    """Hypotheses of every camera for every frame; those in `found` are not made again."""
    wanted = [(f, sensor) for f in task.frames for sensor in task.cameras if sensor in f.points]
    for done, (frame, sensor) in enumerate(wanted):
        progress("searching the body in each camera alone", done, len(wanted))
        if (frame.number, sensor) not in found:
            found[frame.number, sensor] = _hypotheses(task, sensor, frame.points[sensor], rules)
    return found


def _hypotheses(task: Task, sensor: int, points: Floats, rules: CalibrationRules) -> Hypotheses:
    """Search for the body in one camera's frame."""
    if len(points) < _LEAST:
        return NOTHING
    view = _view(task, sensor, points, 1.0)
    # the world is put where the camera is, so that poses are relative to it
    own = view.sensor.moved(inverse(view.sensor.T_sensor_world))  # type: ignore[attr-defined]
    views = plane_views(View(view.name, own, view.observation))
    tracker = Tracker.create(task.rig.body, EstimatorOptions())
    ranked = tracker.explain(tracker.data(tracker.begin(), 0, None, views))
    best = ranked[0].log_evidence if ranked else 0.0
    kept = [one for one in ranked if one.log_evidence > max(best - rules.margin, 0.0)]
    kept = kept[: rules.hypotheses]
    poses = np.array([one.T_world_object for one in kept]).reshape(-1, 4, 4)
    return Hypotheses(poses, np.array([one.log_evidence for one in kept]))


def posed(task: Task, factor: float = 1.0, progress: Progress = silent) -> list[Posed]:
    """Frames of which all sensors together know a pose, at a factor times σ_ε."""
    free = tuple(name for name, is_free in zip(TWIST_NAMES, task.pose_free, strict=True) if is_free)
    turn, distance = task.around
    options = EstimatorOptions(free=free, fuse=task.fuse)
    tracker = Tracker.create(
        task.rig.body, options, task.T_held, rotation_deg=turn, distance=distance
    )
    track, found = tracker.begin(), list[Posed]()
    for done, frame in enumerate(task.frames):
        seen = [_view(task, s, y, factor) for s, y in frame.points.items() if len(y)]
        views = [own for view in seen for own in plane_views(view)]
        track, estimate = tracker.advance(track, frame.number, frame.time_s, views)
        progress("searching the body with all sensors", done, len(task.frames))
        if estimate.T_world_object is not None:
            found.append(Posed(frame, estimate.T_world_object, estimate.status == "ok"))
    return found


def _view(task: Task, sensor: int, points: Floats, factor: float) -> View:
    seen = Observation(PointPattern(points, np.ones(len(points))), factor * task.sigmas[sensor])
    return View(task.rig.names[sensor], task.rig.sensors[sensor], seen)


class Saved(Known):
    """Hypotheses that are written to a file as they are found, a line of JSON each.

    What a calibration that was interrupted had found is taken from the file, if it has the same
    key, which names session, recording and version.
    """

    def __init__(self, path: Path, key: str) -> None:
        super().__init__()
        self._path, first = path, f"{MARK}{json.dumps(key)}}}"
        lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
        known = Known()
        for line in lines[1:] if lines and lines[0] == first else []:
            with suppress(ValueError):  # the last line was cut off
                frame, sensor, poses, evidence = json.loads(line)
                T = np.array(poses, dtype=np.float64).reshape(-1, 4, 4)
                one = Hypotheses(T, np.array(evidence, dtype=np.float64))
                known[int(frame), int(sensor)] = one
        self.resumed = len(known)
        self._stream = path.open("w", encoding="utf-8", newline="\n")
        self._stream.write(first + "\n")
        for place, one in known.items():
            self[place] = one

    def __setitem__(self, key: tuple[int, int], one: Hypotheses) -> None:
        super().__setitem__(key, one)
        self._stream.write(json.dumps([*key, one.poses.tolist(), one.evidence.tolist()]) + "\n")
        self._stream.flush()

    def __enter__(self) -> Saved:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self._stream.close()
        if error is None:  # a finished calibration needs the file no more
            self._path.unlink(missing_ok=True)
