"""The rig: all sensors and the body, which a calibration changes, and its blocks of parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from mixpose.body import Body
from mixpose.objective.projection import BodyProjection, pose_jacobian
from mixpose.records import Floats, Mask
from mixpose.rigid import TWIST_NAMES, from_rotation_vector, inverse, transform
from mixpose.sensors import CloudSensor, FisheyeCamera, RangeSensor, Sensor, facing

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
KINDS: tuple[Kind, ...] = get_args(Kind)[:-1]  # of sensors

_IN_MATRIX = {"focal": ([0, 1], [0, 1]), "principal_point": ([0, 1], [2, 2])}
_NAMES = {"position": TWIST_NAMES[:3], "principal_point": ("cx", "cy"), "range_bias": ("bias",)}
_UNITS = {"position": "length", "range_bias": "length", "delay": "s"}
_LENS = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE_LENS = ("k1", "k2", "k3", "k4")


@dataclass(frozen=True, eq=False)
class Rig:
    """Sensors and body, as the session has them or as calibrated."""

    names: tuple[str, ...]
    sensors: tuple[Sensor, ...]
    points: Floats  # (N, 3): features of the body, in its frame
    delays: Floats  # (L,): seconds from the time stamp of a frame to its exposure
    drifts: Floats  # (L,): seconds per second by which delays grow
    readouts: Floats  # (L,): seconds from a sensor's first row to its last
    body: Body  # as the session has it: names, normals and sizes of features
    scale: float = 1.0  # of all lengths, relative to those of the session

    @classmethod
    def of(cls, names: Sequence[str], sensors: Sequence[Sensor], body: Body) -> Rig:
        """Return the rig of a session, without delays."""
        zeros = np.zeros(len(names))
        return cls(tuple(names), tuple(sensors), body.means, zeros, zeros, zeros, body)

    @property
    def is_late(self) -> bool:
        """Test whether sensors take frames at other moments than their time stamps."""
        return bool(np.any([self.delays, self.drifts, self.readouts]))

    def placed(self, index: int, T_sensor_world: Floats) -> Rig:
        """Return the rig with a camera at another pose."""
        sensor: Any = self.sensors[index]
        return self.exchanged(index, replace(sensor, T_sensor_world=T_sensor_world))

    def exchanged(self, index: int, sensor: Sensor) -> Rig:
        """Return the rig with the sensor of an index replaced."""
        sensors = list(self.sensors)
        sensors[index] = sensor
        return replace(self, sensors=tuple(sensors))

    def project(self, sensor: int, poses: Floats) -> tuple[Floats, Mask]:
        """Project features at poses (K, 4, 4) to a sensor (K, N, m), and test which are in view."""
        geometry, world = self.sensors[sensor], transform(poses, self.points)
        y, visible = geometry.project(world)
        return y + self.centre_offsets(sensor, poses), visible & facing(
            geometry, poses, world, self.body.normals, self.body.edge_on
        )

    def centre_offsets(self, sensor: int, poses: Floats) -> Floats:
        """Return offsets (K, N, m) of images of spheres and disks from those of their centres."""
        geometry, body = self.sensors[sensor], self.body
        if body.radii is None or geometry.dimension == 1:
            return np.zeros((len(poses), len(self.points), geometry.dimension))
        match = BodyProjection((geometry,), (body,)).project(poses)
        centres, _ = geometry.project(transform(poses, body.means))
        return np.where(match.seen[0, ..., None], match.y[0] - centres, 0.0)


class State(NamedTuple):
    """The unknowns of a calibration."""

    rig: Rig
    poses: Floats  # (K, 4, 4): of the body, in each frame


@dataclass(frozen=True)
class Block:
    """The parameters of one kind of a sensor or of the body."""

    kind: Kind
    sensor: int | None  # None for the body
    start: int  # index of the first among all parameters
    names: tuple[str, ...]
    units: tuple[str, ...]  # of "length", "rad", "px", "s" and ""
    scales: tuple[float, ...]  # sizes, in `units`, to which standard deviations are compared
    since: int = 0  # index of the first frame in which they act

    @property
    def place(self) -> slice:
        """Return the slice of the block among all parameters."""
        return slice(self.start, self.start + len(self.names))


def centre_of(sensor: Any) -> Floats:
    """Return the position (3,) of a sensor in the world."""
    if isinstance(sensor, RangeSensor):
        return sensor.position
    return np.asarray(inverse(sensor.T_sensor_world)[:3, 3])


def kinds_of(sensor: Sensor) -> tuple[Kind, ...]:
    """Return the kinds of parameters that a sensor has."""
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
    rig: Rig, free: Mapping[int, Sequence[Kind]], *, body: bool, length: float, interval: float
) -> tuple[Block, ...]:
    """Lay out the free parameters in blocks, one after the other.

    `length`, the size of the rig, and `interval`, the seconds from frame to frame, scale them.
    """
    blocks: list[Block] = []
    sensor_kinds = [(s, kind) for s in sorted(free) for kind in KINDS if kind in free[s]]
    start = 0
    for index, kind in sensor_kinds:
        names, units, scales = _parameters_of(rig.sensors[index], kind, length, interval)
        blocks.append(Block(kind, index, start, names, units, scales))
        start += len(names)
    if body:
        names = tuple(f"{label}.{axis}" for label in rig.body.labels for axis in "xyz")
        radius = float(np.linalg.norm(rig.points - rig.points.mean(axis=0), axis=1).max())
        units, scales = ("length",) * len(names), (radius,) * len(names)
        blocks.append(Block("body", None, start, names, units, scales))
    return tuple(blocks)


def _parameters_of(
    sensor: Any, kind: Kind, length: float, interval: float
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[float, ...]]:
    """Return names, units and scales of a sensor's parameters of one kind."""
    if kind == "pose":
        return TWIST_NAMES, ("length",) * 3 + ("rad",) * 3, (length,) * 3 + (1.0,) * 3
    names, unit = _NAMES.get(kind, (kind,)), _UNITS.get(kind, "")
    scale = {"length": length, "s": interval}.get(unit, 1.0)
    if kind == "focal":
        K = sensor.camera_matrix
        names = ("f",) if np.isclose(K[0, 0], K[1, 1], rtol=1e-9) else ("fx", "fy")
        unit, scale = "px", float(K[0, 0])
    elif kind == "principal_point":
        size = sensor.resolution
        unit, scale = "px", 1000.0 if size is None else float(max(size)) / 2
    elif kind == "distortion":  # of rational and tilted models only the first five are free
        most = max(4, min(5, len(sensor.distortion)))
        names = _FISHEYE_LENS if isinstance(sensor, FisheyeCamera) else _LENS[:most]
    elif kind == "drift":
        scale = 1e-2
    return names, (unit,) * len(names), (scale,) * len(names)


