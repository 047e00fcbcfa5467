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
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from mixpose.density import peak
from mixpose.fit.options import FitRules
from mixpose.objective import BodyProjection
from mixpose.optimise import NewtonOptions, Quadratic, ascend
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import perturb
from mixpose.sensors import Sensor


@dataclass(frozen=True)
class SensorDensity:
    """The matched density of one sensor, as a function of places."""

    geometry: Sensor
    density: Callable[[Floats], NDArray[Any]]  # with its gradient (n, 1 + m) at places (n, m)
    variance: float  # 2σ², that of a feature in the matched density, in squared sensor units
    cell_variance: float  # of the noise of a cell, times the size of a cell
    extent: tuple[Floats, Floats]  # smallest and largest coordinates (m,) of the density's cells

    def left(self, y: Floats) -> tuple[Floats, Floats]:
        """What features (n, m) leave of the gradient (n, m) times √2 σ, and their heights (n,)."""
        away = (y[:, None] - y) / np.sqrt(self.variance)
        bells = np.exp(-0.5 * (away * away).sum(axis=2))
        here = self.density(y).astype(np.float64)
        # features nearer than 1e-4 of √2 σ have one height
        heights = np.linalg.solve(bells + 1e-9 * np.eye(len(y)), here[:, 0])
        slopes = -((bells * heights)[..., None] * away).sum(axis=1)
        return np.sqrt(self.variance) * here[:, 1:] - slopes, heights

    def noise(self) -> float:
        """Standard deviation of the noise of the matched density."""
        return float(np.sqrt(self.cell_variance * peak(self.variance, self.geometry.dimension)))


def misfit(
    densities: Sequence[SensorDensity], points: Floats, unknowns: int, rules: FitRules = FitRules()
) -> float:
    """χ² per degree of freedom of what a body leaves at its features; 1 if it may be noise.

    Each feature's height was fitted, and some unknowns of the pose, to densities at points (n, 3).
    """
    statistic, freedom = 0.0, -unknowns
    for sensor in densities:
        rest, heights = sensor.left(sensor.geometry.project(points)[0])
        # drawing rounds heights to 1/512
        statistic += float((rest**2).sum() / (sensor.noise() ** 2 + (heights.mean() / 512) ** 2))
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
    for _ in range(30):  # peaks two widths apart, the least, draw each other by 0.4 of a step
        rest, own = sensor.left(y)
        if own.min() <= 0:
            return None
        y = y + np.sqrt(sensor.variance) * rest / own[:, None]
    chance = sensor.noise() * np.sqrt(2 * np.log(heights.size))
    others = heights[peaks][order[count:]].max(initial=chance)
    return y if others < 0.5 * own.mean() < sensor.density(y)[:, 0].min() else None


@dataclass(frozen=True)
class LabelledPlaces:
    """Minus the sum of squares between features and the places that are taken for theirs."""

    projection: BodyProjection
    places: Floats  # (L, n, 2) in unknown order
    scales: Floats  # (L,) 1 / √2 σ
    labels: Indices  # (L, n), the place of each feature

    def offsets(self, poses: Floats) -> tuple[Floats, Floats]:
        """Places less projections (H, 2Ln), in units of √2 σ, and Jacobians (H, 2Ln, 6)."""
        at, H = self.projection.project(poses), len(poses)
        taken = np.take_along_axis(self.places, self.labels[..., None], axis=1)
        scales = self.scales[:, None, None, None]
        offsets, J = scales * (taken[:, None] - at.y), scales[..., None] * at.J
        return offsets.swapaxes(0, 1).reshape(H, -1), J.swapaxes(0, 1).reshape(H, -1, 6)

    def linearise(self, poses: Floats) -> Quadratic:
        """Second-order models at poses (H, 4, 4)."""
        offsets, J = self.offsets(poses)
        gradient = 2 * (offsets[:, None] @ J)[:, 0]
        return Quadratic(-(offsets**2).sum(axis=1), gradient, 2 * J.swapaxes(1, 2) @ J)

    def nearest(self, T: Floats) -> Indices:
        """The labels with the least sum of squares at a pose (4, 4)."""
        from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 - as above

        y = self.projection.project(T[None]).y[:, 0]
        costs = ((y[:, :, None] - self.places[:, None]) ** 2).sum(axis=3)
        return np.array([linear_sum_assignment(cost)[1] for cost in costs])

    def fitted(self, T: Floats, free: Mask) -> tuple[float, Floats, LabelledPlaces]:
        """The sum of squares that is reached from a pose, where, and with which labels."""
        term, tried = replace(self, labels=self.nearest(T)), set[bytes]()
        while (key := term.labels.tobytes()) not in tried:
            tried.add(key)
            last = term
            end = ascend(term, T[None], perturb, free, NewtonOptions(60, tolerance=1e-13))
            T = end.states[0]
            term = replace(self, labels=self.nearest(T))
        return -float(end.values[0]), T, last

    def exchanged(self, T: Floats, free: Mask) -> list[float]:
        """Sums of squares, to first order, once two features of a sensor change their places."""
        Q, _ = np.linalg.qr(self.offsets(T[None])[1][0][:, free])
        count, n = self.labels.shape
        squares = []
        for k, (i, j) in product(range(count), combinations(range(n), 2)):
            labels = self.labels.copy()
            labels[k, [i, j]] = labels[k, [j, i]]
            rest = replace(self, labels=labels).offsets(T[None])[0][0]
            squares.append(float(rest @ rest) - float(np.sum((rest @ Q) ** 2)))
        return squares


def fit_freed(
    projection: BodyProjection, densities: Sequence[SensorDensity], starts: Floats, free: Mask
) -> Floats | None:
    """Fit the pose to freed features by least squares; None where no place is surely whose.

    The features, all of one weight, are seen by all sensors; correspondences are sought from
    starts (H, 4, 4), which may change in free directions (6,).
    """
    count = len(projection.body)
    redundant = int(projection.dimensions.sum()) * count - int(free.sum())
    places = np.zeros((len(densities), count, 2))
    for k, density in enumerate(densities):
        y = own_peaks(density, count) if redundant > 0 else None
        if y is None:
            return None
        places[k, :, : y.shape[1]] = y
    scales = 1 / np.sqrt([sensor.variance for sensor in densities])
    term = LabelledPlaces(projection, places, scales, np.zeros(places.shape[:2], np.intp))
    ends = sorted((term.fitted(T, free) for T in starts), key=lambda end: end[0])
    least, T_best, best = ends[0]
    rivals = {end.labels.tobytes(): squares for squares, _, end in ends}
    del rivals[best.labels.tobytes()]
    others = np.array([*rivals.values(), *best.exchanged(T_best, free)])
    return T_best if ((others / least) ** (-0.5 * redundant)).sum() < 1 else None
