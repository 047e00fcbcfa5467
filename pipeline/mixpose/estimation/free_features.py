"""The last step where the body does not fit its observation: least squares of freed features.

The matched objective is least squares between densities.  A feature that lies r from its
prediction pulls with r exp(−r²/4σ²): where the body is deformed by more than a part of σ, the pose
is that of the features that fit.  Known correspondences would give all the same pull.  So they do
once each feature is freed from the body: the places where each of them explains most are the peaks
of the density, whatever the pose, and the pose is fitted to these.

Correspondences come from the fit itself: each place goes to one feature so that the sum of squared
distances is least, and the pose is fitted anew, until nothing changes.  If the misfits of all ν
redundant coordinates are normal with one unknown variance, an assignment that leaves the sum of
squares S has a probability proportional to S^(−ν/2).  Every condition is one of four:

* the body does not fit: χ² of what is left where its features are;
* each feature has a peak of its own, above half of a feature's height, and no other peak is so
  high: half is where presence and absence are equally likely, whatever the noise;
* noise has no such peaks: half a height is above √(2 ln K) standard deviations, which the
  largest of K normal numbers does not exceed;
* the assignment is more probable than all others together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.optimize import linear_sum_assignment
from scipy.special import chdtri

from mixpose.density import peak
from mixpose.objective import Quadratic, pose_jacobian
from mixpose.objective.overlaps import overlap_terms
from mixpose.optimise import NewtonOptions, ascend
from mixpose.rigid import perturb, transform
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]
Sampler: TypeAlias = Callable[[Floats], NDArray[np.floating]]
Labels: TypeAlias = tuple[tuple[int, ...], ...]

_BELIEVED = 0.99  # probability of χ² below which a misfit is taken for noise
_ROUNDING = float(np.sqrt(np.finfo(np.float32).eps))  # share of a height: half of the digits
_CLIMB = NewtonOptions(iterations=60, tolerance=1e-11, value_error=2e-3)


@dataclass(frozen=True)
class Sight:
    """What one sensor sees.

    Attributes
    ----------
    sensor : Sensor
    density : callable
        The matched density and its gradient (n, 1 + m) at any places (n, m).
    at_body : callable
        The same, exact at the body's features, where the estimate has them.
    variance : float
        2σ², that of a feature in the matched density, in squared sensor units.
    cell_variance : float
        Variance of the noise of a cell times the size of a cell.
    """

    sensor: Sensor
    density: Sampler
    at_body: Sampler
    variance: float
    cell_variance: float


@dataclass(frozen=True)
class Assigned:
    """A pose, its sum of squares, and the place of each feature, per sensor."""

    T: Floats
    squares: float
    labels: Labels


def fit_freed(
    sights: Sequence[Sight], points: Floats, starts: Sequence[Floats], free: NDArray[np.bool_]
) -> Floats | None:
    """The pose by least squares of freed features, where the body does not fit.

    Parameters
    ----------
    sights : sequence of Sight
    points : (n, 3) array
        The body's features, all of equal weight and seen by all sensors.
    starts : sequence of (4, 4) array
        Poses from which correspondences are sought; the estimate is the first.
    free : (6,) bool

    Returns
    -------
    (4, 4) array or None
        None where the body fits, or where it is not known which place is whose.
    """
    redundant = sum(sight.sensor.dimension for sight in sights) * len(points) - int(free.sum())
    if redundant <= 0 or fits(sights, transform(starts[0], points)):
        return None
    found = [own_peaks(sight, len(points)) for sight in sights]
    places = [one for one in found if one is not None]
    if len(places) < len(sights):
        return None
    ends = [assign(sights, points, places, T, free) for T in starts]
    each = {one.labels: one for one in ends}
    best = min(each.values(), key=lambda one: one.squares)
    others = [one.squares for one in each.values() if one is not best]
    others += swapped(sights, points, places, best, free)
    odds = (np.array(others) / best.squares) ** (-0.5 * redundant)
    return best.T if odds.sum() < 1 else None


def fits(sights: Sequence[Sight], points_world: Floats) -> bool:
    """Whether what a body leaves unexplained at its features (n, 3) may be noise."""
    statistic, freedom = 0.0, 0
    for sight in sights:
        y, _ = sight.sensor.project(points_world)
        top = peak(sight.variance, y.shape[1])
        away = y[:, None] - y
        bells = top * np.exp(-0.5 / sight.variance * (away * away).sum(axis=2))
        slopes = -(away * bells[..., None]).sum(axis=1) / sight.variance
        here = sight.at_body(y)
        amplitude = float(here[:, 0].sum() / bells.sum())
        rest = here - amplitude * np.column_stack([bells.sum(axis=1), slopes])
        rest[:, 1:] *= np.sqrt(sight.variance)
        noise = sight.cell_variance * top + (_ROUNDING * amplitude * top) ** 2
        statistic += float((rest * rest).sum()) / noise
        freedom += rest.size
    return statistic < float(chdtri(freedom, 1 - _BELIEVED))


def own_peaks(sight: Sight, count: int) -> Floats | None:
    """Where each of `count` features (n, m) explains most, if each has a peak of its own."""
    sensor, step = sight.sensor, np.sqrt(sight.variance / 8)  # half of σ
    axes = [np.arange(a, b, step) for a, b in zip(sensor.lower, sensor.upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    heights = sight.density(grid.reshape(-1, len(axes)))[:, 0].reshape(grid.shape[:-1])
    peaks = (heights == maximum_filter(heights, size=3)) & (heights > 0)
    order = np.argsort(heights[peaks])[::-1]
    if len(order) < count:
        return None
    places, amplitude = climb(sight, grid[peaks][order[:count]])
    half = 0.5 * amplitude * peak(sight.variance, len(axes))
    noise = np.sqrt(sight.cell_variance * peak(sight.variance, len(axes)))
    next_height = heights[peaks][order[count]] if len(order) > count else 0.0
    lowest = sight.density(places)[:, 0].min()
    clear = half > noise * np.sqrt(2 * np.log(heights.size))
    return places if clear and next_height < half < lowest else None


def climb(sight: Sight, y: Floats) -> tuple[Floats, float]:
    """Places (n, m) of n equal features that explain most together, and their amplitude."""
    n, m = y.shape
    select, ones = np.eye(n * m).reshape(n, m, n * m), np.ones(n)

    def model(y: Floats) -> Quadratic:
        sampled = sight.density(y).astype(np.float64)
        overlap = overlap_terms(y, select, ones, sight.variance)
        amplitude, half = sampled[:, 0].sum() / overlap.norm, overlap.half_gradient
        return Quadratic(
            amplitude**2 * overlap.norm,
            2 * amplitude * (sampled[:, 1:].ravel() - amplitude * half),
            2 * amplitude**2 * (overlap.gram - np.outer(half, half) / overlap.norm),
        )

    def move(y: Floats, step: Floats) -> Floats:
        return np.asarray(y + step.reshape(n, m))

    y = ascend(model, move, y, np.ones(n * m, dtype=np.bool_), _CLIMB).state
    norm = overlap_terms(y, select, ones, sight.variance).norm
    return y, float(sight.density(y)[:, 0].sum() / norm)


def assign(
    sights: Sequence[Sight],
    points: Floats,
    places: Sequence[Floats],
    T: Floats,
    free: NDArray[np.bool_],
) -> Assigned:
    """Places to features and the pose to the places, in turns from a pose (4, 4)."""
    labels: Labels = ()
    squares = np.inf
    while True:
        nearest = []
        for sight, place in zip(sights, places, strict=True):
            y, _ = sight.sensor.project(transform(T, points))
            costs = ((y[:, None] - place) ** 2).sum(axis=2)
            nearest.append(tuple(linear_sum_assignment(costs)[1].tolist()))
        if tuple(nearest) == labels:
            return Assigned(T, squares, labels)
        labels = tuple(nearest)
        own = [place[list(label)] for place, label in zip(places, labels, strict=True)]
        T, squares = least_squares(sights, points, own, T, free)


def offsets(
    sights: Sequence[Sight], points: Floats, places: Sequence[Floats], T: Floats
) -> tuple[Floats, Floats]:
    """Places less projections (Σnm,) in units of √2 σ, and the Jacobian (Σnm, 6) of these."""
    rests, jacobians = [], []
    for sight, place in zip(sights, places, strict=True):
        y, by_world, _ = sight.sensor.linearise(transform(T, points))
        scale = 1 / np.sqrt(sight.variance)
        rests.append(scale * (place - y).ravel())
        jacobians.append(scale * pose_jacobian(by_world, T, points).reshape(-1, 6))
    return np.concatenate(rests), np.concatenate(jacobians)


def least_squares(
    sights: Sequence[Sight],
    points: Floats,
    places: Sequence[Floats],
    T: Floats,
    free: NDArray[np.bool_],
) -> tuple[Floats, float]:
    """The pose whose projections are nearest to places (n, m) per sensor, and the sum of squares."""

    def model(T: Floats) -> Quadratic:
        rest, J = offsets(sights, points, places, T)
        return Quadratic(-float(rest @ rest), 2 * rest @ J, 2 * J.T @ J)

    found = ascend(model, perturb, T, free, NewtonOptions(iterations=60, tolerance=1e-13))
    return found.state, -found.value


def swapped(
    sights: Sequence[Sight],
    points: Floats,
    places: Sequence[Floats],
    best: Assigned,
    free: NDArray[np.bool_],
) -> list[float]:
    """Sums of squares, to first order, after any two places of one sensor change features."""
    own = [place[list(label)] for place, label in zip(places, best.labels, strict=True)]
    rest, J = offsets(sights, points, own, best.T)
    Q, _ = np.linalg.qr(J[:, free])
    squares, begin = [], 0
    for sight, place in zip(sights, own, strict=True):
        n, m = place.shape
        for i, j in combinations(range(n), 2):
            apart = (place[j] - place[i]) / np.sqrt(sight.variance)
            other = rest.copy()
            other[begin + i * m : begin + (i + 1) * m] += apart
            other[begin + j * m : begin + (j + 1) * m] -= apart
            squares.append(float(other @ other - (along := other @ Q) @ along))
        begin += n * m
    return squares
