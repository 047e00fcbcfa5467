"""Which detection may be which feature, softly: the weights of the matched objective.

The gradient of ⟨g, h⟩ at a blur σ is that of weighted least squares over all pairs of a detection d
and a predicted feature p, with the weights exp(−|d − p|²/4σ²); ⟨h, h⟩ keeps features from taking
the same detection, for which a pair's weight is shared out where several compete.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.calibration.clock import Clock, interpolate
from mixpose.calibration.rig import State
from mixpose.calibration.task import SeenFrame
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import perturb


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of detections and features of one sensor, over all frames."""

    frame: Indices  # (n,)
    feature: Indices  # (n,)
    detection: Indices  # (n,)
    y: Floats  # (n, m): detected place
    share: Floats  # (n,): 1 where nothing competes
    nearest: Mask  # (n,): whether each of the two is the nearest that the other has


def match(
    state: State,
    frames: Sequence[SeenFrame],
    clock: Clock,
    sensor: int,
    blur: float,
    faintest: float,
) -> Pairs:
    """Pair detections and features of a sensor at a blur, in sensor units.

    Pairs whose weight is less than `faintest` are left out.
    """
    reach = 2 * blur * np.sqrt(-np.log(faintest))
    none = np.zeros(0, dtype=np.intp)
    dimension = state.rig.sensors[sensor].dimension
    parts: list[tuple[NDArray[np.generic], ...]] = [
        (none, none, none, np.zeros((0, dimension)), np.zeros(0), none > 0)
    ]
    for k, features, y, points in _seen(state, frames, clock, sensor):
        i, j, share, nearest = _near(y, points, blur, reach)
        parts.append((np.full(len(i), k), features[i], j, points[j], share, nearest))
    return Pairs(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _seen(
    state: State, frames: Sequence[SeenFrame], clock: Clock, sensor: int
) -> Iterator[tuple[int, Indices, Floats, Floats]]:
    """Of frames in which a sensor sees something: features in view, where, and detections."""
    poses, frame = state.poses, np.arange(len(state.poses))
    tau = clock.tau(state.rig, sensor, frame)
    if tau.any():
        poses = perturb(poses, interpolate(clock, poses, frame, tau).twist)
    y, visible = state.rig.seen(sensor, poses)
    for k, each in enumerate(frames):
        points = each.points.get(sensor)
        if points is not None and len(points) and visible[k].any():
            features = np.flatnonzero(visible[k])
            yield k, features, y[k, features], points


def _near(
    y: Floats, points: Floats, blur: float, reach: float
) -> tuple[Indices, Indices, Floats, Mask]:
    """Pairs within reach: features, detections, shares, and whether they are nearest."""
    away = y[:, None, :] - points[None, :, :]
    squared = (away * away).sum(axis=2)
    kernel = np.exp(-squared / (4 * blur * blur)) * (squared < reach * reach)
    rivals = np.maximum(kernel.sum(axis=1)[:, None], kernel.sum(axis=0))
    least = (squared == squared.min(axis=1)[:, None]) & (squared == squared.min(axis=0))
    i, j = np.nonzero(kernel)
    return i, j, kernel[i, j] / rivals[i, j], least[i, j]


def nearest_distance(
    state: State, frames: Sequence[SeenFrame], clock: Clock, sensor: int
) -> Floats:
    """Distance of every predicted feature in view to the nearest detection, all frames together."""
    found = [cKDTree(points).query(y)[0] for _, _, y, points in _seen(state, frames, clock, sensor)]
    return np.concatenate([np.zeros(0), *found])


def feature_spacing(state: State, sensor: int) -> float:
    """Median distance of a feature to its neighbour in a sensor."""
    found = [
        cKDTree(y[visible]).query(y[visible], k=2)[0][:, 1]
        for y, visible in zip(*state.rig.seen(sensor, state.poses), strict=True)
        if visible.sum() > 1
    ]
    return float(np.median(np.concatenate(found))) if found else np.inf
