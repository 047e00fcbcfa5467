"""Matches of a pose, from what each sensor has at its features."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mixpose.judgement import ScoredPose
from mixpose.matching import Matches
from mixpose.records import Floats


@dataclass(frozen=True)
class Seen:
    """What one sensor has at n features of a body at a pose; lengths in its own units.

    Attributes
    ----------
    J : (n, m, 6)
        Of the features by the pose.
    offsets, places : (n, m)
    shares : (n,) or None
        How far each is met; None: entirely.
    expected : float or None
        Weight in view, the same of each feature; None: one each.
    count : float or None
        Of detections; None: as many as features.
    crowd : float
        Detections per m-th power of the sensor's unit.
    """

    J: Floats
    name: str = "0"
    offsets: ArrayLike = 0.0
    shares: ArrayLike | None = None
    places: ArrayLike = 0.0
    sigma: float = 1.0
    expected: float | None = None
    unseen: float = 0.0
    count: float | None = None
    crowd: float = 1e-5
    unmatched_nearby: float = 0.0
    explained: float = 1.0
    finest: float = 0.05


def of_eight(name: str, met: float, off: float = 0.1, unmatched: float = 0.0) -> Seen:
    """A sensor that meets some of 8 features, each off by some of σ_ε along either axis."""
    shares = np.full(8, met / 8)
    return Seen(np.zeros((8, 2, 6)), name, 1.5 * off, shares, sigma=1.5, unmatched_nearby=unmatched)


def matches_of(*sensors: Seen) -> Matches:
    """One pose against L sensors; those that see fewer features or coordinates are filled up."""
    most = max(len(one.J) for one in sensors)
    each = [_filled(one, most) for one in sensors]

    def of_each(name: str) -> Floats:
        return np.array([getattr(one, name) for one in sensors], dtype=np.float64)

    dimensions = np.array([one.J.shape[1] for one in sensors])
    sigmas = of_each("sigma")
    names = "weights", "shares", "places", "offsets", "J"
    arrays = dict(zip(names, (np.array(part) for part in zip(*each, strict=True)), strict=True))
    features = [float(len(one.J)) for one in sensors]
    counts = zip(sensors, features, strict=True)
    return Matches(
        names=tuple(one.name for one in sensors),
        dimensions=dimensions,
        sigmas=sigmas,
        **arrays,
        detections=np.where(arrays["shares"] > 0, np.arange(most), -1),
        explained=of_each("explained"),
        unseen=of_each("unseen"),
        merged=np.zeros(len(sensors), dtype=np.intp),
        count=np.array([n if one.count is None else one.count for one, n in counts]),
        crowd=of_each("crowd") * sigmas**dimensions,
        space_crowd=of_each("crowd") ** 1.5 * sigmas**3,
        unmatched_nearby=of_each("unmatched_nearby"),
        neighbour_distance=np.full(arrays["weights"].shape, np.nan),
        finest=of_each("finest"),
        extra=np.zeros(arrays["weights"].shape),
        radii=np.zeros(arrays["weights"].shape),
        cut=np.full((*arrays["weights"].shape, 2), np.nan),
    )


def scored(T_world_object: Floats, *sensors: Seen) -> ScoredPose:
    """A pose that is very likely and well known, with these matches."""
    ones, covariance = np.ones(len(sensors)), 1e-6 * np.eye(6)
    return ScoredPose(T_world_object, matches_of(*sensors), covariance, 50.0, variances=ones)


def _filled(one: Seen, most: int) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Weights, shares, places, offsets and J with so many features and two coordinates."""
    n, m, _ = one.J.shape
    weights, shares = np.zeros((2, most))
    places, offsets = np.zeros((2, most, 2))
    J = np.zeros((most, 2, 6))
    weights[:n] = (n if one.expected is None else one.expected) / n
    shares[:n] = 1.0 if one.shares is None else one.shares
    places[:n, :m] = one.places
    offsets[:n, :m] = np.broadcast_to(np.asarray(one.offsets), (n, m)) / one.sigma
    J[:n, :m] = one.J / one.sigma
    return weights, shares, places, offsets, J
