"""Whether a body fits a density: what its features leave of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from mixpose.density import peak
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]

_BELIEVED = 0.99  # probability of χ² up to which a misfit is taken for noise
_ROUNDING = float(np.sqrt(np.finfo(np.float32).eps))  # of a height: half of the digits it has


@dataclass(frozen=True)
class Sight:
    """What one sensor sees.

    Attributes
    ----------
    sensor : Sensor
    density : callable
        The matched density and its gradient (n, 1 + m) at places (n, m).
    variance : float
        2σ², that of a feature in the matched density, in squared sensor units.
    cell_variance : float
        Variance of the noise of a cell times the size of a cell.
    """

    sensor: Sensor
    density: Callable[[Floats], NDArray[Any]]
    variance: float
    cell_variance: float

    def left(self, y: Floats) -> tuple[Floats, float]:
        """What equal features (n, m) leave of the density there, in units of their height, and σ.

        Values and gradients (n, 1 + m), the gradients times √2 σ; the height of a feature.
        """
        away = (y[:, None] - y) / np.sqrt(self.variance)
        bells = np.exp(-0.5 * (away * away).sum(axis=2))
        mixture = np.dstack([bells, -away * bells[..., None]]).sum(axis=1)
        here = self.density(y).astype(np.float64)
        here[:, 1:] *= np.sqrt(self.variance)
        height = max(float(here[:, 0].sum() / bells.sum()), np.finfo(np.float64).tiny)
        return here / height - mixture, height

    def noise(self) -> float:
        """Standard deviation of the noise of the matched density."""
        return float(np.sqrt(self.cell_variance * peak(self.variance, self.sensor.dimension)))


def fits(sights: Sequence[Sight], points_world: Floats) -> bool:
    """Whether what a body leaves unexplained may be noise, by χ² at its features.

    Parameters
    ----------
    sights : sequence of Sight
        Exact at the features.
    points_world : (n, 3) array
        The body's features.
    """
    statistic, freedom = 0.0, 0
    for sight in sights:
        rest, height = sight.left(sight.sensor.project(points_world)[0])
        statistic += float((rest * rest).sum()) / ((sight.noise() / height) ** 2 + _ROUNDING**2)
        freedom += rest.size
    return statistic < float(chdtri(freedom, 1 - _BELIEVED))
