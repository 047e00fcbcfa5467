"""Other poses in which a body looks the same to its sensors, to within their noise.

From orientations all around, predicted features are drawn to the nearest ones that the sensors
would measure at the pose, step by step; what ends with a feature upon each feature is a pose that
the sensors hardly tell from it.  The body's exact symmetries do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from mixpose.body import Body
from mixpose.objective import pose_jacobian
from mixpose.records import Floats, Mask
from mixpose.rigid import perturb, rotation_angle_deg, transform
from mixpose.search import spread_turns
from mixpose.sensors import RangeSensor, Sensor
from mixpose.session import SensorSetup

NOISE_OF_SIGMA = 0.2
"""What centres of blobs and corners err by, of σ_ε; ranges err by σ_ε."""

_LIMIT = 5.0  # standard deviations between poses that some frames confuse, noise being a guess
_PROMISING = 10.0  # the same of one feature, before each is given one of its own
_STEP_RAD = 0.5  # between the orientations that are tried
_STEPS, _LAST_STEPS = 12, 8
_KEPT = 24  # orientations that are followed to the end
_MOST_FEATURES = 12  # features that orientations are tried with; all are compared in the end
_NEAR_DEG = 1.0  # poses closer than this are one


@dataclass(frozen=True)
class LookAlike:
    """A pose that looks like another.

    Attributes
    ----------
    T_world_object : (4, 4) float64
    turn_deg : float
        Angle between the two.
    difference : float
        Between the two patterns of features, in standard deviations of the noise.
    """

    T_world_object: Floats
    turn_deg: float
    difference: float


@dataclass(frozen=True)
class _Seen:
    """What one sensor measures at the pose: features y (V, m), whose they are, and their noise."""

    setup: SensorSetup
    y: Floats
    features: NDArray[np.intp]
    noise: float


def noise_of(setup: SensorSetup) -> float:
    """Standard deviation of one measured feature, in sensor units."""
    share = 1.0 if isinstance(setup.sensor, RangeSensor) else NOISE_OF_SIGMA
    return share * setup.extract.sigma


def look_alikes(
    setups: Sequence[SensorSetup], body: Body, T_world_object: Floats, free: Mask
) -> list[LookAlike]:
    """Poses that no sensor could tell from one, the most alike first.

    Parameters
    ----------
    setups : sequence of SensorSetup
    body : Body
    T_world_object : (4, 4) array
    free : (6,) bool
        Directions that are estimated; the others are the same in all poses.

    Returns
    -------
    list of LookAlike
        Each other than the pose, the body's symmetries and the others in the list by a degree.
    """
    views = [view for setup in setups if (view := _view(setup, body, T_world_object))]
    if not views or not free[3:].any():
        return []
    poses = _turned(T_world_object, body, free)
    chosen = _spread(body.means)
    for _ in range(2):  # the second half of the way is for the best only
        poses = _drawn_near(poses, views, body, chosen, free, _STEPS // 2)
        misfit = _misfit(poses, views, body, chosen)
        order = np.argsort(misfit, kind="stable")[:_KEPT]
        poses = poses[order[misfit[order] < _PROMISING**2]]
        if not len(poses):
            return []
    found: list[LookAlike] = []
    known = T_world_object @ body.symmetries
    for pose in poses:
        if rotation_angle_deg(pose, known).min() < _NEAR_DEG:
            continue
        settled, difference = _settled(pose, views, body, free)
        if difference > _LIMIT or rotation_angle_deg(settled, known).min() < _NEAR_DEG:
            continue
        alike = settled @ body.symmetries
        known = np.concatenate([known, alike])
        turn = float(rotation_angle_deg(alike, T_world_object).min())
        found.append(LookAlike(settled, turn, difference))
    return sorted(found, key=lambda other: other.difference)


def _view(setup: SensorSetup, body: Body, T_world_object: Floats) -> _Seen | None:
    y, seen = setup.sensor.project(transform(T_world_object, body.means))
    seen &= _faces(setup.sensor, T_world_object, body, np.arange(len(body)))
    if not seen.any():
        return None
    return _Seen(setup, y[seen], np.flatnonzero(seen), noise_of(setup))


def _turned(T_world_object: Floats, body: Body, free: Mask) -> Floats:
    """The pose turned all ways (B, 4, 4) about the body's middle, which stays in view."""
    turns = spread_turns(free[3:], _STEP_RAD)
    poses = np.broadcast_to(T_world_object, (len(turns), 4, 4)).copy()
    poses[:, :3, :3] = turns @ T_world_object[:3, :3]
    middle = body.means.mean(axis=0)
    shift = T_world_object[:3, :3] @ middle - poses[:, :3, :3] @ middle
    poses[:, :3, 3] += np.where(free[:3], shift, 0.0)
    return poses


def _spread(points: Floats) -> NDArray[np.intp]:
    """Indices of points far from each other, of all if there are few."""
    if len(points) <= _MOST_FEATURES:
        return np.arange(len(points))
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    away = np.full(len(points), np.inf)
    while len(chosen) < _MOST_FEATURES:
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
        chosen.append(int(away.argmax()))
    return np.array(chosen)


