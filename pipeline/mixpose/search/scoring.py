"""What poses explain: distinct detections, quickly, and the evidence that is judged by in the end.

Detections of a camera are drawn once as disks of labels into a plane across its rays, where the
projection is a matrix whatever the lens, so that one look-up per predicted feature says which
detection it meets.  Features that fall on the same detection count once: counting features would
favour poses that gather them all on one blob.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.body import Body
from mixpose.judgement import odds_of, paid_by_count
from mixpose.matching import Matches, crowding
from mixpose.objective import project_body
from mixpose.records import Floats, Indices, Mask
from mixpose.search.problem import SearchProblem, SensorDetections
from mixpose.search.three_points import cross
from mixpose.sensors import Rays


class LabelImage(NamedTuple):
    """Disks around the M detections of one camera, as large as errors of detections may be."""

    projection: Floats  # (3, 4) from the world to columns and rows of cells, homogeneous
    eye: Floats  # (4,) centre of projection, or the way to it from everywhere, homogeneous
    # (rows, columns) detection 1 to M; in the lower eight bits 255 at a detection, 0 at its rim.
    # Most are empty, and take no memory; the outermost are for certain
    cells: NDArray[np.int32]


def label_image(problem: SearchProblem, sensor: SensorDetections, rays: Rays) -> LabelImage:
    """Draw the detections of a camera."""
    middle = rays.directions.mean(axis=0)
    middle /= np.linalg.norm(middle)
    side = cross(middle, np.eye(3)[np.abs(middle).argmin()])
    side /= np.linalg.norm(side)
    axes, centre = np.array([side, cross(middle, side), middle]), rays.origins[0]
    to_plane, eye = np.column_stack([axes, -axes @ centre]), np.append(centre, 1.0)
    if not rays.central:
        to_plane[2], eye = [0.0, 0.0, 0.0, 1.0], np.append(-middle, 0.0)
    unit = rays.slope if rays.central else rays.offset
    points = rays.origins + rays.directions
    plane = points @ to_plane[:, :3].T + to_plane[:, 3]
    # how many px a unit of the plane is at each detection, whatever the lens
    _, J, _ = sensor.view.sensor.linearise(points)
    per_unit = np.sqrt(np.abs(np.linalg.det(J @ axes[:2].T))) * plane[:, 2] * unit
    radii = problem.reach(sensor) / np.where(per_unit > 0, per_unit, 1.0)
    # at 84° from the middle a ray misses the plane
    inside = plane[:, 2] > min(0.1, 0.5 * plane[:, 2].max())
    places, radii = (plane[:, :2] / plane[:, 2:] / unit)[inside], radii[inside]
    lower, extent = places.min(axis=0), np.ptp(places, axis=0)
    # four cells a radius: the rim is off by an eighth of it; 16 million at most
    step = max(np.median(radii) / 4, np.sqrt(np.prod(extent) / 2**24))
    margin = radii.max() + 2 * step
    columns, rows = (np.ceil((extent + 2 * margin) / step) + 1).astype(int)
    u, v = (margin - lower) / step
    cells = np.zeros((rows, columns), dtype=np.int32)
    _draw(cells, places / step + np.array([u, v]), radii / step)
    to_cells = np.array([[1 / (unit * step), 0.0, u], [0.0, 1 / (unit * step), v], [0.0, 0.0, 1.0]])
    return LabelImage(to_cells @ to_plane, eye, cells)


def _draw(cells: NDArray[np.int32], places: Floats, radii: Floats) -> None:
    """Disks of labels and nearness, at places (M, 2) in cells."""
    half = int(np.ceil(radii.max()))
    u, v = np.floor(places).astype(np.int64).T[..., None] + np.arange(-half, half + 1)
    du, dv = places[:, :1] - u - 0.5, places[:, 1:] - v - 0.5
    near = 1 - np.sqrt(dv[:, :, None] ** 2 + du[:, None] ** 2) / radii[:, None, None]
    label, iv, iu = np.nonzero(near > 0)
    value = (near[label, iv, iu] * 255).astype(np.int32)
    order = np.argsort(value, kind="stable")  # where disks overlap the nearest is drawn last
    label, iv, iu, value = (column[order] for column in (label, iv, iu, value))
    cells[v[label, iv], u[label, iu]] = ((label + 1) << 8) + value


def count_inliers(images: Sequence[LabelImage], body: Body, poses: Floats) -> tuple[Floats, Floats]:
    """Distinct detections (L, H) of each camera that poses (H, 4, 4) explain, and how nearly (H,).

    That is nearness, 0 to 1, summed over features, for ranking equals.
    """
    counts, near = np.zeros((len(images), len(poses))), np.zeros(len(poses))
    size = max(2**17 // len(body), 1)  # so many numbers stay in the cache
    for part in (slice(k, k + size) for k in range(0, len(poses), size)):
        axes = np.ascontiguousarray(poses[part, :3].transpose(1, 0, 2))
        world = axes[..., :3] @ body.means.T + axes[..., 3:]
        shape, world = world.shape[1:], world.reshape(3, -1)
        for k, image in enumerate(images):
            u, v, depth = image.projection[:, :3] @ world + image.projection[:, 3:]
            scale = 1.0 / np.maximum(depth, 1e-300)
            rows, columns = image.cells.shape
            column = np.clip(u * scale, 0.0, columns - 1.0).astype(np.int32)
            row = np.clip(v * scale, 0.0, rows - 1.0).astype(np.int32)
            met = np.take(image.cells, row * columns + column)
            if body.normals is not None:
                outward = (axes[..., :3] @ body.normals.T).reshape(3, -1)
                towards = image.eye[:3, None] - image.eye[3] * world
                met = np.where((outward * towards).sum(axis=0) > 0, met, 0)
            met = met.reshape(shape)
            labels = np.sort(met >> 8, axis=1)
            labels[:, 1:] *= labels[:, 1:] != labels[:, :-1]
            counts[k, part] = np.count_nonzero(labels, axis=1)
            near[part] += (met & 255).sum(axis=1) / 256
    return counts, near


def evidence(problem: SearchProblem, poses: Floats) -> tuple[Floats, Floats]:
    """Log odds (H,) of poses (H, 4, 4) against clutter, paid by count, and shares of the body met.

    All sensors are cameras.
    """
    body, free, rules = problem.body, problem.free, problem.rules
    matches = _matches_of(problem, poses)
    met = matches.met * matches.dimensions
    # of each sensor: what one that is covered meets by chance tells nothing of the others
    spare = met * np.maximum(1 - free.sum() / np.maximum(met.sum(axis=1), 1.0), 0.0)[:, None]
    squares, errors = np.where(spare > 0, matches.squares, 0.0), rules.noise.errors
    degrees = errors.typical_degrees
    variances = (degrees * errors.typical**2 + squares) / (degrees + spare)
    odds = odds_of(matches, variances, np.full(len(poses), 2 * body.radius), rules.detection)
    shares = matches.met / np.maximum(matches.expected, 1.0)
    return paid_by_count(odds, matches, free), shares.mean(axis=1)


def _matches_of(problem: SearchProblem, poses: Floats) -> Matches:
    """Detections that sensors have where they are predicted to see the features of poses."""
    sensors, rules = problem.detections, problem.rules.association
    projection = project_body(tuple(one.view.sensor for one in sensors), problem.body)
    at, sigmas = projection.project(poses), np.array([one.sigma for one in sensors])
    shares, offsets, crowd = np.zeros(at.seen.shape), np.zeros(at.y.shape), []
    for k, (sensor, y, seen) in enumerate(zip(sensors, at.y, at.seen, strict=True)):
        points, sigma = sensor.points, sensor.sigma
        pose, feature, detection = _pairs(y, seen, points, problem.reach(sensor))
        shares[k, pose, feature] = 1.0
        offsets[k, pose, feature] = (points[detection] - y[pose, feature]) / sigma
        lower, upper = points.min(axis=0)[None], points.max(axis=0)[None]
        if rules.crowded:
            inside, blind = seen[..., None], ~seen.any(axis=1)[:, None]
            lower = np.where(blind, 0.0, np.where(inside, y, np.inf).min(axis=1))
            upper = np.where(blind, 0.0, np.where(inside, y, -np.inf).max(axis=1))
        dense = crowding(points, lower, upper, rules.min_region * sigma) * sigma**2
        crowd.append(np.broadcast_to(dense, len(poses)))
    nothing = np.zeros((len(poses), len(sensors)))
    return Matches(
        names=tuple(one.view.name for one in sensors),
        dimensions=projection.dimensions,
        sigmas=sigmas,
        weights=at.seen.swapaxes(0, 1).astype(np.float64),
        shares=shares.swapaxes(0, 1),
        places=at.y.swapaxes(0, 1),
        offsets=offsets.swapaxes(0, 1),
        J=(at.J / sigmas[:, None, None, None, None]).swapaxes(0, 1),
        detections=np.full(at.seen.shape, -1).swapaxes(0, 1),
        explained=nothing,
        unseen=np.count_nonzero(at.faced & ~at.seen, axis=2).T,
        merged=nothing.astype(np.intp),
        count=nothing + [len(one.points) for one in sensors],
        crowd=np.stack(crowd, axis=1),
        unmatched_nearby=nothing,
        finest=nothing + 1.0,
    )


def _pairs(y: Floats, seen: Mask, points: Floats, reach: float) -> tuple[Indices, Indices, Indices]:
    """Poses, features and detections (C,) of places (K, N, 2) that are met within reach.

    A detection is met by the nearest of the features to which it is the nearest.
    """
    pose, feature = np.nonzero(seen)
    away, nearest = cKDTree(points).query(y[pose, feature], distance_upper_bound=reach)
    order = np.argsort(away, kind="stable")[: np.count_nonzero(np.isfinite(away))]
    _, first = np.unique(pose[order] * len(points) + nearest[order], return_index=True)
    met = order[first]
    return pose[met], feature[met], nearest[met]
