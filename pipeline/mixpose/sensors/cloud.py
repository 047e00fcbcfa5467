"""A sensor of unlabelled points in space, such as a system that triangulates gives.

Objectives of images see such points in three images: along z, x and y.  A shift of a point by d
adds up to squared offsets of 2 |d|² in the three, in any direction, so that the best fit to the
images is the best fit in space.  `clouds_among` finds the images of a cloud: a detection is then
met in all three, by its distance in space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import ClassVar, Literal

import numpy as np

from mixpose.records import Floats, Mask
from mixpose.sensors.base import Rays, Sensor
from mixpose.sensors.camera import PlacedSensor
from mixpose.sensors.parallel import ParallelBeam

PLANES: tuple[tuple[str, tuple[int, int]], ...] = (("xy", (0, 1)), ("yz", (1, 2)), ("zx", (2, 0)))
"""Names of the three images, and the axes of the cloud that they show, u first."""


@dataclass(frozen=True, eq=False)
class CloudPlane(ParallelBeam):
    """One of the three images of a cloud, in the cloud's unit of length."""

    cloud: object = None  # token shared by the three images of a cloud only

    def rays(self, y: Floats) -> Rays:
        """Return lines of sight of places (M, 2), with the token of the cloud."""
        return replace(super().rays(y), cloud=self.cloud)


@dataclass(frozen=True, eq=False)
class CloudSensor(PlacedSensor):
    """Measures points in space."""

    T_sensor_world: Floats = field(default_factory=lambda: np.eye(4))  # (4, 4)

    dimension: ClassVar[int] = 3
    unit: ClassVar[Literal["px", "length"]] = "length"

    def __post_init__(self) -> None:
        self._as_floats("T_sensor_world")

    @property
    def lower(self) -> Floats:
        """Smallest measurable coordinates (3,): minus infinity."""
        return np.full(3, -np.inf)

    @property
    def upper(self) -> Floats:
        """Largest measurable coordinates (3,): infinity."""
        return np.full(3, np.inf)

    @cached_property
    def planes(self) -> tuple[CloudPlane, ...]:
        """The three images, in the order of `PLANES`."""
        token = object()
        return tuple(
            CloudPlane(1.0, np.zeros(2), None, _plane_axes(axes) @ self.T_sensor_world, cloud=token)
            for _, axes in PLANES
        )

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        """Return world points (..., 3) in the cloud's axes; all are visible."""
        T = self.T_sensor_world
        y = np.asarray(points_world @ T[:3, :3].T + T[:3, 3])
        return y, np.ones(y.shape[:-1], dtype=np.bool_)

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """Return points as `project`, their Jacobian (..., 3, 3), and visibility."""
        y, visible = self.project(points_world)
        return y, np.broadcast_to(self.T_sensor_world[:3, :3], (*y.shape, 3)).copy(), visible

    def towards(self, points_world: Floats) -> Floats:
        """Return zero directions (..., 3), as the sensor has no position."""
        return np.zeros(np.shape(points_world))

    def rays(self, y: Floats) -> None:
        """Return None: a detection is a point, not a line."""
        return


@lru_cache(maxsize=64)
def clouds_among(sensors: tuple[Sensor, ...]) -> Sequence[Sequence[int]]:
    """Return the indices of the three images of each cloud, in the order of `PLANES`."""
    groups: dict[object, list[int]] = {}
    for k, sensor in enumerate(sensors):
        if isinstance(sensor, CloudPlane):
            groups.setdefault(sensor.cloud, []).append(k)
    return [group for group in groups.values() if len(group) == len(PLANES)]


def as_images(
    sensors: Sequence[Sensor], deviations: Sequence[float]
) -> tuple[tuple[Sensor, ...], Floats, list[int]]:
    """Return sensors with clouds replaced by their images, with deviations, and first indices.

    Deviations of images are √2 times the cloud's, as each coordinate is in two images. First
    indices are those of the given sensors, or of their first images.
    """
    groups = [sensor.planes if isinstance(sensor, CloudSensor) else (sensor,) for sensor in sensors]
    counts = [len(group) for group in groups]
    widened = np.array(deviations, dtype=float) * np.where(np.array(counts) > 1, np.sqrt(2), 1.0)
    firsts = np.cumsum([0, *counts])[:-1].tolist()
    return tuple(sensor for group in groups for sensor in group), widened.repeat(counts), firsts


def from_planes(planes: Floats) -> Floats:
    """Return points (..., 3) in a cloud's axes from places (3, ..., 2) in its three images."""
    first, second, _ = planes
    return np.concatenate([first, second[..., 1:]], axis=-1)


def facing(
    sensor: Sensor,
    T_world_object: Floats,
    points_world: Floats,
    normals: Floats | None,
    edge_on: float = 0.0,
) -> Mask:
    """Test which features (..., n, 3) face a sensor: (..., n), true without normals.

    Normals (n, 3) are in the object's frame, poses (..., 4, 4). A camera sees features whose
    normal has a cosine above `edge_on` with the direction to it; a range sensor, above 0. All
    features face a cloud, whose system sees them from several sides.
    """
    if normals is None or isinstance(sensor, CloudPlane | CloudSensor):
        return np.ones(points_world.shape[:-1], dtype=np.bool_)
    outward = normals @ np.swapaxes(T_world_object[..., :3, :3], -1, -2)
    towards = sensor.towards(points_world)
    cosines = np.vecdot(outward, towards) / np.linalg.norm(towards, axis=-1)
    return np.asarray(cosines > (edge_on if sensor.dimension > 1 else 0.0))


def _plane_axes(axes: tuple[int, int]) -> Floats:
    """Return the motion (4, 4) from a cloud's axes to those of the image that shows these two."""
    T: Floats = np.eye(4)
    T[:3, :3] = np.eye(3)[[*axes, 3 - sum(axes)]]
    return T
