"""How many distinct detections a pose explains: a quick judgement of very many guesses.

Detections are drawn once as disks into a map of labels, so that one look-up per predicted feature
says which detection it meets.  Features that fall on the same detection count once: counting
features would favour poses that gather them all on one blob.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.objective.base import facing
from mixpose.records import PointPattern
from mixpose.rigid import transform
from mixpose.search.sightings import Sighting
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]

GATE = 3.0
"""Radius of a detection's disk in σ_ε."""

_STEPS = 6.0  # map cells per radius
_MOST_CELLS = 4_000_000
_WORD = 63  # labels in one word of bits
_MOST_GUESSES = 20_000  # at once, to stay in the cache


@dataclass(frozen=True)
class LabelMap:
    """Disks around the detections of one camera.

    Attributes
    ----------
    sensor : Sensor
    labels : (cells,) int16
        Detection 1 to M, row by row of the map; 0 where there is none.
    nearness : (cells,) float32
        1 at a detection, 0 at the rim of its disk.
    shape : (int, int)
        Rows and columns, with a rim of zeros.
    origin : (2,) array
    step : float
        Sensor units per cell.
    count : int
        M.
    """

    sensor: Sensor
    labels: NDArray[np.int16]
    nearness: NDArray[np.float32]
    shape: tuple[int, int]
    origin: Floats
    step: float
    count: int

    def look_up(self, y: Floats) -> tuple[NDArray[np.int16], NDArray[np.float32]]:
        """Labels and nearness (H, n) at projected features (H, n, 2)."""
        limit = np.array(self.shape[::-1]) - 1.0
        index = np.clip((y - self.origin) / self.step + 0.5, 0.0, limit).astype(np.int64)
        cell = index[..., 1] * self.shape[1] + index[..., 0]
        return self.labels[cell], self.nearness[cell]


def label_maps(sightings: Sequence[Sighting], gate: float = GATE) -> list[LabelMap]:
    """Maps of all cameras with detections."""
    return [
        _label_map(sighting.view.sensor, sighting.view.observation.pattern.points, radius)
        for sighting in sightings
        if isinstance(sighting.view.observation.pattern, PointPattern)
        and sighting.view.observation.dimension == 2
        for radius in (gate * sighting.sigma,)
    ]


def _label_map(sensor: Sensor, points: Floats, radius: float) -> LabelMap:
    lower, upper = points.min(axis=0) - 1.5 * radius, points.max(axis=0) + 1.5 * radius
    affordable = float(np.sqrt(np.prod(upper - lower) / _MOST_CELLS))
    step = max(radius / _STEPS, affordable)
    columns, rows = (np.ceil((upper - lower) / step).astype(int) + 1).tolist()
    labels = np.zeros((rows, columns), dtype=np.int16)
    nearness = np.zeros((rows, columns), dtype=np.float32)
    half = int(np.ceil(radius / step)) + 1
    for label, point in enumerate(points, start=1):
        column, row = np.round((point - lower) / step).astype(int).tolist()
        part = (
            slice(max(row - half, 1), min(row + half + 1, rows - 1)),
            slice(max(column - half, 1), min(column + half + 1, columns - 1)),
        )
        v = lower[1] + step * np.arange(rows)[part[0]] - point[1]
        u = lower[0] + step * np.arange(columns)[part[1]] - point[0]
        close = (1 - np.hypot(v[:, None], u[None]) / radius).astype(np.float32)
        nearer = close > nearness[part]
        nearness[part][nearer] = close[nearer]
        labels[part][nearer] = label
    return LabelMap(
        sensor, labels.ravel(), nearness.ravel(), (rows, columns), lower, step, len(points)
    )


def explained(
    maps: Sequence[LabelMap], features: Floats, normals: Floats | None, poses: Floats
) -> tuple[Floats, Floats]:
    """Distinct detections explained by poses (H, 4, 4).

    Parameters
    ----------
    maps : sequence of LabelMap
    features : (n, 3) array
        In the object's frame.
    normals : (n, 3) array or None
    poses : (H, 4, 4) array

    Returns
    -------
    (L, H) array
        Number per camera.
    (H,) array
        How near they are met: the sum of nearness over features, for ranking equals.
    """
    counts, near = np.zeros((len(maps), len(poses))), np.zeros(len(poses))
    for start in range(0, len(poses), _MOST_GUESSES):
        part = slice(start, start + _MOST_GUESSES)
        points = transform(poses[part], features)
        for k, each in enumerate(maps):
            y, seen = each.sensor.project(points)
            if normals is not None:
                seen = seen & facing(each.sensor, poses[part], points, normals)
            labels, nearness = each.look_up(y)
            labels = np.where(seen, labels, 0)
            counts[k, part] = _distinct(labels, each.count)
            near[part] += np.where(labels > 0, nearness, 0.0).sum(axis=1)
    return counts, near


def _distinct(labels: NDArray[np.int16], count: int) -> Floats:
    """Number of different labels above 0 in each row (H, n)."""
    total = np.zeros(len(labels))
    for first in range(1, count + 1, _WORD):
        table = np.zeros(count + 1, dtype=np.uint64)
        own = np.arange(first, min(first + _WORD, count + 1))
        table[own] = np.uint64(1) << (own - first).astype(np.uint64)
        met = np.bitwise_or.reduce(table[labels], axis=1)
        total += np.bitwise_count(met)
    return total
