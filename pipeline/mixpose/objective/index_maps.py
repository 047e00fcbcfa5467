"""Where the samples of a body lie in the arrays of densities, as maps for `cv2.remap`.

One evaluation of a sampled objective is to cost hardly more than its look-ups.  So for the paper's
sensors, parallel beams and ranges, samples are kept in single precision, and all sensors share one
matrix product that ends in array indices.  Single precision suffices because samples are relative
to their centre: maps err by less than 1/1000 of an index in arrays of up to 4000 a side.

Samples that a sensor does not see, or that are not finite, come to lie at `FAR`, outside any array.
Profiles of ranges are looked up in the second of four equal rows: `cv2.remap` is twice as fast
there as at a border.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.density import FAR, Density
from mixpose.rigid import transform
from mixpose.sensors import ParallelBeam, RangeSensor, Sensor

Floats: TypeAlias = NDArray[np.float64]
Singles: TypeAlias = NDArray[np.float32]
Maps: TypeAlias = tuple[Singles, Singles]
Projection: TypeAlias = Callable[[Floats], Sequence[Maps]]

_BLOCK = 16384  # cv2.remap takes maps of less than 32767 a side


@dataclass(frozen=True)
class SampledTerm:
    """A sensor with its density g_l (with gradient) at one level of blur."""

    sensor: Sensor
    density: Density


class Samples:
    """Samples of a body, in blocks of equal length; the last one is filled up by repetition.

    Parameters
    ----------
    points : (S, 3) array
        In the object's frame.
    offsets : (S, 3) array or None
        Displacements in the world.

    Attributes
    ----------
    count, blocks : int
        S, and the number B of blocks of W samples.
    centred : (B, 4, W) float32
        Homogeneous coordinates relative to the centre of the samples.
    to_centre : (4, 4) float64
        The shift of the object's origin there.
    radius : float
        Distance of the farthest sample from the centre, with its offset.
    """

    def __init__(self, points: Floats, offsets: Floats | None) -> None:
        self.count = len(points)
        self.blocks = -(-self.count // _BLOCK)
        width = -(-self.count // self.blocks)
        filled = np.minimum(np.arange(self.blocks * width), self.count - 1)
        self.points = points[filled]
        self.offsets = None if offsets is None else offsets[filled]
        self.to_centre = np.eye(4)
        self.to_centre[:3, 3] = (points.min(axis=0) + points.max(axis=0)) / 2
        relative = self.points - self.to_centre[:3, 3]
        self.radius = float(np.linalg.norm(relative, axis=1).max())
        rows = [relative, np.ones((len(relative), 1))]
        if self.offsets is not None:
            rows.append(self.offsets)
            self.radius += float(np.linalg.norm(self.offsets, axis=1).max())
        self.centred = self.in_blocks(np.hstack(rows))

    def in_blocks(self, rows: Floats) -> Singles:
        """Turn (B·W, c) numbers into contiguous (B, c, W) of single precision."""
        blocks = rows.reshape(self.blocks, -1, rows.shape[1]).swapaxes(1, 2)
        return np.ascontiguousarray(blocks, dtype=np.float32)

    def by_pose(self, P: Floats) -> Floats:
        """Coefficients (16, r·c): what rows P (r, 4), for world points, are for `centred`.

        They are linear in the 16 numbers of a pose, the last of which is 1.
        """
        coefficients = np.einsum("ia,bj->abij", P, self.to_centre)
        if self.offsets is not None:
            in_world = np.zeros((4, 4, len(P), 3))
            in_world[3, 3] = P[:, :3]
            coefficients = np.concatenate([coefficients, in_world], axis=3)
        return np.asarray(coefficients.reshape(16, -1))

    def product(self, rows: Floats) -> Singles:
        """Products (k·B, r, W) of rows (k, r·c) for k poses with all samples."""
        k, c = len(rows), self.centred.shape[1]
        single = rows.astype(np.float32)
        if k == self.blocks == 1:  # no time for broadcasting
            return np.asarray(single.reshape(-1, c).dot(self.centred[0])[None])
        maps = single.reshape(k, 1, -1, c) @ self.centred
        return np.asarray(maps.reshape(k * self.blocks, -1, maps.shape[3]))


def index_maps(terms: Sequence[SampledTerm], samples: Samples) -> Projection:
    """Build the function from poses (k, 4, 4) to a pair of maps (k·B, W) per term."""
    groups: dict[type[_Parallel | _Ranges | _Any], list[int]] = {}
    for number, term in enumerate(terms):
        groups.setdefault(_kind(term.sensor, samples), []).append(number)
    parts = [
        (numbers, kind([terms[n] for n in numbers], samples)) for kind, numbers in groups.items()
    ]
    if len(parts) == 1:
        return parts[0][1]

    def project(poses: Floats) -> Sequence[Maps]:
        found: dict[int, Maps] = {}
        for numbers, part in parts:
            found.update(zip(numbers, part(poses), strict=True))
        return [found[number] for number in range(len(found))]

    return project


def look_up_array(density: Density) -> Singles:
    """The density (H, W) itself as maps expect it: contiguous, profiles as four equal rows."""
    values = density.values
    first = values if values.ndim == 2 else values[..., 0]
    rows = np.repeat(first, 4, axis=0) if density.dimension == 1 else first
    return np.ascontiguousarray(rows, dtype=np.float32)


class _Parallel:
    """Parallel beams: one affine map for all of them."""

    def __init__(self, terms: Sequence[SampledTerm], samples: Samples) -> None:
        self._samples = samples
        P = np.zeros((2 * len(terms), 4))
        for k, term in enumerate(terms):
            sensor, window = term.sensor, term.density.window
            assert isinstance(sensor, ParallelBeam)
            rows = sensor.T_sensor_world[:2] / sensor.pixel_size
            rows[:, 3] += sensor.principal_point - window.origin
            P[2 * k : 2 * k + 2] = rows / window.step
        lower, upper = _index_limits(terms)
        self._limits = lower[:, None], upper[:, None]
        by_pose = samples.by_pose(P)
        self._width = by_pose.shape[1]
        self._by_pose = np.hstack([by_pose, self._centres(by_pose, P, lower, upper)])

    def _centres(self, by_pose: Floats, P: Floats, lower: Floats, upper: Floats) -> Floats:
        """Coefficients (16, r) of numbers within ±1 if the centre lies so that all are seen."""
        reach = self._samples.radius * np.linalg.norm(P[:, :3], axis=1)
        half = (upper - lower) / 2 - reach
        half = np.where(half > 0, half, np.nan)
        centres = by_pose.reshape(16, len(P), -1)[:, :, 3].copy()
        centres[15] -= (lower + upper) / 2
        return np.asarray(centres / half)

    def __call__(self, poses: Floats) -> Sequence[Maps]:
        # poses may be anywhere, even not finite
        rows = poses.reshape(-1, 16).dot(self._by_pose)
        if cv2.checkRange(rows[:, self._width :], True, -1.0, 1.0)[0]:
            maps = self._samples.product(rows[:, : self._width])
        else:
            with np.errstate(all="ignore"):
                maps = self._samples.product(rows[:, : self._width])
                _hide(maps, *self._limits)
        return [(maps[:, k], maps[:, k + 1]) for k in range(0, maps.shape[1], 2)]


class _Ranges:
    """Range sensors: with a from the source to the centre, ‖a + z‖ = ‖a‖ + d / (‖a + z‖ + ‖a‖).

    Here d = 2 a·z + ‖z‖² is the difference of the squares, all that needs a product.
    """

    def __init__(self, terms: Sequence[SampledTerm], samples: Samples) -> None:
        sensors = [term.sensor for term in terms if isinstance(term.sensor, RangeSensor)]
        windows = [term.density.window for term in terms]
        self._samples = samples
        self._positions = np.array([sensor.position for sensor in sensors])
        self._step = np.array([[window.step] for window in windows], dtype=np.float32)
        bias = [s.range_bias - w.origin[0] for s, w in zip(sensors, windows, strict=True)]
        self._bias = np.array(bias)[:, None]
        lower, upper = _index_limits(terms)
        self._limits = lower[:, None], upper[:, None]
        centred = samples.points - samples.to_centre[:3, 3]
        squares = (centred**2).sum(axis=1, keepdims=True)
        self._extended = samples.in_blocks(np.hstack([centred, squares]))

    def __call__(self, poses: Floats) -> Sequence[Maps]:
        with np.errstate(all="ignore"):
            poses = poses @ self._samples.to_centre
            away = poses[:, None, :3, 3] - self._positions
            distance = np.linalg.norm(away, axis=2)[..., None]
            twice = 2 * away @ poses[:, :3, :3]
            difference_by = np.concatenate([twice, np.ones_like(distance)], axis=2)
            difference = np.matmul(difference_by.astype(np.float32)[:, None], self._extended)
            far = distance.astype(np.float32)[:, None]
            total = np.sqrt(np.maximum(far * far + difference, 0)) + far
            difference /= np.maximum(total, np.finfo(np.float32).tiny)
            difference /= self._step
            difference += ((distance + self._bias) / self._step).astype(np.float32)[:, None]
            _hide(difference, *self._limits)
        maps = difference.reshape(-1, *difference.shape[2:])
        return [(maps[:, k], _inner_row(maps[:, k])) for k in range(len(self._positions))]


class _Any:
    """Sensors of any kind, one after the other in double precision."""

    def __init__(self, terms: Sequence[SampledTerm], samples: Samples) -> None:
        self._terms = tuple(terms)
        self._samples = samples

    def __call__(self, poses: Floats) -> Sequence[Maps]:
        samples = self._samples
        points = transform(poses, samples.points)
        if samples.offsets is not None:
            points += samples.offsets
        found = []
        for term in self._terms:
            y, _ = term.sensor.project(points)
            u, v = (m.reshape(len(poses) * samples.blocks, -1) for m in term.density.indices(y))
            found.append((u, v if term.density.dimension == 2 else _inner_row(u)))
        return found


def _kind(sensor: Sensor, samples: Samples) -> type[_Parallel | _Ranges | _Any]:
    if isinstance(sensor, ParallelBeam):
        return _Parallel
    if isinstance(sensor, RangeSensor) and samples.offsets is None:
        return _Ranges
    return _Any


def _index_limits(terms: Sequence[SampledTerm]) -> tuple[Floats, Floats]:
    """Smallest and largest indices that sensors can measure, finite; one after the other."""
    windows = [term.density.window for term in terms]
    lower, upper = (
        np.concatenate([(y - w.origin) / w.step for y, w in zip(ys, windows, strict=True)])
        for ys in ([t.sensor.lower for t in terms], [t.sensor.upper for t in terms])
    )
    return np.clip(lower, FAR, -FAR), np.clip(upper, FAR, -FAR)


def _hide(maps: Singles, lower: Floats, upper: Floats) -> None:
    """Move what is outside the limits (r, 1), or not a number, to `FAR`, in place."""
    low, high = lower.astype(np.float32), upper.astype(np.float32)
    maps[~((maps >= low) & (maps <= high))] = FAR


def _inner_row(maps: Singles) -> Singles:
    return np.ones(maps.shape, dtype=np.float32)
