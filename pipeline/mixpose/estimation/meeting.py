"""Where a pose meets a sensor's observation: which features were met, and how closely."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.density import Observation, peak
from mixpose.objective import Projected
from mixpose.objective.stack import MatchedTerm, Stack
from mixpose.records import PointPattern

Floats: TypeAlias = NDArray[np.float64]

LEAST_SHARE = 0.3  # of a full feature's density: below it a feature was not met
_SLIP = 0.25  # of the body's size in the image: steps of a grid are smaller
_SMALLEST_REGION = 20.0  # in σ: features crowd at least over so wide a region


@dataclass(frozen=True)
class Meeting:
    """A pose against one sensor, at the finest blur.

    Attributes
    ----------
    name : str
        Of the sensor.
    explained : float
        Share of the sensor's density that the pose accounts for.
    shares : (n,) float64
        How far each feature in view was met, 0 to its weight.
    offsets : (n, m) float64
        Observed minus predicted place of each, sensor units; 0 where it was not met.  Two that
        were detected as one have those of their middle.
    J : (n, m, 6) float64
        Jacobian of the predicted places by the pose, likewise.
    expected : float
        Sum of the weights of the features in view.
    unseen : float
        Sum of the weights of the features that face the sensor outside its view.
    sigma : float
        σ_ε.
    crowd : float
        Observed features per unit of the sensor's coordinates, around the prediction.
    count : float
        Number of observed features.
    pairs : int
        Features that were detected as one with another.
    surplus : float
        Where features are missed in an image: detections around the body that belong to none.
    """

    name: str
    explained: float
    shares: Floats
    offsets: Floats
    J: Floats
    expected: float
    unseen: float
    sigma: float
    crowd: float
    count: float
    pairs: int = 0
    surplus: float = 0.0

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
    def rms(self) -> float | None:
        """Root mean square of the offsets of the met features, sensor units; None without any."""
        if self.met == 0:
            return None
        return self.sigma * math.sqrt(self.squares / self.met)


def meet(
    stack: Stack, observations: Sequence[Observation], T_world_object: Floats
) -> list[Meeting]:
    """Compare what a pose predicts for some sensors with what was observed.

    Parameters
    ----------
    stack : Stack
        The sensors' matched densities at σ_ε, exact around the pose.
    observations : sequence of Observation
        Of the same sensors.
    T_world_object : (4, 4) array

    Returns
    -------
    list of Meeting
        One per sensor.
    """
    at = stack.gaze.project(T_world_object)
    sampled, _ = stack.look_up(at.y)
    norms = stack.overlaps(at).norm
    return [
        _meeting(stack, observation, at, k, sampled[k], float(norms[k]))
        for k, observation in enumerate(observations)
    ]


def _meeting(
    stack: Stack, observation: Observation, at: Projected, k: int, sampled: Floats, norm: float
) -> Meeting:
    """The meeting with sensor k of a stack."""
    term = stack.terms[k]
    seen, y, weights, J = at.seen[k], at.y[k], at.weights[k], at.J[k]
    unseen = 0.0
    if np.count_nonzero(seen) < seen.size:
        unseen = float(stack.gaze.weights[at.faced[k] & ~seen].sum())
        y, weights, J, sampled = y[seen], weights[seen], J[seen], sampled[seen]
    shares, offsets, explained, pairs = np.zeros(len(y)), np.zeros(y.shape), 0.0, 0
    product = float(weights @ sampled[:, 0])
    if product > 0:
        explained = min(product**2 / (term.energy * norm), 1.0)
        if isinstance(observation.pattern, PointPattern):
            shares, offsets = _nearest(observation.pattern, y, weights, term.variance)
            if np.count_nonzero(shares) < len(shares):
                alone = np.count_nonzero(shares)
                shares, offsets, J = _run_together(shares, offsets, y, J, weights, term.variance)
                pairs = int(np.count_nonzero(shares) - alone)
        else:
            shares, offsets = _residuals(term, y, weights, sampled, amplitude=product / norm)
    sigma = math.sqrt(term.variance / 2)
    count = peak(term.variance, y.shape[1]) / term.energy
    surplus = 0.0
    some_missed = y.shape[1] == 2 and np.count_nonzero(shares) < len(y)
    if some_missed and isinstance(observation.pattern, PointPattern):
        surplus = _surplus(observation.pattern, y, float(shares.sum()))
    return Meeting(
        name=term.name,
        explained=explained,
        shares=shares,
        offsets=offsets,
        J=J,
        expected=float(weights.sum()),
        unseen=unseen,
        sigma=sigma,
        crowd=_crowd(observation, y, sigma, count),
        count=_count(observation, count),
        pairs=pairs,
        surplus=surplus,
    )


def _nearest(
    pattern: PointPattern, y: Floats, weights: Floats, variance: float
) -> tuple[Floats, Floats]:
    """Offsets to the detection nearest to each prediction, each detection taken once.

    Returns
    -------
    shares : (n,) array
        The weight of a feature that was met, 0 for the others.
    offsets : (n, m) array
    """
    shares, offsets = np.zeros(len(y)), np.zeros(y.shape)
    away = pattern.points - y[:, None]
    squared = (away * away).sum(axis=-1)
    near_i, near_j = np.nonzero(squared <= _reach_squared(variance))
    order = np.argsort(squared[near_i, near_j], kind="stable")
    met: set[int] = set()
    taken: set[int] = set()
    for i, j in zip(near_i[order].tolist(), near_j[order].tolist(), strict=True):
        if i not in met and j not in taken:
            met.add(i)
            taken.add(j)
            shares[i] = weights[i]
            offsets[i] = away[i, j]
    return shares, offsets


def _reach_squared(variance: float) -> float:
    """Squared distance from a detection within which a feature is met."""
    return -2 * variance * math.log(LEAST_SHARE)


def _run_together(
    shares: Floats, offsets: Floats, y: Floats, J: Floats, weights: Floats, variance: float
) -> tuple[Floats, Floats, Floats]:
    """Let two features share a detection that lies nearer to their middle than to either.

    Images that overlap are detected as one, in the middle.  The two count as one feature that was
    met there: half of each, with the offset and the Jacobian of their middle.

    Returns
    -------
    shares, offsets, J
        The same, with pairs that run together replaced.
    """
    shares, offsets, J = shares.copy(), offsets.copy(), J.copy()
    single = shares > 0
    for i in np.flatnonzero(shares == 0).tolist():
        seen = np.flatnonzero(single)
        if not len(seen):
            break
        found = y[seen] + offsets[seen]
        near = ((found - y[i]) ** 2).sum(axis=1) <= _reach_squared(variance)
        middle = found - (y[seen] + y[i]) / 2
        closer = (middle**2).sum(axis=1) - (offsets[seen] ** 2).sum(axis=1)
        k = int(np.argmin(np.where(near, closer, np.inf)))
        if not near[k] or closer[k] >= 0:
            continue
        pair = [i, int(seen[k])]
        shares[pair] = weights[pair] / 2
        offsets[pair] = middle[k]
        J[pair] = J[pair].mean(axis=0)
        single[pair[1]] = False
    return shares, offsets, J


def _residuals(
    term: MatchedTerm, y: Floats, weights: Floats, sampled: Floats, amplitude: float
) -> tuple[Floats, Floats]:
    """How far a grid of values puts each feature from its prediction.

    Around a prediction that fits, C is `amplitude` times the predicted mixture blurred alike.
    What is left of the gradient is the pull on this feature alone, without its neighbours'.

    Returns
    -------
    shares : (n,) array
        Weight with which each feature was met; 0 for those that were not.
    offsets : (n, m) array
        Residuals in sensor units.
    """
    top = peak(term.variance, y.shape[1])
    away = y[:, None] - y[None]
    bells = weights * np.exp(-0.5 * (away * away).sum(axis=-1) / term.variance) * top
    predicted_gradient = -(bells[..., None] * away).sum(axis=1) / term.variance
    neighbours = bells.sum(axis=1) - weights * top
    own = sampled[:, 0] - amplitude * neighbours
    # what the better half of the features looks like on its own
    full = float(np.median(np.sort(own)[len(own) // 2 :]))
    if full <= 0:
        return np.zeros(len(y)), np.zeros(y.shape)
    shares = np.clip(own / full, 0.0, 1.0)
    shares = np.where(shares > LEAST_SHARE, shares, 0.0) * weights
    pull = sampled[:, 1:] - amplitude * predicted_gradient
    offsets = term.variance * pull / np.maximum(own, LEAST_SHARE * full)[:, None]
    return shares, np.where(shares[:, None] > 0, offsets, 0.0)


def _count(observation: Observation, participation: float) -> float:
    """Number of observed features: of detections, or of equal ones that give the energy."""
    if isinstance(observation.pattern, PointPattern):
        return float(len(observation.pattern.points))
    return participation


def _crowd(observation: Observation, y: Floats, sigma: float, count: float) -> float:
    """Density of observed features: over the whole pattern, or near the body if denser there."""
    smallest = _SMALLEST_REGION * sigma
    lower, upper = observation.extent
    overall = _count(observation, count) / _area(upper - lower, smallest)
    if not isinstance(observation.pattern, PointPattern) or not len(y):
        return overall
    near, far = y.min(axis=0), y.max(axis=0)
    half = np.maximum(far - near, smallest) / 2
    found = _detected(observation.pattern, (near + far) / 2, half)
    return max(overall, found / _area(2 * half, smallest))


def _surplus(pattern: PointPattern, y: Floats, met: float) -> float:
    """Detections not met in the box of the body, and as far around it as a grid may slip."""
    near, far = y.min(axis=0), y.max(axis=0)
    half = (far - near) / 2 + _SLIP * float((far - near).max())
    return max(_detected(pattern, (near + far) / 2, half) - met, 0.0)


def _detected(pattern: PointPattern, middle: Floats, half: Floats) -> int:
    """Number of detections in a box (m,) about its middle."""
    return int(np.count_nonzero((np.abs(pattern.points - middle) <= half).all(axis=1)))


def _area(sides: NDArray[np.float64], smallest: float) -> float:
    """Size of a box, no side of which counts as less than the smallest."""
    return math.prod(max(side, smallest) for side in sides.tolist())
