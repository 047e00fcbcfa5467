"""Options in a user's words: free parameters, a known length, and the frame of the result.

A free parameter is ``SENSOR:WHAT``, ``WHAT`` for all sensors, or ``body``.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mixpose.calibration.gauge import body_change, length_parts, sensor_change
from mixpose.calibration.result import Calibration
from mixpose.calibration.rig import KINDS, Kind, Rig, centre_of, kinds_of
from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.rigid import from_parts, inverse
from mixpose.sensors import CalibrationError, RangeSensor
from mixpose.session.values import LARGEST, as_number

_ERROR_FIELDS: dict[Kind, tuple[str, ...]] = {
    "pose": ("rotation_deg", "position"),
    "position": ("position",),
    "focal": ("focal",),
    "principal_point": ("principal_point",),
    "range_bias": ("range_bias",),
}


def free_parameters(
    rig: Rig, words: Sequence[str], *, poses_known: bool, world: str | None = None
) -> tuple[dict[int, tuple[Kind, ...]], bool]:
    """Return the kinds that are free, by sensor, and whether the body is.

    Without words: poses of all cameras but the first, or that of the world, or of all if poses are
    known, and positions of range sensors.  Raises a SessionError if a word names no sensor, or no
    parameter of the sensor.
    """
    if not words:
        return _default(rig, poses_known, world), False
    free: dict[int, list[Kind]] = {}
    body = False
    for word in words:
        sensor, colon, kinds = word.rpartition(":")
        for what in kinds.split(","):
            if what == "body" and not colon:
                body = True
                continue
            kind = _kind(word, what)
            for index in _sensors(rig, word, sensor, kind, every=not colon):
                sensor_kinds = free.setdefault(index, [])
                if kind not in sensor_kinds:
                    sensor_kinds.append(kind)
    return {index: tuple(kinds) for index, kinds in sorted(free.items())}, body


def _default(rig: Rig, poses_known: bool, world: str | None) -> dict[int, tuple[Kind, ...]]:
    free: dict[int, tuple[Kind, ...]] = {}
    posed = [k for k, sensor in enumerate(rig.sensors) if "pose" in kinds_of(sensor)]
    posed.sort(key=lambda k: rig.names[k] != world)
    for index, sensor in enumerate(rig.sensors):
        if isinstance(sensor, RangeSensor):
            free[index] = ("position",)
        elif index in (posed if poses_known else posed[1:]):
            free[index] = ("pose",)
    return free


def _kind(word: str, what: str) -> Kind:
    if what in KINDS:
        return what
    near = difflib.get_close_matches(what, KINDS, 1)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise SessionError(f"--free {word}: found {what!r}; allowed: {', '.join(KINDS)}, or body{hint}")


def _sensors(rig: Rig, word: str, name: str, kind: Kind, *, every: bool) -> list[int]:
    if every or name == "*":
        indices = [k for k, sensor in enumerate(rig.sensors) if kind in kinds_of(sensor)]
        if not indices:
            raise SessionError(f"--free {word}: no sensor of the session has a {kind}")
        return indices
    if name not in rig.names:
        raise SessionError(
            f"--free {word}: no such sensor; allowed: {', '.join(rig.names)}, or no name for all"
        )
    index = rig.names.index(name)
    kinds = kinds_of(rig.sensors[index])
    if kind not in kinds:
        raise SessionError(f"--free {word}: sensor {name!r} has none; it has {', '.join(kinds)}")
    return [index]


def error_of_held(error: CalibrationError, kinds: Sequence[Kind]) -> CalibrationError:
    """Return the error of a sensor's calibration without parameters that are free."""
    free = {name: 0.0 for kind in kinds for name in _ERROR_FIELDS.get(kind, ())}
    return replace(error, **free)


def words_of(names: Sequence[str], free: Mapping[int, Sequence[Kind]], body: bool) -> str:
    """Say what is free."""
    parts = [f"{names[k]}:{','.join(kinds)}" for k, kinds in free.items()]
    return " ".join(parts + ["body"] * body) or "nothing"


def known_length(rig: Rig, words: str) -> tuple[tuple[int, int], float]:
    """Return two sensors and their distance, from ``SENSOR:SENSOR=LENGTH``.

    Raises a SessionError if the words are no two sensors and a length, or a sensor gives the scale.
    """
    names, _, value = words.partition("=")
    first, _, second = names.partition(":")
    length = as_number(value)
    are_two = first in rig.names and second in rig.names and first != second
    if not (are_two and 0 < length <= LARGEST):
        raise SessionError(
            f"--length {words}: allowed: SENSOR:SENSOR=LENGTH with two of {', '.join(rig.names)} "
            f"and a length above 0, at most {LARGEST:g}"
        )
    for name, sensor in zip(rig.names, rig.sensors, strict=True):
        if not hasattr(sensor, "camera_matrix"):
            raise SessionError(
                f"--length {words}: sensor {name!r} measures lengths, which give the scale; "
                "allowed: a session of cameras alone"
            )
    pair = (rig.names.index(first), rig.names.index(second))
    if _distance(rig, pair) == 0:
        raise SessionError(f"--length {words}: the session has both at one place")
    return pair, length


