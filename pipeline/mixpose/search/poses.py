"""Many poses at once: what they explain, how they descend, and those of all orientations.

Detections of a camera are drawn once as disks of labels into a plane across its rays, where the
projection is a matrix whatever the lens, so that one look-up per predicted feature says which
detection it meets.  Features that fall on the same detection count once: counting features would
favour poses that gather them all on one blob.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
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
from mixpose.rigid import from_parts, perturb, transform
from mixpose.search.problem import SearchBudget, SearchProblem, SensorDetections
from mixpose.sensors import Rays, clouds_among, from_planes


class LabelImage(NamedTuple):
    """Disks around the M detections of one camera, as large as errors of detections may be."""

    projection: Floats  # (3, 4) from the world to columns and rows of cells, homogeneous
    eye: Floats  # (4,) centre of projection, or the way to it from everywhere, homogeneous
    # (rows, columns) detection 1 to M; in the lower eight bits 255 at a detection, 0 at its rim.
    # Most are empty, and take no memory; the outermost are for certain
    cells: NDArray[np.int32]


def label_image(sensor: SensorDetections, rays: Rays, reach: float) -> LabelImage:
    """Draw the detections of a camera, disks of radius `reach` in px."""
    middle = rays.directions.mean(axis=0)
    middle /= np.linalg.norm(middle)
    side = np.cross(middle, np.eye(3)[np.abs(middle).argmin()])
    side /= np.linalg.norm(side)
    axes, centre = np.array([side, np.cross(middle, side), middle]), rays.origins[0]
    to_plane, eye = np.column_stack([axes, -axes @ centre]), np.append(centre, 1.0)
    if not rays.central:
        to_plane[2], eye = [0.0, 0.0, 0.0, 1.0], np.append(-middle, 0.0)
    if rays.cloud is not None:
        eye = np.zeros(4)  # seen from all sides
    unit = rays.slope if rays.central else rays.offset
    points = rays.origins + rays.directions
    plane = points @ to_plane[:, :3].T + to_plane[:, 3]
    # how many px a unit of the plane is at each detection, whatever the lens
    J = sensor.view.sensor.linearise(points)[1]
    per_unit = np.sqrt(np.abs(np.linalg.det(J @ axes[:2].T))) * plane[:, 2] * unit
    radii = reach / np.where(per_unit > 0, per_unit, 1.0)
    # at 84° from the middle a ray misses the plane
    inside = plane[:, 2] > min(0.1, 0.5 * plane[:, 2].max())
    places, radii = (plane[:, :2] / plane[:, 2:] / unit)[inside], radii[inside]
    lower, extent = places.min(axis=0), np.ptp(places, axis=0)
    # four cells a radius: the rim is off by an eighth of it; 16 million at most
    step = max(np.median(radii) / 4, np.sqrt(np.prod(extent) / 2**24))
    margin = radii.max() + 2 * step
    columns, rows = (np.ceil((extent + 2 * margin) / step) + 1).astype(int)
    shift = (margin - lower) / step
    (u, v), radii = (places / step + shift).T[..., None], radii[:, None] / step
    around = np.arange(-np.ceil(radii.max()), np.ceil(radii.max()) + 1)
    column, row = (np.floor(middle).astype(np.intp) + around.astype(np.intp) for middle in (u, v))
    du, dv = (u - column - 0.5) / radii, (v - row - 0.5) / radii
    near = 1 - np.sqrt(dv[:, :, None] ** 2 + du[:, None] ** 2)
    label, iv, iu = np.nonzero(near > 0)
    value = (near[label, iv, iu] * 255).astype(np.int32)
    # where disks overlap the nearest is drawn last
    label, iv, iu, value = np.array([label, iv, iu, value])[:, np.argsort(value, kind="stable")]
    cells = np.zeros((rows, columns), dtype=np.int32)
    cells[row[label, iv], column[label, iu]] = ((label + 1) << 8) + value
    to_cells = np.diag([1 / (unit * step), 1 / (unit * step), 1.0])
    to_cells[:2, 2] = shift
    return LabelImage(to_cells @ to_plane, eye, cells)


def count_inliers(images: Sequence[LabelImage], body: Body, poses: Floats) -> tuple[Floats, Floats]:
    """Distinct detections (L, H) that poses explain, and nearness (H,), 0 to 1 of each feature."""
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
            with np.errstate(over="ignore"):  # behind the camera, as far out as can be
                column = np.clip(u * scale, 0.0, columns - 1.0).astype(np.int32)
                row = np.clip(v * scale, 0.0, rows - 1.0).astype(np.int32)
            met = np.take(image.cells, row * columns + column)
            if body.normals is not None and image.eye.any():
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
    """Log odds (H,) of poses against clutter, paid by count, and shares met; all are cameras'."""
    matches = matches_of(problem, poses)
    shares = matches.met / np.maximum(matches.expected, 1.0)
    return paid_by_count(odds_at(problem, matches), matches, problem.free), shares.mean(axis=1)


