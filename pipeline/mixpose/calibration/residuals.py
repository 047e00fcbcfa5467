"""How closely a calibration meets what was seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mixpose.calibration.adjust import Adjusted
from mixpose.calibration.bundle import Bundle, normal_equations, rows_of, solved, stepped
from mixpose.calibration.frames import SeenFrame
from mixpose.calibration.result import Sights
from mixpose.calibration.rig import Rig
from mixpose.calibration.task import Task
from mixpose.records import Floats

_MET = 0.05  # weight of a pair: 5 standard deviations off have 0.2
_CLIMBS = 12


def residuals_of(bundle: Bundle, rig: Rig, poses: Floats, adjusted: Adjusted) -> dict[int, float]:
    """Root mean square residual of each sensor over the pairs that a calibration met.

    Poses are fitted to the rig by least squares first, so that two rigs are held to the same.

    Parameters
    ----------
    bundle : Bundle
        Without parameters of the rig.
    rig : Rig
    poses : (K, 4, 4) array
    adjusted : Adjusted
        Which detection is which feature.
    """
    sensors = range(len(rig.sensors))
    weights = [weight * (weight > _MET) for _, _, weight in adjusted.weighted]
    for _ in range(_CLIMBS if bundle.pose_free.any() else 0):
        rows = []
        for s in sensors:
            pairs = adjusted.weighted[s][0]
            each = rows_of(bundle, rig, poses, s, pairs)
            rows.append((s, pairs, each, (weights[s] > 0) * each.known / adjusted.noise[s] ** 2))
        normal = normal_equations(bundle, len(poses), rows, 1e-6)
        step = solved(bundle, normal, np.zeros((0, 0)), len(poses))
        rig, poses = stepped(bundle, rig, poses, step)
    found = {}
    for s in sensors:
        each = rows_of(bundle, rig, poses, s, adjusted.weighted[s][0])
        mask = (weights[s] > 0) & each.known
        squared = (each.residual**2).sum(axis=1)
        found[s] = float(np.sqrt(squared[mask].mean())) if mask.any() else float("nan")
    return found


def met_share(adjusted: Adjusted, frames: Sequence[SeenFrame], task: Task) -> Floats:
    """Share (K,) of the features that frames could show which were met, all sensors together."""
    met, expected = np.zeros(len(frames)), np.zeros(len(frames))
    for s in range(len(task.rig.sensors)):
        pairs, _, weight = adjusted.weighted[s]
        met += np.bincount(pairs.frame, weight > _MET, len(frames))
        for k, frame in enumerate(frames):
            expected[k] += min(len(frame.points.get(s, ())), len(task.rig.points))
    return met / np.maximum(expected, 1)


def explained_share(adjusted: Adjusted, frames: Sequence[SeenFrame], task: Task) -> Floats:
    """Share (L,) of what each sensor could show that is met, by the objective; NaN without any."""
    most, sensors = len(task.rig.points), range(len(task.rig.sensors))
    could = np.array([sum(min(len(f.points.get(s, ())), most) for f in frames) for s in sensors])
    met = np.array([weight.sum() for _, _, weight in adjusted.weighted])
    return np.asarray(np.where(could > 0, met / np.maximum(could, 1), np.nan))


def sights_of(adjusted: Adjusted, numbers: Sequence[int]) -> dict[int, Sights]:
    """What each sensor saw and met."""
    found = {}
    for s, (pairs, residual, weight) in enumerate(adjusted.weighted):
        kept = weight > _MET
        named = np.array(numbers, dtype=np.intp)[pairs.frame[kept]]
        found[s] = Sights(pairs.y[kept], residual[kept], named, pairs.feature[kept])
    return found
