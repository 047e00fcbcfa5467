"""How closely a calibration meets what was seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mixpose.calibration.adjust import Adjusted
from mixpose.calibration.bundle import Bundle, Rows, normal_equations, rows_of, solved, stepped
from mixpose.calibration.frames import SeenFrame
from mixpose.calibration.matching import Pairs
from mixpose.calibration.result import Sights
from mixpose.calibration.rig import Rig
from mixpose.calibration.task import Task
from mixpose.records import Floats

_MET = 0.05  # weight of a pair: 5 standard deviations off have 0.2
_CLIMBS = 12
_CLIMBED = 1e-6  # of the squared residuals: less gained, and poses are fitted


def squared_residuals(bundle: Bundle, rig: Rig, adjusted: Adjusted) -> list[Floats]:
    """Squared residuals (n,) of each sensor's pairs under a rig; NaN of pairs that are not met.

    Poses are fitted to the rig by least squares first, so that all rigs are held to the same.

    Parameters
    ----------
    bundle : Bundle
        Without parameters of the rig.
    adjusted : Adjusted
        Where poses begin, and which detection is which feature.
    """
    poses = adjusted.poses
    met = [weight > _MET for _, _, weight in adjusted.weighted]

    def seen() -> list[tuple[int, Pairs, Rows, Floats]]:
        rows = [rows_of(bundle, rig, poses, s, one[0]) for s, one in enumerate(adjusted.weighted)]
        return [
            (s, adjusted.weighted[s][0], each, met[s] * each.known / adjusted.noise[s] ** 2)
            for s, each in enumerate(rows)
        ]

    rows, spent = seen(), np.inf
    for _ in range(_CLIMBS if bundle.pose_free.any() else 0):
        before, spent = spent, sum(float(w @ (e.residual**2).sum(axis=1)) for *_, e, w in rows)
        if before - spent < _CLIMBED * spent:
            break
        normal = normal_equations(bundle, len(poses), rows, 1e-6)
        step = solved(bundle, normal, np.zeros((0, 0)), len(poses))
        rig, poses = stepped(bundle, rig, poses, step)
        rows = seen()
    return [np.where(w > 0, (e.residual**2).sum(axis=1), np.nan) for *_, e, w in rows]


def rms(squared: Sequence[Floats]) -> float:
    """Root mean square of what is not NaN; NaN of nothing."""
    flat = np.concatenate([np.zeros(0), *squared])
    known = np.isfinite(flat)
    return float(np.sqrt(flat[known].mean())) if known.any() else float("nan")


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
