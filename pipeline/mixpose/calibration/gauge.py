"""Freedoms that no data determine: motions of the rig and of the body's frame; for cameras, scale.

The motions that change no measurement follow from what is free; as many conditions, which change no
residual either, are put on each step of the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.linalg import null_space

from mixpose.calibration.rig import Block, Kind, Rig, State, centre_of
from mixpose.objective.projection import pose_jacobian
from mixpose.records import Floats, Mask
from mixpose.sensors import RangeSensor

_GENERATORS = 13  # six motions of the world, six of the body in its frame, one scale
_MOST_POSES = 40


def gauge_rows(
    state: State, blocks: Sequence[Block], pose_free: Mask, length: tuple[int, int] | None = None
) -> tuple[Floats, tuple[str, ...]]:
    """Return conditions (r, G) on a step, in the parameters' sizes, and sentences on what they fix.

    `length` are two sensors whose distance is known.
    """
    rig = state.rig
    scales = np.array([scale for block in blocks for scale in block.scales])
    moves, held = _generators(state, blocks, pose_free, len(scales))
    unmeasured = null_space(held, rcond=1e-9) if len(held) else np.eye(_GENERATORS)
    Z = (moves @ unmeasured) / scales[:, None]
    rows: list[Floats] = []
    sentences: list[str] = []
    for row, text in _conditions(rig, blocks, scales, Z, length):
        remaining = Z @ null_space(np.array(rows) @ Z) if rows else Z
        if remaining.size and np.linalg.norm(row @ remaining) > 1e-6 * np.linalg.norm(row):
            rows.append(row / np.linalg.norm(row))
            if text not in sentences:
                sentences.append(text)
    return np.array(rows).reshape(len(rows), len(scales)), tuple(sentences)


def _generators(
    state: State, blocks: Sequence[Block], pose_free: Mask, count: int
) -> tuple[Floats, Floats]:
    """Return changes of free parameters (G, 13) and of held ones (h, 13) by the generators."""
    moves, held = np.zeros((count, _GENERATORS)), [np.zeros((0, _GENERATORS))]
    places = {(block.sensor, block.kind): block.place for block in blocks}

    def add(where: slice | None, change: Floats) -> None:
        if where is None:
            held.append(change)
        else:
            moves[where] = change

    for index, sensor in enumerate(state.rig.sensors):
        kind: Kind = "position" if isinstance(sensor, RangeSensor) else "pose"
        add(places.get((index, kind)), sensor_change(sensor))
        if not hasattr(sensor, "camera_matrix"):
            held.append(np.eye(_GENERATORS)[12:])  # it measures lengths
    add(places.get((None, "body")), body_change(state.rig.points))
    fixed = ~pose_free
    if fixed.any():
        poses = state.poses[:: max(len(state.poses) // _MOST_POSES, 1)]
        held += [_pose_change(T)[fixed] for T in poses]
    return moves, np.concatenate(held)


def _by_motion(points: Floats) -> Floats:
    """Return the change (n, 3, 6) of points (n, 3) by a motion about the origin."""
    return pose_jacobian(np.broadcast_to(np.eye(3), (len(points), 3, 3)), points)


def sensor_change(sensor: Any) -> Floats:
    """Return the change of a sensor's pose in its axes, or of a position, by all generators."""
    centre = centre_of(sensor)
    moved = np.zeros((3, _GENERATORS))
    moved[:, :6] = _by_motion(centre[None])[0]
    moved[:, 12] = centre
    if isinstance(sensor, RangeSensor):
        return moved
    R = sensor.T_sensor_world[:3, :3]
    # a motion of the camera in the world is the opposite motion of its world
    change = np.zeros((6, _GENERATORS))
    change[:3] = -R @ moved
    change[3:, 3:6] = -R
    return change


def body_change(points: Floats) -> Floats:
    """Return the change of coordinates of points (n, 3), one after the other, by all generators."""
    change = np.zeros((len(points), 3, _GENERATORS))
    change[:, :, 6:12] = _by_motion(points)
    change[:, :, 12] = points
    return change.reshape(-1, _GENERATORS)


def _pose_change(T: Floats) -> Floats:
    """Return the change of a pose in world axes, x y z rx ry rz, by all generators."""
    R, t = T[:3, :3], T[:3, 3]
    change = np.zeros((6, _GENERATORS))
    change[:3, :6], change[3:, 3:6] = _by_motion(t[None])[0], np.eye(3)
    change[:3, 6:9], change[3:, 9:12] = -R, -R
    change[:3, 12] = t
    return change


def _conditions(
    rig: Rig, blocks: Sequence[Block], scales: Floats, Z: Floats, length: tuple[int, int] | None
) -> list[tuple[Floats, str]]:
    """Return conditions and their sentences in order of preference."""
    conditions: list[tuple[Floats, str]] = []

    def add(text: str, *parts: tuple[Block, Floats]) -> None:
        row = np.zeros(len(scales))
        for block, values in parts:
            row[block.place] += values
        conditions.append((row * scales, text))

    positions = [b for b in blocks if b.kind == "position"]
    if len(positions) > 1:
        for block, values, text in _range_conditions(rig, positions[:3]):
            add(text, (block, values))
    body = next((b for b in blocks if b.kind == "body"), None)
    if body is not None:
        change = body_change(rig.points)
        text = "the body's own frame stays where its features are on average"
        for k in range(6, 12):
            add(text, (body, change[:, k]))
        if length is not None:
            parts = length_parts(rig, blocks, length)
            add("the known length between two sensors stays", *parts)
        else:
            text = "the body keeps its size: cameras alone do not tell scale"
            add(text, (body, change[:, 12]))
    text = "the rig as a whole stays where it is: no data tell where it stands"
    conditions += [(direction, text) for direction in Z.T if np.linalg.norm(direction) > 1e-9]
    return conditions


def length_parts(
    rig: Rig, blocks: Sequence[Block], length: tuple[int, int]
) -> list[tuple[Block, Floats]]:
    """Return the change of the distance between two sensors by blocks of their positions."""
    first, second = (centre_of(rig.sensors[k]) for k in length)
    along = (second - first) / np.linalg.norm(second - first)
    parts = []
    for block in blocks:
        if block.sensor in length and block.kind in ("position", "pose"):
            signed = along if block.sensor == length[1] else -along
            if block.kind == "pose":
                sensor: Any = rig.sensors[block.sensor]
                signed = np.append(-sensor.T_sensor_world[:3, :3] @ signed, np.zeros(3))
            parts.append((block, signed))
    return parts


def _range_conditions(rig: Rig, positions: Sequence[Block]) -> list[tuple[Block, Floats, str]]:
    """Hold the first sensor, the second on a line with it, and the third in their plane."""
    sensors = [b.sensor for b in positions if b.sensor is not None]
    p = [centre_of(rig.sensors[s]) for s in sensors]
    names = [rig.names[s] for s in sensors]
    conditions = [(positions[0], axis, f"{names[0]} stays at its place") for axis in np.eye(3)]
    along = (p[1] - p[0]) / np.linalg.norm(p[1] - p[0])
    text = f"{names[1]} stays on the line from {names[0]}"
    conditions += [(positions[1], axis, text) for axis in null_space(along[None]).T]
    if len(positions) > 2:
        normal = np.cross(along, p[2] - p[0])
        if np.linalg.norm(normal) > 1e-9 * np.linalg.norm(p[2] - p[0]):
            text = f"{names[2]} stays in the plane of {names[0]}, {names[1]} and itself"
            conditions.append((positions[2], normal / np.linalg.norm(normal), text))
    return conditions
