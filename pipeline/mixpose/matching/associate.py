"""Which features of a predicted mixture the sensors have something at, and how far off.

For detections, the nearest ones, each taken once; for grey values and profiles, the pull of what is
left of the density once the neighbours' share of it is taken off.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mixpose.density import MOST_SIGMAS, Observation, peak
from mixpose.matching.matches import Matches
from mixpose.matching.rules import AssociationRules
from mixpose.objective import Match, MatchedObjective, View, in_image
from mixpose.records import Floats, Indices, Mask, PointPattern
from mixpose.rigid import transform
from mixpose.sensors import by_calibration

_FAR = 1e12  # sensor units: where detections are filled up that a sensor does not have
_ALIKE = 0.01  # of a height: features are told apart from a seventh of C's deviation on


class _Detections(NamedTuple):
    """Detections of L sensors side by side, M at most."""

    points: Floats  # (L, M, 2)
    number: Floats  # (L,) or as many equal features as would give the energy of grey values
    is_grid: tuple[bool, ...]


def associate(
    objective: MatchedObjective, poses: Floats, rules: AssociationRules, narrowest: float
) -> Matches:
    """Compare what poses predict with what every sensor observed.

    Parameters
    ----------
    objective : MatchedObjective
        At σ_ε of every sensor.
    poses : (K, 4, 4) array
    rules : AssociationRules
    narrowest : float
        Narrowest blur of interest, σ_ε.

    Returns
    -------
    Matches
        With a leading axis over the poses.
    """
    match, views = objective.match(poses), objective.views
    at, sampled, over = match
    sigmas, dimensions = np.sqrt(objective.variances / 2), objective.projection.dimensions
    energies = objective.energies
    detections = _side_by_side(tuple(view.observation for view in views))
    product = (sampled[..., 0] * at.weights).sum(axis=2)
    explained = np.minimum(np.maximum(product, 0.0) ** 2 / (energies * over.norm), 1.0)
    shares, offsets, by, partner = _met(objective, match, poses, product, detections, rules)
    box = _boxes(at.y, at.seen)
    J = at.J / sigmas[..., None, None, None]
    if (partner >= 0).any():
        k, h, i = np.nonzero(partner >= 0)
        J[k, h, i] = (J[k, h, i] + at.J[k, h, partner[k, h, i]] / sigmas[k, 0, None, None]) / 2
    equal = objective.tops / energies
    count, crowd = _crowding(views, box, sigmas, dimensions, detections, equal, rules)
    hidden = at.faced & ~at.seen
    away = (objective.projection.body.nodes.weights * hidden).sum(axis=2)
    complete = np.count_nonzero(shares, axis=2) == np.count_nonzero(at.seen, axis=2)
    nearby = np.zeros(product.shape)
    if not complete.all():
        met = shares.sum(axis=2)
        nearby = np.where(complete, 0.0, _unmatched(box, dimensions, detections, met, rules))
    extent = (box[1] - box[0]).max(axis=2)
    finest = np.minimum(np.maximum(narrowest, extent / (MOST_SIGMAS * sigmas)), 1.0)
    finest[~at.seen.any(axis=2) | np.array(detections.is_grid)[:, None]] = 1.0
    by_sensor = {
        "weights": at.weights,
        "shares": shares,
        "places": at.y,
        "offsets": offsets / sigmas[..., None, None],
        "J": J,
        "detections": by,
        "explained": explained,
        "unseen": away,
        "merged": np.count_nonzero(partner >= 0, axis=2) // 2,
        "count": count,
        "crowd": crowd,
        "unmatched_nearby": nearby,
        "finest": finest,
    }
    return Matches(
        tuple([view.name for view in views]),
        dimensions,
        sigmas[:, 0],
        by_calibration=_by_calibration(objective, poses, sigmas),
        **{name: array.swapaxes(0, 1) for name, array in by_sensor.items()},
    )


@lru_cache(maxsize=8)
def _side_by_side(observations: tuple[Observation, ...]) -> _Detections:
    patterns = [one.pattern for one in observations]
    points = [p.points if isinstance(p, PointPattern) else np.zeros((0, 2)) for p in patterns]
    side = np.full((len(points), max(map(len, points)), 2), _FAR)
    for row, some in zip(side, points, strict=True):
        row[: len(some), : some.shape[1]] = some
        row[: len(some), some.shape[1] :] = 0.0
    counts = np.array([float(len(some)) for some in points])
    return _Detections(side, counts, tuple([one.cell is not None for one in observations]))


def _met(
    objective: MatchedObjective,
    match: Match,
    poses: Floats,
    product: Floats,
    detections: _Detections,
    rules: AssociationRules,
) -> tuple[Floats, Floats, Indices, Indices]:
    """Shares, offsets in sensor units, detections and partners of features in merged pairs."""
    at, body = match.at, objective.projection.body
    shares, offsets = np.zeros(at.weights.shape), np.zeros(at.y.shape)
    by, partner = np.full((2, *at.weights.shape), -1)
    is_open = at.seen & (product > 0)[..., None]
    if detections.points.shape[1]:
        reach = rules.reach_squared * objective.variances[..., None]
        if body.spread:
            spreads = np.array([body.node_spreads(T) for T in poses])
            reach = reach + rules.reach_squared * _spread(objective, at.J, spreads)
        _to_nearest(match, detections, reach, is_open, rules, (shares, offsets, by, partner))
    unlike = all(detections.is_grid)
    for k in np.flatnonzero(detections.is_grid):
        m = int(objective.projection.dimensions[k])
        for h in range(len(poses)):
            of = np.flatnonzero(is_open[k, h])
            if len(of):
                amplitude = product[k, h] / match.over.norm[k, h]
                shares[k, h, of], offsets[k, h, of, :m] = _residuals(
                    at.y[k, h, of, :m],
                    at.weights[k, h, of],
                    float(objective.variances[k, 0]),
                    match.sampled[k, h, of, : 1 + m],
                    float(amplitude),
                    rules,
                    unlike,
                )
    return shares, offsets, by, partner


def _spread(objective: MatchedObjective, J: Floats, spreads: Floats) -> Floats:
    """Variances (L, H, n) along an axis by which features of a body that gives way may be off."""
    m = objective.projection.dimensions
    return np.array([in_image(spreads, own[..., :size, :]) for own, size in zip(J, m.tolist())])


def _to_nearest(
    match: Match,
    detections: _Detections,
    reach: Floats,
    is_open: Mask,
    rules: AssociationRules,
    found: tuple[Floats, Floats, Indices, Indices],
) -> None:
    """Features met by the nearest detections, each taken once; two that share one, in pairs.

    `reach` (L, H, n) is squared, in sensor units; arrays that are `found` are written to.
    """
    at, (shares, offsets, by, partner) = match.at, found
    away = detections.points[:, None, None] - at.y[..., None, :]
    squared = (away * away).sum(axis=-1)
    pairs = np.nonzero((squared <= reach[..., None]) & is_open[..., None])
    if not len(pairs[0]):
        return
    k, h, i, j = pairs
    row = k * at.y.shape[1] + h
    features = row * at.y.shape[2] + i
    chosen = _once_each(features, row * squared.shape[3] + j, squared[pairs])
    at_chosen = k[chosen], h[chosen], i[chosen]
    shares[at_chosen] = at.weights[at_chosen]
    offsets[at_chosen] = away[(*at_chosen, j[chosen])]
    by[at_chosen] = j[chosen]
    if rules.merged and len(chosen) < len(features):
        # only a feature near a detection that is taken can share it
        left = np.flatnonzero(shares[k, h, i] == 0)
        for a, b in sorted(set(zip(k[left].tolist(), h[left].tolist()))):
            of = np.flatnonzero(is_open[a, b])
            own = [np.array(one[a, b, of]) for one in found]
            limits = np.broadcast_to(reach, is_open.shape)[a, b, of]
            _run_together(at.y[a, b, of], at.weights[a, b, of], limits, *own)
            for one, part in zip(found[:3], own, strict=False):
                one[a, b, of] = part
            partner[a, b, of] = np.where(own[3] >= 0, of[own[3]], -1)


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


def _boxes(y: Floats, seen: Mask) -> tuple[Floats, Floats]:
    """Corners (L, H, 2) of the boxes around the features in view; 0 where there is none."""
    visible, some = seen[..., None], seen.any(axis=2, keepdims=True)
    lower = np.where(visible, y, np.inf).min(axis=2)
    upper = np.where(visible, y, -np.inf).max(axis=2)
    return np.where(some, lower, 0.0), np.where(some, upper, 0.0)


def _crowding(
    views: Sequence[View],
    box: tuple[Floats, Floats],
    sigmas: Floats,
    dimensions: Indices,
    detections: _Detections,
    equal: Floats,
    rules: AssociationRules,
) -> tuple[Floats, Floats]:
    """Number of detections (L, H), and how many per m-th power of σ_ε around the prediction."""
    count = np.tile(detections.number[:, None], (1, box[0].shape[1]))
    crowd = np.zeros(count.shape)
    for k, (view, m, sigma) in enumerate(zip(views, dimensions.tolist(), sigmas[:, 0].tolist())):
        lower, upper = (corner[k, :, :m] for corner in box)
        smallest = rules.min_region * sigma
        if detections.is_grid[k]:  # as many equal features as would give the energy
            near, far = view.observation.extent
            count[k] = equal[k]
            crowd[k] = equal[k] / float(np.maximum(far - near, smallest).prod()) * sigma**m
            continue
        points = detections.points[k, : int(detections.number[k]), :m]
        if not rules.crowded:
            lower, upper = points.min(axis=0)[None], points.max(axis=0)[None]
        crowd[k] = crowding(points, lower, upper, smallest) * sigma**m
    return count, crowd


def crowding(points: Floats, lower: Floats, upper: Floats, smallest: float) -> Floats:
    """Detections (H,) per unit of a sensor's coordinates, in all or in boxes where they are denser.

    Parameters
    ----------
    points : (M, m) array
        Of the detections.
    lower, upper : (H, m) array
        Boxes around the predicted features of H poses.
    smallest : float
        What the side of a region counts at least.
    """
    overall = len(points) / np.maximum(np.ptp(points, axis=0), smallest).prod()
    sides = np.maximum(upper - lower, smallest)
    middle = (lower + upper) / 2
    away = np.abs(points - middle[:, None])
    inside = (away <= sides[:, None] / 2).all(axis=2).sum(axis=1)
    return np.asarray(np.maximum(overall, inside / sides.prod(axis=1)))


def _unmatched(
    box: tuple[Floats, Floats],
    dimensions: Indices,
    detections: _Detections,
    met: Floats,
    rules: AssociationRules,
) -> Floats:
    """Detections (L, H) not met in the box of the body, and as far around it as a grid may slip."""
    lower, upper = box
    size = upper - lower
    half = size / 2 + rules.slip * size.max(axis=2, keepdims=True)
    away = np.abs(detections.points[:, None] - ((lower + upper) / 2)[:, :, None])
    inside = np.count_nonzero((away <= half[:, :, None]).all(axis=3), axis=2)
    return np.where(dimensions[:, None] == 2, np.maximum(inside - met, 0.0), 0.0)


def _by_calibration(objective: MatchedObjective, poses: Floats, sigmas: Floats) -> Floats | None:
    """By how much features are elsewhere (K, L, N, 2, Q), in σ_ε, for calibrations that are off."""
    views = objective.views
    if not any(view.doubts for view in views):
        return None
    points = objective.projection.body.nodes.points
    shape = len(poses), len(views), len(points), 2
    offs = []
    for k, view in enumerate(views):
        if view.doubts:
            shifts = np.array([by_calibration(view.doubts, transform(T, points)) for T in poses])
            own = np.zeros((*shape, shifts.shape[3]))
            own[:, k, :, : shifts.shape[2]] = shifts / sigmas[k, 0]
            offs.append(own)
    return np.concatenate(offs, axis=-1)
