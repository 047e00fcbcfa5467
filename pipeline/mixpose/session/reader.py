"""Read a session file."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mixpose.errors import SessionError
from mixpose.fit import EstimatorOptions
from mixpose.limits import MOST_SAMPLES
from mixpose.rigid import TWIST_NAMES
from mixpose.session.features import build_body
from mixpose.session.geometry import read_motion
from mixpose.session.messages import BadKeyError, one_line, one_of, under
from mixpose.session.schema import EstimatorTable, SessionTable, StartTable
from mixpose.session.sensor_setups import build_sensors
from mixpose.session.setup import ObjectSetup, Session, Start
from mixpose.session.text_files import as_text, parse_toml, read_bytes
from mixpose.session.validation import validate

_LISTED = 5  # session files that a message names
_PLACEHOLDER = {"name": "body", "points": [[0, 0, 0], [1, 0, 0], [0, 1, 0]]}


def load_scene(path: str | Path, *, allow_code: bool = False) -> Session:
    """Read the sensors and recordings of a session file, and ignore its bodies.

    As `load_session`, but `[start]` and `[estimator]` are ignored, and the body is a placeholder:
    `[object]` may be missing, or name a file that does not exist yet.
    """
    return _load(Path(path), allow_code=allow_code, bodies=False)


def load_session(path: str | Path, *, allow_code: bool = False) -> Session:
    """Read a session file, a TOML file, and the calibration and marker files that it names.

    Recordings are not opened. Lengths are in the session's unit, rigid motions exactly rigid.
    `allow_code` permits functions that the file names (``method = "module:function"``) to be run
    when features are extracted; reading a session runs none.

    Raises SessionError if a file is missing or anything in it is wrong: one line with the file, the
    key, what was found and what is allowed.
    """
    return _load(Path(path), allow_code=allow_code, bodies=True)


def _load(path: Path, *, allow_code: bool, bodies: bool) -> Session:
    data: dict[str, Any] = {}
    try:
        content = read_bytes(path)
        data = parse_toml(as_text(content))
        if not bodies:
            data = {k: v for k, v in data.items() if k not in ("start", "estimator")}
            data["object"] = _PLACEHOLDER
        session = _build(path, hashlib.sha256(content).hexdigest(), data)
        return replace(session, allow_code=allow_code)
    except BadKeyError as problem:
        if not data and isinstance(problem.__cause__, FileNotFoundError):
            names = sorted(other.name for other in path.parent.glob("*.toml"))
            more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
            listed = f"{', '.join(names[:_LISTED])}{more}" if names else "no .toml file"
            text = f"{path}: no such file; in {path.parent} there is {listed}"
            raise SessionError(text) from problem
        raise SessionError(one_line(path, problem.key, problem.text, data)) from problem
    except RecursionError as error:
        raise SessionError(f"{path}: lists or tables in it are nested too deeply") from error


def _build(path: Path, sha256: str, data: dict[str, Any]) -> Session:
    table: SessionTable = validate(SessionTable, data)
    objects = _objects(table, path.parent)
    with under("estimator"):
        estimator = _estimator(table.estimator, objects)
    for body in [setup.body for setup in objects]:  # all samples must fit into memory
        if not body.is_exact and len(body) * estimator.samples > MOST_SAMPLES:
            raise BadKeyError(
                f"found {estimator.samples} for {len(body)} features of {body.name}; "
                f"allowed: {MOST_SAMPLES} together",
                "estimator",
                "samples",
            )
    return Session(
        path=path,
        sha256=sha256,
        unit=table.unit,
        body=objects[0].body,
        start=objects[0].start,
        estimator=estimator,
        sensors=build_sensors(table.sensor, table.extract, path.parent, table.unit),
        count=objects[0].count,
        other_objects=objects[1:],
    )


def _objects(table: SessionTable, folder: Path) -> tuple[ObjectSetup, ...]:
    if table.start is not None and len(table.object) > 1:
        raise BadKeyError(
            f"found one for {len(table.object)} bodies; allowed: [object.start] below each "
            "[[object]] whose place is known",
            "start",
        )
    objects: list[ObjectSetup] = []
    for k, entry in enumerate(table.object):
        with under("object", k):
            if table.start is not None and entry.start is not None:
                raise BadKeyError("stands beside [start]; allowed: one of the two", "start")
            body = build_body(entry, folder, table.unit)
            with under("start"):
                start = _start(entry.start)
            added = ObjectSetup(body, start, entry.count)
            taken = {name for setup in objects for name in (setup.body.name, *setup.labels)}
            repeated = taken & {body.name, *added.labels}
            if repeated:
                raise BadKeyError(
                    f'found "{body.name}", and {sorted(repeated)[0]!r} is the name of another one; '
                    "allowed: a name of its own for each body, and count for identical ones",
                    "name",
                )
            objects.append(added)
    if table.start is not None:
        with under("start"):
            objects[0] = replace(objects[0], start=_start(table.start))
    return tuple(objects)


def _start(table: StartTable | None) -> Start | None:
    if table is None:
        return None
    T_world_object = read_motion(table, "T_world_object")
    if T_world_object is None:
        raise BadKeyError(
            "missing; allowed: a 4x4 matrix, or rotation_vector, quaternion_xyzw or euler_xyz_deg "
            "with translation",
            "T_world_object",
        )
    return Start(T_world_object, table.rotation_deg, table.distance)


def _estimator(table: EstimatorTable, objects: Sequence[ObjectSetup]) -> EstimatorOptions:
    held = [name for name in TWIST_NAMES if name not in table.free]
    if held and any(setup.start is None for setup in objects):
        raise BadKeyError(
            f"leaves out {one_of(held)}, which are held where [start] has them, and there is no "
            "[start]; add one with the pose they are held at, or leave free out to estimate all",
            "free",
        )
    return EstimatorOptions(**dict(table))
