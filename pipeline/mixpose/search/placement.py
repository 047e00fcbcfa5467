"""Where the body is, once its orientation is assumed.

Its centre is where every sensor sees the middle of its detections.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.rigid import from_parts, transform
from mixpose.search.budget import SearchBudget
from mixpose.search.constraint import Constraint
from mixpose.search.detections import SensorDetections
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]


def centres(
    detections: Sequence[SensorDetections],
    body: Body,
    constraint: Constraint,
    budget: SearchBudget,
) -> Floats:
    """Places (C, 3) of the body's centre at which all sensors see the middle of what they see."""
    places = _starts(detections, body, constraint)
    for _ in range(budget.place_steps):
        A, b, off = _equations(detections, places[:, None])
        places = places + _solve(A, b, constraint.shifts, limit=5 * body.radius)
    _, _, off = _equations(detections, places[:, None])
    kept: list[int] = []
    for k in np.argsort(off, kind="stable"):
        apart = [np.linalg.norm(places[k] - places[other]) for other in kept]
        if off[k] < off.min() + body.radius and min(apart, default=np.inf) > (
            budget.different * body.radius
        ):
            kept.append(int(k))
    return places[kept[: budget.max_places]]


def place(
    detections: Sequence[SensorDetections],
    body: Body,
    rotations: Floats,
    centre: Floats,
    constraint: Constraint,
    steps: int,
) -> Floats:
    """Poses (H, 4, 4) of assumed rotations (H, 3, 3) with the body's centre about `centre` (3,)."""
    translations = centre - rotations @ body.means.mean(axis=0)
    reference = constraint.T_reference[:3, 3]
    translations = np.where(constraint.shifts, translations, reference)
    for _ in range(steps):
        poses = from_parts(rotations, translations)
        points = transform(poses, body.nodes.points)
        A, b, _ = _equations(detections, points)
        translations = translations + _solve(A, b, constraint.shifts, limit=body.radius)
    return from_parts(rotations, translations)


def _starts(detections: Sequence[SensorDetections], body: Body, constraint: Constraint) -> Floats:
    """Places (S, 3) to start from: on rays, as far as the body looks large, and about ranges."""
    centre = body.means.mean(axis=0)
    size = float(np.sqrt(((body.nodes.points - centre) ** 2).sum(axis=1).mean()))
    starts = [] if constraint.free.all() else [transform(constraint.T_reference, centre[None])[0]]
    sources, ranges = [], []
    for each in detections:
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
    places = np.array(starts).reshape(-1, 3)
    fixed = constraint.T_reference[:3] @ np.append(centre, 1.0)
    return np.where(constraint.shifts, places, fixed)


def _source(sensor: Sensor, length: float) -> Floats:
    """Where the directions towards a sensor meet (3,), in the sense of least squares."""
    probes = length * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    towards = sensor.towards(probes)
    away = np.linalg.norm(towards, axis=1)
    # from where the sensor stands it is seen in no direction
    probes, towards = probes[away > 0], towards[away > 0] / away[away > 0, None]
    across = np.eye(3) - towards[:, :, None] * towards[:, None, :]
    right = (across @ probes[:, :, None]).sum(axis=0)[:, 0]
    return np.asarray(np.linalg.lstsq(across.sum(axis=0), right)[0])


def _equations(
    detections: Sequence[SensorDetections], points: Floats
) -> tuple[Floats, Floats, Floats]:
    """Normal equations (H, 3, 3), (H, 3) of steps that bring means to where they are seen."""
    A, b = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    off = np.zeros(len(points))
    for each in detections:
        y, by_world, seen = each.view.sensor.linearise(points)
        share = seen / np.maximum(seen.sum(axis=1, keepdims=True), 1)
        J = np.einsum("hn,hnmk->hmk", share, by_world)
        any_seen = np.asarray(seen.any(axis=1))
        residual = np.where(any_seen[:, None], each.mean - np.einsum("hn,hnm->hm", share, y), 0.0)
        # per length: the sensor's units are taken off
        scale = np.maximum((J * J).sum(axis=(1, 2)) / y.shape[2], 1e-30)
        A += np.einsum("hmk,hml->hkl", J, J) / scale[:, None, None]
        b += np.einsum("hmk,hm->hk", J, residual) / scale[:, None]
        off += np.where(any_seen, (residual**2).sum(axis=1) / scale, 1e30)
    return A, b, np.sqrt(off)


def _solve(A: Floats, b: Floats, free: NDArray[np.bool_], limit: float) -> Floats:
    steps = np.zeros_like(b)
    if free.any():
        inner = A[:, free][:, :, free] + 1e-6 * np.eye(int(free.sum()))
        steps[:, free] = np.linalg.solve(inner, b[:, free][..., None])[..., 0]
    length = np.linalg.norm(steps, axis=1, keepdims=True)
    return np.asarray(steps * np.minimum(1.0, limit / np.maximum(length, 1e-30)))
