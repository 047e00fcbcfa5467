"""A prediction over many poses, as few numbers: how accurate, where weak, what is seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mixpose.checking import LookAlike, look_alikes
from mixpose.design.prediction import Plan, Prediction, at_tip
from mixpose.records import Floats
from mixpose.rigid import transform
from mixpose.session import SensorSetup

_TRIED = 3  # poses at which others that look alike are searched for: a second each
_NEAR = 4.0  # standard deviations between features whose labels are then mixed up now and then


@dataclass(frozen=True)
class Weakness:
    """Where a system is weakest, and in which direction."""

    pose: int  # number of the pose, from 0
    deviation: float  # along the worst direction
    direction: Floats  # (3,): in world axes: of the position, or the axis of the turn
    ratio: float  # to the deviation along the best direction there


@dataclass(frozen=True)
class Summary:
    """What a system achieves over P poses."""

    deviations: Floats  # (P, 6): x y z rx ry rz, lengths and radians; infinite where not determined
    # (P,): root mean square errors: of the origin, of the turn (radians), and of the tip
    position: Floats
    rotation: Floats  # (P,)
    tip: Floats  # (P,)
    weakest_position: Weakness | None  # none where a direction is not determined at any pose
    weakest_rotation: Weakness | None
    seen: Floats  # (L,): share of the features that each sensor sees, on average
    fewest: Floats  # (L,): features that each sensor sees at its worst pose
    undetermined: tuple[int, ...]  # poses at which a free direction is open
    # (L,): what a sensor's features err by, markers included, over its `sigma`.  From a third on
    # some of them are given up as false, and errors are larger than predicted.
    narrow: Floats
    # (L,): share of the features with another nearer than four standard deviations in a sensor:
    # there detections are mixed up, and errors larger than predicted
    crowded: Floats
    symmetries: int  # orientations that look the same
    # poses that look nearly the same as one of the first, the most alike first
    alike: tuple[LookAlike, ...]


def summarise(
    plan: Plan, setups: tuple[SensorSetup, ...], prediction: Prediction, tip: Floats
) -> Summary:
    """Sum a prediction up.

    Parameters
    ----------
    setups : tuple of SensorSetup
        Those of the plan's sensors.
    tip : (3,) array
        In the object's frame.
    """
    variances = np.einsum("pii->pi", prediction.covariances)
    tips = at_tip(prediction, tip)
    closed = np.isfinite(variances).all(axis=1)
    narrow, crowded = _doubts(plan, prediction)
    alike: list[LookAlike] = []
    for T in prediction.poses[closed][:_TRIED]:
        alike += look_alikes(setups, plan.body, T, plan.free)
    return Summary(
        deviations=np.sqrt(variances),
        position=np.sqrt(variances[:, :3].sum(axis=1)),
        rotation=np.sqrt(variances[:, 3:].sum(axis=1)),
        tip=np.sqrt(np.einsum("pii->p", tips)),
        weakest_position=_weakest(tips),
        weakest_rotation=_weakest(prediction.covariances[:, 3:, 3:]),
        seen=prediction.seen.mean(axis=(0, 2)),
        fewest=prediction.seen.sum(axis=2).min(axis=0),
        undetermined=tuple(int(p) for p in np.flatnonzero(~closed)),
        narrow=narrow,
        crowded=crowded,
        symmetries=len(plan.body.symmetries),
        alike=tuple(sorted(alike, key=lambda other: other.difference)),
    )


def pooled(errors: Floats) -> float:
    """Root mean square over the poses at which it is determined; infinite where there are none."""
    known = errors[np.isfinite(errors)]
    return float(np.sqrt((known**2).mean())) if known.size else float("inf")


def _weakest(covariances: Floats) -> Weakness | None:
    """Of (P, 3, 3), the largest deviation."""
    known = np.isfinite(np.einsum("pii->p", covariances))
    if not known.any():
        return None
    values, vectors = np.linalg.eigh(np.where(known[:, None, None], covariances, 0.0))
    pose = int(values[:, 2].argmax())
    direction = vectors[pose, :, 2]
    direction = direction * np.sign(direction[np.abs(direction).argmax()])
    least = max(float(values[pose, 0]), 0.0)
    worst = float(values[pose, 2])
    ratio = float(np.sqrt(worst / least)) if least > 1e-18 * worst else float("inf")
    return Weakness(pose, float(np.sqrt(worst)), direction, ratio)


def _doubts(plan: Plan, prediction: Prediction) -> tuple[Floats, Floats]:
    """What features err by over `sigma`, and the share of those that are near others, by sensor."""
    narrow, shares = np.zeros(len(plan.sensors)), np.zeros(len(plan.sensors))
    world = transform(prediction.poses, plan.body.means)
    for k, (sensor, noise) in enumerate(zip(plan.sensors, plan.noises, strict=True)):
        y, A, _ = sensor.linearise(world)
        # of markers, as the sensor shows them
        shown = plan.body.spread * np.linalg.norm(A, axis=-1).max(axis=-1)
        errs = np.sqrt(noise**2 + shown**2)
        seen = prediction.seen[:, k]
        narrow[k] = np.median(errs[seen]) / plan.sigmas[k] if seen.any() else 0.0
        apart = np.linalg.norm(y[:, :, None] - y[:, None], axis=-1)
        apart[~(seen[:, :, None] & seen[:, None])] = np.inf
        apart[:, np.arange(len(plan.body)), np.arange(len(plan.body))] = np.inf
        crowded = apart.min(axis=2) < _NEAR * errs
        shares[k] = crowded.sum() / max(int(seen.sum()), 1)
    return narrow, shares