def odds_at(problem: SearchProblem, matches: Matches) -> tuple[Floats, Floats, Floats]:
    """The odds (H,) of what poses meet, before they pay for being chosen; see `odds_of`."""
    body, free, rules = problem.body, problem.free, problem.rules
    met = matches.measurements
    # of each sensor: what one that is covered meets by chance tells nothing of the others
    spare = met * np.maximum(1 - free.sum() / np.maximum(met.sum(axis=1), 1.0), 0.0)[:, None]
    squares, errors = np.where(spare > 0, matches.squares, 0.0), rules.noise.errors
    degrees, size = errors.typical_degrees, np.full(len(met), 2 * body.radius)
    variances = (degrees * errors.typical**2 + squares) / (degrees + spare)
    return odds_of(matches, variances, size, rules.detection, surfaces=body.surfaces)


def matches_of(problem: SearchProblem, poses: Floats) -> Matches:
    """Detections that sensors have where they are predicted to see the features of poses."""
    sensors, rules = problem.detections, problem.rules.association
    projection = project_body(tuple(one.view.sensor for one in sensors), problem.body)
    sigmas, at = np.array([one.sigma for one in sensors]), projection.project(poses)
    y, J = at.y.swapaxes(0, 1), at.J.swapaxes(0, 1)
    seen, faced = at.seen.swapaxes(0, 1), at.faced.swapaxes(0, 1)
    shares, offsets = np.zeros(seen.shape), np.zeros(y.shape)
    crowd, others = np.zeros((2, *seen.shape[:2]))
    by = np.full(seen.shape, -1)
    boxes = np.where(seen[..., None] & rules.crowded, y, np.nan)
    lower, upper = np.fmin.reduce(boxes, axis=2), np.fmax.reduce(boxes, axis=2)
    pairs = _met_in_space(problem, y, seen)
    for k, (sensor, sigma) in enumerate(zip(sensors, sigmas, strict=True)):
        points, smallest = sensor.points, rules.min_region * sigma
        pose, feature, detection = pairs.get(k) or _pairs(
            y[:, k], seen[:, k], points, problem.reach(sensor)
        )
        shares[pose, k, feature], by[pose, k, feature] = 1.0, detection
        offsets[pose, k, feature] = (points[detection] - y[pose, k, feature]) / sigma
        boxes_of = points, lower[:, k], upper[:, k], smallest, shares[:, k].sum(axis=1)
        in_view, in_space = crowding(*boxes_of)
        crowd[:, k], others[:, k] = in_view * sigma**2, in_space * sigma**3
    clouds = clouds_among(tuple([one.view.sensor for one in sensors]))
    for planes in clouds:
        points = from_planes(np.array([sensors[k].points for k in planes]))
        low, high = (from_planes(one[:, planes].swapaxes(0, 1)) for one in (lower, upper))
        least, met = rules.min_region * sigmas[planes[0]], shares[:, planes[0]].sum(axis=1)
        dense = crowding(points, low, high, least, met, deep=1.0)[1]
        others[:, planes] = dense[:, None] * sigmas[planes] ** 3
    nothing = np.zeros(crowd.shape)
    return Matches(
        names=tuple(one.view.name for one in sensors),
        dimensions=projection.dimensions,
        sigmas=sigmas,
        weights=seen.astype(np.float64),
        shares=shares,
        places=y,
        offsets=offsets,
        J=J / sigmas[:, None, None, None],
        detections=by,
        explained=nothing,
        unseen=np.count_nonzero(faced & ~seen, axis=2),
        cut=np.full((*seen.shape, 2), np.nan),
        merged=nothing.astype(np.intp),
        count=nothing + [len(one.points) for one in sensors],
        crowd=crowd,
        space_crowd=others,
        unmatched_nearby=nothing,
        neighbour_distance=np.full(seen.shape, np.nan),
        extra=np.zeros(seen.shape),
        radii=np.zeros(seen.shape),
        finest=nothing + 1.0,
        owners=owners_of(len(sensors), clouds),
    )


def _met_in_space(
    problem: SearchProblem, y: Floats, seen: Mask
) -> dict[int, tuple[Indices, Indices, Indices]]:
    """By sensor what `_pairs` gives, for images of clouds: the same in all three."""
    sensors, pairs = problem.detections, dict[int, tuple[Indices, Indices, Indices]]()
    for planes in clouds_among(tuple([one.view.sensor for one in sensors])):
        points = from_planes(np.array([sensors[k].points for k in planes]))
        places = from_planes(y[:, planes].swapaxes(0, 1))
        found = _pairs(places, seen[:, planes[0]], points, problem.reach(sensors[planes[0]]))
        pairs |= dict.fromkeys(planes, found)
    return pairs


