"""Many poses at once: how guesses descend through narrowing blurs, and guesses of all orientations.

These have the body's middle where the sensors see the middle of what they see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.body import Body
from mixpose.objective import MatchedObjective, View, matched_objective
from mixpose.optimise import NewtonOptions, Quadratic, ascend
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import from_parts, perturb, transform
from mixpose.search.problem import SearchBudget, SearchProblem


class Stage(NamedTuple):
    """One blur of a descent: factors of σ_ε per sensor, steps at it, and how many poses go on."""

    factors: tuple[float, ...]
    steps: int
    survivors: int


@dataclass(frozen=True, eq=False)
class Descent:
    """Refines poses on the blurred observations of all sensors, which are drawn once per blur."""

    views: Sequence[View]
    body: Body
    free: Mask  # (6,) directions that may change
    budget: SearchBudget
    _objectives: dict[tuple[float, ...], MatchedObjective] = field(default_factory=dict)

    def objective(self, factors: tuple[float, ...] = ()) -> MatchedObjective:
        """The matched objective with features wider than σ_ε by factors per sensor; none: 1."""
        key = factors or (1.0,) * len(self.views)
        if key not in self._objectives:
            sigmas = [f * one.observation.sigma for f, one in zip(key, self.views, strict=True)]
            self._objectives[key] = matched_objective(self.views, self.body, sigmas)
        return self._objectives[key]

    def refine(self, poses: Floats, stages: Sequence[Stage]) -> Floats:
        """Poses (K, 4, 4) that are left of H after all stages.

        Where they are too many, the best: by the cosine between observed and predicted densities,
        summed over sensors.
        """
        # directions without any curvature stay
        for factors, steps, survivors in stages if len(poses) else ():
            objective = self.objective(factors)
            if steps:
                options = NewtonOptions(steps, damping=1e-3, unchecked=True)
                poses = ascend(objective, poses, self._moved, self.free, options).states
            if len(poses) > survivors:
                # of shares k/n, not of their squares: what counts is how many features are met
                values = np.sqrt(objective.shares(poses, whole=True)).sum(axis=0)
                poses = poses[np.argsort(-values, kind="stable")]
            poses = poses[unlike(self.body, poses, self.budget.alike / 5)[:survivors]]
        return poses

    def _moved(self, poses: Floats, twists: Floats) -> Floats:
        """Poses (H, 4, 4) moved by twists (H, 6), not farther than the linear model holds: 20°."""
        shift, turn = np.linalg.norm(twists.reshape(-1, 2, 3), axis=2).T
        longest = np.maximum(turn, 0.175 / max(self.body.radius, 1e-12) * shift)
        return perturb(poses, twists * np.minimum(1.0, 0.35 / np.maximum(longest, 1e-12))[:, None])


def unlike(body: Body, poses: Floats, cell: float) -> Indices:
    """Indices, ascending, of poses (H, 4, 4) that do not put the body where an earlier one does.

    Of very many, about: places of features are the same within cells whose side is a share `cell`
    of the body's radius.
    """
    corners = body.means[[0, len(body) // 2, -1]]
    places = transform(poses, corners).reshape(len(poses), corners.size)
    cells = np.round(places / (cell * body.radius)).astype(np.int64)
    keys = cells @ np.random.default_rng(0).integers(1, 2**40, cells.shape[1])
    return np.sort(np.unique(keys, return_index=True)[1])


def first_of_each(body: Body, poses: Floats, count: int, alike: float) -> list[int]:
    """Indices of the first `count` poses (H, 4, 4) that put the body somewhere else each.

    Poses are one where the root mean square distance of their features, symmetries aside, is less
    than a share `alike` of the body's radius.
    """
    kept, images = list[int](), np.zeros((0, len(body), 3))
    for k, pose in enumerate(poses):
        squares = ((transform(pose, body.means) - images) ** 2).sum(axis=-1).mean(axis=-1)
        if len(kept) < count and (squares > (alike * body.radius) ** 2).all():
            kept.append(k)
            images = np.concatenate([images, transform(pose @ body.symmetries, body.means)])
    return kept


def from_spread_orientations(problem: SearchProblem) -> tuple[Floats, list[Stage]]:
    """Poses (H, 4, 4) of all orientations, and how to descend from them."""
    body, budget, T_reference = problem.body, problem.budget, problem.T_reference
    rotations = spread_turns(problem.free[3:], budget.orientation_step) @ T_reference[:3, :3]
    shapes = _Middles(problem, body.nodes.points @ rotations.swapaxes(1, 2))
    poses = [np.zeros((0, 4, 4))]
    for centre in _centres(problem):
        places = centre - rotations @ body.means.mean(axis=0)
        places = np.where(problem.free[:3], places, T_reference[:3, 3])
        poses.append(from_parts(rotations, shapes.approached(places, 3, limit=body.radius)))
    # a turn by a step moves features by so much of their spread
    sigmas = [
        max(budget.orientation_step * one.moments[1] / one.sigma, 1.0) for one in problem.detections
    ]
    stages = [
        Stage(tuple(sigma**power for sigma in sigmas), steps, survivors)
        for power, steps, survivors in budget.orientation_stages
    ]
    return np.concatenate(poses), stages


def spread_turns(free: Mask, step: float) -> Floats:
    """Turns (count, 3, 3) about the free world axes (3,), about `step` radians apart."""
    around = int(free.sum())
    if around == 3:
        return spread_rotations(int(np.ceil(np.pi**2 * 1.5 / step**3)))
    steps = int(np.ceil(2 * np.pi / step))
    angles = -np.pi + 2 * np.pi * np.arange(steps) / steps
    axes = [angles if is_free else np.zeros(1) for is_free in free]
    vectors = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    vectors = vectors[np.linalg.norm(vectors, axis=1) <= np.pi + 1e-9]
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def spread_rotations(count: int) -> Floats:
    """Rotation matrices (count, 3, 3), a super-Fibonacci spiral over all orientations.

    M. Alexa, Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3), CVPR 2022.
    """
    s = np.arange(count) + 0.5
    r, R = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168756204288118041
    quaternions = [r * np.sin(alpha), r * np.cos(alpha), R * np.sin(beta), R * np.cos(beta)]
    return np.asarray(Rotation.from_quat(np.stack(quaternions, axis=1)).as_matrix())


def _centres(problem: SearchProblem) -> Floats:
    """Places (C, 3) of the body's centre at which all sensors see the middle of what they see."""
    radius, places = problem.body.radius, _starts(problem)
    middles = _Middles(problem, np.zeros((len(places), 1, 3)))
    places = middles.approached(places, 12, limit=5 * radius)
    off = np.sqrt(-2 * middles.linearise(places).value)
    kept = list[int]()
    for k in np.argsort(off, kind="stable"):
        apart = np.linalg.norm(places[k] - places[kept], axis=1)
        if off[k] < off.min() + radius and (apart > 0.2 * radius).all():
            kept.append(int(k))
    return places[kept[: problem.budget.sample // 2]]


def _starts(problem: SearchProblem) -> Floats:
    """Places (S, 3) to start from: on rays, as far as the body looks large, and about ranges."""
    body, centre = problem.body, problem.body.means.mean(axis=0)
    size = float(np.sqrt(((body.nodes.points - centre) ** 2).sum(axis=1).mean()))
    held = transform(problem.T_reference, centre[None])[0]
    starts = [] if problem.free.all() else [held]
    for one in problem.detections:
        mean, spread = one.moments
        rays = one.view.sensor.rays(mean[None])
        if rays is None:
            source = one.view.sensor.towards(np.zeros(3))
            starts += [source + sign * mean[0] * axis for sign in (1, -1) for axis in np.eye(3)]
        elif len(rays):
            # a body as large as its features' spread is seen
            across = max(spread, one.sigma) * rays.slope
            far = np.sqrt(2 / 3) * size / across if rays.central else 0.0
            starts.append(rays.origins[0] + far * rays.directions[0])
    return np.where(problem.free[:3], np.array(starts).reshape(-1, 3), held)


@dataclass(frozen=True, eq=False)
class _Middles:
    """Minus half the squared distance of means of points from where sensors see the middle."""

    problem: SearchProblem
    arms: Floats  # (H, n, 3) from the places to points

    def linearise(self, places: Floats) -> Quadratic:
        """Second-order models at places (H, 3), of lengths: the sensors' units are taken off."""
        count, points = len(places), self.arms + places[:, None]
        A, b, off = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros(count)
        for one in self.problem.detections:
            y, by_world, seen = one.view.sensor.linearise(points)
            share = seen / np.maximum(seen.sum(axis=1, keepdims=True), 1)
            J = np.einsum("hn,hnmk->hmk", share, by_world)
            any_seen = np.asarray(seen.any(axis=1))
            residual = one.moments[0] - np.einsum("hn,hnm->hm", share, y)
            residual = np.where(any_seen[:, None], residual, 0.0)
            scale = np.maximum((J * J).sum(axis=(1, 2)) / y.shape[2], 1e-30)
            A += np.einsum("hmk,hml->hkl", J, J) / scale[:, None, None]
            b += np.einsum("hmk,hm->hk", J, residual) / scale[:, None]
            off += np.where(any_seen, (residual**2).sum(axis=1) / scale, 1e30)
        return Quadratic(-0.5 * off, b, A)

    def approached(self, places: Floats, count: int, limit: float) -> Floats:
        """Places (H, 3) after so many steps, none longer than a limit."""

        def moved(places: Floats, steps: Floats) -> Floats:
            length = np.linalg.norm(steps, axis=1, keepdims=True)
            return np.asarray(places + steps * np.minimum(1.0, limit / np.maximum(length, 1e-30)))

        options = NewtonOptions(count, damping=1e-6, unchecked=True)
        return np.asarray(ascend(self, places, moved, self.problem.free[:3], options).states)
