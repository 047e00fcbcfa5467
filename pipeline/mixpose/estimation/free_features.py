"""Least squares of features freed from a body that does not fit its observation.

In the matched objective a feature r away from its prediction pulls with r exp(−r²/4σ²): of a
deformed body only features that fit count.  Each feature's own place is a peak of the density,
whatever the pose.  Places go to features so that the sum of squared distances is least, the pose is
fitted to them by least squares, and so on until nothing changes.  This is trusted where

* what the body leaves at its features is more than noise, by χ²;
* each feature has a peak of its own, above half of a feature's height, and no other peak is as
  high: at half, presence and absence are equally likely, whatever the noise;
* half a height is above √(2 ln K) standard deviations of the noise, which the largest of K normal
  numbers stays below;
* the assignment is more probable than all others together.  If the misfits of ν redundant
  coordinates are normal with one unknown variance, one that leaves the sum of squares S has a
  probability proportional to S^(−ν/2).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.optimize import linear_sum_assignment
from scipy.special import chdtri

from mixpose.density import peak
from mixpose.objective import Quadratic, pose_jacobian
from mixpose.optimise import NewtonOptions, ascend
from mixpose.rigid import perturb, transform
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]
Sampler: TypeAlias = Callable[[Floats], NDArray[Any]]
Labels: TypeAlias = tuple[tuple[int, ...], ...]

_BELIEVED = 0.99  # probability of χ² up to which a misfit is taken for noise
_ROUNDING = float(np.sqrt(np.finfo(np.float32).eps))  # of a height: half of the digits it has
_STEPS = 30  # peaks two widths apart, the least, draw each other by 0.4 of a step: 0.4³⁰ = 1e-12


@dataclass(frozen=True)
class Sight:
    """What one sensor sees.

    Attributes
    ----------
    sensor : Sensor
    density, at_body : callable
        Matched density and gradient (n, 1 + m) at places (n, m): anywhere, and exact at the body's.
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

    @property
    def top(self) -> float:
        """Peak of a feature of unit mass."""
        return peak(self.variance, self.sensor.dimension)

    def left(self, density: Sampler, y: Floats) -> tuple[Floats, float]:
        """What equal features (n, m) leave of density and gradient there; their amplitude."""
        away = y[:, None] - y
        bells = self.top * np.exp(-0.5 / self.variance * (away * away).sum(axis=2))
        slopes = -(away * bells[..., None]).sum(axis=1) / self.variance
        here = density(y).astype(np.float64)
        amplitude = float(here[:, 0].sum() / bells.sum())
        return here - amplitude * np.column_stack([bells.sum(axis=1), slopes]), amplitude

    def own_peaks(self, count: int) -> Floats | None:
        """Where each of `count` features (n, m) explains most, if each has a peak of its own."""
        step = np.sqrt(self.variance / 8)  # half of σ
        limits = zip(self.sensor.lower, self.sensor.upper, strict=True)
        grid = np.stack(np.meshgrid(*(np.arange(a, b, step) for a, b in limits)), axis=-1)
        heights = self.density(grid.reshape(-1, grid.shape[-1]))[:, 0].reshape(grid.shape[:-1])
        peaks = (heights == maximum_filter(heights, size=3)) & (heights > 0)
        order = np.argsort(-heights[peaks])
        if len(order) < count:
            return None
        y = grid[peaks][order[:count]]
        for _ in range(_STEPS):
            rest, amplitude = self.left(self.density, y)
            y = y + self.variance / (max(amplitude, 0.0) * self.top + 1e-300) * rest[:, 1:]
        half = 0.5 * amplitude * self.top
        noise = np.sqrt(2 * np.log(heights.size) * self.cell_variance * self.top)
        others = heights[peaks][order[count:]].max(initial=noise)
        return y if others < half < self.density(y)[:, 0].min() else None


