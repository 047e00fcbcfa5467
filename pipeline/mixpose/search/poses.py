"""Evaluate and refine many poses at once, and make start poses of all orientations.

The detections of a camera are drawn once as labelled disks in a plane across its rays, where the
projection is a matrix whatever the lens, so that one look-up per predicted feature says which
detection it meets.  Features that fall on the same detection count once: counting features would
favour poses that gather them all on one blob.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mixpose.body import Body
from mixpose.judgement import odds_of, paid_by_count
from mixpose.matching import Matches, crowding, owners_of
from mixpose.objective import MatchedObjective, View, matched_objective, project_body
from mixpose.optimise import Quadratic, Sum, squares_of, stepped
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import cross, from_parts, perturb, transform
from mixpose.search.problem import SearchBudget, SearchProblem, SensorDetections
from mixpose.sensors import Rays, clouds_among, from_planes


class LabelImage(NamedTuple):
    """Labelled disks around the M detections of one camera, of the radius of the largest error."""

    projection: Floats  # (3, 4) from the world to columns and rows of cells, homogeneous
    eye: Floats  # (4,) homogeneous centre of projection; a direction if the rays are parallel
    # (rows, columns) number of the detection, 1 to M, above eight bits of nearness: 255 at the
    # detection, 0 at its rim.  Most cells are empty and take no memory, the outermost always.
    cells: NDArray[np.int32]


def label_image(sensor: SensorDetections, rays: Rays, reach: float) -> LabelImage:
    """Draw the detections of a camera as disks of radius `reach` in px."""
    middle = rays.directions.mean(axis=0)
    middle /= np.linalg.norm(middle)
    side = cross(middle, np.eye(3)[np.abs(middle).argmin()])
    side /= np.linalg.norm(side)
    axes, centre = np.array([side, cross(middle, side), middle]), rays.origins[0]
    to_plane, eye = np.column_stack([axes, -axes @ centre]), np.append(centre, 1.0)
    if not rays.central:
        to_plane[2], eye = [0.0, 0.0, 0.0, 1.0], np.append(-middle, 0.0)
    if rays.cloud is not None:
        eye = np.zeros(4)  # a cloud sees features from all sides
    unit = rays.slope if rays.central else rays.offset
    points = rays.origins + rays.directions
    plane = points @ to_plane[:, :3].T + to_plane[:, 3]
    # px per unit of the plane at each detection, whatever the lens
    J = sensor.view.sensor.linearise(points)[1]
    per_unit = np.sqrt(np.abs(np.linalg.det(J @ axes[:2].T))) * plane[:, 2] * unit
    radii = reach / np.where(per_unit > 0, per_unit, 1.0)
    # rays more than 84° from the middle are left out
    inside = plane[:, 2] > min(0.1, 0.5 * plane[:, 2].max())
    places, radii = (plane[:, :2] / plane[:, 2:] / unit)[inside], radii[inside]
    lower, extent = places.min(axis=0), np.ptp(places, axis=0)
    # four cells per radius put the rim off by an eighth of it; 16 million cells at most
    step = max(np.median(radii) / 4, np.sqrt(np.prod(extent) / 2**24))
    margin = radii.max() + 2 * step
    columns, rows = (np.ceil((extent + 2 * margin) / step) + 1).astype(int)
    shift = (margin - lower) / step
    (u, v), radii = (places / step + shift).T[..., None], radii[:, None] / step
    steps = np.arange(-np.ceil(radii.max()), np.ceil(radii.max()) + 1)
    column, row = (np.floor(middle).astype(np.intp) + steps.astype(np.intp) for middle in (u, v))
    du, dv = (u - column - 0.5) / radii, (v - row - 0.5) / radii
    near = 1 - np.sqrt(dv[:, :, None] ** 2 + du[:, None] ** 2)
    label, iv, iu = np.nonzero(near > 0)
    value = (near[label, iv, iu] * 255).astype(np.int32)
    # where disks overlap, the nearest detection is drawn last
    label, iv, iu, value = np.array([label, iv, iu, value])[:, np.argsort(value, kind="stable")]
    cells = np.zeros((rows, columns), dtype=np.int32)
    cells[row[label, iv], column[label, iu]] = ((label + 1) << 8) + value
    to_cells = np.diag([1 / (unit * step), 1 / (unit * step), 1.0])
    to_cells[:2, 2] = shift
    return LabelImage(to_cells @ to_plane, eye, cells)


def count_inliers(images: Sequence[LabelImage], body: Body, poses: Floats) -> tuple[Floats, Floats]:
    """Count distinct detections (L, H) that poses explain, and sum nearness (H,), 0 to 1 each."""
    counts, nearness = np.zeros((len(images), len(poses))), np.zeros(len(poses))
    chunk = max(2**17 // len(body), 1)  # poses whose numbers stay in the cache
    for part in (slice(k, k + chunk) for k in range(0, len(poses), chunk)):
        axes = np.ascontiguousarray(poses[part, :3].transpose(1, 0, 2))
        world = axes[..., :3] @ body.means.T + axes[..., 3:]
        shape, world = world.shape[1:], world.reshape(3, -1)
        for k, image in enumerate(images):
            u, v, depth = image.projection[:, :3] @ world + image.projection[:, 3:]
            scale = 1.0 / np.maximum(depth, 1e-300)
            rows, columns = image.cells.shape
            with np.errstate(over="ignore"):  # points behind the camera overflow
                column = np.clip(u * scale, 0.0, columns - 1.0).astype(np.int32)
                row = np.clip(v * scale, 0.0, rows - 1.0).astype(np.int32)
            cells = np.take(image.cells, row * columns + column)
            if body.normals is not None and image.eye.any():
                outward = (axes[..., :3] @ body.normals.T).reshape(3, -1)
                towards = image.eye[:3, None] - image.eye[3] * world
                cells = np.where((outward * towards).sum(axis=0) > 0, cells, 0)
            cells = cells.reshape(shape)
            labels = np.sort(cells >> 8, axis=1)
            labels[:, 1:] *= labels[:, 1:] != labels[:, :-1]
            counts[k, part] = np.count_nonzero(labels, axis=1)
            nearness[part] += (cells & 255).sum(axis=1) / 256
    return counts, nearness


def evidence(problem: SearchProblem, poses: Floats) -> tuple[Floats, Floats]:
    """Return log odds (H,) of poses against clutter, paid by count, and shares of features met."""
    matches = matches_of(problem, poses)
    shares = matches.met / np.maximum(matches.expected, 1.0)
    return paid_by_count(odds_at(problem, matches), matches, problem.free), shares.mean(axis=1)


def odds_at(problem: SearchProblem, matches: Matches) -> tuple[Floats, Floats, Floats]:
    """Return the terms of `odds_of`, (H,) each, before poses pay for having been chosen."""
    body, free, rules = problem.body, problem.free, problem.rules
    met = matches.measurements
    # by sensor: what a covered sensor meets by chance says nothing of the others' noise
    spare = met * np.maximum(1 - free.sum() / np.maximum(met.sum(axis=1), 1.0), 0.0)[:, None]
    squares, errors = np.where(spare > 0, matches.squares, 0.0), rules.noise.errors
    degrees, size = errors.typical_degrees, np.full(len(met), 2 * body.radius)
    variances = (degrees * errors.typical**2 + squares) / (degrees + spare)
    return odds_of(matches, variances, size, rules.detection, surfaces=body.surfaces)


def matches_of(problem: SearchProblem, poses: Floats) -> Matches:
    """Match predicted features of poses with the detections of all sensors."""
    sensors, rules = problem.detections, problem.rules.association
    projection = project_body(tuple(sensor.view.sensor for sensor in sensors), problem.body)
    sigmas, projected = np.array([sensor.sigma for sensor in sensors]), projection.project(poses)
    y, J = projected.y.swapaxes(0, 1), projected.J.swapaxes(0, 1)
    seen, faced = projected.seen.swapaxes(0, 1), projected.faced.swapaxes(0, 1)
    shares, offsets = np.zeros(seen.shape), np.zeros(y.shape)
    crowd, clutter = np.zeros((2, *seen.shape[:2]))
    detections = np.full(seen.shape, -1)
    boxes = np.where(seen[..., None] & rules.crowded, y, np.nan)
    lower, upper = np.fmin.reduce(boxes, axis=2), np.fmax.reduce(boxes, axis=2)
    pairs = _pairs_in_space(problem, y, seen)
    for k, (sensor, sigma) in enumerate(zip(sensors, sigmas, strict=True)):
        points, smallest = sensor.points, rules.min_region * sigma
        pose, feature, detection = pairs.get(k) or _pairs(
            y[:, k], seen[:, k], points, problem.reach(sensor)
        )
        shares[pose, k, feature], detections[pose, k, feature] = 1.0, detection
        offsets[pose, k, feature] = (points[detection] - y[pose, k, feature]) / sigma
        crowd_inputs = points, lower[:, k], upper[:, k], smallest, shares[:, k].sum(axis=1)
        in_view, in_space = crowding(*crowd_inputs)
        crowd[:, k], clutter[:, k] = in_view * sigma**2, in_space * sigma**3
    clouds = clouds_among(tuple([sensor.view.sensor for sensor in sensors]))
    for planes in clouds:
        points = from_planes(np.array([sensors[k].points for k in planes]))
        low, high = (from_planes(box[:, planes].swapaxes(0, 1)) for box in (lower, upper))
        smallest, met = rules.min_region * sigmas[planes[0]], shares[:, planes[0]].sum(axis=1)
        dense = crowding(points, low, high, smallest, met, deep=1.0)[1]
        clutter[:, planes] = dense[:, None] * sigmas[planes] ** 3
    zeros = np.zeros(crowd.shape)
    return Matches(
        names=tuple(sensor.view.name for sensor in sensors),
        dimensions=projection.dimensions,
        sigmas=sigmas,
        weights=seen.astype(np.float64),
        shares=shares,
        places=y,
        offsets=offsets,
        J=J / sigmas[:, None, None, None],
        detections=detections,
        explained=zeros,
        unseen=np.count_nonzero(faced & ~seen, axis=2),
        cut=np.full((*seen.shape, 2), np.nan),
        merged=zeros.astype(np.intp),
        count=zeros + [len(sensor.points) for sensor in sensors],
        crowd=crowd,
        space_crowd=clutter,
        unmatched_nearby=zeros,
        neighbour_distance=np.full(seen.shape, np.nan),
        extra=np.zeros(seen.shape),
        radii=np.zeros(seen.shape),
        finest=zeros + 1.0,
        owners=owners_of(len(sensors), clouds),
    )


def _pairs_in_space(
    problem: SearchProblem, y: Floats, seen: Mask
) -> dict[int, tuple[Indices, Indices, Indices]]:
    """Return the result of `_pairs` in space for the images of clouds, the same for all three."""
    sensors, pairs = problem.detections, dict[int, tuple[Indices, Indices, Indices]]()
    for planes in clouds_among(tuple([sensor.view.sensor for sensor in sensors])):
        points = from_planes(np.array([sensors[k].points for k in planes]))
        places = from_planes(y[:, planes].swapaxes(0, 1))
        shared = _pairs(places, seen[:, planes[0]], points, problem.reach(sensors[planes[0]]))
        pairs |= dict.fromkeys(planes, shared)
    return pairs


def _pairs(y: Floats, seen: Mask, points: Floats, reach: float) -> tuple[Indices, Indices, Indices]:
    """Return pose, feature and detection (C,) of the places (K, N, 2) met within reach.

    A detection is met by the nearest of the features whose nearest detection it is.
    """
    pose, feature = np.nonzero(seen)
    distances, nearest = cKDTree(points).query(y[pose, feature], distance_upper_bound=reach)
    order = np.argsort(distances, kind="stable")[: np.count_nonzero(np.isfinite(distances))]
    chosen = order[np.unique(pose[order] * len(points) + nearest[order], return_index=True)[1]]
    return pose[chosen], feature[chosen], nearest[chosen]


Stage: TypeAlias = tuple[tuple[float, ...], int, int]
"""One blur of a descent: factors of σ_ε per sensor, number of steps, and of poses that go on."""


@dataclass(frozen=True, eq=False)
class Descent:
    """Refine poses on blurred observations of all sensors, which are drawn once per blur."""

    views: Sequence[View]
    body: Body
    free: Mask  # (6,) directions that may change
    budget: SearchBudget
    _objectives: dict[tuple[float, ...], MatchedObjective] = field(default_factory=dict)

    def objective(self, factors: tuple[float, ...] = ()) -> MatchedObjective:
        """Return the matched objective with blurs of σ_ε times a factor per sensor, or 1."""
        key = factors or (1.0,) * len(self.views)
        if key not in self._objectives:
            sigmas = [f * view.observation.sigma for f, view in zip(key, self.views, strict=True)]
            self._objectives[key] = matched_objective(self.views, self.body, sigmas)
        return self._objectives[key]

    def refine(self, poses: Floats, stages: Sequence[Stage]) -> Floats:
        """Return the poses (K, 4, 4) that remain of H after all stages: the best and distinct."""
        # directions without curvature are not changed
        for factors, steps, survivors in stages if len(poses) else ():
            objective = self.objective(factors)
            if steps:
                ascent = stepped(objective, poses, self._move, self.free, steps, damping=1e-3)
                poses = ascent.states
            if len(poses) > survivors:
                # shares are near (k/n)²: their roots count the k of n features that are met
                values = np.sqrt(objective.shares(poses, whole=True)).sum(axis=0)
                poses = poses[np.argsort(-values, kind="stable")]
            poses = poses[distinct_poses(self.body, poses, self.budget.alike / 5)[:survivors]]
        return poses

    def _move(self, poses: Floats, twists: Floats) -> Floats:
        """Move poses (H, 4, 4) by twists (H, 6), by 20° at most, as far as the model is linear."""
        shift, turn = np.linalg.norm(twists.reshape(-1, 2, 3), axis=2).T
        longest = np.maximum(turn, 0.175 / max(self.body.radius, 1e-12) * shift)
        return perturb(poses, twists * np.minimum(1.0, 0.35 / np.maximum(longest, 1e-12))[:, None])


def distinct_poses(body: Body, poses: Floats, cell: float, *, whole: bool = False) -> Indices:
    """Return ascending indices of poses (H, 4, 4) that do not repeat an earlier one.

    Poses are the same if three features, or those of the `whole` body, fall into the same cells,
    whose side is a share `cell` of the body's radius.  Poses at cell borders may escape.
    """
    corners = body.means if whole else body.means[[0, len(body) // 2, -1]]
    places = transform(poses, corners).reshape(len(poses), corners.size)
    cells = np.round(places / (cell * body.radius))
    # places farther off, or NaN, become one place
    cells = np.clip(np.nan_to_num(cells), -(2.0**62), 2.0**62).astype(np.int64)
    return np.sort(np.unique(cells @ _factors(corners.size), return_index=True)[1])


@lru_cache(maxsize=16)
def _factors(count: int) -> Indices:
    """Return numbers by which different cells have different sums: always the same at random."""
    factors = np.random.default_rng(0).integers(1, 2**40, count)
    factors.flags.writeable = False
    return factors


def spread_poses(problem: SearchProblem) -> tuple[Floats, list[Stage]]:
    """Return poses (H, 4, 4) of all orientations, and the stages of their descent."""
    budget, T_reference, free = problem.budget, problem.T_reference, problem.free
    step = budget.orientation_step
    rotations = spread_rotations(free[3:], step) @ T_reference[:3, :3]
    places = _centre_positions(problem)[:, None] - rotations @ problem.body.means.mean(axis=0)
    poses = from_parts(rotations, np.where(free[:3], places, T_reference[:3, 3]))
    # a turn by one step moves features by that share of their spread
    spreads = [sensor.moments[1] / sensor.sigma for sensor in problem.detections]
    stages = [
        (tuple(max(step * spread, 1.0) ** power for spread in spreads), steps, survivors)
        for power, steps, survivors in budget.orientation_stages
    ]
    return poses.reshape(-1, 4, 4), stages


def spread_rotations(free: Mask, step: float) -> Floats:
    """Return turns (count, 3, 3) about the free world axes (3,), about `step` radians apart."""
    if free.all():  # a super-Fibonacci spiral (Alexa, Low-Discrepancy Sampling of SO(3), CVPR 2022)
        count = int(np.ceil(np.pi**2 * 1.5 / step**3))
        s = np.arange(count) + 0.5
        r, R = np.sqrt(s / count), np.sqrt(1 - s / count)
        alpha, beta = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168756204288118041
        quaternions = [r * np.sin(alpha), r * np.cos(alpha), R * np.sin(beta), R * np.cos(beta)]
        return np.asarray(Rotation.from_quat(np.transpose(quaternions)).as_matrix())
    angles = np.linspace(-np.pi, np.pi, int(np.ceil(2 * np.pi / step)), endpoint=False)
    axes = [angles if is_free else np.zeros(1) for is_free in free]
    vectors = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    vectors = vectors[np.linalg.norm(vectors, axis=1) <= np.pi + 1e-9]
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def _centre_positions(problem: SearchProblem) -> Floats:
    """Return positions (C, 3) of the body's centre that agree with the means of all detections.

    For ranges alone also positions a standard error away, as false ranges may move the means.
    """
    radius, middles = problem.body.radius, Sum(tuple(map(_CentreOffset, problem.detections)))

    def move(places: Floats, steps: Floats) -> Floats:
        length = np.linalg.norm(steps, axis=1, keepdims=True)
        return np.asarray(places + steps * np.minimum(1.0, 5 * radius / np.maximum(length, 1e-30)))

    starts, free = _start_positions(problem), problem.free[:3]
    places = stepped(middles, starts, move, free, 12, damping=1e-6).states
    distances = np.sqrt(-2 * middles.linearise(places).value)
    count = np.count_nonzero(distances < distances.min(initial=np.inf) + radius)
    near = places[np.argsort(distances, kind="stable")[:count]]
    distinct = distinct_poses(problem.body, from_parts(np.eye(3), near), 0.2)
    near = near[distinct[: problem.budget.sample // 2]]
    if any(seen.view.sensor.dimension != 1 or not len(seen.points) for seen in problem.detections):
        return np.asarray(near)
    # ranges are in the unit of positions
    variances = [sensor.moments[1] ** 2 / len(sensor.points) for sensor in problem.detections]
    aside = math.sqrt(np.mean(variances)) * np.eye(3)[problem.free[:3]]
    shifts = np.concatenate(
        [np.zeros((1, 3)), aside, -aside] if aside.any() else [np.zeros((1, 3))]
    )
    return np.asarray((near[:, None] + shifts).reshape(-1, 3))


def _start_positions(problem: SearchProblem) -> Floats:
    """Return start positions (S, 3): on rays, at the distance by size, and about range sensors."""
    centre = problem.body.means.mean(axis=0)
    size = float(np.sqrt(((problem.body.nodes.points - centre) ** 2).sum(axis=1).mean()))
    held_centre = transform(problem.T_reference, centre[None])[0]
    starts = [] if problem.free.all() else [held_centre]
    for sensor in problem.detections:
        mean, spread = sensor.moments
        rays = sensor.view.sensor.rays(mean[None])
        if rays is None:
            source = sensor.view.sensor.towards(np.zeros(3))
            starts += [source + sign * mean[0] * axis for sign in (1, -1) for axis in np.eye(3)]
        elif len(rays):
            # the distance at which the body looks as large as the spread of detections
            angle = max(spread, sensor.sigma) * rays.slope
            distance = np.sqrt(2 / 3) * size / angle if rays.central else 0.0
            starts.append(rays.origins[0] + distance * rays.directions[0])
    return np.where(problem.free[:3], np.array(starts).reshape(-1, 3), held_centre)


@dataclass(frozen=True)
class _CentreOffset:
    """Minus half the squared offset of a position from the mean of a sensor's detections."""

    seen: SensorDetections

    def linearise(self, places: Floats) -> Quadratic:
        """Return second-order models at positions (H, 3), with offsets scaled to lengths."""
        y, J, _ = self.seen.view.sensor.linearise(places)
        scale = np.sqrt(np.maximum((J * J).mean(axis=1).sum(axis=1), 1e-30))[:, None]
        return squares_of((self.seen.moments[0] - y) / scale, J / scale[..., None])
