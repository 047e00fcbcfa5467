"""Change values in a session file; its comments and all other keys stay unchanged."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import tomlkit
from tomlkit.exceptions import NonExistentKey

from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.rigid import TWIST_NAMES
from mixpose.session.setup import Session

ALL_DIGITS = 17  # significant digits that determine a float64
Role: TypeAlias = Literal["source", "times", "file"]
_BOM = "\ufeff"
_MOTION = ("rotation_vector", "quaternion_xyzw", "euler_xyz_deg", "translation")
_BARE_END = re.compile(r"(?<!\r)\n")


def document_of(session: Session, target: Path) -> Any:
    """Return the TOML document of a session, with paths relative to the folder of `target`."""
    document = tomlkit.parse(_text(session).removeprefix(_BOM))
    old, new = session.folder.resolve(), target.parent.resolve()
    for table, key, *_ in paths_in(document) if old != new else ():
        value = str(table[key])
        if not (Path(value).is_absolute() or "://" in value or value.startswith("camera:")):
            table[key] = Path(os.path.relpath(old / value, new)).as_posix()
    return document


def refuse_lost_code(session: Session, target: Path) -> None:
    """Raise a SessionError if modules beside the session are missing beside `target`."""
    for setup in session.sensors:
        module, colon, _ = setup.extract.method.partition(":")
        name = module.partition(".")[0]
        has_module = [
            (folder / f"{name}.py").is_file() or (folder / name).is_dir()
            for folder in (session.folder, target.parent)
        ]
        if colon and has_module == [True, False]:
            raise SessionError(
                f'{session.path}: extract.method: "{setup.extract.method}" is looked for beside '
                f"the session, and {target.parent.absolute()} has no {name}; allowed: -o in "
                f"{session.folder.absolute()}, or {name} copied there"
            )


def text_of(document: Any, session: Session, head: str = "") -> str:
    """Return the text of a document below `head`, with the session's BOM and line ends."""
    original, text = _text(session), head + str(tomlkit.dumps(document))
    if "\r\n" in original and not _BARE_END.search(original):
        text = _BARE_END.sub("\r\n", text)
    return _BOM + text if original.startswith(_BOM) else text


def _text(session: Session) -> str:
    return session.path.read_bytes().decode("utf-8")


def objects_of(document: Any) -> Iterator[Any]:
    """Yield the table of each body."""
    objects = document["object"]
    yield from objects if isinstance(objects, list) else [objects]


def put(table: Any, key: str, value: Any, note: str | None = None) -> None:
    """Set a key of a table, with a note as a comment after its value."""
    item = tomlkit.item(value)
    if note:
        item.comment(note)
    table[key] = item


def put_motion(table: Any, key: str, T: Floats, note: str | None = None, digits: int = 10) -> None:
    """Set a rigid motion (4, 4), in place of its other forms."""
    for form in _MOTION:
        table.pop(form, None)
    put(table, key, rounded(T, digits), note)


def put_starts(document: Any, session: Session, T_new_old: Floats, scale: float = 1.0) -> None:
    """Set the starts of bodies, scaled and then moved to another frame of the world."""
    for table, setup in zip(objects_of(document), session.objects, strict=True):
        parent = document if "start" in document else table
        if setup.start is None or "start" not in parent:
            continue
        T = setup.start.T_world_object.copy()
        T[:3, 3] *= scale
        old = parent["start"].unwrap()
        try:
            put_motion(parent["start"], "T_world_object", T_new_old @ T, digits=ALL_DIGITS)
        except (IndexError, NonExistentKey):  # dotted keys as start.translation cannot be removed
            del parent["start"]
            parent["start"] = {key: old[key] for key in old.keys() - {*_MOTION, "T_world_object"}}
            put_motion(parent["start"], "T_world_object", T_new_old @ T, digits=ALL_DIGITS)
        if scale != 1 and setup.start.distance is not None:
            put(parent["start"], "distance", rounded(scale * setup.start.distance))


def put_gravity(document: Any, session: Session, T_new_old: Floats) -> None:
    """Set the directions of gravity in another frame of the world."""
    for table, setup in zip(objects_of(document), session.objects, strict=True):
        if setup.body.gravity is not None:
            direction = T_new_old[:3, :3] @ setup.body.gravity.direction
            put(table["gravity"], "direction", rounded(direction, ALL_DIGITS))


def refuse_held_directions(session: Session) -> None:
    """Raise a SessionError if world directions are held, as these change with the world frame."""
    if len(session.estimator.free) < len(TWIST_NAMES):
        raise SessionError(
            f"{session.path}: estimator.free: found {', '.join(session.estimator.free)}, "
            "directions of the world as it is; allowed: all six, where the world becomes another"
        )


def rounded(values: Floats | float, digits: int = 10) -> Any:
    """Return a number, or an array as nested lists, rounded to significant digits."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0:
        return float(f"{float(array):.{digits}g}") + 0.0
    return [rounded(row, digits) for row in array]


def paths_in(document: Any) -> Iterator[tuple[Any, str | int, Role, str]]:
    """Yield container, key, role and owner of each path in a session file."""
    objects = list(objects_of(document))
    for table in objects:
        if "file" in table:
            yield table, "file", "file", "object" if len(objects) == 1 else table["name"]
    for sensor in document["sensor"]:
        name, source, calibration = sensor["name"], sensor.get("source"), sensor.get("calibration")
        if isinstance(source, list):
            yield from ((source, i, "source", name) for i in range(len(source)))
        elif isinstance(source, str):
            yield sensor, "source", "source", name
        if "times" in sensor:
            yield sensor, "times", "times", name
        if isinstance(calibration, dict):
            yield calibration, "file", "file", name
        elif calibration is not None:
            yield sensor, "calibration", "file", name
