"""Guesses of all orientations, the body's middle where sensors see the middle of what they see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mixpose.optimise import NewtonOptions, Quadratic, ascend
from mixpose.records import Floats
from mixpose.rigid import from_parts, transform
from mixpose.search.problem import SearchProblem
from mixpose.search.refinement import Stage
from mixpose.search.spread import spread_turns
from mixpose.sensors import Sensor


def from_spread_orientations(problem: SearchProblem) -> tuple[Floats, list[Stage]]:
    """Poses (H, 4, 4) of all orientations, and how to descend from them."""
    budget = problem.budget
    turns = spread_turns(problem.free[3:], budget.orientation_step)
    rotations = turns @ problem.T_reference[:3, :3]
    poses = [_placed(problem, rotations, centre) for centre in _centres(problem)]
    wide = [
        max(budget.orientation_blur * each.spread / each.sigma, 1.0) for each in problem.detections
    ]
    stages = [
        Stage(tuple(w**share for w in wide), steps, survivors)
        for share, steps, survivors in budget.orientation_stages
    ]
    return np.concatenate(poses) if poses else np.zeros((0, 4, 4)), stages


def _centres(problem: SearchProblem) -> Floats:
    """Places (C, 3) of the body's centre at which all sensors see the middle of what they see."""
    budget, radius = problem.budget, problem.body.radius
    places = _starts(problem)
    middles = _Middles(problem, np.zeros((len(places), 1, 3)))
    places = middles.approached(places, budget.place_steps, limit=5 * radius)
    off = np.sqrt(-2 * middles.linearise(places).value)
    kept: list[int] = []
    for k in np.argsort(off, kind="stable"):
        apart = np.linalg.norm(places[k] - places[kept], axis=1)
        if off[k] < off.min() + radius and (apart > budget.different * radius).all():
            kept.append(int(k))
    return places[kept[: budget.sample // 2]]


def _placed(problem: SearchProblem, rotations: Floats, centre: Floats) -> Floats:
    """Poses (H, 4, 4) of assumed rotations (H, 3, 3) with the body's centre about `centre` (3,)."""
    body, shifts = problem.body, problem.free[:3]
    translations = centre - rotations @ body.means.mean(axis=0)
    translations = np.where(shifts, translations, problem.T_reference[:3, 3])
    middles = _Middles(problem, body.nodes.points @ rotations.swapaxes(1, 2))
    steps = problem.budget.place_steps // 4
    translations = middles.approached(translations, steps, limit=body.radius)
    return from_parts(rotations, translations)


def _starts(problem: SearchProblem) -> Floats:
    """Places (S, 3) to start from: on rays, as far as the body looks large, and about ranges."""
    body, T_reference = problem.body, problem.T_reference
    centre = body.means.mean(axis=0)
    size = float(np.sqrt(((body.nodes.points - centre) ** 2).sum(axis=1).mean()))
    held = transform(T_reference, centre[None])[0]
    starts = [] if problem.free.all() else [held]
    sources, ranges = [], []
    for each in problem.detections:
        ray = each.view.sensor.rays(each.mean[None])
        if ray is None:
            sources.append(_source(each.view.sensor, body.radius))
            ranges.append(float(each.mean[0]))
        elif len(ray):
            spread = max(each.spread, each.sigma) * ray.slope
            # a body as large as its features' spread is seen
            far = np.sqrt(2 / 3) * size / spread if ray.central else 0.0
            starts.append(ray.origins[0] + far * ray.directions[0])
    if sources:
        positions, distance = np.array(sources), float(np.mean(ranges))
        normal = np.linalg.svd(positions - positions.mean(axis=0))[2][-1]
        axes = np.concatenate([[normal], np.eye(3)])
        starts += list(positions.mean(axis=0) + distance * np.concatenate([axes, -axes]))
    return np.where(problem.free[:3], np.array(starts).reshape(-1, 3), held)


def _source(sensor: Sensor, length: float) -> Floats:
    """Where the directions towards a sensor meet (3,), in the sense of least squares."""
    probes = length * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    towards = sensor.towards(probes)
    towards = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-300)
    across = np.eye(3) - towards[:, :, None] * towards[:, None, :]
    right = (across @ probes[:, :, None]).sum(axis=0)[:, 0]
    return np.asarray(np.linalg.lstsq(across.sum(axis=0), right)[0])


@dataclass(frozen=True, eq=False)
class _Middles:
    """Minus half the squared distance of means of points from where sensors see the middle."""

    problem: SearchProblem
    arms: Floats  # (H, n, 3) from the places to points

    def linearise(self, places: Floats) -> Quadratic:
        """Second-order models at places (H, 3), of lengths: the sensors' units are taken off."""
        count, points = len(places), self.arms + places[:, None]
        A, b, off = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros(count)
        for each in self.problem.detections:
            y, by_world, seen = each.view.sensor.linearise(points)
            share = seen / np.maximum(seen.sum(axis=1, keepdims=True), 1)
            J = np.einsum("hn,hnmk->hmk", share, by_world)
            any_seen = np.asarray(seen.any(axis=1))
            residual = each.mean - np.einsum("hn,hnm->hm", share, y)
            residual = np.where(any_seen[:, None], residual, 0.0)
            scale = np.maximum((J * J).sum(axis=(1, 2)) / y.shape[2], 1e-30)
            A += np.einsum("hmk,hml->hkl", J, J) / scale[:, None, None]
            b += np.einsum("hmk,hm->hk", J, residual) / scale[:, None]
            off += np.where(any_seen, (residual**2).sum(axis=1) / scale, 1e30)
        return Quadratic(np.asarray(-0.5 * off), b, A)

    def approached(self, places: Floats, count: int, limit: float) -> Floats:
        """Places (H, 3) after so many steps, none longer than a limit."""

        def moved(places: Floats, steps: Floats) -> Floats:
            length = np.linalg.norm(steps, axis=1, keepdims=True)
            shares = np.minimum(1.0, limit / np.maximum(length, 1e-30))
            return np.asarray(places + steps * shares)

        options = NewtonOptions(count, damping=1e-6, unchecked=True)
        return np.asarray(ascend(self, places, moved, self.problem.free[:3], options).states)
