"""Linearise several sensors of a kind together.

For few points NumPy's time is that of its calls: a single product for all sensors costs no more.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Protocol

import numpy as np

from mixpose.records import Floats, Mask
from mixpose.sensors.base import Sensor, hide
from mixpose.sensors.distortion import LensDistortion
from mixpose.sensors.lateration import RangeSensor
from mixpose.sensors.pinhole import NEAREST, PinholeCamera


class SensorBatch(Protocol):
    """L sensors together; the second coordinate of those with a single one is 0."""

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """Return coordinates (L, n, 2), Jacobians (L, n, 2, 3) and visibility (L, n) of points.

        As `Sensor.linearise` of each sensor.  Points are (n, 3), the same for all sensors, or
        (L, n, 3).
        """
        ...

    def towards(self, points_world: Floats) -> Floats:
        """Return directions (L, n, 3) of any length from points (n, 3) or (L, n, 3) to sensors."""
        ...


@lru_cache(maxsize=64)
def side_by_side(sensors: tuple[Sensor, ...]) -> SensorBatch:
    """Return a batch of sensors of any kinds, cached for the same objects."""
    cameras = [sensor for sensor in sensors if isinstance(sensor, PinholeCamera)]
    if len(cameras) == len(sensors) and not any(_is_tilted(camera) for camera in cameras):
        return PinholeBatch(cameras)
    ranges = [sensor for sensor in sensors if isinstance(sensor, RangeSensor)]
    if len(ranges) == len(sensors):
        return RangeBatch(ranges)
    return MixedBatch(sensors)


class MixedBatch:
    """Sensors of any kinds, linearised one after the other."""

    def __init__(self, sensors: Sequence[Sensor]) -> None:
        self._sensors = tuple(sensors)

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """As `SensorBatch.linearise`."""
        L, n = len(self._sensors), points_world.shape[-2]
        points = np.broadcast_to(points_world, (L, n, 3))
        y, J = np.zeros((L, n, 2)), np.zeros((L, n, 2, 3))
        visible = np.empty((L, n), dtype=np.bool_)
        for k, sensor in enumerate(self._sensors):
            m = sensor.dimension
            y[k, :, :m], J[k, :, :m], visible[k] = sensor.linearise(points[k])
        return y, J, visible

    def towards(self, points_world: Floats) -> Floats:
        """As `SensorBatch.towards`."""
        points = np.broadcast_to(points_world, (len(self._sensors), *points_world.shape[-2:]))
        return np.array([sensor.towards(points[k]) for k, sensor in enumerate(self._sensors)])


class RangeBatch:
    """Range sensors."""

    def __init__(self, sensors: Sequence[RangeSensor]) -> None:
        self._positions = np.array([sensor.position for sensor in sensors])[:, None]
        self._biases = np.array([sensor.range_bias for sensor in sensors])[:, None]
        self._lower = np.array([sensor.lower for sensor in sensors])
        self._upper = np.array([sensor.upper for sensor in sensors])

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """As `SensorBatch.linearise`."""
        away = points_world - self._positions
        distance = np.sqrt((away * away).sum(axis=2))
        y, J = np.zeros((*distance.shape, 2)), np.zeros((*distance.shape, 2, 3))
        y[..., 0] = distance + self._biases
        J[..., 0, :] = away / np.maximum(distance, np.finfo(np.float64).tiny)[..., None]
        visible = (y[..., 0] >= self._lower) & (y[..., 0] <= self._upper)
        hide(y, visible, J)
        return y, J, visible

    def towards(self, points_world: Floats) -> Floats:
        """As `SensorBatch.towards`."""
        return np.asarray(self._positions - points_world)


class PinholeBatch:
    """Pinhole cameras without tilted sensors: one product projects points into all of them."""

    def __init__(self, cameras: Sequence[PinholeCamera]) -> None:
        self._count = len(cameras)
        self._K = np.array([camera.camera_matrix for camera in cameras])
        self._middle, self._half = _image_bounds(cameras)
        self._lens = _lenses(cameras)
        # maps to pixels, or to normalised coordinates, which lenses distort
        T = np.array([camera.T_sensor_world for camera in cameras])
        P = T[:, :3]
        if self._lens is None:
            P = self._K @ P
        self._rows, self._t = P[..., :3].reshape(-1, 3), P[..., 3:]
        self._upper_rows, self._last_row = P[:, None, :2, :3], P[:, None, 2:, :3]
        self._R = P[:, None, :, :3]
        self._centres = -T[:, None, :3, 3] @ T[:, :3, :3]

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """As `SensorBatch.linearise`."""
        if points_world.ndim == 2:
            points = (self._rows @ points_world.T).reshape(self._count, 3, -1)
        else:
            points = self._rows.reshape(self._count, 3, 3) @ points_world.swapaxes(1, 2)
        points += self._t
        depth = points[:, 2]
        in_front = depth > NEAREST
        if np.count_nonzero(in_front) < in_front.size:
            depth = np.where(in_front, depth, 1.0)
        inverse_depth = 1.0 / depth
        xy, lens = points[:, :2] * inverse_depth[:, None], self._lens
        y = xy.swapaxes(1, 2)
        if lens is None:
            J = self._upper_rows - y[..., None] * self._last_row
            J *= inverse_depth[..., None, None]
        else:
            in_front &= (xy * xy).sum(axis=1) < lens.radius_limit**2
            if np.count_nonzero(in_front) < in_front.size:
                # polynomials of huge radii overflow; hidden points are overwritten anyway
                xy = np.where(in_front[:, None], xy, 0.0)
            y, D = lens.linearise(xy)
            K, (L, _, n) = self._K[:, :2, :2], y.shape
            y = (K @ y + self._K[:, :2, 2:]).swapaxes(1, 2)
            # Jacobian by points in camera axes: x / z and y / z decrease as z grows
            by_point = np.empty((L, 2, 3, n))
            by_point[:, :, :2] = (K @ D.reshape(L, 2, 2 * n)).reshape(L, 2, 2, n)
            by_point[:, :, 2] = -(by_point[:, :, :2] * xy[:, None]).sum(axis=2)
            by_point *= inverse_depth[:, None, None]
            J = by_point.transpose(0, 3, 1, 2) @ self._R
        inside = np.abs(y - self._middle) <= self._half
        if np.count_nonzero(inside) == inside.size and np.count_nonzero(in_front) == in_front.size:
            return y, J, in_front
        y, visible = np.ascontiguousarray(y), in_front & inside.all(axis=2)
        hide(y, visible, J)
        return y, J, visible

    def towards(self, points_world: Floats) -> Floats:
        """As `SensorBatch.towards`."""
        return np.asarray(self._centres - points_world)


def _image_bounds(cameras: Sequence[PinholeCamera]) -> tuple[Floats, Floats]:
    """Return centres and half sizes (L, 1, 2) of images; infinite for an unknown resolution."""
    lower = np.array([camera.lower for camera in cameras])[:, None]
    upper = np.array([camera.upper for camera in cameras])[:, None]
    bounded = np.isfinite(upper)
    middle = np.zeros_like(upper)
    middle[bounded] = (lower[bounded] + upper[bounded]) / 2
    return middle, np.where(bounded, upper - middle, np.inf)


def _is_tilted(camera: PinholeCamera) -> bool:
    return camera.lens is not None and bool(camera.lens.coefficients[12:].any())


def _lenses(cameras: Sequence[PinholeCamera]) -> LensDistortion | None:
    """Return the lenses of all cameras as one, with a column per camera; None without any."""
    if all(camera.lens is None for camera in cameras):
        return None
    coefficients = np.zeros((14, len(cameras), 1))
    limits = np.full((len(cameras), 1), np.inf)
    for k, camera in enumerate(cameras):
        if camera.lens is not None:
            coefficients[:, k, 0] = camera.lens.coefficients
            limits[k] = camera.lens.radius_limit
    return LensDistortion(coefficients, limits)
