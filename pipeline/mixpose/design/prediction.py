"""Predict covariances of poses before anything is measured, by errors of detections and markers.

With the Jacobian J_li of feature i in sensor l by the pose, its Jacobian A_li by the feature's own
place, and the weights W_li of a run, a least-squares fit has the covariance

    H⁻¹ (Σ_l Σ_i J_liᵀ W_li σ_l² W_li J_li + Σ_i G_i Σ_i G_iᵀ) H⁻¹,
    H = Σ_l Σ_i J_liᵀ W_li J_li,    G_i = Σ_l J_liᵀ W_li A_li .

W_li = (s_l² I + A_li Σ_i A_liᵀ)⁻¹, with s_l between the sensor's `sigma` and the noise of its
features, σ_l (`Plan.weighed`).  A marker that is off its place is off in all sensors alike, which
is why its terms are summed over sensors before they are squared.  If s_l is proportional to σ_l and
markers are exact, it is the inverse information.  For points measured alike in three directions it
is the target registration error of Fitzpatrick, West and Maurer (1998, equation 46).

A prediction over many poses is summarised: how accurate, where weak, what is seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mixpose.body import Body
from mixpose.checking import LookAlike, look_alikes, noise_of
from mixpose.fit import free_mask
from mixpose.judgement import NoiseModel, invert_information
from mixpose.objective import pose_jacobian
from mixpose.records import Floats, Mask
from mixpose.rigid import transform
from mixpose.sensors import Sensor, facing
from mixpose.session import SensorSetup, Session

_TRIED = 3  # poses at which look-alikes are searched for, a second each
_NEAR = 4.0  # standard deviations between features whose labels are sometimes mixed up


@dataclass(frozen=True, eq=False)
class Plan:
    """A system: sensors with the noise of their features, and a body."""

    names: tuple[str, ...]  # of the sensors
    sensors: tuple[Sensor, ...]
    noises: tuple[float, ...]  # by sensor: deviation of a feature's coordinates, px or length units
    sigmas: tuple[float, ...]  # by sensor: σ_ε, by which a run weighs sensors at first
    body: Body  # spreads of its features are errors of markers
    free: Mask  # (6,): directions that are estimated

    def weighed(self) -> Floats:
        """Return variances s_l² (L,) by which a run weighs sensors once it has seen their noise.

        Single ranges alone are weighed by `sigma`.
        """
        stated = np.square(self.sigmas)
        ratios = np.square(self.noises) / stated
        if not ratios.all() or all(sensor.dimension == 1 for sensor in self.sensors):
            return stated
        counted = NoiseModel().errors.counted(ratios)
        return np.asarray(stated * counted * (1 / counted).mean())


@dataclass(frozen=True)
class Prediction:
    """Covariances expected at P poses."""

    poses: Floats  # (P, 4, 4): T_world_object
    covariances: Floats  # (P, 6, 6), world axes: infinite on the diagonal if open, 0 if held
    seen: Mask  # (P, L, N): features in view of a sensor that face it


def plan_of(session: Session, noises: dict[str, float] | None = None) -> Plan:
    """Return the system of a session; `noises` by sensor replace those by its `sigma`."""
    changed = noises or {}
    return Plan(
        names=tuple(setup.name for setup in session.sensors),
        sensors=tuple(setup.sensor for setup in session.sensors),
        noises=tuple(changed.get(setup.name, noise_of(setup)) for setup in session.sensors),
        sigmas=tuple(setup.extract.sigma for setup in session.sensors),
        body=session.body,
        free=free_mask(session.estimator),
    )


def predict(plan: Plan, poses: Floats) -> Prediction:
    """Predict the covariance of one frame at each of P poses (P, 4, 4)."""
    points, count = plan.body.means, len(poses)
    world, arms = transform(poses, points), points @ poses[:, :3, :3].swapaxes(1, 2)
    spread = plan.body.feature_spreads(poses)
    H, V = np.zeros((count, 6, 6)), np.zeros((count, 6, 6))
    G = np.zeros((count, len(points), 6, 3))
    seen = np.zeros((count, len(plan.sensors), len(points)), dtype=np.bool_)
    rows = zip(plan.sensors, plan.noises, plan.weighed().tolist(), strict=True)
    for k, (sensor, noise, variance) in enumerate(rows):
        _, A, visible = sensor.linearise(world)
        visible = visible & facing(sensor, poses, world, plan.body.normals, plan.body.edge_on)
        seen[:, k] = visible
        A = A * visible[..., None, None]
        J = pose_jacobian(A, arms)
        wide = variance * np.eye(A.shape[-2])
        W = np.linalg.inv(wide + A @ spread @ A.swapaxes(-1, -2))
        JW = J.swapaxes(-1, -2) @ W
        H += (JW @ J).sum(axis=1)
        V += noise**2 * (JW @ JW.swapaxes(-1, -2)).sum(axis=1)
        G += JW @ A
    V += (G @ spread @ G.swapaxes(-1, -2)).sum(axis=1)
    covariances = np.array([_sandwich(h, v, plan.free) for h, v in zip(H, V)])
    return Prediction(poses, covariances, seen)


def at_tip(prediction: Prediction, tip: Floats) -> Floats:
    """Return the covariance (P, 3, 3) of a body's point (3,), in world axes; infinite if open."""
    arms = prediction.poses[:, :3, :3] @ tip
    J = pose_jacobian(np.broadcast_to(np.eye(3), (len(arms), 3, 3)), arms)
    known = np.isfinite(prediction.covariances)
    result = J @ np.where(known, prediction.covariances, 0.0) @ J.swapaxes(1, 2)
    is_open = ~np.isfinite(np.einsum("pii->pi", prediction.covariances))
    reach = np.abs(J) > 1e-9 * max(1.0, float(np.abs(tip).max()))
    is_affected = (reach & is_open[:, None, :]).any(axis=2)
    for p, axis in np.argwhere(is_affected):
        result[p, axis, axis] = np.inf
    return np.asarray(result)