@dataclass(frozen=True)
class Matching:
    """Features (n, 3), and places (n, m) per sensor that are theirs in unknown order."""

    sights: Sequence[Sight]
    points: Floats
    places: Sequence[Floats]
    free: NDArray[np.bool_]

    def offsets(self, T: Floats, labels: Labels) -> tuple[Floats, Floats]:
        """Places less projections (Σnm,) in units of √2 σ, and Jacobians (Σnm, 6) of these."""
        rests, jacobians = [], []
        for sight, place, own in zip(self.sights, self.places, labels, strict=True):
            y, by_world, _ = sight.sensor.linearise(transform(T, self.points))
            scale = 1 / np.sqrt(sight.variance)
            rests.append(scale * (place[list(own)] - y).ravel())
            jacobians.append(scale * pose_jacobian(by_world, T, self.points).reshape(-1, 6))
        return np.concatenate(rests), np.concatenate(jacobians)

    def nearest(self, T: Floats) -> Labels:
        """The place of each feature, per sensor, with the least sum of squares at a pose."""
        labels = []
        for sight, place in zip(self.sights, self.places, strict=True):
            y, _ = sight.sensor.project(transform(T, self.points))
            costs = ((y[:, None] - place) ** 2).sum(axis=2)
            labels.append(tuple(linear_sum_assignment(costs)[1].tolist()))
        return tuple(labels)

    def fit(self, T: Floats) -> tuple[Floats, Labels, float]:
        """Pose, labels and sum of squares that are reached from a pose (4, 4)."""
        labels, tried = self.nearest(T), set[Labels]()
        while labels not in tried:
            tried.add(labels)

            def model(T: Floats, labels: Labels = labels) -> Quadratic:
                rest, J = self.offsets(T, labels)
                return Quadratic(-float(rest @ rest), 2 * rest @ J, 2 * J.T @ J)

            found = ascend(model, perturb, T, self.free, NewtonOptions(60, tolerance=1e-13))
            T, last, labels = found.state, labels, self.nearest(found.state)
        return T, last, -found.value

    def swapped(self, T: Floats, labels: Labels) -> list[float]:
        """Sums of squares, to first order, once two features of a sensor change their places."""
        Q, _ = np.linalg.qr(self.offsets(T, labels)[1][:, self.free])
        squares = []
        for k, own in enumerate(labels):
            for i, j in combinations(range(len(own)), 2):
                other = list(own)
                other[i], other[j] = own[j], own[i]
                rest, _ = self.offsets(T, (*labels[:k], tuple(other), *labels[k + 1 :]))
                squares.append(float(rest @ rest) - float(np.sum((rest @ Q) ** 2)))
        return squares


def fits(sights: Sequence[Sight], points_world: Floats) -> bool:
    """Whether what a body leaves unexplained at its features (n, 3) may be noise."""
    statistic, freedom = 0.0, 0
    for sight in sights:
        rest, amplitude = sight.left(sight.at_body, sight.sensor.project(points_world)[0])
        rest[:, 1:] *= np.sqrt(sight.variance)
        noise = sight.cell_variance * sight.top + (_ROUNDING * amplitude * sight.top) ** 2
        statistic += float((rest * rest).sum()) / noise
        freedom += rest.size
    return statistic < float(chdtri(freedom, 1 - _BELIEVED))


def fit_freed(
    sights: Sequence[Sight], points: Floats, starts: Sequence[Floats], free: NDArray[np.bool_]
) -> Floats | None:
    """Fit the pose to freed features by least squares, where the body does not fit.

    Parameters
    ----------
    sights : sequence of Sight
    points : (n, 3) array
        The body's features, all of one weight and seen by all sensors.
    starts : sequence of (4, 4) array
        Poses from which correspondences are sought; the first is the estimate so far.
    free : (6,) bool

    Returns
    -------
    (4, 4) array or None
        None where the body fits, or where it is not known which place is whose.
    """
    redundant = sum(sight.sensor.dimension for sight in sights) * len(points) - int(free.sum())
    if redundant <= 0 or fits(sights, transform(starts[0], points)):
        return None
    found = [sight.own_peaks(len(points)) for sight in sights]
    places = [one for one in found if one is not None]
    if len(places) < len(sights):
        return None
    matching = Matching(sights, points, places, free)
    ends = {labels: (square, T) for T, labels, square in map(matching.fit, starts)}
    best = min(ends, key=lambda labels: ends[labels][0])
    least, T = ends.pop(best)
    others = np.array([square for square, _ in ends.values()] + matching.swapped(T, best))
    return T if ((others / least) ** (-0.5 * redundant)).sum() < 1 else None