def moved(rig: Rig, blocks: Sequence[Block], step: Floats) -> Rig:
    """Return the rig after a step (G,) of its parameters.

    Cameras turn about their own centre: x_sensor <- exp(r) x_sensor + t.
    """
    for block in blocks:
        delta = step[block.place]
        if block.sensor is None:
            rig = replace(rig, points=rig.points + delta.reshape(-1, 3))
        elif block.kind in ("delay", "drift"):
            field = f"{block.kind}s"
            values = getattr(rig, field).copy()
            values[block.sensor] += delta[0]
            rig = replace(rig, **{field: values})
        else:
            sensor = _changed(rig.sensors[block.sensor], block.kind, delta)
            rig = rig.exchanged(block.sensor, sensor)
    return rig


def values_of(rig: Rig, block: Block) -> Floats:
    """Return the values of a sensor's parameters of any kind but a pose."""
    assert block.sensor is not None, "features of the body are in rig.points"
    if block.kind in ("delay", "drift"):
        return getattr(rig, f"{block.kind}s")[[block.sensor]]  # type: ignore[no-any-return]
    return _values(rig.sensors[block.sensor], block.kind)[: len(block.names)]


def _values(sensor: Any, kind: Kind) -> Floats:
    """Return the values of all parameters of one kind; at least four of a lens."""
    if kind in _IN_MATRIX and hasattr(sensor, "camera_matrix"):
        return sensor.camera_matrix[_IN_MATRIX[kind]]  # type: ignore[no-any-return]
    if kind == "distortion":
        return np.pad(sensor.distortion, (0, max(4 - len(sensor.distortion), 0)))
    return np.atleast_1d(getattr(sensor, kind)).astype(np.float64)


def _changed(sensor: Any, kind: Kind, delta: Floats) -> Any:
    """Return a sensor after a step of its parameters of one kind."""
    if kind == "pose":
        T = from_rotation_vector(delta[3:], delta[:3]) @ sensor.T_sensor_world
        return replace(sensor, T_sensor_world=T)
    values = _values(sensor, kind).copy()
    if kind == "focal":  # one step may change fx and fy alike
        values += delta
    else:
        values[: len(delta)] += delta
    if kind in _IN_MATRIX and hasattr(sensor, "camera_matrix"):
        K = sensor.camera_matrix.copy()
        K[_IN_MATRIX[kind]] = values
        return replace(sensor, camera_matrix=K)
    return replace(sensor, **{kind: float(values[0]) if kind == "range_bias" else values})


_STEPS = {"focal": 1e-2, "principal_point": 1e-2, "distortion": 1e-5}


def parameter_jacobian(sensor: Any, kind: Kind, world: Floats, by_world: Floats) -> Floats:
    """Return the Jacobian (n, m, k) of images of points (n, 3) by a sensor's own parameters.

    `by_world` is the Jacobian by the points (n, m, 3).
    """
    if kind == "pose":
        T = sensor.T_sensor_world
        return pose_jacobian(by_world @ T[:3, :3].T, transform(T, world))
    if kind == "position":
        return -by_world
    if kind == "range_bias":
        return np.ones((len(world), 1, 1))
    count = len(_parameters_of(sensor, kind, 1.0, 1.0)[0])
    unbounded = replace(sensor, resolution=None)
    J = np.empty((len(world), 2, count))
    for k, step in enumerate(_STEPS[kind] * np.eye(count)):
        high, _ = _changed(unbounded, kind, step).project(world)
        low, _ = _changed(unbounded, kind, -step).project(world)
        J[:, :, k] = (high - low) / (2 * _STEPS[kind])
    return J
