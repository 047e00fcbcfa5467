"""What no data can tell: moving the whole rig, the body's own frame, and, for cameras, scale.

The motions that change no measurement are found from what is free; as many conditions are put on
each step of the parameters, which change no residual either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space

from mixpose.calibration.rig import Block, Rig, centre_of
from mixpose.records import Floats
from mixpose.sensors import RangeSensor

_GENERATORS = 13  # six motions of the world, six of the body in its frame, one scale
_MOST_POSES = 40


@dataclass(frozen=True, eq=False)
class Freedom:
    """What is free beside the parameters of the rig."""

    pose_free: NDArray[np.bool_]  # (6,)
    poses: Floats  # (K, 4, 4)


def gauge_rows(
    rig: Rig, blocks: Sequence[Block], freedom: Freedom, length: tuple[int, int] | None = None
) -> tuple[Floats, tuple[str, ...]]:
    """Conditions on a step of the parameters, in the parameters' sizes, and what they say.

    Parameters
    ----------
    length : (int, int) or None
        Sensors whose distance is known.

    Returns
    -------
    (r, G) array
    tuple of str
        A sentence for each freedom that was removed.
    """
    count = sum(len(block.names) for block in blocks)
    scales = np.concatenate([np.array(b.scales) for b in blocks]) if blocks else np.zeros(0)
    moves, held = _generators(rig, blocks, freedom, count)
    idle = null_space(held, rcond=1e-9) if len(held) else np.eye(_GENERATORS)
    Z = (moves @ idle) / scales[:, None]
    rows: list[Floats] = []
    said: list[str] = []
    for row, text in _conditions(rig, blocks, count, scales, Z, length):
        left = Z @ null_space(np.array(rows) @ Z) if rows else Z
        if left.size and np.linalg.norm(row @ left) > 1e-6 * np.linalg.norm(row):
            rows.append(row / np.linalg.norm(row))
            if text not in said:
                said.append(text)
    return np.array(rows).reshape(len(rows), count), tuple(said)


def _generators(
    rig: Rig, blocks: Sequence[Block], freedom: Freedom, count: int
) -> tuple[Floats, Floats]:
    """Each generator's change of the free parameters (G, 13), and of all that is held (h, 13)."""
    moves, held = np.zeros((count, _GENERATORS)), []
    place = {(block.sensor, block.kind): block.place for block in blocks}
    for index, sensor in enumerate(rig.sensors):
        kind = "position" if isinstance(sensor, RangeSensor) else "pose"
        change = _sensor_change(sensor)
        if (index, kind) in place:
            moves[place[index, kind]] = change  # type: ignore[index]
        else:
            held.append(change)
        if isinstance(sensor, RangeSensor) or not hasattr(sensor, "camera_matrix"):
            held.append(np.eye(_GENERATORS)[12:])  # it measures lengths
    change = _body_change(rig.points)
    if (None, "body") in place:
        moves[place[None, "body"]] = change
    else:
        held.append(change)
    fixed = ~freedom.pose_free
    if fixed.any():
        poses = freedom.poses[:: max(len(freedom.poses) // _MOST_POSES, 1)]
        held += [_pose_change(T)[fixed] for T in poses]
    return moves, np.concatenate(held) if held else np.zeros((0, _GENERATORS))


def _cross(v: Floats) -> Floats:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0.0]])


def _sensor_change(sensor: Any) -> Floats:
    """Change of a sensor's pose in its axes, or of a position, by all generators."""
    centre = centre_of(sensor)
    moved = np.zeros((3, _GENERATORS))
    moved[:, :3] = np.eye(3)
    moved[:, 3:6] = -_cross(centre)
    moved[:, 12] = centre
    if isinstance(sensor, RangeSensor):
        return moved
    R = sensor.T_sensor_world[:3, :3]
    # the camera moves in the world: its world moves the other way
    change = np.zeros((6, _GENERATORS))
    change[:3] = -R @ moved
    change[3:, 3:6] = -R
    return change


