"""What a calibration found, and how closely it meets what was seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mixpose.calibration.adjust import Adjusted
from mixpose.calibration.bundle import Bundle, Weighted, rows_of, solved, stepped
from mixpose.calibration.rig import Block, Rig, State
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.task import SeenFrame, Task
from mixpose.records import Floats, Indices

_MET = 0.05  # weight of a pair: 5 standard deviations off have 0.2
_CLIMBS = 12
_CLIMBED = 1e-6  # of the squared residuals: less gained, and poses are fitted


@dataclass(frozen=True)
class Residual:
    """Root mean square residuals of one sensor, sensor units; NaN without any."""

    before: float  # with the calibration before
    after: float
    held: float  # of every frame, with the calibration that the others tell: that of new data


@dataclass(frozen=True, eq=False)
class Sights:
    """All that one sensor saw and met, for pictures and lists."""

    y: Floats  # (n, m): detections that were met
    offset: Floats  # (n, m): detected minus predicted, after
    frame: Indices  # (n,): frame numbers
    feature: Indices  # (n,)


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibration with all that tells whether to trust it."""

    before: Rig
    after: Rig
    blocks: tuple[Block, ...]
    deviations: Floats  # (G,): of the free parameters; infinite where not determined
    covariance: Floats  # (G, G)
    refused: tuple[str, ...]  # directions that the data do not determine; they stay as they were
    gauge: tuple[str, ...]  # freedoms of the rig that were removed
    through: Mapping[int, tuple[int | None, int]]  # as of `Start`
    unlinked: tuple[int, ...]
    used: tuple[int, ...]  # numbers of the frames that are calibrated from
    bad: tuple[int, ...]  # and of those left out
    recorded: int  # frames of the recording with detections
    residuals: Mapping[int, Residual]
    noise: Floats  # (L,)
    inflation: float
    # share of the weight of pairs of which each is the nearest that the other has: near 1, or
    # detections cannot be told apart
    certainty: float
    # (G,): standard deviations that biases of ranges as large as σ_ε would add, where they are held
    # and nothing is stated of them
    moved_by_biases: Floats
    # (L,): share of what each sensor could show that is met, weighted as in the objective; NaN
    # without
    explained: Floats
    sights: Mapping[int, Sights]
    poses: Mapping[int, Floats]  # (4, 4), by frame number
    frames: tuple[SeenFrame, ...]

    def doubtful(self, rules: CalibrationRules) -> tuple[int, ...]:
        """Sensors that most likely stand elsewhere: what they saw is not explained."""
        return tuple(int(s) for s in np.flatnonzero(self.explained < rules.explained))


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
    state = State(rig, adjusted.state.poses)

    def seen() -> list[Weighted]:
        found = []
        for s, (before, weight) in enumerate(adjusted.weighted):
            rows = rows_of(bundle, state, s, before.pairs)
            found.append((rows, (weight > _MET) * rows.known / adjusted.noise[s] ** 2))
        return found

    rows, spent = seen(), np.inf
    for _ in range(_CLIMBS if bundle.pose_free.any() else 0):
        before, spent = spent, sum(float(w @ (e.residual**2).sum(axis=1)) for e, w in rows)
        if before - spent < _CLIMBED * spent:
            break
        state = stepped(bundle, state, solved(bundle, state, rows, 1e-6))
        rows = seen()
    return [np.where(w > 0, (e.residual**2).sum(axis=1), np.nan) for e, w in rows]


def rms(squared: Sequence[Floats]) -> float:
    """Root mean square of what is not NaN; NaN of nothing."""
    flat = np.concatenate([np.zeros(0), *squared])
    known = np.isfinite(flat)
    return float(np.sqrt(flat[known].mean())) if known.any() else float("nan")


def _could_show(frames: Sequence[SeenFrame], task: Task) -> Floats:
    """Features (K, L) that each sensor could show."""
    most, sensors = len(task.rig.points), range(len(task.rig.sensors))
    return np.array([[min(len(f.points.get(s, ())), most) for s in sensors] for f in frames])


def met_share(adjusted: Adjusted, frames: Sequence[SeenFrame], task: Task) -> Floats:
    """Share (K,) of the features that frames could show which were met, all sensors together."""
    met = sum(
        np.bincount(rows.pairs.frame, weight > _MET, len(frames))
        for rows, weight in adjusted.weighted
    )
    return np.asarray(met / np.maximum(_could_show(frames, task).sum(axis=1), 1))


def explained_share(adjusted: Adjusted, frames: Sequence[SeenFrame], task: Task) -> Floats:
    """Share (L,) of what each sensor could show that is met, by the objective; NaN without any."""
    could = _could_show(frames, task).sum(axis=0)
    met = np.array([weight.sum() for _, weight in adjusted.weighted])
    return np.asarray(np.where(could > 0, met / np.maximum(could, 1), np.nan))


def sights_of(adjusted: Adjusted, numbers: Sequence[int]) -> dict[int, Sights]:
    """What each sensor saw and met."""
    found = {}
    for s, (rows, weight) in enumerate(adjusted.weighted):
        pairs, kept = rows.pairs, weight > _MET
        named = np.array(numbers, dtype=np.intp)[pairs.frame[kept]]
        found[s] = Sights(pairs.y[kept], rows.residual[kept], named, pairs.feature[kept])
    return found
