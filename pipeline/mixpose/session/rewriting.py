"""A session file with other values: comments, and keys that are not changed, stay as they are."""

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

ALL_DIGITS = 17  # of float64
Role: TypeAlias = Literal["source", "times", "file"]
_BOM = "\ufeff"
_MOTION = ("rotation_vector", "quaternion_xyzw", "euler_xyz_deg", "translation")
_BARE_END = re.compile(r"(?<!\r)\n")


def document_of(session: Session, target: Path) -> Any:
    """The TOML document of a session, with paths as they are from where it will be written."""
    document = tomlkit.parse(_written(session).removeprefix(_BOM))
    _lead_back(document, session.folder, target.parent)
    return document


def refuse_lost_code(session: Session, target: Path) -> None:
    """Raise a SessionError where functions of the session's own are not found from a target."""
    for setup in session.sensors:
        module, colon, _ = setup.extract.method.partition(":")
        name = module.partition(".")[0]
        if colon and _has_module(session.folder, name) and not _has_module(target.parent, name):
            raise SessionError(
                f'{session.path}: extract.method: "{setup.extract.method}" is looked for beside '
                f"the session, and {target.parent.absolute()} has no {name}; allowed: -o in "
                f"{session.folder.absolute()}, or {name} copied there"
            )


def _has_module(folder: Path, name: str) -> bool:
    return (folder / f"{name}.py").is_file() or (folder / name).is_dir()


def text_of(document: Any, session: Session, head: str = "") -> str:
    """The text of a TOML document below a head; byte order mark and ends of lines stay."""
    written, text = _written(session), head + str(tomlkit.dumps(document))
    if "\r\n" in written and not _BARE_END.search(written):
        text = _BARE_END.sub("\r\n", text)
    return _BOM + text if written.startswith(_BOM) else text


def _written(session: Session) -> str:
    """The text of the session file, with a byte order mark and line ends as they are."""
    return session.path.read_bytes().decode("utf-8")


def objects_of(document: Any) -> Iterator[Any]:
    """The table of each body."""
    objects = document["object"]
    yield from objects if isinstance(objects, list) else [objects]


def put(table: Any, key: str, value: Any, said: str | None = None) -> None:
    """Set a key of a table, with a comment behind it."""
    item = tomlkit.item(value)
    if said:
        item.comment(said)
    table[key] = item


def put_motion(table: Any, key: str, T: Floats, said: str | None = None, digits: int = 10) -> None:
    """Set a rigid motion (4, 4), in place of what says it otherwise."""
    for other in _MOTION:
        table.pop(other, None)
    put(table, key, plain(T, digits), said)


def put_starts(document: Any, session: Session, T_new_old: Floats, scale: float = 1.0) -> None:
    """Where bodies are at first, in another frame of a world whose lengths were scaled before."""
    for table, one in zip(objects_of(document), session.objects, strict=True):
        home = document if "start" in document else table
        if one.start is None or "start" not in home:
            continue
        T = one.start.T_world_object.copy()
        T[:3, 3] *= scale
        told = home["start"].unwrap()
        try:
            put_motion(home["start"], "T_world_object", T_new_old @ T, digits=ALL_DIGITS)
        except (IndexError, NonExistentKey):  # of keys as start.translation none can be taken out
            del home["start"]
            home["start"] = {key: told[key] for key in told.keys() - {*_MOTION, "T_world_object"}}
            put_motion(home["start"], "T_world_object", T_new_old @ T, digits=ALL_DIGITS)
        if scale != 1 and one.start.distance is not None:
            put(home["start"], "distance", plain(scale * one.start.distance))


def put_gravity(document: Any, session: Session, T_new_old: Floats) -> None:
    """Where gravity points, in another frame of the world."""
    for table, one in zip(objects_of(document), session.objects, strict=True):
        if one.body.gravity is not None:
            direction = T_new_old[:3, :3] @ one.body.gravity.direction
            put(table["gravity"], "direction", plain(direction, ALL_DIGITS))


def refuse_held(session: Session) -> None:
    """Raise a SessionError where directions of the world are held, which is to be another one."""
    if len(session.estimator.free) < len(TWIST_NAMES):
        raise SessionError(
            f"{session.path}: estimator.free: found {', '.join(session.estimator.free)}, "
            "directions of the world as it is; allowed: all six, where the world becomes another"
        )


def plain(values: Floats | float, digits: int = 10) -> Any:
    """Nested lists of numbers with so many digits."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0:
        return float(f"{float(array):.{digits}g}") + 0.0
    return [plain(each, digits) for each in array]


def _lead_back(document: Any, old: Path, new: Path) -> None:
    """Let relative paths lead from a new folder to where they led from the old one."""
    if old.resolve() == new.resolve():
        return
    for table, key, *_ in places_of(document):
        value = str(table[key])
        if not (Path(value).is_absolute() or "://" in value or value.startswith("camera:")):
            path = os.path.relpath(old.resolve() / value, new.resolve())
            table[key] = Path(path).as_posix()


def places_of(document: Any) -> Iterator[tuple[Any, str | int, Role, str]]:
    """Where a session file holds paths: container, key, what the path is for, and what has it."""
    objects = list(objects_of(document))
    for one in objects:
        if "file" in one:
            yield one, "file", "file", "object" if len(objects) == 1 else one["name"]
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