def _body_change(points: Floats) -> Floats:
    change = np.zeros((len(points), 3, _GENERATORS))
    change[:, :, 6:9] = np.eye(3)
    change[:, :, 9:12] = [-_cross(p) for p in points]
    change[:, :, 12] = points
    return change.reshape(-1, _GENERATORS)


def _pose_change(T: Floats) -> Floats:
    """Change of a pose in world axes: x y z rx ry rz."""
    R, t = T[:3, :3], T[:3, 3]
    change = np.zeros((6, _GENERATORS))
    change[:3, :3], change[:3, 3:6], change[3:, 3:6] = np.eye(3), -_cross(t), np.eye(3)
    change[:3, 6:9], change[3:, 9:12] = -R, -R
    change[:3, 12] = t
    return change


def _conditions(
    rig: Rig,
    blocks: Sequence[Block],
    count: int,
    scales: Floats,
    Z: Floats,
    length: tuple[int, int] | None,
) -> list[tuple[Floats, str]]:
    """Conditions in the order in which they are preferred."""
    found: list[tuple[Floats, str]] = []

    def row(place: slice, values: Floats) -> Floats:
        out = np.zeros(count)
        out[place] = values
        return out * scales

    positions = [b for b in blocks if b.kind == "position"]
    if len(positions) > 1:
        found += _range_conditions(rig, positions, row)
    body = next((b for b in blocks if b.kind == "body"), None)
    if body is not None:
        change = _body_change(rig.points)
        text = "the body's own frame stays where its features are on average"
        found += [(row(body.place, change[:, k]), text) for k in range(6, 12)]
        if length is not None:
            text = "the known length between two sensors stays"
            found.append((_length_row(rig, blocks, length, row, count), text))
        else:
            text = "the body keeps its size: cameras alone do not tell scale"
            found.append((row(body.place, change[:, 12]), text))
    for direction in Z.T:
        if np.linalg.norm(direction) > 1e-9:
            text = "the rig as a whole stays where it is: no data tell where it stands"
            found.append((direction, text))
    return found


def _length_row(
    rig: Rig, blocks: Sequence[Block], length: tuple[int, int], row: Any, count: int
) -> Floats:
    """The change of the distance between two sensors by a step of the parameters."""
    centres = [centre_of(rig.sensors[k]) for k in length]
    along = (centres[1] - centres[0]) / np.linalg.norm(centres[1] - centres[0])
    out = np.zeros(count)
    for index, sign in zip(length, (-1.0, 1.0), strict=True):
        for block in blocks:
            if block.sensor == index and block.kind == "position":
                out += row(block.place, sign * along)
            elif block.sensor == index and block.kind == "pose":
                sensor: Any = rig.sensors[index]
                turned = -sign * sensor.T_sensor_world[:3, :3] @ along
                out += row(block.place, np.concatenate([turned, np.zeros(3)]))
    return out


def _range_conditions(rig: Rig, positions: Sequence[Block], row: Any) -> list[tuple[Floats, str]]:
    """First at its place, second on the line from it, third in their plane."""
    first, second = positions[0], positions[1]
    p = [centre_of(rig.sensors[b.sensor]) for b in positions[:3] if b.sensor is not None]
    names = [rig.names[b.sensor] for b in positions[:3] if b.sensor is not None]
    found = [(row(first.place, axis), f"{names[0]} stays at its place") for axis in np.eye(3)]
    along = (p[1] - p[0]) / np.linalg.norm(p[1] - p[0])
    text = f"{names[1]} stays on the line from {names[0]}"
    found += [(row(second.place, axis), text) for axis in null_space(along[None]).T]
    if len(positions) > 2:
        normal = np.cross(along, p[2] - p[0])
        if np.linalg.norm(normal) > 1e-9 * np.linalg.norm(p[2] - p[0]):
            text = f"{names[2]} stays in the plane of {names[0]}, {names[1]} and itself"
            found.append((row(positions[2].place, normal / np.linalg.norm(normal)), text))
    return found
