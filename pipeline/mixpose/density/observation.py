"""Observations of one sensor as densities at any blur; inner products of Gaussian mixtures.

A pattern g0, whose features have standard deviation σ once blurred, gives g = g0 * ε, the paper's
observation density, and C, which is g blurred once more by σ: its samples are inner products
⟨g, N(p, σ²)⟩ with a predicted feature of the same width.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from mixpose.density.atlas import Atlas, remap
from mixpose.density.blur import DRAWING, blurred, mass, odd_factor, reduced
from mixpose.records import (
    Floats,
    GridPattern,
    Indices,
    Mask,
    Pattern,
    PointPattern,
    Singles,
    replace,
)


@dataclass(frozen=True)
class Window:
    """A grid in sensor coordinates."""

    origin: Floats  # (m,) sensor coordinates of the first grid point
    shape: tuple[int, int]  # rows and columns; one row for ranges
    step: float  # sensor units between grid points

    @classmethod
    def around(cls, lower: Floats, upper: Floats, step: float) -> Window:
        """Return the smallest grid that covers the box from `lower` to `upper`, both (m,)."""
        count = np.maximum(np.ceil((upper - lower) / step - 1e-9).astype(int) + 1, 2)
        rows = int(count[1]) if len(count) == 2 else 1
        return cls(np.asarray(lower, dtype=np.float64), (rows, int(count[0])), float(step))

    def axis(self, k: int) -> Floats:
        """Return sensor coordinates of the grid along axis k (0 is u or the range, 1 is v)."""
        return np.asarray(self.origin[k] + self.step * np.arange(self.shape[1 - k]))


@dataclass(frozen=True)
class Density:
    """A probability density over sensor coordinates, sampled on a window; 0 outside."""

    # (H, W) in 1/unit^m, or (H, W, 3) with its gradient; for ranges the last channel is empty
    values: Singles
    window: Window  # index = (y - origin) / step
    sigma: float  # standard deviation of an exact feature in it, sensor units

    def sample(self, y: Floats) -> Singles:
        """Interpolate channels (..., 1 + m) at sensor coordinates (..., m); 0 outside and at NaN.

        A single channel has no last axis.
        """
        m = len(self.window.origin)
        index = (y.reshape(-1, m) - self.window.origin) / self.window.step
        index = np.clip(
            np.nan_to_num(index, copy=False, nan=DRAWING.far), DRAWING.far, -DRAWING.far
        )
        u = index[None, :, 0].astype(np.float32)
        v = index[None, :, 1].astype(np.float32) if m == 2 else np.zeros_like(u)
        looked_up = remap(self.values, u, v).reshape(*y.shape[:-1], *self.values.shape[2:])
        return np.asarray(looked_up if self.values.ndim == 2 else looked_up[..., : 1 + m])


def render(pattern: Pattern, sigma: float, window: Window, *, gradient: bool = False) -> Density:
    """Blur a pattern g0 by `sigma`, in sensor units, normalise the whole, and draw a window."""
    blur, total = sigma, np.inf if is_empty(pattern) else mass(pattern)
    if isinstance(pattern, GridPattern):
        pattern, blur = reduced(pattern, sigma)
    u, v = window.axis(0), window.axis(pattern.dimension - 1)
    layers = blurred(pattern, blur, u, v, total, gradient=gradient)
    if gradient:  # three channels: with two, cv2.remap of OpenCV 5 rounds places to 1/32 of a cell
        layers += [np.zeros(window.shape, dtype=np.float32)] * (3 - len(layers))
    return Density(np.asarray(cv2.merge(layers), dtype=np.float32), window, sigma)


@dataclass(frozen=True, eq=False)
class Observation:
    """A feature pattern with its blur, in sensor units."""

    pattern: Pattern  # g0 in sensor coordinates
    sigma: float  # σ_ε, the finest standard deviation of a feature
    intrinsic: float = 0.0  # blur that the pattern has already: σ_ε of simulated densities
    passed_over: int = 0  # detections left out of the pattern, as there were too many

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
        """Return the observation with chosen detections (M,)."""
        assert isinstance(self.pattern, PointPattern)
        return replace(self, pattern=self.pattern.only(chosen))

    @cached_property
    def cell(self) -> float | None:
        """Size of a cell of grey values, each with independent noise; None for detections."""
        pattern = self.pattern
        return None if isinstance(pattern, PointPattern) else float(pattern.step**self.dimension)

    @property
    def cells(self) -> int:
        """Number of cells, or of detections."""
        return self.pattern.size

    @property
    def found(self) -> int:
        """Number of detections, including those left out of the pattern."""
        return self.pattern.size + self.passed_over

    @property
    def weight(self) -> float:
        """Sum of all weights or values."""
        return self.pattern.total

    @property
    def is_empty(self) -> bool:
        """Whether the sensor observed no feature at all."""
        return is_empty(self.pattern)

    @cached_property
    def extent(self) -> tuple[Floats, Floats]:
        """Smallest and largest sensor coordinates (m,) of the pattern."""
        return self.pattern.extent

    def around(self, y: Floats, reach: float) -> Observation:
        """Keep detections within a reach, in σ_ε, of places (n, m); all if there are none."""
        if self.points is None or not len(y):
            return self
        near = nearest_of(self.points, y)[0] < (reach * self.sigma) ** 2
        return self.only(near) if near.any() else self

    def density(
        self, sigma: float, within: tuple[Floats, Floats], *, gradient: bool = False
    ) -> Density:
        """Draw g with features of standard deviation sigma, on a window over the box `within`.

        The window is fine enough for the blur, within the budget of cells.
        """
        (near, far), margin = self.extent, DRAWING.cut * sigma
        lower = np.maximum(within[0], near - margin)
        upper = np.maximum(np.minimum(within[1], far + margin), lower)
        affordable = float(np.prod(upper - lower) / DRAWING.window_cells) ** (1 / self.dimension)
        step, grid = max(sigma / DRAWING.steps_per_sigma, affordable), self.pattern
        if isinstance(grid, GridPattern):  # grid points at the centres of blocks of pixels
            factor = odd_factor(step / grid.step)
            begin = np.floor((lower - grid.origin) / grid.step) + (factor - 1) / 2
            lower, step = grid.origin + begin * grid.step, factor * grid.step
        window = Window.around(lower, upper, step)
        return replace(render(grid, self.blur(sigma), window, gradient=gradient), sigma=sigma)

    def blur(self, sigma: float, *, matched: bool = False) -> float:
        """Return the blur that gives features in g, or if `matched` in C, a deviation of sigma."""
        variance = (2 if matched else 1) * sigma**2 - self.intrinsic**2
        return math.sqrt(max(variance, 0.0))

    def energy(self, sigma: float) -> float:
        """Return ⟨g, g⟩ over the whole pattern, for features of standard deviation sigma."""
        return self._finest_energy if sigma == self.sigma else self._energy(sigma)

    @cached_property
    def _finest_energy(self) -> float:
        return self._energy(self.sigma)

    def _energy(self, sigma: float) -> float:
        if self.is_empty:
            return 0.0
        if isinstance(self.pattern, PointPattern):
            weights = self.pattern.effective_weights(DRAWING.exact * self.blur(sigma, matched=True))
            overlap = self_overlap(self.pattern.points, weights, 2 * sigma**2)
            return overlap / float(weights.sum()) ** 2
        g = self.density(sigma, (np.array(-np.inf), np.array(np.inf)))
        squared = np.einsum("ij,ij->", g.values, g.values, dtype=np.float64)
        return float(squared * g.window.step**self.dimension)


def matched_atlas(
    observations: Sequence[Observation], sigmas: Sequence[float], steps_per_sigma: float
) -> Atlas:
    """Return C of several sensors, none of them empty, for features of these deviations."""
    blurs = [o.blur(sigma, matched=True) for o, sigma in zip(observations, sigmas, strict=True)]
    return Atlas([observation.pattern for observation in observations], blurs, steps_per_sigma)


def peak(variance: Any, dimension: Any) -> Any:
    """Return the value of an isotropic Gaussian density at its centre, also of arrays."""
    return (2 * np.pi * variance) ** (-dimension / 2)


def close_pairs(places: Floats, variances: Floats) -> Indices:
    """Return pairs i < j (P, 2) of n points that overlap in any of K blurred pictures (K, n, m)."""
    n = places.shape[1]
    _, i, j = pairs_by_picture(places, variances)
    numbers = np.sort(n * i + j)
    is_first = np.append(True, numbers[1:] > numbers[:-1])[: len(numbers)]
    return np.stack(np.divmod(numbers[is_first], n), axis=1)


def pairs_by_picture(places: Floats, variances: Floats) -> tuple[Indices, Indices, Indices]:
    """Return overlapping pairs by picture: numbers (P,) of pictures, ascending, and i < j."""
    reaches = np.sqrt(2 * DRAWING.negligible * variances).tolist()
    by_picture = [cKDTree(y).query_pairs(r, output_type="ndarray") for y, r in zip(places, reaches)]
    i, j = np.concatenate(by_picture).T
    return np.arange(len(by_picture)).repeat([len(pairs) for pairs in by_picture]), i, j


@lru_cache
def all_pairs(count: int) -> Indices:
    """Return all pairs i < j (P, 2) of as many points."""
    pairs = np.stack(np.triu_indices(count, 1), axis=1)
    pairs.flags.writeable = False
    return pairs


def nearest_of(points: Floats, places: Floats) -> tuple[Floats, Indices]:
    """Return squared distances (M,) of points (M, m) to the nearest of places (n, m), and which."""
    if len(points) * len(places) > DRAWING.few_pairs:
        distances, numbers = cKDTree(places).query(points)
        return distances**2, numbers
    away = points[:, None] - places
    squared = np.vecdot(away, away)
    numbers = squared.argmin(axis=1)
    return squared[range(len(points)), numbers], numbers


def self_overlap(points: Floats, weights: Floats, variance: float) -> float:
    """Return ⟨g, g⟩ = Σ_ij w_i w_j N(y_i − y_j; 0, v) of points (n, m), weights (n,), v = 2σ²."""
    if len(points) ** 2 <= DRAWING.few_pairs:
        away = points[:, None] - points
        overlap = weights @ np.exp(np.vecdot(away, away) * (-0.5 / variance)) @ weights
    else:
        i, j = close_pairs(points[None], np.array([variance])).T
        away = points[i] - points[j]
        bells = np.exp(np.vecdot(away, away) * (-0.5 / variance))
        overlap = weights @ weights + 2 * (weights[i] * weights[j]) @ bells
    return float(overlap * peak(variance, points.shape[1]))


def is_empty(pattern: Pattern) -> bool:
    """Test whether a pattern has no feature at all."""
    if isinstance(pattern, PointPattern):
        return not pattern.total > 0
    # profiles below zero, or too small to be normalised in single precision, have no density
    return not pattern.values.max() > 1e-30
