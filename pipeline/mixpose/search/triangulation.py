"""Points in space where lines of sight of different sensors meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.search.sightlines import Sightlines

Floats: TypeAlias = NDArray[np.float64]

_LEAST_SINE = 0.02  # of the angle between two lines that still fix a depth


@dataclass(frozen=True)
class Meetings:
    """Points where a line of one sensor comes close to a line of another.

    Attributes
    ----------
    points : (P, 3) float64
        In the world.
    tolerance : (P,) float64
        How far off the point may be, in length units.
    sensors : (P, 2) int
        The two sensors, first before second.
    lines : (P, 2) int
        The line of either sensor.
    """

    points: Floats
    tolerance: Floats
    sensors: NDArray[np.intp]
    lines: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.points)

    def select(self, chosen: NDArray[np.intp] | NDArray[np.bool_]) -> Meetings:
        """Some of the points."""
        return Meetings(
            self.points[chosen], self.tolerance[chosen], self.sensors[chosen], self.lines[chosen]
        )


def triangulate(lines: Sequence[Sightlines], gates: Sequence[float]) -> Meetings:
    """All pairs of lines of two sensors that meet within the error of the detections.

    Parameters
    ----------
    lines : sequence of Sightlines
        One per sensor.
    gates : sequence of float
        Largest error of a detection per sensor, in px.
    """
    found = [
        _between(lines, gates, first, second)
        for first in range(len(lines))
        for second in range(first + 1, len(lines))
    ]
    if not found:
        empty = np.zeros((0, 2), dtype=np.intp)
        return Meetings(np.zeros((0, 3)), np.zeros(0), empty, empty)
    return Meetings(
        np.concatenate([each.points for each in found]),
        np.concatenate([each.tolerance for each in found]),
        np.concatenate([each.sensors for each in found]),
        np.concatenate([each.lines for each in found]),
    )


def _between(
    lines: Sequence[Sightlines], gates: Sequence[float], first: int, second: int
) -> Meetings:
    a, b = lines[first], lines[second]
    apart = b.origins[None] - a.origins[:, None]
    cosine = a.directions @ b.directions.T
    along_a = (apart * a.directions[:, None]).sum(axis=-1)
    along_b = (apart * b.directions[None]).sum(axis=-1)
    sine2 = np.maximum(1 - cosine**2, 1e-300)
    s = (along_a - cosine * along_b) / sine2
    t = (cosine * along_a - along_b) / sine2
    on_a = a.origins[:, None] + s[..., None] * a.directions[:, None]
    on_b = b.origins[None] + t[..., None] * b.directions[None]
    gap = np.linalg.norm(on_a - on_b, axis=-1)
    error_a = gates[first] * (a.offset + a.slope * np.abs(s))
    error_b = gates[second] * (b.offset + b.slope * np.abs(t))
    tolerance = np.hypot(error_a, error_b)
    good = (gap <= tolerance) & (sine2 > _LEAST_SINE**2)
    good &= ~((a.central & (s <= 0)) | (b.central & (t <= 0)))
    i, j = np.nonzero(good)
    return Meetings(
        0.5 * (on_a[i, j] + on_b[i, j]),
        tolerance[i, j] / np.sqrt(sine2[i, j]),
        np.tile(np.array([first, second], dtype=np.intp), (len(i), 1)),
        np.stack([i, j], axis=1),
    )