def _pairs(y: Floats, seen: Mask, points: Floats, reach: float) -> tuple[Indices, Indices, Indices]:
    """Poses, features and detections (C,) of places (K, N, 2) that are met within reach.

    A detection is met by the nearest of the features to which it is the nearest.
    """
    pose, feature = np.nonzero(seen)
    away, nearest = cKDTree(points).query(y[pose, feature], distance_upper_bound=reach)
    order = np.argsort(away, kind="stable")[: np.count_nonzero(np.isfinite(away))]
    met = order[np.unique(pose[order] * len(points) + nearest[order], return_index=True)[1]]
    return pose[met], feature[met], nearest[met]


Stage: TypeAlias = tuple[tuple[float, ...], int, int]
"""One blur of a descent: factors of σ_ε per sensor, steps at it, and how many poses go on."""


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
        """Poses (K, 4, 4) that are left of H after all stages; of too many, those of most value."""
        # directions without any curvature stay
        for factors, steps, survivors in stages if len(poses) else ():
            objective = self.objective(factors)
            if steps:
                ends = stepped(objective, poses, self._moved, self.free, steps, damping=1e-3)
                poses = ends.states
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


def unlike(body: Body, poses: Floats, cell: float, *, whole: bool = False) -> Indices:
    """Indices, ascending, of poses (H, 4, 4) that do not put the body where an earlier one does.

    Of very many, about: places of three features, or of the `whole` body, are the same within cells
    whose side is a share `cell` of the body's radius.
    """
    corners = body.means if whole else body.means[[0, len(body) // 2, -1]]
    places = transform(poses, corners).reshape(len(poses), corners.size)
    cells = np.round(places / (cell * body.radius))
    # what is farther off than that, or nowhere, is in one place
    cells = np.clip(np.nan_to_num(cells), -(2.0**62), 2.0**62).astype(np.int64)
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
        (tuple(max(blur, 1.0) ** power for blur in blurs), steps, survivors)
        for power, steps, survivors in budget.orientation_stages
    ]
    return poses.reshape(-1, 4, 4), stages


def spread_turns(free: Mask, step: float) -> Floats:
    """Turns (count, 3, 3) about the free world axes (3,), about `step` radians apart."""
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


def _centres(problem: SearchProblem) -> Floats:
    """Places (C, 3) of the body's centre at which all sensors see the middle of what they see.

    Of single ranges also those to which false ranges may have moved the middle from.
    """
    radius, middles = problem.body.radius, Sum(tuple(map(_Middle, problem.detections)))

    def moved(places: Floats, steps: Floats) -> Floats:
        length = np.linalg.norm(steps, axis=1, keepdims=True)
        return np.asarray(places + steps * np.minimum(1.0, 5 * radius / np.maximum(length, 1e-30)))

    begun, free = _starts(problem), problem.free[:3]
    places = stepped(middles, begun, moved, free, 12, damping=1e-6).states
    off = np.sqrt(-2 * middles.linearise(places).value)
    count = np.count_nonzero(off < off.min(initial=np.inf) + radius)
    near = places[np.argsort(off, kind="stable")[:count]]
    distinct = unlike(problem.body, from_parts(np.eye(3), near), 0.2)
    near = near[distinct[: problem.budget.sample // 2]]
    if any(one.view.sensor.dimension != 1 or not len(one.points) for one in problem.detections):
        return np.asarray(near)
    # their unit is that of places
    variances = [one.moments[1] ** 2 / len(one.points) for one in problem.detections]
    aside = math.sqrt(np.mean(variances)) * np.eye(3)[problem.free[:3]]
    around = np.concatenate(
        [np.zeros((1, 3)), aside, -aside] if aside.any() else [np.zeros((1, 3))]
    )
    return np.asarray((near[:, None] + around).reshape(-1, 3))


def _starts(problem: SearchProblem) -> Floats:
    """Places (S, 3) to start from: on rays, as far as the body looks large, and about ranges."""
    centre = problem.body.means.mean(axis=0)
    size = float(np.sqrt(((problem.body.nodes.points - centre) ** 2).sum(axis=1).mean()))
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


@dataclass(frozen=True)
class _Middle:
    """Minus half the squared distance of a place from where a sensor sees the middle."""

    seen: SensorDetections

    def linearise(self, places: Floats) -> Quadratic:
        """Second-order models at places (H, 3), of lengths: the sensor's unit is taken off."""
        y, J, _ = self.seen.view.sensor.linearise(places)
        scale = np.sqrt(np.maximum((J * J).mean(axis=1).sum(axis=1), 1e-30))[:, None]
        return squares_of((self.seen.moments[0] - y) / scale, J / scale[..., None])
