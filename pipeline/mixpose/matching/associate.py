"""Which features of a predicted mixture the sensors have something at, and how far off.

For detections, the nearest ones, each taken once; for grey values and profiles, the pull of what is
left of the density once the neighbours' share of it is taken off.
"""

from __future__ import annotations

import numpy as np

from mixpose.density import peak
from mixpose.matching.detections import Detections, side_by_side, surroundings
from mixpose.matching.matches import Matches
from mixpose.matching.rules import AssociationRules
from mixpose.objective import Match, MatchedObjective, in_image
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import transform
from mixpose.sensors import by_calibration

_ALIKE = 0.01  # of a height: features are told apart from a seventh of C's deviation on


def associate(
    objective: MatchedObjective, T_world_object: Floats, rules: AssociationRules, narrowest: float
) -> Matches:
    """Compare what a pose predicts with what every sensor observed.

    Parameters
    ----------
    objective : MatchedObjective
        At σ_ε of every sensor.
    T_world_object : (4, 4) array
    rules : AssociationRules
    narrowest : float
        Narrowest blur of interest, σ_ε.
    """
    match, views = objective.match(T_world_object[None]), objective.views
    y, seen, weights = match.y[:, 0], match.seen[:, 0], match.weights[:, 0]
    sigmas = np.array([view.observation.sigma for view in views])
    detections = side_by_side(tuple([view.observation for view in views]), rules)
    product = (match.sampled[:, 0, :, 0] * weights).sum(axis=1)
    energy, norm = objective.energies[:, 0], match.norm[:, 0]
    explained = np.minimum(np.maximum(product, 0.0) ** 2 / (energy * norm), 1.0)
    shares, offsets, by, partner = _met(
        objective, match, T_world_object, product, detections, rules
    )
    J, merged = match.J[:, 0] / sigmas[:, None, None, None], np.zeros(len(views), dtype=np.intp)
    paired = np.nonzero(partner >= 0)
    if len(paired[0]):
        J[paired] = (J[paired] + J[paired[0], partner[paired]]) / 2
        merged = np.bincount(paired[0], minlength=len(views)) // 2
    faced = match.faced[:, 0] & ~seen
    around = surroundings(objective, y, seen, shares, detections, rules)
    return Matches(
        names=tuple([view.name for view in views]),
        dimensions=objective.projection.dimensions,
        sigmas=sigmas,
        weights=weights,
        shares=shares,
        places=y,
        offsets=offsets / sigmas[:, None, None],
        J=J,
        detections=by,
        explained=explained,
        unseen=(objective.projection.body.nodes.weights * faced).sum(axis=1),
        merged=merged,
        count=around.count,
        crowd=around.crowd,
        unmatched_nearby=around.unmatched,
        finest=np.minimum(np.maximum(narrowest, around.finest), 1.0),
        by_calibration=_by_calibration(objective, T_world_object, sigmas),
    )


def _met(
    objective: MatchedObjective,
    match: Match,
    T_world_object: Floats,
    product: Floats,
    detections: Detections,
    rules: AssociationRules,
) -> tuple[Floats, Floats, Indices, Indices]:
    """Shares, offsets in sensor units, detections, and partners of features in merged pairs."""
    variances, y, weights = objective.variances, match.y[:, 0], match.weights[:, 0]
    shares, offsets = np.zeros(weights.shape), np.zeros(y.shape)
    by, partner = np.full((2, *weights.shape), -1)
    is_open = match.seen[:, 0] & (product > 0)[:, None]
    if detections.points.shape[1]:
        reach = rules.reach_squared * variances
        if objective.projection.body.spread:
            reach = reach + rules.reach_squared * _spread(objective, match.J[:, 0], T_world_object)
        _to_nearest(y, weights, detections, reach, is_open, rules, (shares, offsets, by, partner))
    unlike = all(detections.is_grid)
    for k in np.flatnonzero(detections.is_grid) if any(detections.is_grid) else ():
        of, m = np.flatnonzero(is_open[k]), int(objective.projection.dimensions[k])
        if len(of):
            amplitude, variance = product[k] / match.norm[k, 0], float(variances[k, 0])
            sampled = match.sampled[k, 0, of, : 1 + m]
            shares[k, of], offsets[k, of, :m] = _residuals(
                y[k, of, :m], weights[k, of], variance, sampled, float(amplitude), rules, unlike
            )
    return shares, offsets, by, partner


def _spread(objective: MatchedObjective, J: Floats, T_world_object: Floats) -> Floats:
    """Variances (L, n) along an axis by which features of a body that gives way may be off."""
    spreads = objective.projection.body.node_spreads(T_world_object)
    m = objective.projection.dimensions.tolist()
    return np.array([in_image(spreads, own[..., :size, :]) for own, size in zip(J, m)])


