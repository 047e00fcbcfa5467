"""What one sensor observed, as densities at any blur.

Two densities are made of a pattern g0 whose features have standard deviation σ after blurring:

* ``density(σ)``: g = g0 * ε, the paper's observation density;
* ``matched(σ)``: g blurred once more by σ, whose samples are inner products ⟨g, N(p, σ²)⟩ of the
  observation with a predicted feature of the same width.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.density.atlas import Atlas, render_atlas
from mixpose.density.blur import TRUNCATE, odd_factor, render
from mixpose.density.grid import Density, Window
from mixpose.density.mixture import FEW, Mixture, mixture
from mixpose.density.overlap import self_overlap, squared_distances
from mixpose.records import Pattern, PointPattern

Floats: TypeAlias = NDArray[np.float64]

STEPS_PER_SIGMA = 4.0
"""Grid points per standard deviation: bilinear gradients then err by 0.2 % of a step at a peak."""

TILE_REACH = 3.0
"""Half-width of a tile in standard deviations of the matched density."""

MOST_CELLS = 1_500_000


@dataclass(frozen=True)
class Observation:
    """A feature pattern with what is known about its blur.

    Attributes
    ----------
    pattern : PointPattern or GridPattern
        g0 in sensor coordinates.
    sigma : float
        σ_ε, the finest standard deviation of a feature, in sensor units.
    intrinsic : float
        Standard deviation that features have in the pattern already: 0 for detections, σ_ε for
        a simulated measurement that is a density itself.

    Raises
    ------
    ValueError
        If sigma is not greater than 0.
    """

    pattern: Pattern
    sigma: float
    intrinsic: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.sigma < np.inf:
            raise ValueError(f"sigma: found {self.sigma}; allowed: greater than 0")

    @property
    def dimension(self) -> int:
        """m, the number of sensor coordinates."""
        if isinstance(self.pattern, PointPattern):
            return int(self.pattern.points.shape[1])
        return len(self.pattern.origin)

    @cached_property
    def is_empty(self) -> bool:
        """Whether the sensor saw no feature at all."""
        if isinstance(self.pattern, PointPattern):
            return len(self.pattern.points) == 0 or not self.pattern.weights.sum() > 0
        # a profile that lies below zero as a whole has no density anywhere
        return not self.pattern.values.max() > 0

    @cached_property
    def extent(self) -> tuple[Floats, Floats]:
        """Smallest and largest sensor coordinates (m,) of the pattern."""
        pattern = self.pattern
        if isinstance(pattern, PointPattern):
            return pattern.points.min(axis=0), pattern.points.max(axis=0)
        size = np.array(pattern.values.shape[::-1])[: self.dimension]
        return pattern.origin, np.asarray(pattern.origin + (size - 1) * pattern.step)

    def density(
        self, sigma: float, within: tuple[Floats, Floats], *, gradient: bool = False
    ) -> Density:
        """Make g with features of standard deviation sigma, on a window over the box `within`."""
        return self._render(sigma**2 - self.intrinsic**2, sigma, within, gradient)

    def matched(self, sigma: float, within: tuple[Floats, Floats]) -> Density:
        """Make g blurred once more by sigma, with gradients, on a window over the box `within`."""
        return self._render(2 * sigma**2 - self.intrinsic**2, np.sqrt(2) * sigma, within, True)

    def matched_near(
        self, sigma: float, centres: Floats | None, reach: float = TILE_REACH
    ) -> Atlas | Mixture | None:
        """As `matched`, exact, around expected features (n, m), or None for anywhere.

        Detections are summed where they are asked for; grids are drawn finely on tiles that reach
        `reach` standard deviations of the matched density to each side.

        None where a grid pattern is too coarse for the blur to be summed over its points, or no
        features are given.
        """
        blur = float(np.sqrt(2 * sigma**2 - self.intrinsic**2))
        if isinstance(self.pattern, PointPattern):
            if sigma == self.sigma and len(self.pattern.points) <= FEW:
                return self._finest
            return mixture(self.pattern, blur, centres, reach * blur)
        if centres is None or blur < self.pattern.step:
            return None
        return render_atlas(self.pattern, blur, centres, reach * np.sqrt(2) * sigma)

    def energy(self, sigma: float) -> float:
        """⟨g, g⟩ at the given standard deviation of a feature, over the whole pattern."""
        pattern = self.pattern
        if self.is_empty:
            return 0.0
        if isinstance(pattern, PointPattern):
            if sigma == self.sigma:
                return self._finest_energy
            return self_overlap(pattern.points, self._shares, 2 * sigma**2, self._apart)
        lower, upper = self.extent
        margin = TRUNCATE * sigma
        g = self.density(sigma, (lower - margin, upper + margin))
        squared = np.einsum("ij,ij->", g.values, g.values, dtype=np.float64)
        return float(squared * g.window.step**self.dimension)

    # what is made of detections at σ_ε serves the estimate, its rivals and their judgement

    @cached_property
    def _finest(self) -> Mixture:
        assert isinstance(self.pattern, PointPattern)
        blur = float(np.sqrt(2 * self.sigma**2 - self.intrinsic**2))
        return mixture(self.pattern, blur, None, 0.0)

    @cached_property
    def _finest_energy(self) -> float:
        assert isinstance(self.pattern, PointPattern)
        return self_overlap(self.pattern.points, self._shares, 2 * self.sigma**2, self._apart)

    @cached_property
    def _shares(self) -> Floats:
        """Weights of detections, normalised."""
        assert isinstance(self.pattern, PointPattern)
        return np.asarray(self.pattern.weights / self.pattern.weights.sum())

    @cached_property
    def _apart(self) -> Floats | None:
        """Squared distances of all detections from one another, where they are few."""
        assert isinstance(self.pattern, PointPattern)
        return squared_distances(self.pattern.points)

    def _render(
        self, variance: float, feature_sigma: float, within: tuple[Floats, Floats], gradient: bool
    ) -> Density:
        window = self._window(feature_sigma, within)
        blur = float(np.sqrt(max(variance, 0.0)))
        rendered = render(self.pattern, blur, window, gradient=gradient)
        return Density(rendered.values, window, feature_sigma)

    def _window(self, feature_sigma: float, within: tuple[Floats, Floats]) -> Window:
        """A window over the box, fine enough for the blur and within the budget of cells."""
        margin = TRUNCATE * feature_sigma
        near, far = self.extent
        lower = np.maximum(within[0], near - margin)
        upper = np.maximum(np.minimum(within[1], far + margin), lower)
        affordable = float(np.prod(upper - lower) / MOST_CELLS) ** (1 / self.dimension)
        step = max(feature_sigma / STEPS_PER_SIGMA, affordable)
        if isinstance(self.pattern, PointPattern):
            return Window.around(lower, upper, step)
        grid = self.pattern
        factor = odd_factor(step / grid.step)
        # grid points at the centres of blocks of pixels, so that averages need no resampling
        begin = np.floor((lower - grid.origin) / grid.step) + (factor - 1) / 2
        return Window.around(grid.origin + begin * grid.step, upper, factor * grid.step)