def _distance(rig: Rig, pair: tuple[int, int]) -> float:
    first, second = (centre_of(rig.sensors[k]) for k in pair)
    return float(np.linalg.norm(second - first))


def in_length(calibration: Calibration, words: str) -> Calibration:
    """Scale a calibration of cameras to the distance of two of them that `known_length` reads.

    The body and the poses are scaled as well, so that no image changes.
    """
    rig, units = calibration.after, [u for block in calibration.blocks for u in block.units]
    pair, length = known_length(rig, words)
    factor = length / _distance(rig, pair)
    sizes = [factor if unit == "length" else 1.0 for unit in units]
    change, by_distance = np.zeros((2, len(units)))
    for block in calibration.blocks:  # change with the scale of all lengths
        if block.kind == "body":
            change[block.place] = body_change(rig.points)[:, -1]
        elif block.kind == "pose" and block.sensor is not None:
            change[block.place] = sensor_change(rig.sensors[block.sensor])[:, -1]
    for block, values in length_parts(rig, calibration.blocks, pair):
        by_distance[block.place] += values
    # an error of the distance scales all lengths
    share = factor / _distance(rig, pair)
    by_old = np.diag(sizes) - share * np.outer(change, by_distance)
    return replace(
        calibration.linear(by_old),
        before=_scaled(calibration.before, factor),
        after=_scaled(rig, factor),
        poses={number: _shifted(T, factor) for number, T in calibration.poses.items()},
    )


def _scaled(rig: Rig, factor: float) -> Rig:
    cameras: list[Any] = list(rig.sensors)
    moved = [replace(c, T_sensor_world=_shifted(c.T_sensor_world, factor)) for c in cameras]
    points, scale = rig.points * factor, rig.scale * factor
    return replace(rig, sensors=tuple(moved), points=points, scale=scale)


def _shifted(T: Floats, factor: float) -> Floats:
    return from_parts(T[:3, :3], factor * T[:3, 3])


def check_world(rig: Rig, words: str, numbers: Collection[int]) -> None:
    """Raise a SessionError if words name no frame: a sensor, or ``body@FRAME`` of the recording.

    It is checked before the search, which takes long.
    """
    if _frame_number(words, numbers) is None and words not in _with_a_frame(rig):
        frames = ", ".join(f"body@{n}" for n in sorted(numbers)[:3])
        raise SessionError(
            f"--world {words}: allowed: {', '.join(_with_a_frame(rig))}, or the body in a frame, "
            f"whatever it is called: {frames}, ..."
        )


def in_world(calibration: Calibration, words: str) -> Calibration:
    """Return the calibration in another frame, named as for `check_world`."""
    check_world(calibration.after, words, calibration.poses)
    number = _frame_number(words, calibration.poses)
    if number is None:
        T_new_world = _with_a_frame(calibration.after)[words]
    else:
        T_new_world = inverse(calibration.poses[number])
    sensors = tuple(sensor.moved(inverse(T_new_world)) for sensor in calibration.after.sensors)
    by_old, names = np.eye(len(calibration.deviations)), calibration.after.names
    placed = [(b.sensor, b) for b in calibration.blocks if b.kind in ("pose", "position")]
    reference = next((b for s, b in placed if s is not None and names[s] == words), None)
    for index, block in placed:
        if block.kind == "position":
            by_old[block.place, block.place] = T_new_world[:3, :3]
        if reference is not None and index is not None:  # others move by the reference's errors
            change = sensor_change(sensors[index])[:, :6]
            by_old[block.place, reference.place] = change if block is not reference else 0.0
    return replace(
        calibration.linear(by_old),
        after=replace(calibration.after, sensors=sensors),
        poses={number: T_new_world @ T for number, T in calibration.poses.items()},
        gauge=(*calibration.gauge, f"the world is that of {words}"),
        T_new_old=T_new_world,
    )


def _frame_number(words: str, numbers: Collection[int]) -> int | None:
    """Return the frame number of ``body@FRAME``; None if it is no frame of the recording."""
    body, _, number = words.partition("@")
    known = {str(n): n for n in numbers} if body == "body" else {}
    return known.get(number.lstrip("0") or number[-1:])


def _with_a_frame(rig: Rig) -> dict[str, Floats]:
    """Return T_sensor_world by name of the sensors that have one."""
    both = zip(rig.names, rig.sensors, strict=True)
    return {n: s.T_sensor_world for n, s in both if hasattr(s, "T_sensor_world")}
