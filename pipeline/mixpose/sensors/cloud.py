"""Points in space as a sensor: what a system that triangulates gives, without labels.

An objective of images knows such points by three of them: along z, x and y.  A shift of a point by
d moves it by 2 |d|² in the three together, whichever way, so that what fits them best fits best in
space.  What belongs together in them is told by `clouds_among`: then one detection is met in all
three, by its distance in space.
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
"""What the three images are called, and the axes of the cloud that are theirs, u first."""


@dataclass(frozen=True, eq=False)
class CloudPlane(ParallelBeam):
    """One of the three images of a cloud, in its units of length."""

    cloud: object = None  # the same for the three of one cloud, and for nothing else

    def rays(self, y: Floats) -> Rays:
        """Lines of sight of places (M, 2), which say what cloud they are of."""
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
        """Smallest measurable coordinates (3,): none."""
        return np.full(3, -np.inf)

    @property
    def upper(self) -> Floats:
        """Largest measurable coordinates (3,): none."""
        return np.full(3, np.inf)

    @cached_property
    def planes(self) -> tuple[CloudPlane, ...]:
        """The three images, in the order of `PLANES`."""
        token = object()
        return tuple(
            CloudPlane(1.0, np.zeros(2), None, _turned(axes) @ self.T_sensor_world, cloud=token)
            for _, axes in PLANES
        )

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        """Points (..., 3) in the cloud's axes of world points (..., 3); all are seen."""
        T = self.T_sensor_world
        y = np.asarray(points_world @ T[:3, :3].T + T[:3, 3])
        return y, np.ones(y.shape[:-1], dtype=np.bool_)

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """As `project`, with the Jacobian (..., 3, 3) in between."""
        y, visible = self.project(points_world)
        return y, np.broadcast_to(self.T_sensor_world[:3, :3], (*y.shape, 3)).copy(), visible

    def towards(self, points_world: Floats) -> Floats:
        """Directions (..., 3) to the sensor: none, it is nowhere."""
        return np.zeros(np.shape(points_world))

    def rays(self, y: Floats) -> None:
        """None: a detection is a point, not a line."""
        return


@lru_cache(maxsize=64)
def clouds_among(sensors: tuple[Sensor, ...]) -> Sequence[Sequence[int]]:
    """Where the three images of each cloud are among sensors, in the order of `PLANES`."""
    groups: dict[object, list[int]] = {}
    for k, sensor in enumerate(sensors):
        if isinstance(sensor, CloudPlane):
            groups.setdefault(sensor.cloud, []).append(k)
    return [group for group in groups.values() if len(group) == len(PLANES)]


def as_images(
    sensors: Sequence[Sensor], deviations: Sequence[float]
) -> tuple[tuple[Sensor, ...], Floats, list[int]]:
    """Sensors with clouds as their images, which tell as much at as many deviations along an axis.

    These are √2 times the cloud's, as each coordinate is in two images. The last are the places of
    the sensors given, or of their first images.
    """
    parts = [one.planes if isinstance(one, CloudSensor) else (one,) for one in sensors]
    counts = [len(part) for part in parts]
    each = np.array(deviations, dtype=float) * np.where(np.array(counts) > 1, np.sqrt(2), 1.0)
    first = np.cumsum([0, *counts])[:-1].tolist()
    return tuple(one for part in parts for one in part), each.repeat(counts), first


def from_planes(planes: Floats) -> Floats:
    """Points (..., 3) in the axes of a cloud of places (3, ..., 2) in its three images."""
    first, second, _ = planes
    return np.concatenate([first, second[..., 1:]], axis=-1)


def facing(
    sensor: Sensor,
    T_world_object: Floats,
    points_world: Floats,
    normals: Floats | None,
    edge_on: float = 0.0,
) -> Mask:
    """Which features (..., n, 3) turn their face to a sensor: (..., n), true without normals.

    Normals (n, 3) are in the object's frame, poses (..., 4, 4). In images a feature is `edge_on`
    from that cosine of the angle to its normal; ranges are measured from all of its front. All
    features face a cloud, whose system sees them from several sides.
    """
    if normals is None or isinstance(sensor, CloudPlane | CloudSensor):
        return np.ones(points_world.shape[:-1], dtype=np.bool_)
    outward = normals @ np.swapaxes(T_world_object[..., :3, :3], -1, -2)
    towards = sensor.towards(points_world)
    cosines = np.vecdot(outward, towards) / np.linalg.norm(towards, axis=-1)
    return np.asarray(cosines > (edge_on if sensor.dimension > 1 else 0.0))


def _turned(axes: tuple[int, int]) -> Floats:
    """From the axes of a cloud (4, 4) to those of an image that shows two of them."""
    T: Floats = np.eye(4)
    T[:3, :3] = np.eye(3)[[*axes, 3 - sum(axes)]]
    return T
