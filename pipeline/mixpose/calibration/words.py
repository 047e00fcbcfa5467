"""What a user's words say: what is free, a known length, and in whose frame to tell.

What is free is ``SENSOR:WHAT``, ``WHAT`` for all sensors, or ``body``.
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

_FREES: dict[Kind, tuple[str, ...]] = {
    "pose": ("rotation_deg", "position"),
    "position": ("position",),
    "focal": ("focal",),
    "principal_point": ("principal_point",),
    "range_bias": ("range_bias",),
}


def free_parameters(
    rig: Rig, words: Sequence[str], *, poses_known: bool, world: str | None = None
) -> tuple[dict[int, tuple[Kind, ...]], bool]:
    """Kinds that are free, by sensor, and whether the body is.

    Without words: where all cameras but the first, or that of the world, stand, or all where poses
    are known, and positions of range sensors.  Raises a SessionError if a word names no sensor, or
    nothing that the sensor has.
    """
    if not words:
        return _default(rig, poses_known, world), False
    found: dict[int, list[Kind]] = {}
    body = False
    for word in words:
        sensor, colon, kinds = word.rpartition(":")
        for what in kinds.split(","):
            if what == "body" and not colon:
                body = True
                continue
            kind = _kind(word, what)
            for index in _sensors(rig, word, sensor, kind, every=not colon):
                own = found.setdefault(index, [])
                if kind not in own:
                    own.append(kind)
    return {index: tuple(kinds) for index, kinds in sorted(found.items())}, body


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
        found = [k for k, sensor in enumerate(rig.sensors) if kind in kinds_of(sensor)]
        if not found:
            raise SessionError(f"--free {word}: no sensor of the session has a {kind}")
        return found
    if name not in rig.names:
        raise SessionError(
            f"--free {word}: no such sensor; allowed: {', '.join(rig.names)}, or no name for all"
        )
    index = rig.names.index(name)
    has = kinds_of(rig.sensors[index])
    if kind not in has:
        raise SessionError(f"--free {word}: sensor {name!r} has none; it has {', '.join(has)}")
    return [index]


def error_of_held(error: CalibrationError, kinds: Sequence[Kind]) -> CalibrationError:
    """How far a sensor may be off in what is not free."""
    free = {name: 0.0 for kind in kinds for name in _FREES.get(kind, ())}
    return replace(error, **free)


def words_of(names: Sequence[str], free: Mapping[int, Sequence[Kind]], body: bool) -> str:
    """What is free, for people."""
    parts = [f"{names[k]}:{','.join(kinds)}" for k, kinds in free.items()]
    return " ".join(parts + ["body"] * body) or "nothing"


def known_length(rig: Rig, words: str) -> tuple[tuple[int, int], float]:
    """Two sensors and how far they are apart, as ``SENSOR:SENSOR=LENGTH`` says.

    Raises a SessionError if the words are no two sensors and a length, or a sensor tells scale.
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
    if _apart(rig, pair) == 0:
        raise SessionError(f"--length {words}: the session has both at one place")
    return pair, length


def _apart(rig: Rig, pair: tuple[int, int]) -> float:
    first, second = (centre_of(rig.sensors[k]) for k in pair)
    return float(np.linalg.norm(second - first))


def in_length(found: Calibration, words: str) -> Calibration:
    """The calibration of cameras, all lengths scaled by what `known_length` reads.

    The body and the poses as well: no image changes.
    """
    pair, length = known_length(found.after, words)
    factor = length / _apart(found.after, pair)
    units = [unit for block in found.blocks for unit in block.units]
    sizes = [factor if unit == "length" else 1.0 for unit in units]
    change, along = np.zeros((2, len(units)))
    for block in found.blocks:  # how each changes with the scale of all lengths
        if block.kind == "body":
            change[block.place] = body_change(found.after.points)[:, -1]
        elif block.kind == "pose" and block.sensor is not None:
            change[block.place] = sensor_change(found.after.sensors[block.sensor])[:, -1]
    for block, values in length_parts(found.after, found.blocks, pair):
        along[block.place] += values
    # what the distance errs by scales all
    share = factor / _apart(found.after, pair)
    by_old = np.diag(sizes) - share * np.outer(change, along)
    return replace(
        _by_linear(found, by_old),
        before=_scaled(found.before, factor),
        after=_scaled(found.after, factor),
        poses={number: _shifted(T, factor) for number, T in found.poses.items()},
    )


