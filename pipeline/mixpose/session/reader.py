"""Reading a session file."""

from __future__ import annotations

import hashlib
import tomllib
from pathlib import Path
from typing import Any

from mixpose.errors import SessionError
from mixpose.fit import EstimatorOptions
from mixpose.rigid import TWIST_NAMES
from mixpose.session.features import build_body
from mixpose.session.messages import BadKeyError, one_line, one_of, under
from mixpose.session.motion import read_motion
from mixpose.session.schema import EstimatorTable, SessionTable, StartTable
from mixpose.session.sensor_setups import build_sensors
from mixpose.session.setup import Session, Start
from mixpose.session.text_files import as_text, read_bytes
from mixpose.session.validation import validate


def load_session(path: str | Path) -> Session:
    """Read a session file and the calibration and marker files that it names.

    Recordings are not opened.

    Parameters
    ----------
    path : str or Path
        A TOML file; paths in it are relative to it.

    Returns
    -------
    Session
        Checked through: lengths in the session's unit, rigid motions exactly rigid.

    Raises
    ------
    SessionError
        If a file is missing or anything in it is wrong: one line with the file, the key, what
        was found and what is allowed.
    """
    path = Path(path)
    data: dict[str, Any] = {}
    try:
        content = read_bytes(path)
        data = _parse(as_text(content))
        return _build(path, hashlib.sha256(content).hexdigest(), data)
    except BadKeyError as problem:
        raise SessionError(one_line(path, problem.key, problem.text, data)) from problem
    except RecursionError as error:
        raise SessionError(f"{path}: lists or tables in it are nested too deeply") from error


def _parse(text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BadKeyError(f"not TOML: {error}") from error
    except ValueError as error:  # a number of thousands of digits
        raise BadKeyError(f"not TOML: {error}") from error


def _build(path: Path, sha256: str, data: dict[str, Any]) -> Session:
    table: SessionTable = validate(SessionTable, data)
    with under("object"):
        body = build_body(table.object, path.parent, table.unit)
    with under("start"):
        start = _start(table.start)
    with under("estimator"):
        estimator = _estimator(table.estimator, start)
    return Session(
        path=path,
        sha256=sha256,
        unit=table.unit,
        body=body,
        start=start,
        estimator=estimator,
        sensors=build_sensors(table.sensor, table.extract, path.parent, table.unit),
    )


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


def _estimator(table: EstimatorTable, start: Start | None) -> EstimatorOptions:
    held = [name for name in TWIST_NAMES if name not in table.free]
    if held and start is None:
        raise BadKeyError(
            f"leaves out {one_of(held)}, which are held where [start] has them, and there is no "
            "[start]; add one with the pose they are held at, or leave free out to estimate all",
            "free",
        )
    return EstimatorOptions(
        table.objective, table.free, table.samples, table.seed, table.fuse, table.search
    )
