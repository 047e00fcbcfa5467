"""Where the body is for all sensors together, where none knows it alone: ranges, parallel beams.

The sensors are then believed to stand about where the session has them.  Blurs wider than σ_ε
forgive what they are off, until the rig can be adjusted to what was found.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mixpose.calibration.frames import SeenFrame
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.task import Progress, Task
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions
from mixpose.objective import View
from mixpose.records import Floats, PointPattern
from mixpose.rigid import TWIST_NAMES
from mixpose.tracking import Tracker


def joint_poses(
    task: Task, rules: CalibrationRules, progress: Progress
) -> Iterator[tuple[tuple[SeenFrame, ...], Floats]]:
    """Frames whose pose all sensors together know, and the poses (K, 4, 4), blur after blur."""
    for factor in rules.widened:
        sure: list[tuple[SeenFrame, Floats]] = []
        doubtful: list[tuple[SeenFrame, Floats]] = []
        for done, (posed, is_sure) in enumerate(_tracked(task, factor)):
            progress("searching the body with all sensors", done, len(task.frames))
            if posed is not None:
                (sure if is_sure else doubtful).append(posed)
        # where hardly any pose is believed, the likeliest are a start, and deviations will tell
        few = len(sure) < rules.believed * len(task.frames)
        found = sorted(sure + doubtful, key=lambda one: one[0].number) if few else sure
        poses = np.array([T for _, T in found]).reshape(-1, 4, 4)
        yield tuple(frame for frame, _ in found), poses


def _tracked(task: Task, factor: float) -> Iterator[tuple[tuple[SeenFrame, Floats] | None, bool]]:
    """Each frame with its pose, and whether it is believed, at a factor times σ_ε."""
    free = tuple(name for name, is_free in zip(TWIST_NAMES, task.pose_free, strict=True) if is_free)
    turn, distance = task.around
    options = EstimatorOptions(free=free, fuse=task.fuse)
    tracker = Tracker.create(task.body, options, task.T_held, rotation_deg=turn, distance=distance)
    track = tracker.begin()
    for frame in task.frames:
        views = _views(task, frame, factor)
        track, estimate = tracker.advance(track, frame.number, frame.time_s, views)
        T = estimate.T_world_object
        yield None if T is None else (frame, T), estimate.status == "ok"


def _views(task: Task, frame: SeenFrame, factor: float) -> list[View]:
    return [
        View(
            task.rig.names[sensor],
            task.rig.sensors[sensor],
            Observation(PointPattern(points, np.ones(len(points))), factor * task.sigmas[sensor]),
        )
        for sensor, points in frame.points.items()
        if len(points)
    ]
