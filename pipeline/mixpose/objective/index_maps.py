"""Where the samples of a body lie in the arrays of parallel beams' densities, for `cv2.remap`.

One evaluation of a sampled objective is to cost hardly more than its look-ups.  So for the paper's
cameras samples are kept in single precision, and one matrix product for all of them ends in array
indices.  Single precision suffices because samples are relative to their centre: maps err by less
than 1/1000 of an index in arrays of up to 4000 a side.

Samples that a sensor does not see, or that are not finite, come to lie at `FAR`, outside any array.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from mixpose.density import DRAWING, FAR, Window
from mixpose.records import Floats, Singles
from mixpose.sensors import ParallelBeam


class ParallelMaps:
    """Samples (S, 3) of a body in blocks of W, B of them, before parallel beams.

    Windows are those of their densities; offsets (S, 3) are displacements in the world.
    """

    def __init__(
        self,
        sensors: Sequence[ParallelBeam],
        windows: Sequence[Window],
        points: Floats,
        offsets: Floats | None,
    ) -> None:
        blocks = -(-len(points) // DRAWING.side)
        # the last block is filled up by repetition
        filled = np.minimum(np.arange(blocks * -(-len(points) // blocks)), len(points) - 1)
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        parts = [points - centre] if offsets is None else [points - centre, offsets]
        reach = sum(float(np.linalg.norm(one, axis=1).max()) for one in parts)
        parts.insert(1, np.ones((len(points), 1)))
        rows = np.hstack(parts)[filled].reshape(blocks, -1, sum(one.shape[1] for one in parts))
        self._samples: Singles = np.ascontiguousarray(rows.swapaxes(1, 2), dtype=np.float32)
        P, limits = np.zeros((len(sensors), 2, 4)), np.zeros((2, len(sensors), 2))
        for k, (sensor, window) in enumerate(zip(sensors, windows, strict=True)):
            P[k] = sensor.T_sensor_world[:2] / sensor.pixel_size
            P[k, :, 3] += sensor.principal_point - window.origin
            P[k] /= window.step
            limits[:, k] = (np.stack([sensor.lower, sensor.upper]) - window.origin) / window.step
        P_all = P.reshape(-1, 4)
        lower, upper = np.clip(limits.reshape(2, -1), FAR, -FAR)
        self._limits = [one[:, None].astype(np.float32) for one in (lower, upper)]
        by_pose = _by_pose(P_all, centre, with_offsets=offsets is not None)
        self._width = by_pose.shape[1]
        # numbers within ±1 if the centre lies so that all samples are seen
        half = (upper - lower) / 2 - reach * np.linalg.norm(P_all[:, :3], axis=1)
        centres = by_pose.reshape(16, len(P_all), -1)[:, :, 3].copy()
        centres[15] -= (lower + upper) / 2
        self._by_pose = np.hstack([by_pose, centres / np.where(half > 0, half, np.nan)])

    def __call__(self, poses: Floats) -> list[tuple[Singles, Singles]]:
        """Maps (k * B, W) along columns and rows, per sensor, for poses (k, 4, 4)."""
        # poses may be anywhere, even not finite
        rows = poses.reshape(-1, 16).dot(self._by_pose)
        if cv2.checkRange(rows[:, self._width :], True, -1.0, 1.0)[0]:
            maps = self._product(rows)
        else:
            with np.errstate(all="ignore"):
                maps = self._product(rows)
                lower, upper = self._limits
                maps[~((maps >= lower) & (maps <= upper))] = FAR
        return [(maps[:, k], maps[:, k + 1]) for k in range(0, maps.shape[1], 2)]

    def _product(self, rows: Floats) -> Singles:
        """Indices (k * B, 2 L, W) of all samples."""
        blocks, c, width = self._samples.shape
        single = rows[:, : self._width].astype(np.float32)
        if len(rows) == blocks == 1:  # no time for broadcasting
            return np.asarray(single.reshape(-1, c).dot(self._samples[0])[None])
        maps = single.reshape(len(rows), 1, -1, c) @ self._samples
        return np.asarray(maps.reshape(len(rows) * blocks, -1, width))


def _by_pose(P: Floats, centre: Floats, *, with_offsets: bool) -> Floats:
    """Coefficients (16, r·c): what rows P (r, 4), for world points, are for samples.

    They are linear in the 16 numbers of a pose, the last of which is 1.
    """
    to_centre = np.eye(4)
    to_centre[:3, 3] = centre
    coefficients = np.einsum("ia,bj->abij", P, to_centre)
    if with_offsets:
        in_world = np.zeros((4, 4, len(P), 3))
        in_world[3, 3] = P[:, :3]
        coefficients = np.concatenate([coefficients, in_world], axis=3)
    return np.asarray(coefficients.reshape(16, -1))
