"""Which features of a predicted mixture a pattern has something at, and how far off.

For detections, the nearest ones, each taken once; for grey values and profiles, the pull of what is
left of the density once the neighbours' share of it is taken off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mixpose.constants import constant
from mixpose.density.observation import Observation
from mixpose.density.overlap import peak
from mixpose.records import Floats, GridPattern, PointPattern

_ALIKE = 0.01  # of a height: features are told apart from a seventh of C's deviation on


@dataclass(frozen=True)
class AssociationRules:
    """When a feature counts as met."""

    min_share: float = constant(
        0.3,
        "share of a feature's peak density from which it is met: within 1.55 standard deviations "
        "of C, 2.2 σ_ε; false features pass for true ones beyond (search rows)",
    )
    min_region: float = constant(
        20.0,
        "σ_ε: features crowd at least over so wide a region, so that two that are close do not "
        "make the density of clutter infinite",
    )
    crowded: bool = constant(
        True, "whether clutter is as dense as detections around the body, where they are denser"
    )
    merged: bool = constant(
        True, "whether two features may share one detection: blobs that touch have one centre"
    )
    slip: float = constant(
        0.25,
        "of the body's size in the image: around its box, a grid shifted by a step has detections "
        "that belong to no feature (chessboards have steps of 1/8)",
    )

    @property
    def reach_squared(self) -> float:
        """Squared distance within which a feature is met, in variances of C."""
        return -2 * math.log(self.min_share)


class FeaturesMet(NamedTuple):
    """What a pattern has at n predicted features."""

    shares: Floats  # (n,) how far each was met, 0 to its weight
    offsets: Floats  # (n, m) observed minus predicted place; of two that run together of the middle
    partner: NDArray[np.intp]  # (n,) the feature that one shares its detection with, or itself
    detections: NDArray[np.intp]  # (n,) by which each was met; -1 for none

    @classmethod
    def none(cls, y: Floats) -> FeaturesMet:
        """No feature of those at y (n, m)."""
        n = len(y)
        return cls(np.zeros(n), np.zeros(y.shape), np.arange(n), np.full(n, -1))


def features_met(
    observation: Observation,
    y: Floats,
    weights: Floats,
    variance: float,
    sampled: Floats,
    amplitude: float,
    rules: AssociationRules,
    wide: Floats | float = 0.0,
    *,
    unlike: bool = True,
) -> FeaturesMet:
    """Compare predicted features with what was observed.

    Parameters
    ----------
    observation : Observation
    y : (n, m) array
        Predicted places.
    weights : (n,) array
    variance : float
        Of C, 2σ².
    sampled : (n, 1 + m) array
        C and its gradient there.
    amplitude : float
        The factor with which the predicted mixture meets the observed one.
    rules : AssociationRules
    wide : (n,) array or float
        Variances by which features may be off their places beside that, squared sensor units.
    unlike : bool
        Whether features of a grid of values have amplitudes of their own, as the fit gave them.
    """
    if isinstance(observation.pattern, GridPattern):
        return _residuals(y, weights, variance, sampled, amplitude, rules, unlike)
    reach = rules.reach_squared * (variance + np.broadcast_to(wide, len(y)))
    found = _nearest(observation.pattern, y, weights, reach)
    if rules.merged and np.count_nonzero(found.shares) < len(y):
        _run_together(found, y, weights, reach)
    return found


def _nearest(pattern: PointPattern, y: Floats, weights: Floats, reach: Floats) -> FeaturesMet:
    """Features met by the nearest detections, each taken once."""
    found = FeaturesMet.none(y)
    away = pattern.points - y[:, None]
    squared = (away * away).sum(axis=-1)
    near_i, near_j = np.nonzero(squared <= reach[:, None])
    order = np.argsort(squared[near_i, near_j], kind="stable")
    taken: set[int] = set()
    for i, j in zip(near_i[order].tolist(), near_j[order].tolist(), strict=True):
        if found.detections[i] < 0 and j not in taken:
            taken.add(j)
            found.shares[i] = weights[i]
            found.offsets[i] = away[i, j]
            found.detections[i] = j
    return found


def _run_together(found: FeaturesMet, y: Floats, weights: Floats, reach: Floats) -> None:
    """Let two features share a detection that lies nearer to their middle than to either.

    Images that overlap are detected as one, in the middle.  The two count as one feature that was
    met there: half of each, with the offset of their middle.
    """
    shares, offsets, partner, detections = found
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
) -> FeaturesMet:
    """How far a grid of values puts each feature from its prediction.

    Around a prediction that fits, C is the predicted mixture blurred alike, each feature with an
    amplitude of its own about `amplitude`.  What is left of the gradient once all are taken off is
    the pull on this feature alone.
    """
    found, n, top = FeaturesMet.none(y), len(y), peak(variance, y.shape[1])
    away = y[:, None] - y[None]
    bells = weights * np.exp(-0.5 * (away * away).sum(axis=-1) / variance) * top
    rest = sampled[:, 0] - amplitude * bells.sum(axis=1)
    # at one place features cannot be told apart: they are taken to be alike
    widened = bells + _ALIKE * top * np.diag(weights)
    amplitudes = amplitude + (np.linalg.solve(widened, rest) if unlike else np.zeros(n))
    predicted_gradient = -((amplitudes * bells)[..., None] * away).sum(axis=1) / variance
    own = amplitudes * weights * top if unlike else rest + amplitude * weights * top
    # what the better half of the features looks like on its own
    full = float(np.median(np.sort(own)[n // 2 :]))
    if full <= 0:
        return found
    shares = np.clip(own / full, 0.0, 1.0)
    is_met = shares > rules.min_share
    pull = sampled[:, 1:] - predicted_gradient
    offsets = variance * pull / np.maximum(own, rules.min_share * full)[:, None]
    found.shares[is_met], found.offsets[is_met] = (shares * weights)[is_met], offsets[is_met]
    return found


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
    away = np.abs(points - (lower + upper)[:, None] / 2)
    inside = (away <= sides[:, None] / 2).all(axis=2).sum(axis=1)
    return np.asarray(np.maximum(overall, inside / sides.prod(axis=1)))


def surplus(observation: Observation, y: Floats, met: float, rules: AssociationRules) -> float:
    """Detections not met in the box of the body (n, 2), and as far around it as a grid may slip."""
    pattern = observation.pattern
    if y.shape[1] != 2 or not len(y) or not isinstance(pattern, PointPattern):
        return 0.0
    near, far = y.min(axis=0), y.max(axis=0)
    half = (far - near) / 2 + rules.slip * float((far - near).max())
    inside = np.abs(pattern.points - (near + far) / 2) <= half
    return max(int(np.count_nonzero(inside.all(axis=1))) - met, 0.0)