def _sandwich(H: Floats, V: Floats, free: Mask) -> Floats:
    inverse = invert_information(H, free)
    is_open = ~np.isfinite(np.diag(inverse))
    inverse[is_open, :] = inverse[:, is_open] = 0.0
    covariance = inverse @ V @ inverse
    covariance[is_open, is_open] = np.inf
    return np.asarray((covariance + covariance.T) / 2)


@dataclass(frozen=True)
class Weakness:
    """The pose and direction in which a system is weakest."""

    pose: int  # number of the pose, from 0
    deviation: float  # along the worst direction
    direction: Floats  # (3,): of the position, or the axis of the turn, in world axes
    ratio: float  # to the deviation along the best direction at that pose


@dataclass(frozen=True)
class Summary:
    """The accuracy of a system over P poses, and what limits it."""

    deviations: Floats  # (P, 6): x y z rx ry rz, lengths and radians; infinite if not determined
    position: Floats  # (P,): root mean square error of the origin
    rotation: Floats  # (P,): of the turn, radians
    tip: Floats  # (P,)
    weakest_position: Weakness | None  # None if no pose is determined
    weakest_rotation: Weakness | None
    seen: Floats  # (L,): share of the features that each sensor sees, on average
    fewest: Floats  # (L,): features that each sensor sees at its worst pose
    undetermined: tuple[int, ...]  # poses at which a free direction is not determined
    # (L,): noise of a sensor's features, with that of markers, over its `sigma`.  From a third on
    # some features are given up as false, and errors are larger than predicted.
    narrow: Floats
    # (L,): share of features nearer than four standard deviations to another in a sensor, whose
    # detections are sometimes mixed up, so that errors are larger than predicted
    crowded: Floats
    symmetries: int  # orientations that look the same
    alike: tuple[LookAlike, ...]  # look-alikes of the first poses, the most similar first


def summarise(
    plan: Plan, setups: tuple[SensorSetup, ...], prediction: Prediction, tip: Floats
) -> Summary:
    """Summarise a prediction; the setups are those of the plan's sensors."""
    variances = np.einsum("pii->pi", prediction.covariances)
    tips = at_tip(prediction, tip)
    is_determined = np.isfinite(variances).all(axis=1)
    narrow, crowded = _doubts(plan, prediction)
    alike = [
        look_alike
        for T in prediction.poses[is_determined][:_TRIED]
        for look_alike in look_alikes(setups, plan.body, T, plan.free)
    ]
    return Summary(
        deviations=np.sqrt(variances),
        position=np.sqrt(variances[:, :3].sum(axis=1)),
        rotation=np.sqrt(variances[:, 3:].sum(axis=1)),
        tip=np.sqrt(np.einsum("pii->p", tips)),
        weakest_position=_weakest(tips),
        weakest_rotation=_weakest(prediction.covariances[:, 3:, 3:]),
        seen=prediction.seen.mean(axis=(0, 2)),
        fewest=prediction.seen.sum(axis=2).min(axis=0),
        undetermined=tuple(np.flatnonzero(~is_determined).tolist()),
        narrow=narrow,
        crowded=crowded,
        symmetries=len(plan.body.symmetries),
        alike=tuple(sorted(alike, key=lambda look_alike: look_alike.difference)),
    )


def pooled(errors: Floats) -> float:
    """Return the root mean square of errors at determined poses; infinite if there are none."""
    known = errors[np.isfinite(errors)]
    return float(np.sqrt((known**2).mean())) if known.size else float("inf")


def _weakest(covariances: Floats) -> Weakness | None:
    """Return the largest deviation of covariances (P, 3, 3), if any is determined."""
    is_known = np.isfinite(np.einsum("pii->p", covariances))
    if not is_known.any():
        return None
    values, vectors = np.linalg.eigh(np.where(is_known[:, None, None], covariances, 0.0))
    pose = int(values[:, 2].argmax())
    direction = vectors[pose, :, 2]
    direction = direction * np.sign(direction[np.abs(direction).argmax()])
    least = max(float(values[pose, 0]), 0.0)
    worst = float(values[pose, 2])
    ratio = float(np.sqrt(worst / least)) if least > 1e-18 * worst else float("inf")
    return Weakness(pose, float(np.sqrt(worst)), direction, ratio)


def _doubts(plan: Plan, prediction: Prediction) -> tuple[Floats, Floats]:
    """Return, by sensor, noise of features over `sigma`, and the share of features near others."""
    narrow, shares = np.zeros(len(plan.sensors)), np.zeros(len(plan.sensors))
    world = transform(prediction.poses, plan.body.means)
    for k, (sensor, noise) in enumerate(zip(plan.sensors, plan.noises, strict=True)):
        y, A, _ = sensor.linearise(world)
        # errors of markers in the sensor, along the axis on which they are largest
        marker_noise = plan.body.spread * np.linalg.norm(A, axis=-1).max(axis=-1)
        feature_noise = np.sqrt(noise**2 + marker_noise**2)
        seen = prediction.seen[:, k]
        narrow[k] = np.median(feature_noise[seen]) / plan.sigmas[k] if seen.any() else 0.0
        distances = np.linalg.norm(y[:, :, None] - y[:, None], axis=-1)
        distances[~(seen[:, :, None] & seen[:, None])] = np.inf
        distances[:, np.arange(len(plan.body)), np.arange(len(plan.body))] = np.inf
        crowded = distances.min(axis=2) < _NEAR * feature_noise
        shares[k] = crowded.sum() / max(int(seen.sum()), 1)
    return narrow, shares
