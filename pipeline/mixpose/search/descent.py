"""Many poses at once: how they descend through narrowing blurs, and those of all orientations."""

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
from mixpose.search.problem import SearchBudget, SearchProblem, SensorDetections


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


def from_spread_orientations(problem: SearchProblem) -> tuple[Floats, list[Stage]]:
    """Poses (H, 4, 4) of all orientations, and how to descend from them."""
    budget, T_reference, free = problem.budget, problem.T_reference, problem.free
    rotations = spread_turns(free[3:], budget.orientation_step) @ T_reference[:3, :3]
    places = _centres(problem)[:, None] - rotations @ problem.body.means.mean(axis=0)
    poses = from_parts(rotations, np.where(free[:3], places, T_reference[:3, 3]))
    # a turn by a step moves features by so much of their spread
    blurs = [budget.orientation_step * one.moments[1] / one.sigma for one in problem.detections]
    stages = [
        Stage(tuple(max(blur, 1.0) ** power for blur in blurs), steps, survivors)
        for power, steps, survivors in budget.orientation_stages
    ]
    return poses.reshape(-1, 4, 4), stages


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
    radius, middles = problem.body.radius, _Middles(problem.detections)

    def moved(places: Floats, steps: Floats) -> Floats:
        length = np.linalg.norm(steps, axis=1, keepdims=True)
        return np.asarray(places + steps * np.minimum(1.0, 5 * radius / np.maximum(length, 1e-30)))

    options = NewtonOptions(12, damping=1e-6, unchecked=True)
    places = ascend(middles, _starts(problem), moved, problem.free[:3], options).states
    off, kept = np.sqrt(-2 * middles.linearise(places).value), list[int]()
    for k in np.argsort(off, kind="stable").tolist():
        apart = np.linalg.norm(places[k] - places[kept], axis=1)
        if off[k] < off.min() + radius and (apart > 0.2 * radius).all():
            kept.append(k)
    return np.asarray(places[kept[: problem.budget.sample // 2]])


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
            starts += [source + sign * mean * axis for sign in (1, -1) for axis in np.eye(3)]
        elif len(rays):
            # a body as large as its features' spread is seen
            across = max(spread, one.sigma) * rays.slope
            far = np.sqrt(2 / 3) * size / across if rays.central else 0.0
            starts.append(rays.origins[0] + far * rays.directions[0])
    return np.where(problem.free[:3], np.array(starts).reshape(-1, 3), held)


@dataclass(frozen=True)
class _Middles:
    """Minus half the squared distance of a place from where sensors see the middle of features."""

    detections: Sequence[SensorDetections]

    def linearise(self, places: Floats) -> Quadratic:
        """Second-order models at places (H, 3), of lengths: the sensors' units are taken off."""
        value, pull, C = np.zeros(len(places)), np.zeros((len(places), 3)), np.zeros((1, 3, 3))
        for one in self.detections:
            y, J, _ = one.view.sensor.linearise(places)
            scale = np.sqrt(np.maximum((J * J).mean(axis=1).sum(axis=1), 1e-30))[:, None]
            J, residual = J / scale[..., None], (one.moments[0] - y) / scale
            value -= 0.5 * (residual**2).sum(axis=1)
            pull = pull + np.einsum("hmk,hm->hk", J, residual)
            C = C + np.einsum("hmk,hml->hkl", J, J)
        return Quadratic(value, pull, C)