def _drawn_near(
    poses: Floats,
    views: Sequence[_Seen],
    body: Body,
    chosen: NDArray[np.intp],
    free: Mask,
    steps: int,
) -> Floats:
    """Poses (B, 4, 4) after steps in which every feature is drawn to the nearest measured one."""
    for _ in range(steps):
        normal = np.zeros((len(poses), 6, 6))
        pull = np.zeros((len(poses), 6))
        for view in views:
            y, J, visible = _linearised(view, poses, body, chosen)
            away = _distances(y, view.y)
            toward = view.y[away.argmin(axis=2)] - y
            _add(normal, pull, J, toward, visible / view.noise**2)
            # and every measured feature draws the nearest one, lest they all go to one place
            nearest = np.where(visible[:, :, None], away, np.inf).argmin(axis=1)
            at = np.arange(len(poses))[:, None]
            wanted = np.isin(view.features, chosen)
            nearest = nearest[:, wanted]
            toward = view.y[wanted] - y[at, nearest]
            _add(normal, pull, J[at, nearest], toward, visible[at, nearest] / view.noise**2)
        poses = perturb(poses, _step(normal, pull, free))
    return poses


def _misfit(poses: Floats, views: Sequence[_Seen], body: Body, chosen: NDArray[np.intp]) -> Floats:
    """Mean squared distance (B,) of features from the nearest measured ones, in noise."""
    total = np.zeros(len(poses))
    for view in views:
        y, visible = view.setup.sensor.project(transform(poses, body.means[chosen]))
        visible &= _faces(view.setup.sensor, poses, body, chosen)
        nearest = _distances(y, view.y).min(axis=2) / view.noise**2
        total += np.where(visible, nearest, 1e6).mean(axis=1)
    return total


def _settled(pose: Floats, views: Sequence[_Seen], body: Body, free: Mask) -> tuple[Floats, float]:
    """The pose that meets one feature with one measured feature best, and how far it stays off.

    The difference is infinite where as many features are not in view.
    """
    pose, everything = pose[None], np.arange(len(body))
    previous = np.inf
    for _ in range(_LAST_STEPS):
        normal, pull, difference = np.zeros((1, 6, 6)), np.zeros((1, 6)), 0.0
        for view in views:
            y, J, visible = _linearised(view, pose, body, everything)
            if visible.sum() != len(view.y):
                return pose[0], np.inf
            y, J = y[visible][None], J[visible][None]
            cost = _distances(y, view.y)[0]
            rows, columns = linear_sum_assignment(cost)
            difference += float(cost[rows, columns].sum()) / view.noise**2
            _add(
                normal,
                pull,
                J,
                (view.y[columns] - y[0])[None],
                np.full(y.shape[:2], view.noise**-2),
            )
        if difference >= previous * (1 - 1e-3):
            break
        previous = difference
        pose = perturb(pose, _step(normal, pull, free))
    return pose[0], float(np.sqrt(min(difference, previous)))


def _linearised(
    view: _Seen, poses: Floats, body: Body, chosen: NDArray[np.intp]
) -> tuple[Floats, Floats, Mask]:
    """Features (B, n, m), their Jacobian (B, n, m, 6) by the twist, and which are visible."""
    sensor, points = view.setup.sensor, body.means[chosen]
    y, by_world, visible = sensor.linearise(transform(poses, points))
    arms = points @ np.swapaxes(poses[:, :3, :3], -1, -2)
    visible = visible & _faces(sensor, poses, body, chosen)
    return y, pose_jacobian(by_world, arms), visible


def _faces(sensor: Sensor, poses: Floats, body: Body, chosen: NDArray[np.intp]) -> Mask:
    """Which features (..., n) turn their front to a sensor; all of a body without normals."""
    if body.normals is None:
        return np.ones((*poses.shape[:-2], len(chosen)), dtype=np.bool_)
    fronts = body.normals[chosen] @ np.swapaxes(poses[..., :3, :3], -1, -2)
    towards = sensor.towards(transform(poses, body.means[chosen]))
    return np.asarray((fronts * towards).sum(axis=-1) > 0)


def _distances(y: Floats, measured: Floats) -> Floats:
    """Squared distances (B, n, V) of features (B, n, m) from measured ones (V, m)."""
    return np.asarray(((y[:, :, None, :] - measured) ** 2).sum(axis=-1))


def _add(normal: Floats, pull: Floats, J: Floats, toward: Floats, weights: Floats) -> None:
    """Add to the normal equations, in place."""
    weighted = J * weights[:, :, None, None]
    count = len(J)
    rows = weighted.reshape(count, -1, 6)
    normal += np.swapaxes(rows, 1, 2) @ J.reshape(count, -1, 6)
    pull += np.einsum("bki,bk->bi", rows, toward.reshape(count, -1))


def _step(normal: Floats, pull: Floats, free: Mask) -> Floats:
    """Damped Gauss-Newton steps (B, 6) in the free directions."""
    inner = normal[:, free][:, :, free]
    scale = np.maximum(np.einsum("bii->bi", inner), np.finfo(np.float64).tiny)
    inner = inner + 1e-4 * scale[:, :, None] * np.eye(free.sum())
    step = np.zeros_like(pull)
    step[:, free] = np.linalg.solve(inner, pull[:, free, None])[..., 0]
    return step
