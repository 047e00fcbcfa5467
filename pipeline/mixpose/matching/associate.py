"""Which features of a predicted mixture the sensors have something at, and how far off.

For detections, the nearest ones, each taken once; for grey values and profiles, the pull of what is
left of the density once the neighbours' share of it is taken off.
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
    """When a feature counts as met."""

    min_share: float = constant(0.3, "of a feature's peak: within 2.2 σ_ε; false ones pass beyond")
    min_region: float = constant(20.0, "σ_ε over which features crowd at least, be they two")
    crowded: bool = constant(True, "whether clutter is as dense as detections around the body")
    merged: bool = constant(True, "whether two features may share a detection: blobs that touch")
    middle: float = constant(0.2, "σ_ε: of two that share one, which one of them may outshine")
    alike: float = constant(
        0.01,
        "of a feature's energy: those nearer than a seventh of C's deviation are not told apart",
    )
    both: float = constant(
        0.6, "that a spot is of two features within its radius: P_D² / (1 - (1 - P_D)²)"
    )
    slip: float = constant(0.25, "of the body's size: there a slipped grid (1/8) has detections")

    @property
    def reach_squared(self) -> float:
        """Squared distance within which a feature is met, in variances of C."""
        return -2 * math.log(self.min_share)


def associate(
    objective: MatchedObjective, T_world_object: Floats, rules: AssociationRules, narrowest: float
) -> Matches:
    """Compare what a pose (4, 4) predicts with what sensors observed; `narrowest` blur in σ_ε."""
    match, views = objective.match(T_world_object[None]), objective.views
    sigmas = np.array([view.observation.sigma for view in views])
    dimensions, body = objective.projection.dimensions, objective.projection.body
    y, seen, weights, J = match.y[:, 0], match.seen[:, 0], match.weights[:, 0], match.J[:, 0]
    product = np.vecdot(match.sampled[:, 0, :, 0], weights)
    detections, looks = _observed(tuple([view.observation for view in views]))
    explained = np.maximum(product, 0.0) ** 2 / (objective.energies[:, 0] * match.norm[:, 0])
    reach = objective.variances.repeat(y.shape[1], axis=1)
    if body.spread:  # variances along an axis by which features may be off
        spreads = body.node_spreads(T_world_object)
        reach = reach + [in_image(spreads, own[:, :m]) for own, m in zip(J, dimensions.tolist())]
    # shares, offsets in sensor units, detections, and partners of features in merged pairs
    met = np.zeros(weights.shape), np.zeros(y.shape), *np.full((2, *weights.shape), -1)
    shares, offsets, by, partner = met
    is_open = seen & (product > 0)[:, None]
    clouds = clouds_among(objective.projection.sensors)
    others = _to_nearest(
        y, weights, detections, rules.reach_squared * reach, is_open, rules.merged, met, clouds
    )
    grids = np.flatnonzero(objective.are_grids & is_open.any(axis=1)).tolist()
    J = J.copy() if grids else J  # what was projected is used again
    for k in grids:
        of, m, amplitude = seen[k], dimensions[k], float(product[k] / match.norm[k, 0])
        mixture = y[k, of, :m], weights[k, of], float(objective.variances[k, 0])
        shares[k, of], offsets[k, of, :m], J[k, of, :m] = _residuals(
            *mixture, match.sampled[k, 0, of, : 1 + m], J[k, of, :m], amplitude, rules
        )
    J, merged = J / sigmas[:, None, None, None], (partner >= 0).sum(axis=1) // 2
    if np.count_nonzero(merged):
        paired = np.nonzero(partner >= 0)
        J[paired] = (J[paired] + J[paired[0], partner[paired]]) / 2
    # what two features share is long for that
    own = looks[np.arange(len(views))[:, None], np.where(partner < 0, by, -1)]
    extra = own[..., 0] + rules.both * _beside(y, seen & (shares == 0), own[..., 1]) / (
        4 * (sigmas * sigmas)[:, None]
    )
    return Matches(
        extra=np.where(partner >= 0, rules.middle**2, extra),
        radii=own[..., 1],
        cut=own[..., 2:],
        names=tuple([view.name for view in views]),
        dimensions=dimensions,
        sigmas=sigmas,
        weights=weights,
        shares=shares,
        places=y,
        offsets=offsets / sigmas[:, None, None],
        J=J,
        detections=by,
        explained=np.minimum(explained, 1.0),
        unseen=(match.faced[:, 0] & ~seen) @ body.nodes.weights,
        merged=merged,
        beside=np.where(seen, np.sqrt(others) / sigmas[:, None], np.nan),
        owners=owners_of(len(views), clouds),
        **_surroundings(objective, y, seen, shares, detections, rules, narrowest),
        by_calibration=_by_calibration(objective, T_world_object),
    )


def owners_of(count: int, clouds: Sequence[Sequence[int]]) -> Indices | None:
    """`Matches.owners` of so many images: those of a cloud are one sensor's."""
    if not clouds:
        return None
    owners = np.arange(count)
    for planes in clouds:
        owners[planes] = planes[0]
    return owners


