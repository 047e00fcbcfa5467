"""Associate the features of a predicted mixture with what sensors observed, with offsets.

Features are met by the nearest detections, each of which is taken once; in grey values and profiles
by the pull of the density that remains without the share of neighbouring features.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.constants import constant
from mixpose.density import DRAWING, Observation, peak
from mixpose.matching.matches import Matches
from mixpose.objective import MatchedObjective, in_image
from mixpose.records import Floats, Indices, Mask, PointPattern
from mixpose.rigid import transform
from mixpose.sensors import calibration_shifts, clouds_among, from_planes


@dataclass(frozen=True)
class AssociationRules:
    """Thresholds of matches, and of the surroundings of a body."""

    min_share: float = constant(0.3, "of a feature's peak: within 2.2 σ_ε; false ones pass beyond")
    min_region: float = constant(20.0, "σ_ε over which features crowd at least, be they two")
    crowded: bool = constant(True, "whether clutter is as dense as detections around the body")
    merged: bool = constant(True, "whether two features may share a detection: blobs that touch")
    middle: float = constant(0.2, "σ_ε: of a spot of two features, one of which may be brighter")
    alike: float = constant(
        0.01,
        "of a feature's energy: features within a seventh of C's deviation are not resolved",
    )
    both: float = constant(
        0.6, "probability that a spot is of two features in its radius: P_D² / (1 - (1 - P_D)²)"
    )
    slip: float = constant(0.25, "of the body's size: there a slipped grid (1/8) has detections")

    @property
    def reach_squared(self) -> float:
        """Squared distance within which a feature is met, in variances of C."""
        return -2 * math.log(self.min_share)


def associate(
    objective: MatchedObjective, T_world_object: Floats, rules: AssociationRules, narrowest: float
) -> Matches:
    """Match features predicted at a pose (4, 4) with observations; `narrowest` blur in σ_ε."""
    match, views = objective.match(T_world_object[None]), objective.views
    sigmas = np.array([view.observation.sigma for view in views])
    dimensions, body = objective.projection.dimensions, objective.projection.body
    y, seen, weights, J = match.y[:, 0], match.seen[:, 0], match.weights[:, 0], match.J[:, 0]
    product = np.vecdot(match.sampled[:, 0, :, 0], weights)
    detections, looks = _observed(tuple([view.observation for view in views]))
    explained = np.maximum(product, 0.0) ** 2 / (objective.energies[:, 0] * match.norm[:, 0])
    reach = objective.variances.repeat(y.shape[1], axis=1)
    if body.spread:  # the reach grows by the variance of features along an axis
        spreads = body.node_spreads(T_world_object)
        reach = reach + [in_image(spreads, J_l[:, :m]) for J_l, m in zip(J, dimensions.tolist())]
    # shares, offsets in sensor units, numbers of detections, and partners in merged pairs
    met = np.zeros(weights.shape), np.zeros(y.shape), *np.full((2, *weights.shape), -1)
    shares, offsets, met_by, partner = met
    is_open = seen & (product > 0)[:, None]
    clouds = clouds_among(objective.projection.sensors)
    neighbours = _to_nearest(
        y, weights, detections, rules.reach_squared * reach, is_open, rules.merged, met, clouds
    )
    are_grids = objective.are_grids.tolist()
    grids = [k for k, is_grid in enumerate(are_grids) if is_grid and is_open[k].any()]
    J = J.copy() if grids else J  # the projection is cached
    for k in grids:
        in_view, m, amplitude = seen[k], dimensions[k], float(product[k] / match.norm[k, 0])
        mixture = y[k, in_view, :m], weights[k, in_view], float(objective.variances[k, 0])
        shares[k, in_view], offsets[k, in_view, :m], J[k, in_view, :m] = _residuals(
            *mixture, match.sampled[k, 0, in_view, : 1 + m], J[k, in_view, :m], amplitude, rules
        )
    J, merged = J / sigmas[:, None, None, None], (partner >= 0).sum(axis=1) // 2
    if np.count_nonzero(merged):
        paired = np.nonzero(partner >= 0)
        J[paired] = (J[paired] + J[paired[0], partner[paired]]) / 2
    # a detection of two features is long because of that, not cut
    look = looks[np.arange(len(views))[:, None], np.where(partner < 0, met_by, -1)]
    extra = look[..., 0] + rules.both * _to_missed(y, seen & (shares == 0), look[..., 1]) / (
        4 * (sigmas * sigmas)[:, None]
    )
    return Matches(
        extra=np.where(partner >= 0, rules.middle**2, extra),
        radii=look[..., 1],
        cut=look[..., 2:],
        names=tuple([view.name for view in views]),
        dimensions=dimensions,
        sigmas=sigmas,
        weights=weights,
        shares=shares,
        places=y,
        offsets=offsets / sigmas[:, None, None],
        J=J,
        detections=met_by,
        explained=np.minimum(explained, 1.0),
        unseen=(match.faced[:, 0] & ~seen) @ body.nodes.weights,
        merged=merged,
        neighbour_distance=np.where(seen, np.sqrt(neighbours) / sigmas[:, None], np.nan),
        owners=owners_of(len(views), clouds),
        **_surroundings(objective, y, seen, shares, detections, rules, narrowest),
        by_calibration=_by_calibration(objective, T_world_object),
    )


def owners_of(count: int, clouds: Sequence[Sequence[int]]) -> Indices | None:
    """Return `Matches.owners` of so many images: those of a cloud belong to one sensor."""
    if not clouds:
        return None
    owners = np.arange(count)
    for planes in clouds:
        owners[planes] = planes[0]
    return owners


@lru_cache(maxsize=8)  # several poses of a frame are matched
def _observed(observations: tuple[Observation, ...]) -> tuple[Floats, Floats]:
    """Stack detections (L, M, 2) of L sensors, NaN beyond those of a sensor, and their looks.

    Looks (L, M + 1, 4) are the extra variance, σ_ε², the radius in sensor units, 0 if unknown, and
    `Matches.cut`; the last row is that of no detection.
    """
    patterns = [observation.pattern for observation in observations]
    points = [p.points if isinstance(p, PointPattern) else np.zeros((0, 2)) for p in patterns]
    detections = np.full((len(points), max(map(len, points)) or 1, 2), np.nan)
    looks = np.zeros((len(points), detections.shape[1] + 1, 4))
    looks[..., 2:] = np.nan
    for stacked, look, places, observation in zip(detections, looks, points, observations):
        stacked[: len(places)] = 0.0
        stacked[: len(places), : places.shape[1]] = places
        pattern, sigma = observation.pattern, observation.sigma
        if not isinstance(pattern, PointPattern) or (pattern.is_uniform and not pattern.has_radii):
            continue
        look[: len(places), 0], look[: len(places), 1] = pattern.deviations / sigma, pattern.radii
        if pattern.cut is not None:
            look[: len(places), 2:] = pattern.cut / [1.0, sigma]
    looks[..., [0, 3]] *= looks[..., [0, 3]]
    detections.flags.writeable = looks.flags.writeable = False
    return detections, looks


def _to_missed(y: Floats, missed: Mask, radii: Floats) -> Floats:
    """Return squared distances (L, n) from features at y (L, n, 2) to missed ones in their spots.

    The farthest counts; 0 for none.  Such a spot may well be of both features, which together look
    whole, so that it lies at their middle.
    """
    farthest = np.zeros(radii.shape)
    if not (np.count_nonzero(missed) and np.count_nonzero(radii)):  # as a rule
        return farthest
    for k in np.flatnonzero(missed.any(axis=1) & radii.any(axis=1)).tolist():
        sized = np.flatnonzero(radii[k])
        away = y[k, sized, None] - y[k, missed[k]]
        squared = np.vecdot(away, away)
        within = np.where(squared < radii[k, sized, None] ** 2, squared, 0.0)
        farthest[k, sized] = within.max(axis=1)
    return farthest


def _to_nearest(
    y: Floats,
    weights: Floats,
    detections: Floats,
    reach: Floats,  # (L, n) squared, in sensor units
    is_open: Mask,
    merged: bool,
    met: tuple[Floats, Floats, Indices, Indices],
    clouds: Sequence[Sequence[int]] = (),
) -> Floats:
    """Match features with the nearest detections, each taken once or by a pair of features.

    Writes to `met`, and returns squared distances (L, n) to the nearest other detections.  Images
    of one of the `clouds` are matched together, by distances in space.
    """
    shares, offsets, by, _ = met
    which, squared = _neighbours(y, detections, reach, clouds)
    k, i, at = np.nonzero((squared <= reach[..., None]) & is_open[..., None])
    order = squared[k, i, at].argsort(kind="stable")
    pairs = k, i, j = np.array([k, i, which[k, i, at]])[:, order]
    accepted = _in_turn(k * by.shape[1] + i, k * detections.shape[1] + j)
    k, i, j = pairs[:, accepted]
    shares[k, i], offsets[k, i], by[k, i] = weights[k, i], detections[k, j] - y[k, i], j
    if merged and len(accepted) < len(order):
        # only features near a detection that is taken can share it
        in_clouds = {k for planes in clouds for k in planes}  # whose points do not merge
        for k in set(np.unique(pairs[0][by[*pairs[:2]] < 0]).tolist()) - in_clouds:
            _run_together(y[k], weights[k], reach[k], is_open[k], [array[k] for array in met])
    squared[which == by[..., None]] = np.nan
    return np.asarray(np.fmin.reduce(squared, axis=2))


def _neighbours(
    y: Floats, detections: Floats, reach: Floats, clouds: Sequence[Sequence[int]]
) -> tuple[Indices, Floats]:
    """Return the detections (L, n, K) nearest to features, and their squared distances.

    K is at least 2 and covers all within reach; the distance of missing ones is NaN.
    """
    most = detections.shape[1]
    if clouds or y.shape[1] * most <= DRAWING.few_pairs:
        away = detections[:, None] - y[:, :, None]
        squared = np.vecdot(away, away)
        for planes in clouds:  # each coordinate is in two of them
            squared[planes] = squared[planes].sum(axis=0) / 2
        return np.arange(most) + np.zeros(squared.shape, dtype=np.intp), squared
    trees = [cKDTree(places[places[:, 0] == places[:, 0]]) for places in detections]
    count, limit = 2, math.sqrt(float(reach.max(initial=0.0)))
    while True:
        queries = [tree.query(places, k=count) for tree, places in zip(trees, y)]
        distances, which = (np.array(part) for part in zip(*queries))
        if count >= most or float(distances[..., -1].min(initial=np.inf)) > limit:
            break
        count *= 2
    return which, np.where(np.isfinite(distances), distances * distances, np.nan)


def _in_turn(features: Indices, detections: Indices) -> Indices:
    """Accept pairs (P,) in their order, unless one of the two was taken before; return numbers."""
    taken, remaining = [], np.arange(len(features))
    if len({*features.tolist()}) == len(features) == len({*detections.tolist()}):
        return remaining  # as a rule no pair competes with another
    while len(remaining):
        i, j = features[remaining], detections[remaining]
        by_i, by_j = np.zeros(features.max() + 1, np.intp), np.zeros(detections.max() + 1, np.intp)
        by_i[i[::-1]] = by_j[j[::-1]] = remaining[::-1]
        accepted = remaining[(by_i[i] == remaining) & (by_j[j] == remaining)]
        taken.append(accepted)
        by_i[:], by_j[:] = 0, 0
        by_i[features[accepted]] = by_j[detections[accepted]] = 1
        remaining = remaining[(by_i[i] | by_j[j]) == 0]
    return np.sort(np.concatenate(taken)) if taken else remaining


def _run_together(
    y: Floats,
    weights: Floats,
    reach: Floats,
    is_open: Mask,
    met: Sequence[NDArray[Any]],
) -> None:
    """Let two features share a detection that lies nearer to their middle than to either.

    Images that overlap are detected as a single spot, and the two count as one feature there.
    """
    shares, offsets, detections, partner = met
    single = shares > 0
    for i in np.flatnonzero(is_open & ~single).tolist():
        places = y + offsets
        near = single & (((places - y[i]) ** 2).sum(axis=1) <= reach[i])
        middle = places - (y + y[i]) / 2
        closer = (middle**2).sum(axis=1) - (offsets**2).sum(axis=1)
        k = int(np.argmin(np.where(near, closer, np.inf)))
        if near[k] and closer[k] < 0:
            pair = [i, k]
            shares[pair], offsets[pair] = weights[pair] / 2, middle[k]
            partner[pair], detections[pair] = pair[::-1], detections[k]
            single[k] = False


def _residuals(
    y: Floats,
    weights: Floats,
    variance: float,
    sampled: Floats,
    J: Floats,
    amplitude: float,
    rules: AssociationRules,
) -> tuple[Floats, Floats, Floats]:
    """Return shares, offsets and Jacobians (n, m, 6) of features (n, m) in a grid of values.

    C is modelled as the predicted mixture with an amplitude per feature.  The pull on a feature is
    the gradient without that of all others.  Once heights are fitted, pulls of features that
    overlap depend on the places of all (F, 1 for a single feature) and have correlated errors (S).
    Offsets and Jacobians are S^(−½) δ and S^(−½) F J, with independent and equal errors.
    """
    (n, m), top, away = y.shape, peak(variance, y.shape[1]), y[:, None] - y[None]
    overlaps = np.exp(-0.5 * (away * away).sum(axis=-1) / variance)
    bells = weights * overlaps * top
    excess = sampled[:, 0] - amplitude * bells.sum(axis=1)
    amplitudes = amplitude + np.linalg.solve(bells + rules.alike * top * np.diag(weights), excess)
    height = amplitudes * weights * top
    steep = (overlaps[..., None] * away).swapaxes(1, 2).reshape(n * m, n) / np.sqrt(variance)
    outer = np.eye(m) - away[..., :, None] * away[..., None, :] / variance
    alone = (overlaps[..., None, None] * outer).swapaxes(1, 2).reshape(n * m, n * m)
    by_height = np.linalg.solve(overlaps + rules.alike * np.eye(n), steep.T)
    F = alone - steep @ by_height
    S = F - rules.alike * by_height.T @ by_height
    # the median height of the better half of the features
    full = float(np.median(np.sort(height)[n // 2 :]))
    if full <= 0:
        return np.zeros(n), np.zeros(y.shape), J
    shares = np.clip(height / full, 0.0, 1.0)
    is_met = shares > rules.min_share
    predicted_gradient = -((amplitudes * bells)[..., None] * away).sum(axis=1) / variance
    pull = sampled[:, 1:] - predicted_gradient
    offsets = variance * pull / np.maximum(height, rules.min_share * full)[:, None]
    values, axes = np.linalg.eigh(S)
    # directions of smaller variance tell nothing of places
    apart = (axes / np.sqrt(np.where(values > rules.alike, values, np.inf))) @ axes.T
    offsets, rows = (apart @ offsets.ravel()).reshape(n, m), apart @ F @ J.reshape(n * m, -1)
    return (
        np.where(is_met, shares * weights, 0.0),
        np.where(is_met[:, None], offsets, 0.0),
        rows.reshape(J.shape),
    )


def _surroundings(
    objective: MatchedObjective,
    y: Floats,
    seen: Mask,
    shares: Floats,
    detections: Floats,
    rules: AssociationRules,
    narrowest: float,
) -> dict[str, Floats]:
    """Return the fields of `Matches` (L,) about detections around features at y (L, n, 2)."""
    observations = [view.observation for view in objective.views]
    sigmas = np.array([observation.sigma for observation in observations])
    is_flat = objective.projection.dimensions == 1
    in_view = np.where(seen[..., None], y, np.nan)
    lower, upper = np.fmin.reduce(in_view, axis=1), np.fmax.reduce(in_view, axis=1)
    size, middle = upper - lower, (lower + upper) / 2
    smallest = sigmas[:, None] * np.where(is_flat[:, None], [rules.min_region, 1], rules.min_region)
    around = upper if rules.crowded else np.full_like(upper, np.nan)
    met = shares.sum(axis=1)
    crowd, space_crowd = crowding(detections, lower, around, smallest, met)
    for planes in clouds_among(objective.projection.sensors):
        points, low, high = (from_planes(array[planes]) for array in (detections, lower, around))
        least = rules.min_region * float(sigmas[planes[0]])
        space_crowd[planes] = crowding(points, low, high, least, met[planes[0]], deep=1.0)[1]
    crowd, space_crowd = crowd * sigmas**2, space_crowd * sigmas**3
    count = (detections[..., 0] == detections[..., 0]).sum(axis=1).astype(np.float64)
    unmatched = np.zeros(len(sigmas))
    missing = (seen & (shares == 0)).any(axis=1)
    if np.count_nonzero(missing):
        half = size / 2 + rules.slip * size.max(axis=1, keepdims=True)
        near = np.abs(detections - middle[:, None]) <= half[:, None]
        unmatched_inside = np.count_nonzero(near.all(axis=2), axis=1) - met
        unmatched = np.where(missing & ~is_flat, np.maximum(unmatched_inside, 0.0), 0.0)
    finest = np.zeros(len(sigmas))
    if seen.size > DRAWING.own_tiles:  # densities are drawn on pages
        finest = size.max(axis=1) / (DRAWING.widest * sigmas)  # NaN where no feature is in view
    for k, observation in enumerate(observations):
        if observation.cell is not None:  # as many equal features as have this energy of a grid
            near, far = (corner / observation.sigma for corner in observation.extent)
            count[k] = objective.tops[k, 0] / objective.energies[k, 0]
            crowd[k] = count[k] / np.maximum(far - near, rules.min_region).prod()
            space_crowd[k] = crowd[k] / np.sqrt(np.maximum(far - near, rules.min_region).prod())
            finest[k] = 1.0
    finest = np.fmin(np.maximum(narrowest, finest), 1.0)
    return {
        "count": count,
        "crowd": crowd,
        "space_crowd": space_crowd,
        "unmatched_nearby": unmatched,
        "finest": finest,
    }


def crowding(
    points: Floats,
    lower: Floats,
    upper: Floats,
    smallest: Floats | float,
    met: Floats,
    deep: float = 1.5,
) -> tuple[Floats, Floats]:
    """Return densities (...,) of detections (..., M, m), NaN for missing ones, in two units.

    Of all, or in boxes (..., m) if denser there; sides are at least `smallest`.  The first is per
    unit^m; the second per unit^(`deep` m), without the detections in boxes that meet (...,) the
    body: the density of points in space if they are as deep as wide.
    """
    number = (points[..., 0] == points[..., 0]).sum(axis=-1)
    extent = np.fmax.reduce(points, axis=-2) - np.fmin.reduce(points, axis=-2)
    sides = np.fmax(upper - lower, smallest)
    away = np.abs(points - ((lower + upper) / 2)[..., None, :])
    inside = (away <= sides[..., None, :] / 2).all(axis=-1).sum(axis=-1)
    overall, in_box = np.fmax(extent, smallest).prod(axis=-1), sides.prod(axis=-1)
    in_space = np.maximum(number / overall**deep, (inside - met) / in_box**deep)
    return np.maximum(number / overall, inside / in_box), in_space


def _by_calibration(objective: MatchedObjective, T_world_object: Floats) -> Floats | None:
    """Return shifts of features (L, N, 2, Q), σ_ε, by Q calibration errors of one deviation."""
    columns, views = [], objective.views
    for k, view in enumerate(views):
        if view.doubts:
            points = transform(T_world_object, objective.projection.body.nodes.points)
            shifts = calibration_shifts(view.doubts, points)
            column = np.zeros((len(views), len(points), 2, shifts.shape[2]))
            column[k, :, : shifts.shape[1]] = shifts / view.observation.sigma
            columns.append(column)
    return np.concatenate(columns, axis=-1) if columns else None
