"""The matched density of a pattern on a grid, by summation instead of interpolation.

C(y) = Σ_x g(x) N(y − x; 0, s²) over the pixels x is what filtering and looking up approximate.
For the few features of a body the sum itself is as fast, has no interpolation error, and gives
the second derivatives too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.records import GridPattern

Floats: TypeAlias = NDArray[np.float64]

REACH = 6.5  # standard deviations at which the sum along v ends: the tail holds 1e-10


@dataclass(frozen=True)
class Quadrature:
    """A density on a grid that is evaluated anywhere, blurred once more by s.

    Attributes
    ----------
    values : (H, W) float64
        Density on the grid; one row for ranges.
    origin : (m,) float64
        Sensor coordinates of ``values[0, 0]``, u first.
    step : float
        Sensor units between grid points.
    sigma : float
        s, standard deviation of the blur, in sensor units; at least one step.
    """

    values: Floats
    origin: Floats
    step: float
    sigma: float

    @property
    def energy(self) -> float:
        """⟨g, g⟩ over the grid."""
        return float((self.values**2).sum() * self.step ** len(self.origin))

    def sample(self, y: Floats) -> Floats:
        """C and its gradient (..., 1 + m) at sensor coordinates (..., m)."""
        return self.sample_all(y)[0]

    def sample_all(self, y: Floats) -> tuple[Floats, Floats]:
        """As `sample`, with the second derivatives (..., m, m)."""
        m = len(self.origin)
        index = (y.reshape(-1, m) - self.origin) / self.step
        u = _bells(index[:, 0], 0, self.values.shape[1], self.sigma / self.step)
        if m == 1:
            sums = np.stack([bell @ self.values[0] for bell in u], axis=1)
            second = sums[:, 2:, None]
        else:
            reach = REACH * self.sigma / self.step
            first = int(np.clip(index[:, 1].min() - reach, 0, self.values.shape[0] - 1))
            last = int(np.clip(index[:, 1].max() + reach, first + 1, self.values.shape[0]))
            v = _bells(index[:, 1], first, last, self.sigma / self.step)
            rows = [bell @ self.values[first:last] for bell in v]
            pairs = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # derivatives by u, by v
            sums = np.stack([(u[a] * rows[b]).sum(axis=1) for a, b in pairs], axis=1)
            second = sums[:, [3, 4, 4, 5]].reshape(-1, 2, 2)
        # the sums of densities over steps are integrals: one step per axis, one less a derivative
        lead = sums[:, : 1 + m] / np.array([1.0] + [self.step] * m)
        return lead.reshape(*y.shape[:-1], 1 + m), (second / self.step**2).reshape(*y.shape, m)


def _bells(centres: Floats, first: int, last: int, sigma: float) -> list[Floats]:
    """Normal densities (n, last − first) at grid points, with their derivatives by the centre."""
    away = (np.arange(first, last) - centres[:, None]) / sigma
    bell = np.exp(-0.5 * away * away) / (np.sqrt(2 * np.pi) * sigma)
    slope = bell * away / sigma
    return [bell, slope, (slope * away - bell / sigma) / sigma]


def cut(pattern: GridPattern, lower: Floats, upper: Floats, sigma: float) -> Quadrature:
    """The part of a pattern in the box from `lower` to `upper` (m,), to be blurred by sigma."""
    m = len(pattern.origin)
    size = np.array(pattern.values.shape[::-1])[:m]
    begin = np.clip(np.floor((lower - pattern.origin) / pattern.step), 0, size - 1).astype(int)
    end = np.clip(np.ceil((upper - pattern.origin) / pattern.step) + 1, begin + 1, size).astype(int)
    rows = slice(begin[1], end[1]) if m == 2 else slice(None)
    values = pattern.values[rows, begin[0] : end[0]].astype(np.float64)
    return Quadrature(values, pattern.origin + begin * pattern.step, pattern.step, sigma)
