"""What each sensor contributes to the search: detections that count alike, and lines of sight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.density import Observation
from mixpose.objective import View
from mixpose.records import GridPattern, PointPattern
from mixpose.search.sightlines import Sightlines, sightlines

Floats: TypeAlias = NDArray[np.float64]

MOST_PEAKS = 64
_LEAST_PEAK = 0.15  # of the highest: lower maxima are noise


@dataclass(frozen=True)
class Sighting:
    """One sensor with its detections.

    Attributes
    ----------
    view : View
        Its observation holds every detection with the same weight: a bright blob is not worth
        more features than a faint one, nor are two that merged.
    lines : Sightlines or None
        None for sensors without lines of sight.
    """

    view: View
    lines: Sightlines | None

    @property
    def sigma(self) -> float:
        """σ_ε of the sensor."""
        return self.view.observation.sigma

    @property
    def count(self) -> int:
        """Number of detections; 0 where the pattern is not made of detections."""
        pattern = self.view.observation.pattern
        return len(pattern.points) if isinstance(pattern, PointPattern) else 0


def sightings(views: Sequence[View], body: Body) -> list[Sighting]:
    """Detections of all views that saw something."""
    found = []
    for view in views:
        if view.observation.is_empty:
            continue
        is_pointlike = len(body.nodes.points) == len(body)
        observation = _counted_alike(view.observation, is_pointlike)
        if observation.is_empty:
            continue
        lines = None
        if isinstance(observation.pattern, PointPattern) and observation.dimension == 2:
            lines = sightlines(view.sensor, observation.pattern.points)
        found.append(Sighting(View(view.name, view.sensor, observation), lines))
    return found


def _counted_alike(observation: Observation, is_pointlike: bool) -> Observation:
    """The observation as detections of equal weight; range profiles stay what they are."""
    pattern = observation.pattern
    if isinstance(pattern, PointPattern):
        points = pattern.points[pattern.weights > 0]
    elif observation.dimension == 2 and is_pointlike:
        points = peaks(pattern, observation.sigma)
    else:
        return observation
    return Observation(PointPattern(points, np.ones(len(points))), observation.sigma)


def peaks(pattern: GridPattern, sigma: float) -> Floats:
    """Local maxima (M, 2) of a blurred image, highest first, in sensor coordinates.

    Parameters
    ----------
    pattern : GridPattern
    sigma : float
        Standard deviation of the blur in sensor units.
    """
    values = np.asarray(pattern.values, dtype=np.float32)
    spread = max(sigma / pattern.step, 0.5)
    blurred = np.asarray(
        cv2.GaussianBlur(values, (0, 0), spread, borderType=cv2.BORDER_CONSTANT), dtype=np.float32
    )
    size = 2 * max(round(spread), 1) + 1
    highest = cv2.dilate(blurred, np.ones((size, size), np.uint8))
    rows, columns = np.nonzero((blurred >= highest) & (blurred > _LEAST_PEAK * blurred.max()))
    order = np.argsort(-blurred[rows, columns], kind="stable")[:MOST_PEAKS]
    rows, columns = rows[order], columns[order]
    inner_rows = np.clip(rows, 1, values.shape[0] - 2)
    inner_columns = np.clip(columns, 1, values.shape[1] - 2)
    shift_u = _vertex(*(blurred[rows, inner_columns + k] for k in (-1, 0, 1)))
    shift_v = _vertex(*(blurred[inner_rows + k, columns] for k in (-1, 0, 1)))
    places = np.stack([inner_columns + shift_u, inner_rows + shift_v], axis=1)
    return np.asarray(pattern.origin + pattern.step * places)


def _vertex(
    before: NDArray[np.float32], here: NDArray[np.float32], after: NDArray[np.float32]
) -> Floats:
    """Offset of the top of the parabola through three neighbours, within half a step."""
    bend = (2.0 * here - before - after).astype(np.float64)
    slope = 0.5 * (after - before).astype(np.float64)
    return np.asarray(np.clip(slope / np.maximum(bend, 1e-12), -0.5, 0.5))
