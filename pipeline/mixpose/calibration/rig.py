"""The rig: everything that a calibration may change, and its parameters in blocks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.body import Body
from mixpose.objective.projection import pose_jacobian
from mixpose.records import Floats
from mixpose.rigid import from_parts, inverse
from mixpose.sensors import CloudSensor, RangeSensor, Sensor

Kind: TypeAlias = Literal[
    "pose",
    "position",
    "focal",
    "principal_point",
    "distortion",
    "range_bias",
    "delay",
    "drift",
    "body",
]
KINDS: tuple[Kind, ...] = (
    "pose",
    "position",
    "focal",
    "principal_point",
    "distortion",
    "range_bias",
    "delay",
    "drift",
)

_LENS = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE_LENS = ("k1", "k2", "k3", "k4")


@dataclass(frozen=True, eq=False)
class Rig:
    """Sensors and body as they are believed to be."""

    names: tuple[str, ...]
    sensors: tuple[Sensor, ...]
    points: Floats  # (N, 3): features of the body, in its frame
    normals: Floats | None  # (N, 3)
    delays: Floats  # (L,): seconds by which a sensor's frames are taken later than their times say
    drifts: Floats  # (L,): seconds per second by which that grows
    labels: tuple[str, ...]  # what the features are called in messages

    @classmethod
    def of(cls, names: Sequence[str], sensors: Sequence[Sensor], body: Body) -> Rig:
        """The rig as a session has it."""
        none = np.zeros(len(names))
        return cls(tuple(names), tuple(sensors), body.means, body.normals, none, none, body.labels)

    def placed(self, index: int, T_sensor_world: Floats) -> Rig:
        """The rig with a camera elsewhere."""
        sensor: Any = self.sensors[index]
        return self.exchanged(index, replace(sensor, T_sensor_world=T_sensor_world))

    def exchanged(self, index: int, sensor: Sensor) -> Rig:
        """The rig with another sensor in the place of one."""
        sensors = list(self.sensors)
        sensors[index] = sensor
        return replace(self, sensors=tuple(sensors))


@dataclass(frozen=True)
class Block:
    """Parameters of one kind, of one sensor or of the body."""

    kind: Kind
    sensor: int | None  # none for the body
    start: int  # of the block among all parameters
    names: tuple[str, ...]
    units: tuple[str, ...]  # tuple of {"length", "rad", "px", "s", ""}
    # size of what is sought, in `units`: by it a standard deviation is large or small
    scales: tuple[float, ...]

    @property
    def place(self) -> slice:
        """Where the block stands among all parameters."""
        return slice(self.start, self.start + len(self.names))


def centre_of(sensor: Any) -> Floats:
    """Where a sensor stands in the world (3,)."""
    if isinstance(sensor, RangeSensor):
        return sensor.position
    return np.asarray(inverse(sensor.T_sensor_world)[:3, 3])


def kinds_of(sensor: Sensor) -> tuple[Kind, ...]:
    """Kinds of parameters that a sensor has."""
    if isinstance(sensor, RangeSensor):
        return ("position", "range_bias", "delay", "drift")
    if not hasattr(sensor, "T_sensor_world"):
        return ("delay", "drift")
    if isinstance(sensor, CloudSensor):
        return ("pose", "delay", "drift")
    if hasattr(sensor, "camera_matrix"):
        return ("pose", "focal", "principal_point", "distortion", "delay", "drift")
    return ("pose", "principal_point", "delay", "drift")


def blocks_of(
    rig: Rig,
    free: Mapping[int, Sequence[Kind]],
    *,
    body: bool,
    length: float,
    interval: float,
) -> tuple[Block, ...]:
    """Lay out the free parameters, one after the other.

    Parameters
    ----------
    free : mapping of int to sequence of kinds
        By sensor.
    body : bool
        Whether the features of the body are free.
    length : float
        Size of the rig.
    interval : float
        Seconds from frame to frame.
    """
    blocks: list[Block] = []
    start = 0
    for index in sorted(free):
        for kind in KINDS:
            if kind in free[index]:
                block = _block(rig.sensors[index], kind, index, start, length, interval)
                blocks.append(block)
                start += len(block.names)
    if body:
        names = tuple(f"{label}.{axis}" for label in rig.labels for axis in "xyz")
        radius = float(np.linalg.norm(rig.points - rig.points.mean(axis=0), axis=1).max())
        units, scales = ("length",) * len(names), (radius,) * len(names)
        blocks.append(Block("body", None, start, names, units, scales))
    return tuple(blocks)


def _block(
    sensor: Any, kind: Kind, index: int, start: int, length: float, interval: float
) -> Block:
    names: tuple[str, ...]
    units: tuple[str, ...]
    scales: tuple[float, ...]
    match kind:
        case "pose":
            names = ("x", "y", "z", "rx", "ry", "rz")
            units = ("length",) * 3 + ("rad",) * 3
            scales = (length,) * 3 + (1.0,) * 3
        case "position":
            names, units, scales = ("x", "y", "z"), ("length",) * 3, (length,) * 3
        case "focal":
            K = sensor.camera_matrix
            names = ("f",) if np.isclose(K[0, 0], K[1, 1], rtol=1e-9) else ("fx", "fy")
            units, scales = ("px",) * len(names), (float(K[0, 0]),) * len(names)
        case "principal_point":
            size = 1000.0 if sensor.resolution is None else float(max(sensor.resolution)) / 2
            names, units, scales = ("cx", "cy"), ("px",) * 2, (size,) * 2
        case "distortion":
            names = _lens_names(sensor)
            units, scales = ("",) * len(names), (1.0,) * len(names)
        case "range_bias":
            names, units, scales = ("bias",), ("length",), (length,)
        case "delay":
            names, units, scales = ("delay",), ("s",), (interval,)
        case _:
            names, units, scales = ("drift",), ("",), (1e-2,)
    return Block(kind, index, start, names, units, scales)


def _lens_names(sensor: Any) -> tuple[str, ...]:
    """Coefficients that are sought: of rational and tilted models the first five."""
    if type(sensor).__name__ == "FisheyeCamera":
        return _FISHEYE_LENS
    return _LENS[: max(4, min(5, len(sensor.distortion)))]


def moved(rig: Rig, blocks: Sequence[Block], step: Floats) -> Rig:
    """The rig after a step of its parameters (G,).

    Cameras turn about their own centre: x_sensor <- exp(r) x_sensor + t.
    """
    for block in blocks:
        delta = step[block.place]
        if block.sensor is None:
            rig = replace(rig, points=rig.points + delta.reshape(-1, 3))
        elif block.kind in ("delay", "drift"):
            values = (rig.delays if block.kind == "delay" else rig.drifts).copy()
            values[block.sensor] += delta[0]
            late = block.kind == "delay"
            rig = replace(rig, delays=values) if late else replace(rig, drifts=values)
        else:
            sensor = changed(rig.sensors[block.sensor], block.kind, delta)
            rig = rig.exchanged(block.sensor, sensor)
    return rig


def changed(sensor: Any, kind: Kind, delta: Floats) -> Any:
    """A sensor after a step of its parameters of one kind."""
    if kind == "pose":
        turn = Rotation.from_rotvec(delta[3:]).as_matrix()
        T = from_parts(turn, delta[:3]) @ sensor.T_sensor_world
        return replace(sensor, T_sensor_world=T)
    if kind == "position":
        return replace(sensor, position=sensor.position + delta)
    if kind == "range_bias":
        return replace(sensor, range_bias=sensor.range_bias + float(delta[0]))
    if kind == "distortion":
        lens = np.zeros(max(len(sensor.distortion), 4))
        lens[: len(sensor.distortion)] = sensor.distortion
        lens[: len(delta)] += delta
        return replace(sensor, distortion=lens)
    if kind == "principal_point" and not hasattr(sensor, "camera_matrix"):
        return replace(sensor, principal_point=sensor.principal_point + delta)
    K = sensor.camera_matrix.copy()
    if kind == "focal":
        K[0, 0] += delta[0]
        K[1, 1] += delta[-1]
    else:
        K[:2, 2] += delta
    return replace(sensor, camera_matrix=K)


_STEPS = {"focal": 1e-2, "principal_point": 1e-2, "distortion": 1e-5}


def by_parameters(sensor: Any, kind: Kind, world: Floats, by_world: Floats) -> Floats:
    """Jacobian (n, m, k) of what a sensor sees of points (n, 3) by its own parameters.

    Parameters
    ----------
    world : (n, 3) array
    by_world : (n, m, 3) array
        Jacobian by the points.
    """
    if kind == "pose":
        T = sensor.T_sensor_world
        by_sensor = by_world @ T[:3, :3].T
        x = world @ T[:3, :3].T + T[:3, 3]
        return pose_jacobian(by_sensor, x)
    if kind == "position":
        return -by_world
    if kind == "range_bias":
        return np.ones((len(world), 1, 1))
    count = len(_block(sensor, kind, 0, 0, 1.0, 1.0).names)
    unbounded = replace(sensor, resolution=None)
    J = np.empty((len(world), 2, count))
    for k in range(count):
        delta = np.zeros(count)
        delta[k] = _STEPS[kind]
        high, _ = changed(unbounded, kind, delta).project(world)
        low, _ = changed(unbounded, kind, -delta).project(world)
        J[:, :, k] = (high - low) / (2 * _STEPS[kind])
    return J
