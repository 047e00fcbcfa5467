"""Simulated measurements: sums of Gaussians at the projected features, and noise.

Written without the densities of mixpose, so that no estimate is checked against itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.rigid import transform
from mixpose.sensors import Sensor
from paper.systems import POINTS, RANGE_LIMITS, Scenario, System, pose

Floats: TypeAlias = NDArray[np.float64]

SNR = 0.5


@dataclass(frozen=True)
class Measurement:
    """What one sensor measured: values on a grid of one unit.

    Attributes
    ----------
    values : (H, W) float32
        A profile has one row.
    origin : (m,) float64
        Sensor coordinates of ``values[0, 0]``.
    clean : (H, W) float64
        The values without noise.
    noise : float
        Standard deviation of the noise.
    """

    values: NDArray[np.float32]
    origin: Floats
    clean: Floats
    noise: float


def measure(
    system: System,
    scenario: Scenario,
    truth: Floats,
    rng: np.random.Generator,
    snr: float = SNR,
) -> list[Measurement]:
    """Measure the object at the true pose (6,) with every sensor of a system.

    `snr` is the peak of one feature over the standard deviation of the noise, where there is any.
    """
    points = transform(pose(truth), scenario.observed(POINTS))
    return [_measure_one(sensor, scenario, points, rng, snr) for sensor in system.sensors]


def _measure_one(
    sensor: Sensor,
    scenario: Scenario,
    points_world: Floats,
    rng: np.random.Generator,
    snr: float,
) -> Measurement:
    y, _ = sensor.project(points_world)
    clean = sum_of_gaussians(y, grid_axes(sensor), scenario.sigma)
    one_peak = (2 * np.pi * scenario.sigma**2) ** (-sensor.dimension / 2)
    noise = one_peak / snr if scenario.noisy else 0.0
    values = clean + noise * rng.standard_normal(clean.shape) if scenario.noisy else clean
    origin = np.array([axis[0] for axis in grid_axes(sensor)])
    return Measurement(values.astype(np.float32), origin, clean, noise)


def grid_axes(sensor: Sensor) -> list[Floats]:
    """Sensor coordinates of pixels or bins along each axis, u first."""
    if sensor.dimension == 1:
        return [np.arange(RANGE_LIMITS[0], RANGE_LIMITS[1] + 1)]
    size = (sensor.upper + 0.5).round().astype(int)
    return [np.arange(size[0], dtype=np.float64), np.arange(size[1], dtype=np.float64)]


def bells(centres: Floats, axis: Floats, sigma: float) -> Floats:
    """Normal densities (n, len(axis)) around centres (n,)."""
    away = (axis - centres[:, None]) / sigma
    return np.asarray(np.exp(-0.5 * away * away) / (np.sqrt(2 * np.pi) * sigma))


def sum_of_gaussians(y: Floats, axes: Sequence[Floats], sigma: float) -> Floats:
    """Σ_i N(· − y_i; 0, σ²) on a grid (H, W), for projected features (n, m)."""
    along_u = bells(y[:, 0], axes[0], sigma)
    if len(axes) == 1:
        return np.asarray(along_u.sum(axis=0, keepdims=True))
    return np.asarray(bells(y[:, 1], axes[1], sigma).T @ along_u)