@lru_cache(maxsize=8)  # of one frame, some poses of which are matched
def _observed(observations: tuple[Observation, ...]) -> tuple[Floats, Floats]:
    """Detections (L, M, 2) of L sensors side by side; NaN beyond those that a sensor has.

    And their looks (L, M + 1, 4), the last of none: the variance by which each errs more than
    others, σ_ε²; its radius, sensor units, 0 where nobody knows; `Matches.cut`.
    """
    patterns = [one.pattern for one in observations]
    points = [p.points if isinstance(p, PointPattern) else np.zeros((0, 2)) for p in patterns]
    detections = np.full((len(points), max(map(len, points)) or 1, 2), np.nan)
    looks = np.zeros((len(points), detections.shape[1] + 1, 4))
    looks[..., 2:] = np.nan
    for side, look, own, one in zip(detections, looks, points, observations):
        side[: len(own)] = 0.0
        side[: len(own), : own.shape[1]] = own
        pattern, sigma = one.pattern, one.sigma
        if not isinstance(pattern, PointPattern) or (pattern.is_even and not pattern.has_radii):
            continue
        look[: len(own), 0], look[: len(own), 1] = pattern.deviations / sigma, pattern.radii
        if pattern.cut is not None:
            look[: len(own), 2:] = pattern.cut / [1.0, sigma]
    looks[..., [0, 3]] *= looks[..., [0, 3]]
    detections.flags.writeable = looks.flags.writeable = False
    return detections, looks


def _beside(y: Floats, missed: Mask, radii: Floats) -> Floats:
    """Squared distances (L, n) from features at y (L, n, 2) to missed ones within their spots.

    The farthest, and 0 without any.  Such a spot shows both as likely as not: the two of them look
    whole, and it is at their middle.
    """
    farthest = np.zeros(radii.shape)
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
    """Write what the nearest detections meet, each taken once or by a pair of features.

    Images of one of the `clouds` are met together, by distances in space.

    Returns squared distances (L, n) to the nearest detections but these.
    """
    shares, offsets, by, _ = met
    which, squared = _neighbours(y, detections, reach, clouds)
    k, i, at = np.nonzero((squared <= reach[..., None]) & is_open[..., None])
    order = squared[k, i, at].argsort(kind="stable")
    pairs = k, i, j = np.array([k, i, which[k, i, at]])[:, order]
    own = _in_turn(k * by.shape[1] + i, k * detections.shape[1] + j)
    k, i, j = pairs[:, own]
    shares[k, i], offsets[k, i], by[k, i] = weights[k, i], detections[k, j] - y[k, i], j
    if merged and len(own) < len(order):
        # only a feature near a detection that is taken can share it
        in_clouds = {k for planes in clouds for k in planes}  # where points do not run together
        for k in set(np.unique(pairs[0][by[*pairs[:2]] < 0]).tolist()) - in_clouds:
            _run_together(y[k], weights[k], reach[k], is_open[k], [array[k] for array in met])
    squared[which == by[..., None]] = np.nan
    return np.asarray(np.fmin.reduce(squared, axis=2))


