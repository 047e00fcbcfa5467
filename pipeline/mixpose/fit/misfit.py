"""Whether a body fits a density, and least squares of features freed from one that does not.

In the matched objective a feature r away from its prediction pulls with r exp(−r²/4σ²): of a
deformed body only features that fit count.  Each feature's own place is a peak of the density,
whatever the pose: places go to features so that the sum of squares S is least, the pose is fitted
to them, and so on.  An assignment is as probable as S^(−ν/2), if the misfits of ν redundant
coordinates are normal with one unknown variance; see *A body that does not fit* in
`docs/method.md`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from mixpose.constants import constant
from mixpose.density import peak
from mixpose.objective import pose_jacobian
from mixpose.optimise import NewtonOptions, Quadratic, ascend
from mixpose.records import Floats
from mixpose.rigid import perturb, transform
from mixpose.sensors import Sensor

Labels: TypeAlias = tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class MisfitRules:
    """When a body does not fit."""

    believed: float = constant(
        0.99, "probability of χ² up to which a misfit is taken for noise: one frame in a hundred"
    )
    rounding: float = constant(1 / 512, "of a height: what a body may leave at its features")
    unlike: float = constant(
        0.3, "spread of the features' brightness, relative: markers of one kind under one lamp"
    )


@dataclass(frozen=True)
class SensorDensity:
    """The matched density of one sensor, as a function of places."""

    geometry: Sensor
    density: Callable[[Floats], NDArray[Any]]  # with its gradient (n, 1 + m) at places (n, m)
    variance: float  # 2σ², that of a feature in the matched density, in squared sensor units
    cell_variance: float  # of the noise of a cell, times the size of a cell
    extent: tuple[Floats, Floats]  # smallest and largest coordinates (m,) of the density's cells
    same: float = constant(1e-9, "of a height: features nearer than 1e-4 of √2 σ have one")
    steps: int = constant(
        30, "peaks two widths apart, the least, draw each other by 0.4 of a step: 0.4³⁰ = 1e-12"
    )

    def left(self, y: Floats) -> tuple[Floats, Floats]:
        """What features (n, m), each of its own height (n,), leave of the density's gradient.

        Gradients (n, m) times √2 σ, which have the noise of the values.
        """
        away = (y[:, None] - y) / np.sqrt(self.variance)
        bells = np.exp(-0.5 * (away * away).sum(axis=2))
        here = self.density(y).astype(np.float64)
        heights = np.linalg.solve(bells + self.same * np.eye(len(y)), here[:, 0])
        slopes = -((bells * heights)[..., None] * away).sum(axis=1)
        return np.sqrt(self.variance) * here[:, 1:] - slopes, heights

    def noise(self) -> float:
        """Standard deviation of the noise of the matched density."""
        return float(np.sqrt(self.cell_variance * peak(self.variance, self.geometry.dimension)))


def misfit(
    densities: Sequence[SensorDensity],
    points_world: Floats,
    unknowns: int,
    rules: MisfitRules = MisfitRules(),
) -> float:
    """χ² per degree of freedom of what a body leaves at its features; 1 if it may be noise.

    Each feature's height was fitted, and `unknowns` numbers of the pose, to exact densities at
    `points_world` (n, 3).
    """
    statistic, freedom = 0.0, -unknowns
    for sensor in densities:
        rest, heights = sensor.left(sensor.geometry.project(points_world)[0])
        noise = np.hypot(sensor.noise(), rules.rounding * float(heights.mean()))
        statistic += float((rest * rest).sum()) / noise**2
        freedom += rest.size
    if freedom <= 0 or statistic < float(chdtri(freedom, 1 - rules.believed)):
        return 1.0
    return statistic / freedom


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
    for _ in range(sensor.steps):
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
            term = LabelledPlaces(self, labels)
            found = ascend(term, T[None], perturb, self.free, NewtonOptions(60, tolerance=1e-13))
            T = found.states[0]
            last, labels = labels, self.nearest(T)
        return Matched(T, last, -float(found.values[0]))

    def swapped(self, best: Matched) -> list[float]:
        """Sums of squares, to first order, once two features of a sensor change their places."""
        Q, _ = np.linalg.qr(self.offsets(best.T, best.labels)[1][:, self.free])
        squares = []
        for k, own in enumerate(best.labels):
            for i, j in combinations(range(len(own)), 2):
                other = list(own)
                other[i], other[j] = own[j], own[i]
                labels = (*best.labels[:k], tuple(other), *best.labels[k + 1 :])
                rest, _ = self.offsets(best.T, labels)
                squares.append(float(rest @ rest) - float(np.sum((rest @ Q) ** 2)))
        return squares


@dataclass(frozen=True)
class LabelledPlaces:
    """Minus the sum of squares between features and the places that are taken for theirs."""

    matching: Matching
    labels: Labels

    def linearise(self, poses: Floats) -> Quadratic:
        """Second-order models at poses (H, 4, 4)."""
        pairs = [self.matching.offsets(T, self.labels) for T in poses]
        models = [(-float(rest @ rest), 2 * rest @ J, 2 * J.T @ J) for rest, J in pairs]
        return Quadratic(*map(np.array, zip(*models, strict=True)))


def fit_freed(
    densities: Sequence[SensorDensity],
    points: Floats,
    starts: Floats,
    free: NDArray[np.bool_],
) -> Floats | None:
    """Fit the pose to freed features by least squares; None where no place is surely whose.

    The features (n, 3), all of one weight, are seen by all sensors; correspondences are sought from
    starts (H, 4, 4), which may change in free directions (6,).
    """
    coordinates = sum(sensor.geometry.dimension for sensor in densities)
    redundant = coordinates * len(points) - int(free.sum())
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
