"""What one sensor observed, as densities at any blur, and inner products of Gaussian mixtures.

Of a pattern g0 whose features have standard deviation σ after blurring these are g = g0 * ε, the
paper's observation density, and C, g blurred once more by σ, whose samples are inner products
⟨g, N(p, σ²)⟩ with a predicted feature of the same width.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.spatial import cKDTree

from mixpose.density.atlas import Atlas
from mixpose.density.grid import Density, Window, is_empty, odd_factor, render
from mixpose.density.rules import DRAWING
from mixpose.records import Floats, Indices, Mask, Pattern, PointPattern, Singles


@dataclass(frozen=True, eq=False)
class Observation:
    """A feature pattern with what is known about its blur, in sensor units."""

    pattern: Pattern  # g0 in sensor coordinates
    sigma: float  # σ_ε, the finest standard deviation of a feature
    intrinsic: float = 0.0  # the same in the pattern already: σ_ε of simulated densities

    def __post_init__(self) -> None:
        if not 0 < self.sigma < np.inf:
            raise ValueError(f"sigma: found {self.sigma}; allowed: greater than 0")

    @property
    def dimension(self) -> int:
        """m, the number of sensor coordinates."""
        return self.pattern.dimension

    @property
    def points(self) -> Floats | None:
        """Single detections (M, m); None for a grid of values."""
        return self.pattern.points if isinstance(self.pattern, PointPattern) else None

    def only(self, chosen: Mask) -> Observation:
        """With some of its detections (M,)."""
        assert isinstance(self.pattern, PointPattern)
        part = PointPattern(self.pattern.points[chosen], self.pattern.weights[chosen])
        return replace(self, pattern=part)

    @property
    def cell(self) -> float | None:
        """Size of a cell whose value carries noise of its own; None for detections."""
        if isinstance(self.pattern, PointPattern):
            return None
        return float(self.pattern.step**self.dimension)

    @property
    def cells(self) -> int:
        """Number of cells, or of detections."""
        return self._amounts.size

    @property
    def weight(self) -> float:
        """Sum of all weights or values."""
        return float(self._amounts.sum())

    @property
    def _amounts(self) -> Floats | Singles:
        pattern = self.pattern
        return pattern.weights if isinstance(pattern, PointPattern) else pattern.values

    @cached_property
    def is_empty(self) -> bool:
        """Whether the sensor saw no feature at all."""
        return is_empty(self.pattern)

    @cached_property
    def extent(self) -> tuple[Floats, Floats]:
        """Smallest and largest sensor coordinates (m,) of the pattern."""
        return self.pattern.extent

    def around(self, y: Floats, reach: float) -> Observation:
        """Detections within a reach, in σ_ε, of places (n, m), if there are any."""
        pattern = self.pattern
        if not isinstance(pattern, PointPattern) or not len(y):
            return self
        distances, _ = cKDTree(y).query(pattern.points, distance_upper_bound=reach * self.sigma)
        near = np.isfinite(distances)
        if not near.any() or near.all():
            return self
        return replace(self, pattern=PointPattern(pattern.points[near], pattern.weights[near]))

    def density(
        self, sigma: float, within: tuple[Floats, Floats], *, gradient: bool = False
    ) -> Density:
        """Make g with features of standard deviation sigma, on a window over the box `within`."""
        window = self._window(sigma, within)
        rendered = render(self.pattern, self.blur(sigma), window, gradient=gradient)
        return replace(rendered, sigma=sigma)

    def blur(self, sigma: float, *, matched: bool = False) -> float:
        """Blur of the pattern that gives features a standard deviation, once or for C."""
        variance = (2 if matched else 1) * sigma**2 - self.intrinsic**2
        return float(np.sqrt(max(variance, 0.0)))

    def energy(self, sigma: float) -> float:
        """⟨g, g⟩ at the given standard deviation of a feature, over the whole pattern."""
        return self._finest_energy if sigma == self.sigma else self._energy(sigma)

    @cached_property
    def _finest_energy(self) -> float:
        return self._energy(self.sigma)

    def _energy(self, sigma: float) -> float:
        pattern = self.pattern
        if self.is_empty:
            return 0.0
        if isinstance(pattern, PointPattern):
            weights = pattern.weights / pattern.weights.sum()
            return self_overlap(pattern.points, weights, 2 * sigma**2)
        lower, upper = self.extent
        g = self.density(sigma, (lower - DRAWING.cut * sigma, upper + DRAWING.cut * sigma))
        squared = np.einsum("ij,ij->", g.values, g.values, dtype=np.float64)
        return float(squared * g.window.step**self.dimension)

    def _window(self, feature_sigma: float, within: tuple[Floats, Floats]) -> Window:
        """A window over the box, fine enough for the blur and within the budget of cells."""
        (near, far), margin = self.extent, DRAWING.cut * feature_sigma
        lower = np.maximum(within[0], near - margin)
        upper = np.maximum(np.minimum(within[1], far + margin), lower)
        affordable = float(np.prod(upper - lower) / DRAWING.window_cells) ** (1 / self.dimension)
        step = max(feature_sigma / DRAWING.steps_per_sigma, affordable)
        if isinstance(self.pattern, PointPattern):
            return Window.around(lower, upper, step)
        grid = self.pattern
        factor = odd_factor(step / grid.step)
        # grid points at the centres of blocks of pixels
        begin = np.floor((lower - grid.origin) / grid.step) + (factor - 1) / 2
        return Window.around(grid.origin + begin * grid.step, upper, factor * grid.step)


def matched_atlas(
    observations: Sequence[Observation], sigmas: Sequence[float], steps_per_sigma: float
) -> Atlas:
    """C of several sensors, none of which is empty, with features of standard deviations sigmas."""
    blurs = [o.blur(sigma, matched=True) for o, sigma in zip(observations, sigmas, strict=True)]
    return Atlas([observation.pattern for observation in observations], blurs, steps_per_sigma)


def peak(variance: float, dimension: int) -> float:
    """Value of an isotropic Gaussian density at its centre."""
    return float((2 * np.pi * variance) ** (-dimension / 2))


def close_pairs(points: Floats, variance: float) -> Indices:
    """Pairs i < j of points (n, m) that overlap at the given variance, or all of few: (P, 2)."""
    if len(points) ** 2 <= DRAWING.few_pairs:
        return all_pairs(len(points))
    reach = np.sqrt(2 * DRAWING.negligible * variance)
    return np.asarray(cKDTree(points).query_pairs(reach, output_type="ndarray"), dtype=np.intp)


@lru_cache
def all_pairs(count: int) -> Indices:
    """Pairs i < j (P, 2) of as many points."""
    pairs = np.stack(np.triu_indices(count, 1), axis=1)
    pairs.flags.writeable = False
    return pairs


def self_overlap(points: Floats, weights: Floats, variance: float) -> float:
    """⟨g, g⟩ = Σ_ij w_i w_j N(y_i − y_j; 0, v) of points (n, m) and weights (n,), v = 2σ²."""
    pairs = close_pairs(points, variance)
    away = points[pairs[:, 0]] - points[pairs[:, 1]]
    bells = np.exp(-0.5 * (away * away).sum(axis=1) / variance)
    cross = float(np.sum(weights[pairs[:, 0]] * weights[pairs[:, 1]] * bells))
    return (float(weights @ weights) + 2 * cross) * peak(variance, points.shape[1])