def _neighbours(
    y: Floats, detections: Floats, reach: Floats, clouds: Sequence[Sequence[int]]
) -> tuple[Indices, Floats]:
    """The detections (L, n, K) that are nearest to features, and their squared distances.

    Two at least, and all within reach; NaN is the distance of those that there are not.
    """
    most = detections.shape[1]
    if clouds or y.shape[1] * most <= DRAWING.few_pairs:
        away = detections[:, None] - y[:, :, None]
        squared = np.vecdot(away, away)
        for planes in clouds:  # each coordinate is in two of them
            squared[planes] = squared[planes].sum(axis=0) / 2
        return np.broadcast_to(np.arange(most), squared.shape), squared
    trees = [cKDTree(own[own[:, 0] == own[:, 0]]) for own in detections]
    count, limit = 2, math.sqrt(float(reach.max(initial=0.0)))
    while True:
        each = [tree.query(own, k=count) for tree, own in zip(trees, y)]
        distances, which = (np.array(part) for part in zip(*each))
        if count >= most or float(distances[..., -1].min(initial=np.inf)) > limit:
            break
        count *= 2
    return which, np.where(np.isfinite(distances), distances * distances, np.nan)


def _in_turn(one: Indices, other: Indices) -> Indices:
    """Which pairs (P,) come to be, of those before which neither of the two was taken."""
    taken, left = [], np.arange(len(one))
    if len({*one.tolist()}) == len(one) == len({*other.tolist()}):
        return left  # as a rule each has one
    while len(left):
        first, also = np.zeros(one.max() + 1, np.intp), np.zeros(other.max() + 1, np.intp)
        first[one[left][::-1]] = also[other[left][::-1]] = left[::-1]
        some = left[(first[one[left]] == left) & (also[other[left]] == left)]
        taken.append(some)
        first[:], also[:] = 0, 0
        first[one[some]] = also[other[some]] = 1
        left = left[(first[one[left]] | also[other[left]]) == 0]
    return np.sort(np.concatenate(taken)) if taken else left


