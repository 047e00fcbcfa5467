"""Whether a body fits a density: what its features leave of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from mixpose.constants import constant
from mixpose.density import peak
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]

_SAME = 1e-9  # features nearer than 1e-4 of √2 σ have one height
_ROUNDING = 1 / 512  # of a height: what a body may leave at its features and yet fit


@dataclass(frozen=True)
class MisfitRules:
    """When a body does not fit."""

    believed: float = constant(
        0.99, "probability of χ² up to which a misfit is taken for noise: one frame in a hundred"
    )
    unlike: float = constant(
        0.3, "spread of the features' brightness, relative: markers of one kind under one lamp"
    )


@dataclass(frozen=True)
class SensorDensity:
    """The matched density of one sensor, as a function of places.

    Attributes
    ----------
    geometry : Sensor
    density : callable
        The matched density and its gradient (n, 1 + m) at places (n, m).
    variance : float
        2σ², that of a feature in the matched density, in squared sensor units.
    cell_variance : float
        Variance of the noise of a cell times the size of a cell.
    extent : tuple of (m,) float64
        Smallest and largest sensor coordinates of the density's cells.
    """

    geometry: Sensor
    density: Callable[[Floats], NDArray[Any]]
    variance: float
    cell_variance: float
    extent: tuple[Floats, Floats]

    def left(self, y: Floats) -> tuple[Floats, Floats]:
        """What features (n, m), each of its own height (n,), leave of the density's gradient.

        Gradients (n, m) times √2 σ, which have the noise of the values.
        """
        away = (y[:, None] - y) / np.sqrt(self.variance)
        bells = np.exp(-0.5 * (away * away).sum(axis=2))
        here = self.density(y).astype(np.float64)
        heights = np.linalg.solve(bells + _SAME * np.eye(len(y)), here[:, 0])
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

    Parameters
    ----------
    densities : sequence of SensorDensity
        Exact at the features.
    points_world : (n, 3) array
        The body's features.
    unknowns : int
        Numbers of the pose that were fitted; each feature's height was, too.
    rules : MisfitRules
    """
    statistic, freedom = 0.0, -unknowns
    for sensor in densities:
        rest, heights = sensor.left(sensor.geometry.project(points_world)[0])
        noise = np.hypot(sensor.noise(), _ROUNDING * float(heights.mean()))
        statistic += float((rest * rest).sum()) / noise**2
        freedom += rest.size
    if freedom <= 0 or statistic < float(chdtri(freedom, 1 - rules.believed)):
        return 1.0
    return statistic / freedom
