"""Where range biases begin, poses being known: the shift that most ranges agree on.

That is the objective over one number at a wide blur: Σ over all frames, features and ranges of a
kernel at range − distance − bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mixpose.calibration.frames import SeenFrame
from mixpose.calibration.rig import Rig
from mixpose.calibration.task import Task
from mixpose.records import Floats
from mixpose.rigid import transform
from mixpose.sensors import RangeSensor

_STEPS = 4  # of the search in a σ_ε
_FARTHEST = 0.5  # of the median distance: no bias is larger


def biased(task: Task, frames: Sequence[SeenFrame], poses: Floats) -> Rig:
    """The rig with those biases that are free where most ranges agree on them."""
    rig = task.rig
    for sensor, kinds in task.free.items():
        eye = rig.sensors[sensor]
        if isinstance(eye, RangeSensor) and "range_bias" in kinds:
            bias = _agreed(eye, rig.points, frames, poses, sensor, float(task.sigmas[sensor]))
            rig = rig.exchanged(sensor, replace(eye, range_bias=eye.range_bias + bias))
    return rig


def _agreed(
    eye: RangeSensor,
    points: Floats,
    frames: Sequence[SeenFrame],
    poses: Floats,
    sensor: int,
    sigma: float,
) -> float:
    y, _ = eye.project(transform(poses, points))
    found = [
        (frame.points[sensor][None, :, 0] - y[k]).ravel()
        for k, frame in enumerate(frames)
        if sensor in frame.points
    ]
    if not found:
        return 0.0
    shifts = np.concatenate(found)
    step = sigma / _STEPS
    farthest = _FARTHEST * float(np.median(y))
    places = np.arange(-farthest, farthest, step)
    counts, _ = np.histogram(shifts, bins=np.append(places, places[-1] + step) - step / 2)
    width = 4 * _STEPS
    kernel = np.exp(-0.25 * (np.arange(-width, width + 1) / _STEPS) ** 2)
    return float(places[np.argmax(np.convolve(counts, kernel, mode="same"))])