def _by_linear(found: Calibration, by_old: Floats) -> Calibration:
    """The calibration with the deviations of parameters that depend linearly (G, G) on the old."""
    covariance = by_old @ found.covariance @ by_old.T
    told = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    told = np.where(np.isfinite(found.deviations), told, np.inf)
    return replace(found, covariance=covariance, deviations=told)


def _scaled(rig: Rig, factor: float) -> Rig:
    cameras: list[Any] = list(rig.sensors)
    moved = [replace(one, T_sensor_world=_shifted(one.T_sensor_world, factor)) for one in cameras]
    points, scale = rig.points * factor, rig.scale * factor
    return replace(rig, sensors=tuple(moved), points=points, scale=scale)


def _shifted(T: Floats, factor: float) -> Floats:
    return from_parts(T[:3, :3], factor * T[:3, 3])


def check_world(rig: Rig, words: str, numbers: Collection[int]) -> None:
    """Refuse words that name no frame: a sensor's, or ``body@FRAME`` of a frame of the recording.

    So that nothing is searched in vain.  Raises a SessionError.
    """
    if _frame_number(words, numbers) is None and words not in _with_a_frame(rig):
        frames = ", ".join(f"body@{n}" for n in sorted(numbers)[:3])
        raise SessionError(
            f"--world {words}: allowed: {', '.join(_with_a_frame(rig))}, or the body in a frame, "
            f"whatever it is called: {frames}, ..."
        )


def in_world(found: Calibration, words: str) -> Calibration:
    """The calibration in another frame, named as for `check_world`."""
    check_world(found.after, words, found.poses)
    number = _frame_number(words, found.poses)
    if number is None:
        T_new_world = _with_a_frame(found.after)[words]
    else:
        T_new_world = inverse(found.poses[number])
    moved = tuple(sensor.moved(inverse(T_new_world)) for sensor in found.after.sensors)
    by_old, names = np.eye(len(found.deviations)), found.after.names
    placed = [(b.sensor, b) for b in found.blocks if b.kind in ("pose", "position")]
    own = next((b for s, b in placed if s is not None and names[s] == words), None)
    for sensor, block in placed:
        if block.kind == "position":
            by_old[block.place, block.place] = T_new_world[:3, :3]
        if own is not None and sensor is not None:  # the others move as this one errs
            change = sensor_change(moved[sensor])[:, :6]
            by_old[block.place, own.place] = change if block is not own else 0.0
    return replace(
        _by_linear(found, by_old),
        after=replace(found.after, sensors=moved),
        poses={number: T_new_world @ T for number, T in found.poses.items()},
        gauge=(*found.gauge, f"the world is that of {words}"),
        T_new_old=T_new_world,
    )


def _frame_number(words: str, numbers: Collection[int]) -> int | None:
    """The frame of ``body@FRAME``; None where the words are no frame of the recording."""
    body, _, number = words.partition("@")
    known = {str(each): each for each in numbers} if body == "body" else {}
    return known.get(number.lstrip("0") or number[-1:])


def _with_a_frame(rig: Rig) -> dict[str, Floats]:
    """T_sensor_world of sensors that have a frame of their own, by name."""
    both = zip(rig.names, rig.sensors, strict=True)
    return {n: s.T_sensor_world for n, s in both if hasattr(s, "T_sensor_world")}
