"""Find other poses in which a body looks the same to its sensors, to within their noise.

From orientations all around, poses climb until predicted features meet the nearest ones that the
sensors would measure at the given pose.  An end that pairs all features is a pose that the sensors
can hardly tell from it.  The body's exact symmetries do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from mixpose.body import Body
from mixpose.objective import BodyProjection, project_body
from mixpose.optimise import NewtonOptions, Quadratic, ascend, squares_of, stepped
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import perturb, rotation_angle_deg
from mixpose.search import far_apart, spread_rotations, thinned
from mixpose.sensors import RangeSensor, as_images
from mixpose.session import SensorSetup

NOISE_OF_SIGMA = 0.2
"""Error of centres of blobs and corners, as a share of σ_ε; ranges err by σ_ε."""

_LIMIT = 5.0  # standard deviations between poses that frames may confuse; the noise is a guess
_PROMISING = 10.0  # root mean square distance of features, in noise, before they are paired
_STEP_RAD = 0.5  # between the orientations that are tried
_KEPT = 24  # poses that are followed to the end
_MOST_FEATURES = 12  # features to try orientations with; all are compared in the end
_NEAR_DEG = 1.0  # poses closer than this are the same
_FAR = 1e6  # squared distance, in noise, of a feature out of view
_HALF_WAY = 6  # steps
_TO_THE_END = NewtonOptions(iterations=9, tolerance=1e-3)


@dataclass(frozen=True)
class LookAlike:
    """A pose that looks like another one."""

    T_world_object: Floats  # (4, 4)
    turn_deg: float  # angle between the two poses
    difference: float  # between the patterns of features, in standard deviations of the noise


def noise_of(setup: SensorSetup) -> float:
    """Return the standard deviation of one measured feature, in sensor units."""
    share = 1.0 if isinstance(setup.sensor, RangeSensor) else NOISE_OF_SIGMA
    return share * setup.extract.sigma


def look_alikes(
    setups: Sequence[SensorSetup], body: Body, T_world_object: Floats, free: Mask
) -> list[LookAlike]:
    """Find poses that look like a pose to all sensors, in free directions (6,), most alike first.

    They differ by a degree at least from the pose, its symmetric ones and each other.
    """
    noises = [noise_of(setup) for setup in setups]
    sensors, noise, _ = as_images([setup.sensor for setup in setups], noises)
    reduced = thinned(body, _MOST_FEATURES)
    projection = project_body(sensors, body)
    match = projection.project(T_world_object[None])
    measured = _Measured(projection, match.y[:, 0], match.seen[:, 0], noise)
    if not measured.seen.any() or not free[3:].any():
        return []
    poses = _turned(T_world_object, body, free)
    points = body.nodes.points
    chosen = np.arange(len(points)) if reduced is body else far_apart(points, _MOST_FEATURES)
    nearest = _Nearest(measured, project_body(sensors, reduced), chosen)
    for _ in range(2):  # only the best go the second half of the way
        poses = stepped(nearest, poses, perturb, free, _HALF_WAY).states
        misfit = nearest.misfit(poses)
        order = np.argsort(misfit, kind="stable")[:_KEPT]
        poses = poses[order[misfit[order] < _PROMISING**2]]
    known = T_world_object @ body.symmetries
    is_new = rotation_angle_deg(poses[:, None], known).min(axis=1, initial=180.0) >= _NEAR_DEG
    if not is_new.any():
        return []
    ends = ascend(measured, poses[is_new], perturb, free, _TO_THE_END)
    differences = np.sqrt(np.maximum(-2 * ends.values, 0.0))
    alike: list[LookAlike] = []
    for k in np.flatnonzero(differences <= _LIMIT):
        pose = ends.states[k]
        if rotation_angle_deg(pose, known).min() >= _NEAR_DEG:
            images = pose @ body.symmetries
            known = np.concatenate([known, images])
            turn = float(rotation_angle_deg(images, T_world_object).min())
            alike.append(LookAlike(pose, turn, float(differences[k])))
    return sorted(alike, key=lambda other: other.difference)


@dataclass(frozen=True, eq=False)
class _Measured:
    """The points, n of a body, that L sensors measure at the given pose, as an objective.

    Its value is minus half the squared distances, in noise, with points paired one to one; minus
    infinity at poses with another number of points in view.
    """

    projection: BodyProjection
    y: Floats  # (L, n, 2)
    seen: Mask  # (L, n)
    noise: Floats  # (L,)

    def linearise(self, poses: Floats) -> Quadratic:
        """Return second-order models at poses (H, 4, 4)."""
        match, toward = self.projection.project(poses), np.zeros((*self.seen.shape, 2))
        toward = np.repeat(toward[:, None], len(poses), axis=1)
        is_whole = np.ones(len(poses), dtype=np.bool_)
        for k, (y, seen) in enumerate(zip(self.y, self.seen, strict=True)):
            is_whole &= match.seen[k].sum(axis=1) == seen.sum()
            for h in np.flatnonzero(is_whole):
                offsets = y[seen] - match.y[k, h, match.seen[k, h], None]
                rows, columns = linear_sum_assignment((offsets**2).sum(axis=2))
                toward[k, h, match.seen[k, h]] = offsets[rows, columns]
        model = _least_squares(toward, match.J, match.seen, self.noise)
        return model._replace(value=np.where(is_whole, model.value, -np.inf))


@dataclass(frozen=True, eq=False)
class _Nearest:
    """Objective: minus half the squared distances of points to the nearest measured ones, in noise.

    And of the measured ones to the nearest points, lest all go to one place.
    """

    measured: _Measured
    projection: BodyProjection  # of these points
    chosen: Indices  # of these points among all

    def linearise(self, poses: Floats) -> Quadratic:
        """Return second-order models at poses (H, 4, 4)."""
        y, J, seen, squared = self._predicted(poses)
        whole, chosen = self.measured, self.chosen
        sensor, pose = np.ogrid[: len(y), : len(poses)]
        sensor, pose = sensor[..., None], pose[..., None]
        to = whole.y[sensor, squared.argmin(axis=3)]
        nearest = np.where(seen[..., None], squared, np.inf)[..., chosen].argmin(axis=2)
        back = whole.y[:, None, chosen] - y[sensor, pose, nearest]
        wanted = seen[sensor, pose, nearest] & whole.seen[:, None, chosen]
        toward = np.concatenate([to - y, back], axis=2)
        J_both = np.concatenate([J, J[sensor, pose, nearest]], axis=2)
        return _least_squares(toward, J_both, np.concatenate([seen, wanted], axis=2), whole.noise)

    def misfit(self, poses: Floats) -> Floats:
        """Return the mean squared distance (H,) of points from the nearest measured, in noise."""
        _, _, seen, squared = self._predicted(poses)
        nearest = squared.min(axis=3) / self.measured.noise[:, None, None] ** 2
        off = np.where(seen, nearest, _FAR).mean(axis=2)
        return np.asarray(off[self.measured.seen.any(axis=1)].sum(axis=0))

    def _predicted(self, poses: Floats) -> tuple[Floats, Floats, Mask, Floats]:
        """Return places, Jacobians, masks in view, squared distances (L, H, k, n) to measured."""
        match, whole = self.projection.project(poses), self.measured
        takes_part = np.asarray(whole.seen.any(axis=1))
        seen = match.seen & takes_part[:, None, None]
        squared = ((match.y[:, :, :, None] - whole.y[:, None, None]) ** 2).sum(axis=4)
        return match.y, match.J, seen, np.where(whole.seen[:, None, None], squared, np.inf)


def _least_squares(toward: Floats, J: Floats, seen: Mask, noise: Floats) -> Quadratic:
    """Return models of offsets (L, H, k, 2) in view with Jacobians (L, H, k, 2, 6)."""
    scale, (L, H, n) = noise[:, None, None, None], seen.shape
    residuals = np.where(seen[..., None], toward, 0.0) / scale
    rows = np.where(seen[..., None, None], J, 0.0) / scale[..., None]
    # by pose, of all sensors together
    together = residuals.swapaxes(0, 1).reshape(H, 2 * L * n)
    return squares_of(together, rows.swapaxes(0, 1).reshape(H, 2 * L * n, 6))


def _turned(T_world_object: Floats, body: Body, free: Mask) -> Floats:
    """Turn the pose all ways (H, 4, 4) about the body's middle, which stays in view."""
    turns, middle = spread_rotations(free[3:], _STEP_RAD), body.means.mean(axis=0)
    poses = np.broadcast_to(T_world_object, (len(turns), 4, 4)).copy()
    poses[:, :3, :3] = turns @ T_world_object[:3, :3]
    shift = T_world_object[:3, :3] @ middle - poses[:, :3, :3] @ middle
    poses[:, :3, 3] += np.where(free[:3], shift, 0.0)
    return poses