def _run_together(
    y: Floats,
    weights: Floats,
    reach: Floats,
    is_open: Mask,
    met: Sequence[NDArray[Any]],
) -> None:
    """Let two features share a detection that lies nearer to their middle than to either.

    Images that overlap are detected as one.  The two count as one feature in their middle.
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
    """Shares, offsets and Jacobians (n, m, 6) of features (n, m) that a grid of values is seen at.

    C is the predicted mixture blurred alike, each feature with an amplitude of its own.  What is
    left of the gradient without all others is the pull on a feature.  Pulls of features that
    overlap answer to the places of all (F, 1 for a feature by itself) and err
    together (S), once heights are fitted.  So offsets and Jacobians are S^(−½) δ and S^(−½) F J,
    whose errors are independent and alike.
    """
    (n, m), top, away = y.shape, peak(variance, y.shape[1]), y[:, None] - y[None]
    overlaps = np.exp(-0.5 * (away * away).sum(axis=-1) / variance)
    bells = weights * overlaps * top
    rest = sampled[:, 0] - amplitude * bells.sum(axis=1)
    amplitudes = amplitude + np.linalg.solve(bells + rules.alike * top * np.diag(weights), rest)
    height = amplitudes * weights * top
    steep = (overlaps[..., None] * away).swapaxes(1, 2).reshape(n * m, n) / np.sqrt(variance)
    outer = np.eye(m) - away[..., :, None] * away[..., None, :] / variance
    alone = (overlaps[..., None, None] * outer).swapaxes(1, 2).reshape(n * m, n * m)
    by_height = np.linalg.solve(overlaps + rules.alike * np.eye(n), steep.T)
    F = alone - steep @ by_height
    S = F - rules.alike * by_height.T @ by_height
    # what the better half of the features looks like by itself
    full = float(np.median(np.sort(height)[n // 2 :]))
    if full <= 0:
        return np.zeros(n), np.zeros(y.shape), J
    shares = np.clip(height / full, 0.0, 1.0)
    is_met = shares > rules.min_share
    predicted_gradient = -((amplitudes * bells)[..., None] * away).sum(axis=1) / variance
    pull = sampled[:, 1:] - predicted_gradient
    offsets = variance * pull / np.maximum(height, rules.min_share * full)[:, None]
    values, axes = np.linalg.eigh(S)
    # what is as small tells nothing of places
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
    """What `Matches` says (L,) of detections around features in view at places y (L, n, 2)."""
    observations = [view.observation for view in objective.views]
    sigmas = np.array([one.sigma for one in observations])
    is_flat = objective.projection.dimensions == 1
    in_view = np.where(seen[..., None], y, np.nan)
    lower, upper = np.fmin.reduce(in_view, axis=1), np.fmax.reduce(in_view, axis=1)
    size, middle = upper - lower, (lower + upper) / 2
    smallest = sigmas[:, None] * np.where(is_flat[:, None], [rules.min_region, 1], rules.min_region)
    around = upper if rules.crowded else np.full_like(upper, np.nan)
    met = shares.sum(axis=1)
    crowd, others = crowding(detections, lower, around, smallest, met)
    for planes in clouds_among(objective.projection.sensors):
        points, low, high = (from_planes(one[planes]) for one in (detections, lower, around))
        least = rules.min_region * float(sigmas[planes[0]])
        others[planes] = crowding(points, low, high, least, met[planes[0]], deep=1.0)[1]
    crowd, others = crowd * sigmas**2, others * sigmas**3
    count = (detections[..., 0] == detections[..., 0]).sum(axis=1).astype(np.float64)
    unmatched = np.zeros(len(sigmas))
    missing = (seen & (shares == 0)).any(axis=1)
    if np.count_nonzero(missing):
        half = size / 2 + rules.slip * size.max(axis=1, keepdims=True)
        near = np.abs(detections - middle[:, None]) <= half[:, None]
        beside = np.count_nonzero(near.all(axis=2), axis=1) - met
        unmatched = np.where(missing & ~is_flat, np.maximum(beside, 0.0), 0.0)
    finest = np.zeros(len(sigmas))
    if seen.size > DRAWING.own_tiles:  # on pages
        finest = size.max(axis=1) / (DRAWING.widest * sigmas)  # NaN where no feature is in view
    for k, one in enumerate(observations):
        if one.cell is not None:  # as many equal features as would give the energy of grey values
            near, far = (corner / one.sigma for corner in one.extent)
            count[k] = objective.tops[k, 0] / objective.energies[k, 0]
            crowd[k] = count[k] / np.maximum(far - near, rules.min_region).prod()
            others[k] = crowd[k] / np.sqrt(np.maximum(far - near, rules.min_region).prod())
            finest[k] = 1.0
    finest = np.fmin(np.maximum(narrowest, finest), 1.0)
    return {
        "count": count,
        "crowd": crowd,
        "others": others,
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
    """Detections (..., M, m), NaN where there are fewer, per unit of coordinates (...,).

    Of all, or in boxes (..., m) where they are denser; a side counts as `smallest` at least.  Then
    per unit to the power `deep` m, without those in the boxes that meet (...,) the body: so dense
    are points in space that images show, which are as deep as they are wide.
    """
    number = (points[..., 0] == points[..., 0]).sum(axis=-1)
    extent = np.fmax.reduce(points, axis=-2) - np.fmin.reduce(points, axis=-2)
    sides = np.fmax(upper - lower, smallest)
    away = np.abs(points - ((lower + upper) / 2)[..., None, :])
    inside = (away <= sides[..., None, :] / 2).all(axis=-1).sum(axis=-1)
    overall, own = np.fmax(extent, smallest).prod(axis=-1), sides.prod(axis=-1)
    beside = np.maximum(number / overall**deep, (inside - met) / own**deep)
    return np.maximum(number / overall, inside / own), beside


def _by_calibration(objective: MatchedObjective, T_world_object: Floats) -> Floats | None:
    """By how much calibrations that are off move features (L, N, 2, Q), σ_ε."""
    columns, views = [], objective.views
    for k, view in enumerate(views):
        if view.doubts:
            points = transform(T_world_object, objective.projection.body.nodes.points)
            shifts = calibration_shifts(view.doubts, points)
            own = np.zeros((len(views), len(points), 2, shifts.shape[2]))
            own[k, :, : shifts.shape[1]] = shifts / view.observation.sigma
            columns.append(own)
    return np.concatenate(columns, axis=-1) if columns else None
