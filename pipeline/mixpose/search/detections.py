"""What each sensor contributes to the search: detections that count alike, and rays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.density import Observation
from mixpose.objective import View
from mixpose.records import Floats, GridPattern, PointPattern
from mixpose.search.budget import SearchBudget
from mixpose.sensors import Rays


@dataclass(frozen=True)
class SensorDetections:
    """One sensor with its detections, all of the same weight.

    A bright blob is not worth more features than a faint one, nor are two that merged.
    """

    view: View
    points: Floats  # (M, m) in sensor coordinates; none where features leave no points
    rays: Rays | None  # None for sensors without lines of sight
    mean: Floats  # (m,) middle of what the sensor saw
    spread: float  # root mean square distance from it, in sensor units

    @property
    def sigma(self) -> float:
        """σ_ε of the sensor."""
        return self.view.observation.sigma


def is_pointlike(body: Body) -> bool:
    """Whether every feature of a body is a point."""
    return len(body.nodes.points) == len(body)


def sensor_detections(
    views: Sequence[View], body: Body, budget: SearchBudget
) -> list[SensorDetections]:
    """Detections of all views that saw something."""
    sensors = []
    for view in views:
        observation = view.observation
        if observation.is_empty:
            continue
        pattern = observation.pattern
        # the one place where kinds of pattern differ
        if isinstance(pattern, PointPattern):
            points = pattern.points[pattern.weights > 0]
        elif observation.dimension == 2 and is_pointlike(body):
            points = peaks(pattern, observation.sigma, budget)
        else:
            nothing = np.zeros((0, observation.dimension))
            moments = _moments(*_weighted_places(pattern, budget))
            sensors.append(SensorDetections(view, nothing, None, *moments))
            continue
        if len(points):
            ones, rays = np.ones(len(points)), view.sensor.rays(points)
            alike = Observation(PointPattern(points, ones), observation.sigma)
            even = View(view.name, view.sensor, alike, view.delay)
            sensors.append(SensorDetections(even, points, rays, *_moments(points, ones)))
    return sensors


def _moments(points: Floats, weights: Floats) -> tuple[Floats, float]:
    """Weighted mean (m,) and root mean square distance from it."""
    mean = weights @ points / weights.sum()
    variance = weights @ ((points - mean) ** 2).sum(axis=1) / weights.sum()
    return mean, float(np.sqrt(variance))


def _weighted_places(pattern: GridPattern, budget: SearchBudget) -> tuple[Floats, Floats]:
    """Grid points (K, m) that stand out, and their values (K,)."""
    values = pattern.values.astype(np.float64)
    rows, columns = np.nonzero(values > budget.height * values.max())
    places = np.stack([columns, rows], axis=1)[:, : pattern.dimension]
    return pattern.origin + pattern.step * places, values[rows, columns]


def peaks(pattern: GridPattern, sigma: float, budget: SearchBudget) -> Floats:
    """Local maxima (M, 2) of an image, highest first, in sensor coordinates.

    It is blurred by `sigma`, a standard deviation in sensor units.
    """
    values = np.asarray(pattern.values, dtype=np.float32)
    spread = max(sigma / pattern.step, 0.5)
    blurred = np.asarray(
        cv2.GaussianBlur(values, (0, 0), spread, borderType=cv2.BORDER_CONSTANT), dtype=np.float32
    )
    size = 2 * max(round(spread), 1) + 1
    highest = cv2.dilate(blurred, np.ones((size, size), np.uint8))
    rows, columns = np.nonzero((blurred >= highest) & (blurred > budget.height * blurred.max()))
    order = np.argsort(-blurred[rows, columns], kind="stable")[: 8 * budget.sample]
    rows, columns = rows[order], columns[order]
    inner_rows = np.clip(rows, 1, values.shape[0] - 2)
    inner_columns = np.clip(columns, 1, values.shape[1] - 2)
    offsets = np.array([[-1], [0], [1]])
    shift_u = _vertex(blurred[rows, inner_columns + offsets])
    shift_v = _vertex(blurred[inner_rows + offsets, columns])
    places = np.stack([inner_columns + shift_u, inner_rows + shift_v], axis=1)
    return np.asarray(pattern.origin + pattern.step * places)


def _vertex(neighbours: NDArray[np.float32]) -> Floats:
    """Offset of the top of parabolas through three neighbours (3, M), within half a step."""
    before, here, after = neighbours
    bend = (2.0 * here - before - after).astype(np.float64)
    slope = 0.5 * (after - before).astype(np.float64)
    return np.asarray(np.clip(slope / np.maximum(bend, 1e-12), -0.5, 0.5))
