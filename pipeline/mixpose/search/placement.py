"""Where the body is, once its orientation is assumed.

Its centre is where every sensor sees the middle of its detections; or, where few directions are
free, one feature on one line of sight says it all.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.records import PointPattern
from mixpose.rigid import from_parts, transform
from mixpose.search.constraint import Constraint
from mixpose.search.sightings import Sighting
from mixpose.search.sightlines import sightlines
from mixpose.search.triangulation import Meetings
from mixpose.sensors import RangeSensor

Floats: TypeAlias = NDArray[np.float64]

_STEPS = 12
_FINAL_STEPS = 3
_DIFFERENT = 0.2  # of the body's radius: nearer centres are one


def middle(sighting: Sighting) -> tuple[Floats, float]:
    """Mean (m,) of a sensor's pattern, and its root mean square spread."""
    pattern = sighting.view.observation.pattern
    if isinstance(pattern, PointPattern):
        centre = pattern.points.mean(axis=0)
        return centre, float(np.sqrt(((pattern.points - centre) ** 2).sum(axis=1).mean()))
    values = np.maximum(pattern.values.astype(np.float64), 0.0)
    values = np.where(values > 0.1 * values.max(), values, 0.0)
    means, variance = [], 0.0
    for k in range(len(pattern.origin)):
        along = values.sum(axis=0 if k == 0 else 1)
        places = pattern.origin[k] + pattern.step * np.arange(len(along))
        means.append(float(along @ places / along.sum()))
        variance += float(along @ (places - means[-1]) ** 2 / along.sum())
    return np.array(means), float(np.sqrt(variance))


def centres(sightings: Sequence[Sighting], body: Body, constraint: Constraint) -> Floats:
    """Places (C, 3) of the body's centre at which all sensors see the middle of what they see."""
    starts = _starts(sightings, body, constraint)
    middles = [middle(sighting)[0] for sighting in sightings]
    places, off = starts, np.full(len(starts), np.inf)
    for _ in range(_STEPS):
        A, b, off = _equations(sightings, middles, places[:, None])
        places = places + _solve(A, b, constraint.shifts, limit=5 * body.radius)
    _, _, off = _equations(sightings, middles, places[:, None])
    kept: list[int] = []
    for k in np.argsort(off, kind="stable"):
        apart = [np.linalg.norm(places[k] - places[other]) for other in kept]
        if off[k] < off.min() + body.radius and min(apart, default=np.inf) > (
            _DIFFERENT * body.radius
        ):
            kept.append(int(k))
    return places[kept[:4]]


def place(
    sightings: Sequence[Sighting],
    body: Body,
    rotations: Floats,
    centre: Floats,
    constraint: Constraint,
) -> Floats:
    """Poses (H, 4, 4) of assumed rotations (H, 3, 3) with the body's centre about `centre` (3,)."""
    middles = [middle(sighting)[0] for sighting in sightings]
    translations = centre - rotations @ body.means.mean(axis=0)
    reference = constraint.T_reference[:3, 3]
    translations = np.where(constraint.shifts, translations, reference)
    for _ in range(_FINAL_STEPS):
        poses = from_parts(rotations, translations)
        points = transform(poses, body.nodes.points)
        A, b, _ = _equations(sightings, middles, points)
        translations = translations + _solve(A, b, constraint.shifts, limit=body.radius)
    return from_parts(rotations, translations)


def _starts(sightings: Sequence[Sighting], body: Body, constraint: Constraint) -> Floats:
    centre = body.means.mean(axis=0)
    size = float(np.sqrt(((body.nodes.points - centre) ** 2).sum(axis=1).mean()))
    starts = [] if constraint.free.all() else [transform(constraint.T_reference, centre[None])[0]]
    for sighting in sightings:
        mean, spread = middle(sighting)
        line = sightlines(sighting.view.sensor, mean[None])
        if line is not None and len(line):
            spread = max(spread, sighting.sigma) * line.slope
            # a body as large as its features' spread is seen
            far = np.sqrt(2 / 3) * size / spread if line.central else 0.0
            starts.append(line.origins[0] + far * line.directions[0])
    sources, ranges = [], []
    for sighting in sightings:
        if isinstance(sighting.view.sensor, RangeSensor):
            sources.append(sighting.view.sensor.position)
            ranges.append(middle(sighting)[0][0])
    if sources:
        positions, distance = np.array(sources), float(np.mean(ranges))
        normal = np.linalg.svd(positions - positions.mean(axis=0))[2][-1]
        axes = np.concatenate([[normal], np.eye(3)])
        starts += list(positions.mean(axis=0) + distance * np.concatenate([axes, -axes]))
    places = np.array(starts).reshape(-1, 3)
    fixed = constraint.T_reference[:3] @ np.append(centre, 1.0)
    return np.where(constraint.shifts, places, fixed)


def _equations(
    sightings: Sequence[Sighting], middles: Sequence[Floats], points: Floats
) -> tuple[Floats, Floats, Floats]:
    """Normal equations (H, 3, 3), (H, 3) in length units that bring means to the middles."""
    A, b = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    off = np.zeros(len(points))
    for sighting, wanted in zip(sightings, middles, strict=True):
        y, by_world, seen = sighting.view.sensor.linearise(points)
        share = seen / np.maximum(seen.sum(axis=1, keepdims=True), 1)
        J = np.einsum("hn,hnmk->hmk", share, by_world)
        any_seen = np.asarray(seen.any(axis=1))
        residual = np.where(any_seen[:, None], wanted - np.einsum("hn,hnm->hm", share, y), 0.0)
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


def on_lines(
    sightings: Sequence[Sighting], body: Body, rotations: Floats, constraint: Constraint
) -> Iterator[Floats]:
    """Poses with one feature on one line of sight, for at most two free shifts.

    Yields
    ------
    (K, 4, 4) array
        For one camera: all rotations (H, 3, 3), features and lines.
    """
    shifts = np.eye(3)[:, constraint.shifts]
    reference = constraint.T_reference[:3, 3]
    spots = rotations @ body.means.T + reference[:, None]
    for sighting in sightings:
        lines = sighting.lines
        if lines is None or len(lines) == 0:
            continue
        across = np.eye(3) - lines.directions[:, :, None] * lines.directions[:, None, :]
        solver = np.linalg.pinv(across @ shifts)
        gap = lines.origins[:, None, None] - spots.transpose(0, 2, 1)[None]
        shift = np.einsum("mfk,mhnk->mhnf", solver @ across, gap)
        translations = reference + shift @ shifts.T
        wide = np.broadcast_to(rotations[None, :, None], (*translations.shape[:3], 3, 3))
        yield from_parts(wide.reshape(-1, 3, 3), translations.reshape(-1, 3))


def on_points(meetings: Meetings, body: Body, rotations: Floats) -> Floats:
    """Poses with one feature at one point in space, for all rotations (H, 3, 3)."""
    spots = (rotations @ body.means.T).transpose(0, 2, 1)
    translations = meetings.points[:, None, None] - spots[None]
    wide = np.broadcast_to(rotations[None, :, None], (*translations.shape[:3], 3, 3))
    return from_parts(wide.reshape(-1, 3, 3), translations.reshape(-1, 3))
