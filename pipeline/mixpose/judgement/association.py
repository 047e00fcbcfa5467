"""Poses against sensors: which features were met, and how closely."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mixpose.density import (
    AssociationRules,
    ErrorRules,
    FeaturesMet,
    Observation,
    Offsets,
    crowding,
    features_met,
    surplus,
)
from mixpose.objective import Match, MatchedObjective, in_image
from mixpose.records import Floats, PointPattern
from mixpose.rigid import transform
from mixpose.sensors import by_calibration


@dataclass(frozen=True)
class Association:
    """A pose against one sensor, at the finest blur; n features are in view."""

    name: str
    explained: float  # share of the sensor's density that the pose accounts for
    features: NDArray[np.intp]  # (n,) nodes of the body that are in view
    shares: Floats  # (n,) how far each was met, 0 to its weight
    places: Floats  # (n, m) where they are predicted, sensor units
    offsets: Floats  # (n, m) seen minus predicted; 0 where not met; of a merged pair its middle's
    J: Floats  # (n, m, 6) Jacobian of the predicted places by the pose, likewise
    expected: float  # sum of the weights of the features in view
    unseen: float  # sum of the weights of the features that face the sensor outside its view
    sigma: float  # σ_ε
    finest: float  # narrowest blur of the sensor, in σ_ε
    crowd: float  # observed features per unit of the sensor's coordinates, around the prediction
    count: float  # number of observed features
    merged: int = 0  # features that were detected as one with another
    surplus: float = 0.0  # detections around the body that belong to none, where some are missed
    # (n,) the observed features by which they were met; -1 for none
    detections: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    # (n, m, K) by how much each is elsewhere for calibrations off by a deviation in one of K things
    by_calibration: Floats | None = None

    @cached_property
    def met(self) -> float:
        """Sum of the shares."""
        return float(self.shares.sum())

    @property
    def missed(self) -> float:
        """Sum of the weights of the features in view that were not met."""
        return self.expected - self.met

    @property
    def coverage(self) -> float:
        """Share of the features that face the sensor that were met."""
        return self.met / max(self.expected + self.unseen, 1e-12)

    @property
    def measurements(self) -> float:
        """Number of coordinates that were met."""
        return self.met * int(self.J.shape[1])

    @cached_property
    def squared(self) -> Floats:
        """Squared offset of each feature, in σ² (n,)."""
        return np.asarray((self.offsets * self.offsets).sum(axis=1) / self.sigma**2)

    @cached_property
    def squares(self) -> float:
        """Sum of the squared offsets, in σ."""
        return float(self.shares @ self.squared)

    @property
    def rows(self) -> Floats:
        """Jacobian and offsets side by side (nm, 7) in σ, by the root of how far each was met."""
        roots = np.sqrt(self.shares)[:, None, None] / self.sigma
        rows = roots * np.concatenate([self.J, self.offsets[..., None]], axis=2)
        return np.asarray(rows.reshape(-1, 7))

    @property
    def rms(self) -> float | None:
        """Root mean square of the offsets of the met features, sensor units; None without any."""
        if self.met == 0:
            return None
        return self.sigma * math.sqrt(self.squares / self.met)


@dataclass(frozen=True)
class Matches:
    """What L sensors have at the N features of a body at K poses, which are worked on at once.

    Every feature has a place, also where a sensor does not have it in view, and every sensor M
    coordinates; what is not there has no share, no Jacobian and no offset.
    """

    dimensions: NDArray[np.intp]  # (L,) coordinates of each sensor
    weights: Floats  # (K, L, N) of the features in view; 0 of the others
    shares: Floats  # (K, L, N) how far each was met, 0 to its weight
    places: Floats  # (K, L, N, M) where they are predicted, sensor units
    offsets: Floats  # (K, L, N, M) observed minus predicted place, in σ_ε
    J: Floats  # (K, L, N, M, 6) of the places by the pose, in σ_ε; first by the place in the world
    crowd: Floats  # (K, L) observed features per m-th power of σ_ε
    count: Floats  # (K, L) number of observed features
    unseen: Floats  # (K, L) weight of the features that face a sensor outside its view
    each: Sequence[Sequence[Association]] = ()  # what they were put together of, if of these

    def residuals(self, k: int = 0) -> Offsets:
        """Offsets of the features of all sensors at one of the poses."""
        squared, finest = (self.offsets[k] ** 2).sum(axis=2), [one.finest for one in self.each[k]]
        return Offsets(squared, self.shares[k], self.dimensions, np.array(finest))

    @classmethod
    def of(cls, each: Sequence[Sequence[Association]]) -> Matches:
        """Put the associations of K poses with the same L sensors side by side."""
        dimensions = np.array([one.J.shape[1] for one in each[0]])
        all_of_them = [one for found in each for one in found]
        most = 1 + max(int(one.features.max(initial=0)) for one in all_of_them)
        shape = len(each), len(dimensions), most
        weights, shares = np.zeros((2, *shape))
        places, offsets = np.zeros((2, *shape, int(dimensions.max())))
        J = np.zeros((*places.shape, 6))
        for k, found in enumerate(each):
            for i, one in enumerate(found):
                n, m = one.offsets.shape
                at = k, i, one.features
                weights[at] = one.expected / max(n, 1)
                shares[at] = one.shares
                places[(*at, slice(m))] = one.places
                offsets[(*at, slice(m))] = one.offsets / one.sigma
                J[(*at, slice(m))] = one.J / one.sigma
        whole = [
            (one.crowd * one.sigma ** one.J.shape[1], one.count, one.unseen) for one in all_of_them
        ]
        crowd, count, unseen = np.array(whole).reshape(*shape[:2], 3).transpose(2, 0, 1)
        return cls(dimensions, weights, shares, places, offsets, J, crowd, count, unseen, each)


def associate(
    objective: MatchedObjective,
    T_world_object: Floats,
    rules: AssociationRules,
    narrowest: float = ErrorRules().narrowest,
) -> tuple[list[Association], float]:
    """Compare what a pose predicts with what every sensor observed.

    Parameters
    ----------
    objective : MatchedObjective
        At σ_ε of every sensor.
    T_world_object : (4, 4) array
    rules : AssociationRules
    narrowest : float
        Narrowest blur in σ_ε, as `mixpose.density.ErrorRules` has it.

    Returns
    -------
    list of Association
        One per view.
    float
        The objective at the pose.
    """
    match = objective.match(T_world_object[None])
    views = range(len(objective.views))
    found = [_associated(objective, match, k, T_world_object, rules, narrowest) for k in views]
    return found, float(objective.shares_of(match).sum())


def _associated(
    objective: MatchedObjective,
    match: Match,
    k: int,
    T_world_object: Floats,
    rules: AssociationRules,
    narrowest: float,
) -> Association:
    """The same of sensor k."""
    at, sampled, over = match
    view, body = objective.views[k], objective.projection.body
    m, observation = int(objective.projection.dimensions[k]), view.observation
    variance, energy = float(objective.variances[k, 0]), float(objective.energies[k, 0])
    features = np.flatnonzero(at.seen[k, 0])
    y, weights = at.y[k, 0, features, :m], at.weights[k, 0, features]
    J, C = at.J[k, 0, features, :m], sampled[k, 0, features, : 1 + m]
    product, norm = float(weights @ C[:, 0]), float(over.norm[k, 0])
    if product > 0:
        wide = in_image(body.node_spreads(T_world_object)[features], J) if body.spread else 0.0
        # beside detections the fit gives all features of a sensor one amplitude
        unlike = all(one.observation.cell is not None for one in objective.views)
        beside = product / norm, rules, wide
        met = features_met(observation, y, weights, variance, C, *beside, unlike=unlike)
    else:
        met = FeaturesMet.none(y)
    paired = met.partner != np.arange(len(y))
    if paired.any():
        J = np.where(paired[:, None, None], (J + J[met.partner]) / 2, J)
    sigma, world = math.sqrt(variance / 2), transform(T_world_object, body.nodes.points[features])
    # of grey values as many equal features as would give their energy
    count, crowd = _crowd(observation, y, sigma, float(objective.tops[k, 0]) / energy, rules)
    complete, total = np.count_nonzero(met.shares) == len(y), float(met.shares.sum())
    return Association(
        name=view.name,
        explained=min(product**2 / (energy * norm), 1.0) if product > 0 else 0.0,
        features=features,
        shares=met.shares,
        places=y,
        offsets=met.offsets,
        J=J,
        expected=float(weights.sum()),
        unseen=float(body.nodes.weights[at.faced[k, 0] & ~at.seen[k, 0]].sum()),
        sigma=sigma,
        finest=observation.narrowest(narrowest, y),
        crowd=crowd,
        count=count,
        detections=met.detections,
        merged=int(np.count_nonzero(paired)) // 2,
        surplus=0.0 if complete else surplus(observation, y, total, rules),
        by_calibration=by_calibration(view.doubts, world) if view.doubts else None,
    )


def _crowd(
    observation: Observation, y: Floats, sigma: float, equal: float, rules: AssociationRules
) -> tuple[float, float]:
    """Number of observed features, and their density around predicted ones (n, m)."""
    pattern, smallest = observation.pattern, rules.min_region * sigma
    if not isinstance(pattern, PointPattern):
        lower, upper = observation.extent
        return equal, equal / float(np.maximum(upper - lower, smallest).prod())
    around = y if rules.crowded and len(y) else pattern.points
    lower, upper = around.min(axis=0, keepdims=True), around.max(axis=0, keepdims=True)
    return float(len(pattern.points)), float(crowding(pattern.points, lower, upper, smallest)[0])
