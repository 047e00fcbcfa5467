"""Points in space where rays of different sensors meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mixpose.records import Floats, Indices
from mixpose.sensors import Rays


@dataclass(frozen=True)
class TriangulatedPoints:
    """Points where a ray of one sensor comes close to a ray of another."""

    points: Floats  # (P, 3) in the world
    tolerance: Floats  # (P,) how far off the point may be, in length units
    gap: Floats  # (P,) distance of the two rays as a share of what the gates allow, 0 to 1
    sensors: Indices  # (P, 2) the two sensors, first before second
    rays: Indices  # (P, 2) the ray of either sensor

    def __len__(self) -> int:
        return len(self.points)

    def select(self, chosen: Indices | Sequence[int]) -> TriangulatedPoints:
        """Some of the points."""
        return TriangulatedPoints(*(each[chosen] for each in vars(self).values()))


def triangulate(
    rays: Sequence[Rays], gates: Sequence[float], min_sine: float
) -> TriangulatedPoints:
    """All pairs of rays of two sensors or more that meet within the error of the detections.

    That is a gate in px, one per sensor; `min_sine` is of an angle that still fixes a depth.
    """
    meetings = []
    for first, second in combinations(range(len(rays)), 2):
        a, b = rays[first], rays[second]
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
        tolerance = np.hypot(
            gates[first] * (a.offset + a.slope * np.abs(s)),
            gates[second] * (b.offset + b.slope * np.abs(t)),
        )
        good = (gap <= tolerance) & (sine2 > min_sine**2)
        good &= ~((a.central & (s <= 0)) | (b.central & (t <= 0)))
        i, j = np.nonzero(good)
        meetings.append(
            (
                0.5 * (on_a[i, j] + on_b[i, j]),
                tolerance[i, j] / np.sqrt(sine2[i, j]),
                gap[i, j] / tolerance[i, j],
                np.tile(np.array([first, second], dtype=np.intp), (len(i), 1)),
                np.stack([i, j], axis=1),
            )
        )
    return TriangulatedPoints(*map(np.concatenate, zip(*meetings, strict=True)))
