"""In whose frame, and to which scale, a calibration is told."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np

from mixpose.calibration.result import Calibration
from mixpose.calibration.rig import Rig, centre_of
from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.rigid import inverse


def with_length(rig: Rig, words: str) -> tuple[Rig, tuple[int, int]]:
    """The rig and body scaled so that two sensors are a known length apart.

    Parameters
    ----------
    words : str
        ``SENSOR:SENSOR=LENGTH``.

    Raises
    ------
    SessionError
        If the words are no two sensors and a length.
    """
    names, _, value = words.partition("=")
    first, _, second = names.partition(":")
    try:
        length = float(value)
    except ValueError:
        length = 0.0
    if first not in rig.names or second not in rig.names or first == second or not length > 0:
        raise SessionError(
            f"--length {words}: allowed: SENSOR:SENSOR=LENGTH with two of {', '.join(rig.names)} "
            "and a length above 0"
        )
    pair = (rig.names.index(first), rig.names.index(second))
    centres = [centre_of(rig.sensors[k]) for k in pair]
    apart = float(np.linalg.norm(centres[1] - centres[0]))
    if apart == 0:
        raise SessionError(f"--length {words}: the session has both at one place")
    factor = length / apart
    sensors = tuple(_scaled(sensor, factor) for sensor in rig.sensors)
    return replace(rig, sensors=sensors, points=rig.points * factor), pair


def _scaled(sensor: Any, factor: float) -> Any:
    if hasattr(sensor, "T_sensor_world"):
        T = sensor.T_sensor_world.copy()
        T[:3, 3] *= factor
        return replace(sensor, T_sensor_world=T)
    return replace(sensor, position=sensor.position * factor)


def check_world(rig: Rig, words: str, numbers: Collection[int]) -> None:
    """See, before anything is searched, that there is such a frame.

    Parameters
    ----------
    words : str
        A sensor, or ``body@FRAME``.
    numbers : collection of int
        Frames of the recording.

    Raises
    ------
    SessionError
        If there is none.
    """
    body, at, number = words.partition("@")
    if at and body == "body" and number.isdecimal() and int(number) in numbers:
        return
    if words not in _placed(rig):
        raise _no_such_frame(words, rig, numbers)


def in_world(found: Calibration, words: str) -> Calibration:
    """The calibration in another frame: that of a sensor, or of the body in a frame.

    Raises
    ------
    SessionError
        If there is no such frame.
    """
    T_new_world = _frame(found, words)
    moved = tuple(sensor.moved(inverse(T_new_world)) for sensor in found.after.sensors)
    poses = {number: T_new_world @ T for number, T in found.poses.items()}
    text = f"the world is that of {words}"
    return replace(
        found,
        after=replace(found.after, sensors=moved),
        poses=poses,
        gauge=(*found.gauge, text),
    )


def _frame(found: Calibration, words: str) -> Floats:
    """T_new_world (4, 4)."""
    body, _, number = words.partition("@")
    if body == "body" and number.isdecimal() and int(number) in found.poses:
        return inverse(found.poses[int(number)])
    if words in found.after.names:
        sensor: Any = found.after.sensors[found.after.names.index(words)]
        if hasattr(sensor, "T_sensor_world"):
            return np.asarray(sensor.T_sensor_world)
    raise _no_such_frame(words, found.after, found.poses)


def _placed(rig: Rig) -> list[str]:
    """Sensors that have a frame of their own."""
    return [n for n, s in zip(rig.names, rig.sensors) if hasattr(s, "T_sensor_world")]


def _no_such_frame(words: str, rig: Rig, numbers: Collection[int]) -> SessionError:
    frames = ", ".join(f"body@{n}" for n in sorted(numbers)[:3])
    return SessionError(
        f"--world {words}: allowed: {', '.join(_placed(rig))}, or the body in a frame, whatever "
        f"it is called: {frames}, ..."
    )
