"""Which detection may be which feature, softly: the weights of the matched objective.

The gradient of ⟨g, h⟩ at a blur σ is that of weighted least squares over all pairs of a detection d
and a predicted feature p, with the weights exp(−|d − p|²/4σ²); ⟨h, h⟩ keeps features from taking
the same detection, for which a pair's weight is shared out where several compete.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.calibration.frames import SeenFrame
from mixpose.calibration.interpolation import Neighbours, interpolate
from mixpose.calibration.rig import Rig
from mixpose.records import Floats
from mixpose.rigid import perturb, transform
from mixpose.sensors import facing

Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of detections and features of one sensor, over all frames."""

    frame: Ints  # (n,)
    feature: Ints  # (n,)
    detection: Ints  # (n,)
    y: Floats  # (n, m): detected place
    share: Floats  # (n,): 1 where nothing competes
    nearest: NDArray[np.bool_]  # (n,): whether each of the two is the nearest that the other has


@dataclass(frozen=True, eq=False)
class Clock:
    """When sensors look."""

    near: Neighbours
    late: Floats  # (L, K): seconds from a frame's common time to a sensor's; 0 where not known
    since: Floats  # (L, K): seconds from the middle of the recording

    def tau(self, rig: Rig, sensor: int, frame: Ints) -> Floats:
        """Seconds from the common time of frames (n,) to when a sensor took them."""
        late = self.late[sensor, frame] + rig.delays[sensor]
        return np.asarray(late + rig.drifts[sensor] * self.since[sensor, frame])


def clock_of(frames: Sequence[SeenFrame], near: Neighbours, sensors: int) -> Clock:
    """When sensors say that they look."""
    late, since = np.zeros((sensors, len(frames))), np.zeros((sensors, len(frames)))
    times = [frame.time_s for frame in frames if frame.time_s is not None]
    middle = (min(times) + max(times)) / 2 if times else 0.0
    for k, frame in enumerate(frames):
        for sensor, time in frame.times.items():
            if frame.time_s is not None:
                late[sensor, k] = time - frame.time_s
                since[sensor, k] = time - middle
    return Clock(near, late, since)


def seen_poses(rig: Rig, poses: Floats, clock: Clock, sensor: int) -> Floats:
    """Poses (K, 4, 4) at the moments when a sensor looks."""
    frame = np.arange(len(poses))
    tau = clock.tau(rig, sensor, frame)
    if not tau.any():
        return poses
    return perturb(poses, interpolate(clock.near, poses, frame, tau).twist)


def match(
    rig: Rig,
    poses: Floats,
    frames: Sequence[SeenFrame],
    clock: Clock,
    sensor: int,
    blur: float,
    faintest: float,
) -> Pairs:
    """Pair detections and features of a sensor at a blur.

    Parameters
    ----------
    poses : (K, 4, 4) array
    blur : float
        In sensor units.
    faintest : float
        Weight below which a pair is left out.
    """
    at = seen_poses(rig, poses, clock, sensor)
    eye = rig.sensors[sensor]
    world = transform(at, rig.points)
    y, visible = eye.project(world)
    visible = visible & facing(eye, at, world, rig.normals)
    reach = 2 * blur * np.sqrt(-np.log(faintest))
    parts: list[tuple[NDArray[Any], ...]] = []
    for k, frame in enumerate(frames):
        points = frame.points.get(sensor)
        if points is None or not len(points) or not visible[k].any():
            continue
        features = np.flatnonzero(visible[k])
        i, j, share, nearest = _near(y[k, features], points, blur, reach)
        parts.append((np.full(len(i), k), features[i], j, points[j], share, nearest))
    if not parts:
        none = np.zeros(0, dtype=np.intp)
        return Pairs(none, none, none, np.zeros((0, eye.dimension)), np.zeros(0), none > 0)
    return Pairs(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _near(
    y: Floats, points: Floats, blur: float, reach: float
) -> tuple[Ints, Ints, Floats, NDArray[np.bool_]]:
    """Pairs within reach: features, detections, shares, and whether they are nearest."""
    away = y[:, None, :] - points[None, :, :]
    squared = (away * away).sum(axis=2)
    kernel = np.exp(-squared / (4 * blur * blur)) * (squared < reach * reach)
    rivals = np.maximum(kernel.sum(axis=1)[:, None], kernel.sum(axis=0))
    least = (squared == squared.min(axis=1)[:, None]) & (squared == squared.min(axis=0))
    i, j = np.nonzero(kernel)
    return i, j, kernel[i, j] / rivals[i, j], least[i, j]


def nearest_distance(
    rig: Rig, poses: Floats, frames: Sequence[SeenFrame], clock: Clock, sensor: int
) -> Floats:
    """Distance of every predicted feature in view to the nearest detection, all frames together."""
    at = seen_poses(rig, poses, clock, sensor)
    eye = rig.sensors[sensor]
    world = transform(at, rig.points)
    y, visible = eye.project(world)
    visible = visible & facing(eye, at, world, rig.normals)
    found = [np.zeros(0)]
    for k, frame in enumerate(frames):
        points = frame.points.get(sensor)
        if points is not None and len(points) and visible[k].any():
            found.append(cKDTree(points).query(y[k, visible[k]])[0])
    return np.concatenate(found)


def feature_spacing(rig: Rig, poses: Floats, sensor: int) -> float:
    """Median distance of a feature to its neighbour in a sensor."""
    eye = rig.sensors[sensor]
    world = transform(poses, rig.points)
    y, visible = eye.project(world)
    visible = visible & facing(eye, poses, world, rig.normals)
    found = [
        cKDTree(y[k, visible[k]]).query(y[k, visible[k]], k=2)[0][:, 1]
        for k in range(len(poses))
        if visible[k].sum() > 1
    ]
    return float(np.median(np.concatenate(found))) if found else np.inf
