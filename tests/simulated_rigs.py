"""Rigs and recordings for tests of calibration, whose truth is known.

What each camera knows alone is given a little wrong, as searching for it takes most of the time and
has tests of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mixpose.body import Body, PointFeature
from mixpose.calibration import CalibrationRules, Rig, SeenFrame, Task
from mixpose.calibration.task import Hypotheses
from mixpose.rigid import from_parts, from_rotation_vector, perturb, transform
from mixpose.sensors import PinholeCamera, RangeSensor

Floats = np.ndarray
POINTS = np.array(
    [[0, 0, 0], [95, 12, -8], [-62, 70, 14], [-38, -84, 22], [41, 48, 76], [58, -57, 45.0]]
)
BODY = Body("six", tuple(PointFeature(p) for p in POINTS))
K = np.array([[800.0, 0, 320], [0, 800, 256], [0, 0, 1]])
FPS = 30.0
ALL = np.ones(6, dtype=np.bool_)
# adjusted once where frames held back would be told, too, by five adjustments more
NO_FRAME_HELD_BACK = CalibrationRules(least_frames=1000)
PLACES = np.array([[0, -1000, 0], [1000, 0, 0], [0, 0, 1000.0]])


def cameras(count: int) -> list[PinholeCamera]:
    found = []
    for angle in np.linspace(-0.7, 0.7, count):
        turn = from_rotation_vector([0.05, angle, 0.02], [0, 0, 0])
        T = from_parts(np.eye(3), [5.0, -8.0, 820.0]) @ turn
        found.append(PinholeCamera(K, resolution=(640, 512), T_sensor_world=T))
    return found


def motion(time: float) -> Floats:
    way = np.array([3.1, 4.3, 2.3, 3.7, 2.9, 4.9]) * time + np.arange(6)
    twist = np.sin(way) * [40, 40, 40, 0.5, 0.5, 0.5]
    return from_rotation_vector(twist[3:], twist[:3])


def recording(
    sensors: Sequence[PinholeCamera | RangeSensor],
    count: int,
    noise: float,
    late: float | Callable[[float], float] = 0.0,
    points: Floats = POINTS,
    look: Callable[..., tuple[Floats, Floats]] | None = None,
    seed: int = 1,
) -> tuple[SeenFrame, ...]:
    """Shuffled detections; the second sensor takes its frames `late` seconds later.

    `look` tells what a sensor sees at a time and which of it is in view, in place of points.
    """
    rng = np.random.default_rng(seed)
    frames = []
    for k in range(count):
        time = k / FPS
        seen = {}
        for index, sensor in enumerate(sensors):
            after = late(time) if callable(late) else late
            at = time + (after if index == 1 else 0.0)
            y, visible = (
                sensor.project(transform(motion(at), points)) if look is None else look(sensor, at)
            )
            y = y[visible] + rng.normal(0, noise, y[visible].shape)
            seen[index] = rng.permutation(y)
        frames.append(SeenFrame(k, time, seen, dict.fromkeys(seen, time)))
    return tuple(frames)


def alone(
    sensors: Sequence[PinholeCamera],
    frames: Sequence[SeenFrame],
    pose: Callable[[int], Floats] = lambda number: motion(number / FPS),
) -> dict[tuple[int, int], Hypotheses]:
    """What each camera knows alone, a little wrong, and a wrong answer beside it."""
    rng = np.random.default_rng(2)
    known = {}
    for frame in frames:
        for index in frame.points:
            T = sensors[index].T_sensor_world @ pose(frame.number)
            near = perturb(T, rng.normal(0, [3, 3, 3, 0.01, 0.01, 0.01]))
            wrong = perturb(T, rng.normal(0, [30, 30, 30, 0.5, 0.5, 0.5]))
            known[frame.number, index] = Hypotheses(np.array([wrong, near]), np.array([9.0, 8.0]))
    return known


def task_of(
    sensors: Sequence[PinholeCamera | RangeSensor],
    frames: tuple[SeenFrame, ...],
    sigma: float = 1.5,
    **options: Any,
) -> Task:
    names = [f"s{k}" for k in range(len(sensors))]
    rig = Rig.of(names, sensors, BODY)
    defaults: dict[str, Any] = {"free": dict.fromkeys(range(1, len(sensors)), ("pose",))}
    return Task(rig, frames, np.full(len(sensors), sigma), **{**defaults, **options})


def bumped(task: Task, index: int, deg: float, mm: float) -> Task:
    off = from_rotation_vector(
        np.radians(deg) * np.array([0.6, 0.64, 0.48]), [mm * 0.6, 0, mm * 0.8]
    )
    T = off @ task.rig.sensors[index].T_sensor_world  # type: ignore[attr-defined]
    return replace(task, rig=task.rig.placed(index, T))