def _to_nearest(
    y: Floats,
    weights: Floats,
    detections: Detections,
    reach: Floats,
    is_open: Mask,
    rules: AssociationRules,
    result: tuple[Floats, Floats, Indices, Indices],
) -> None:
    """Features met by the nearest detections, each taken once; two that share one, in pairs.

    `reach` (L, n) is squared, in sensor units; the arrays of the result are written to.
    """
    shares, offsets, by, partner = result
    away = detections.points[:, None] - y[:, :, None]
    squared = (away * away).sum(axis=3)
    pairs = np.nonzero((squared <= reach[..., None]) & is_open[..., None])
    k, i, j = pairs
    if not len(k):
        return
    features, taken = k * y.shape[1] + i, k * squared.shape[2] + j
    chosen = _once_each(features, taken, squared[pairs])
    at = k[chosen], i[chosen]
    shares[at], offsets[at], by[at] = weights[at], away[(*at, j[chosen])], j[chosen]
    if rules.merged and len(chosen) < len(features):
        # only a feature near a detection that is taken can share it
        left = shares[k, i] == 0
        for row in np.unique(k[left]).tolist():
            of = np.flatnonzero(is_open[row])
            own = [np.array(array[row, of]) for array in result]
            limits = np.broadcast_to(reach, weights.shape)[row, of]
            _run_together(y[row, of], weights[row, of], limits, *own)
            shares[row, of], offsets[row, of], by[row, of] = own[:3]
            partner[row, of] = np.where(own[3] >= 0, of[own[3]], -1)


def _once_each(features: Indices, detections: Indices, squared: Floats) -> Indices:
    """Pairs in which no feature and no detection occurs twice, the nearest first."""
    if np.bincount(features).max() == 1 and np.bincount(detections).max() == 1:
        return np.arange(len(features))
    order = np.argsort(squared, kind="stable")
    pairs = zip(order.tolist(), features[order].tolist(), detections[order].tolist(), strict=True)
    chosen, met, taken = [], set[int](), set[int]()
    for number, feature, detection in pairs:
        if feature not in met and detection not in taken:
            met.add(feature)
            taken.add(detection)
            chosen.append(number)
    return np.array(chosen)


def _run_together(
    y: Floats,
    weights: Floats,
    reach: Floats,
    shares: Floats,
    offsets: Floats,
    detections: Indices,
    partner: Indices,
) -> None:
    """Let two features share a detection that lies nearer to their middle than to either.

    Images that overlap are detected as one, in the middle.  The two count as one feature that was
    met there: half of each, with the offset of their middle.
    """
    single = shares > 0
    for i in np.flatnonzero(shares == 0).tolist():
        seen = np.flatnonzero(single)
        if not len(seen):
            break
        places = y[seen] + offsets[seen]
        near = ((places - y[i]) ** 2).sum(axis=1) <= reach[i]
        middle = places - (y[seen] + y[i]) / 2
        closer = (middle**2).sum(axis=1) - (offsets[seen] ** 2).sum(axis=1)
        k = int(np.argmin(np.where(near, closer, np.inf)))
        if not near[k] or closer[k] >= 0:
            continue
        pair = [i, int(seen[k])]
        shares[pair] = weights[pair] / 2
        offsets[pair] = middle[k]
        partner[pair] = pair[::-1]
        detections[pair] = detections[pair[1]]
        single[pair[1]] = False


def _residuals(
    y: Floats,
    weights: Floats,
    variance: float,
    sampled: Floats,
    amplitude: float,
    rules: AssociationRules,
    unlike: bool,
) -> tuple[Floats, Floats]:
    """Shares and offsets by which a grid of values puts features (n, m) from their predictions.

    Around a prediction that fits, C is the predicted mixture blurred alike, each feature with an
    amplitude of its own about `amplitude`, or with that where they are not `unlike`.  What is left
    of the gradient once all are taken off is the pull on this feature alone.
    """
    n, top = len(y), peak(variance, y.shape[1])
    away = y[:, None] - y[None]
    bells = weights * np.exp(-0.5 * (away * away).sum(axis=-1) / variance) * top
    rest = sampled[:, 0] - amplitude * bells.sum(axis=1)
    # at one place features cannot be told apart: they are taken to be alike
    widened = bells + _ALIKE * top * np.diag(weights)
    amplitudes = amplitude + (np.linalg.solve(widened, rest) if unlike else np.zeros(n))
    predicted_gradient = -((amplitudes * bells)[..., None] * away).sum(axis=1) / variance
    height = amplitudes * weights * top if unlike else rest + amplitude * weights * top
    # what the better half of the features looks like by itself
    full = float(np.median(np.sort(height)[n // 2 :]))
    if full <= 0:
        return np.zeros(n), np.zeros(y.shape)
    shares = np.clip(height / full, 0.0, 1.0)
    is_met = shares > rules.min_share
    pull = sampled[:, 1:] - predicted_gradient
    offsets = variance * pull / np.maximum(height, rules.min_share * full)[:, None]
    return np.where(is_met, shares * weights, 0.0), np.where(is_met[:, None], offsets, 0.0)


def _by_calibration(
    objective: MatchedObjective, T_world_object: Floats, sigmas: Floats
) -> Floats | None:
    """By how much features are elsewhere (L, N, 2, Q), in σ_ε, for calibrations that are off."""
    views = objective.views
    if not any(view.doubts for view in views):
        return None
    points = transform(T_world_object, objective.projection.body.nodes.points)
    columns = []
    for k, view in enumerate(views):
        if view.doubts:
            shifts = by_calibration(view.doubts, points)
            own = np.zeros((len(views), len(points), 2, shifts.shape[2]))
            own[k, :, : shifts.shape[1]] = shifts / sigmas[k]
            columns.append(own)
    return np.concatenate(columns, axis=-1)
