"""Least squares of features freed from a body that does not fit its observation.

In the matched objective a feature r away from its prediction pulls with r exp(−r²/4σ²): of a
deformed body only features that fit count.  Each feature's own place is a peak of the density,
whatever the pose.  Places go to features so that the sum of squared distances is least, the pose is
fitted to them by least squares, and so on until nothing changes.  This is trusted where

* what the body leaves at its features is more than noise (`mixpose.fit.misfit`);
* each feature has a peak of its own, above half of a feature's height, and no other peak is as
  high: at half, presence and absence are equally likely, whatever the noise;
* half a height is above √(2 ln K) standard deviations of the noise, which the largest of K normal
  numbers stays below;
* the assignment is more probable than all others together.  If the misfits of ν redundant
  coordinates are normal with one unknown variance, one that leaves the sum of squares S has a
  probability proportional to S^(−ν/2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.fit.misfit import SensorDensity
from mixpose.objective import Quadratic, pose_jacobian
from mixpose.optimise import NewtonOptions, ascend
from mixpose.rigid import perturb, transform

Floats: TypeAlias = NDArray[np.float64]
Labels: TypeAlias = tuple[tuple[int, ...], ...]

_STEPS = 30  # peaks two widths apart, the least, draw each other by 0.4 of a step: 0.4³⁰ = 1e-12


def own_peaks(sensor: SensorDensity, count: int) -> Floats | None:
    """Where each of `count` features (n, m) explains most, if each has a peak of its own."""
    from scipy.ndimage import maximum_filter  # noqa: PLC0415 - takes long to import, seldom needed

    step = np.sqrt(sensor.variance / 8)  # half of σ
    limits = zip(*sensor.extent, strict=True)
    grid = np.stack(np.meshgrid(*(np.arange(a, b, step) for a, b in limits)), axis=-1)
    heights = sensor.density(grid.reshape(-1, grid.shape[-1]))[:, 0].reshape(grid.shape[:-1])
    peaks = (heights == maximum_filter(heights, size=3)) & (heights > 0)
    order = np.argsort(-heights[peaks])
    if len(order) < count:
        return None
    y = grid[peaks][order[:count]]
    for _ in range(_STEPS):
        rest, own = sensor.left(y)
        if own.min() <= 0:
            return None
        y = y + np.sqrt(sensor.variance) * rest / own[:, None]
    height = float(own.mean())
    chance = sensor.noise() * np.sqrt(2 * np.log(heights.size))
    others = heights[peaks][order[count:]].max(initial=chance)
    return y if others < 0.5 * height < sensor.density(y)[:, 0].min() else None


class Matched(NamedTuple):
    """A pose, the place of each feature per sensor, and the sum of squares."""

    T: Floats
    labels: Labels
    squares: float


@dataclass(frozen=True)
class Matching:
    """Features (n, 3), and places (n, m) per sensor that are theirs in unknown order."""

    densities: Sequence[SensorDensity]
    points: Floats
    places: Sequence[Floats]
    free: NDArray[np.bool_]

    def offsets(self, T: Floats, labels: Labels) -> tuple[Floats, Floats]:
        """Places less projections (Σnm,) in units of √2 σ, and Jacobians (Σnm, 6) of these."""
        rests, jacobians = [], []
        for sensor, place, own in zip(self.densities, self.places, labels, strict=True):
            y, by_world, _ = sensor.geometry.linearise(transform(T, self.points))
            arms = self.points @ T[:3, :3].T
            scale = 1 / np.sqrt(sensor.variance)
            rests.append(scale * (place[list(own)] - y).ravel())
            jacobians.append(scale * pose_jacobian(by_world, arms).reshape(-1, 6))
        return np.concatenate(rests), np.concatenate(jacobians)

    def nearest(self, T: Floats) -> Labels:
        """The place of each feature, per sensor, with the least sum of squares at a pose."""
        from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 - as above

        labels = []
        for sensor, place in zip(self.densities, self.places, strict=True):
            y, _ = sensor.geometry.project(transform(T, self.points))
            costs = ((y[:, None] - place) ** 2).sum(axis=2)
            labels.append(tuple(linear_sum_assignment(costs)[1].tolist()))
        return tuple(labels)

    def fit(self, T: Floats) -> Matched:
        """What is reached from a pose (4, 4)."""
        labels, tried = self.nearest(T), set[Labels]()
        while labels not in tried:
            tried.add(labels)

            def model(T: Floats, labels: Labels = labels) -> Quadratic:
                rest, J = self.offsets(T, labels)
                return Quadratic(-float(rest @ rest), 2 * rest @ J, 2 * J.T @ J)

            found = ascend(model, perturb, T, self.free, NewtonOptions(60, tolerance=1e-13))
            T, last, labels = found.state, labels, self.nearest(found.state)
        return Matched(T, last, -found.value)

    def swapped(self, best: Matched) -> list[float]:
        """Sums of squares, to first order, once two features of a sensor change their places."""
        Q, _ = np.linalg.qr(self.offsets(best.T, best.labels)[1][:, self.free])
        squares = []
        for k, own in enumerate(best.labels):
            for i, j in combinations(range(len(own)), 2):
                other = list(own)
                other[i], other[j] = own[j], own[i]
                rest, _ = self.offsets(
                    best.T, (*best.labels[:k], tuple(other), *best.labels[k + 1 :])
                )
                squares.append(float(rest @ rest) - float(np.sum((rest @ Q) ** 2)))
        return squares


def fit_freed(
    densities: Sequence[SensorDensity],
    points: Floats,
    starts: Sequence[Floats],
    free: NDArray[np.bool_],
) -> Floats | None:
    """Fit the pose to freed features by least squares.

    Parameters
    ----------
    densities : sequence of SensorDensity
    points : (n, 3) array
        The body's features, all of one weight and seen by all sensors.
    starts : sequence of (4, 4) array
        Poses from which correspondences are sought.
    free : (6,) bool

    Returns
    -------
    (4, 4) array or None
        None where it is not known which place is whose.
    """
    redundant = sum(sensor.geometry.dimension for sensor in densities) * len(points) - int(
        free.sum()
    )
    found = [own_peaks(sensor, len(points)) for sensor in densities]
    places = [one for one in found if one is not None]
    if redundant <= 0 or len(places) < len(densities):
        return None
    matching = Matching(densities, points, places, free)
    fitted = sorted((matching.fit(T) for T in starts), key=lambda one: one.squares)
    best = fitted[0]
    rivals = {one.labels: one.squares for one in fitted if one.labels != best.labels}
    others = np.array([*rivals.values(), *matching.swapped(best)])
    return best.T if ((others / best.squares) ** (-0.5 * redundant)).sum() < 1 else None
