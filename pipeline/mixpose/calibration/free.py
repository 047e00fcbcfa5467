"""What is free, in the user's words: ``SENSOR:WHAT``, ``WHAT`` for all sensors, or ``body``."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import replace

from mixpose.calibration.rig import KINDS, Kind, Rig, kinds_of
from mixpose.errors import SessionError
from mixpose.sensors import CalibrationError, RangeSensor

ALLOWED = ", ".join(KINDS)


def free_parameters(
    rig: Rig, words: Sequence[str], *, poses_known: bool
) -> tuple[dict[int, tuple[Kind, ...]], bool]:
    """Read what is free.

    Parameters
    ----------
    words : sequence of str
        None of them: where all cameras but the first stand, or all where poses are known, and
        positions of range sensors.

    Returns
    -------
    dict of int to tuple of kinds
        By sensor.
    bool
        Whether the body is free.

    Raises
    ------
    SessionError
        If a word names no sensor, or nothing that the sensor has.
    """
    if not words:
        return _default(rig, poses_known=poses_known), False
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
                found.setdefault(index, [])
                if kind not in found[index]:
                    found[index].append(kind)
    return {index: tuple(kinds) for index, kinds in sorted(found.items())}, body


def _default(rig: Rig, *, poses_known: bool) -> dict[int, tuple[Kind, ...]]:
    free: dict[int, tuple[Kind, ...]] = {}
    held = False
    for index, sensor in enumerate(rig.sensors):
        if isinstance(sensor, RangeSensor):
            free[index] = ("position",)
        elif "pose" in kinds_of(sensor):
            if held or poses_known:
                free[index] = ("pose",)
            held = True
    return free


def _kind(word: str, what: str) -> Kind:
    for kind in KINDS:
        if kind == what:
            return kind
    near = difflib.get_close_matches(what, KINDS, 1)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise SessionError(f"--free {word}: found {what!r}; allowed: {ALLOWED}, or body{hint}")


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


_FREES: dict[Kind, tuple[str, ...]] = {
    "pose": ("rotation_deg", "position"),
    "position": ("position",),
    "focal": ("focal",),
    "principal_point": ("principal_point",),
    "range_bias": ("range_bias",),
}


def error_of_held(error: CalibrationError, kinds: Sequence[Kind]) -> CalibrationError:
    """How far a sensor may be off in what is not free."""
    free = {name: 0.0 for kind in kinds for name in _FREES.get(kind, ())}
    return replace(error, **free)


def words_of(names: Sequence[str], free: Mapping[int, Sequence[Kind]], body: bool) -> str:
    """What is free, for people."""
    parts = [f"{names[k]}:{','.join(kinds)}" for k, kinds in free.items()]
    return " ".join(parts + ["body"] * body) or "nothing"
