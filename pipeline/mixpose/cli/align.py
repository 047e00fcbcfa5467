"""``mixpose align``: move a session into a world frame that is given by objects on the floor."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from mixpose import __version__, rigid
from mixpose.calibration.rig import centre_of
from mixpose.cli.app import AlignRequest
from mixpose.cli.notices import say, warn
from mixpose.cli.output import refuse_suffix, refuse_to_overwrite_but, shown, write_text
from mixpose.cli.run import named_sources
from mixpose.errors import RecordingError, SessionError
from mixpose.poses.jsonl import read_poses
from mixpose.records import Estimate, Floats
from mixpose.runner import run
from mixpose.selection import Selection
from mixpose.session import Session, load_session, rewriting
from mixpose.trajectories.floor import Axis, Floor, floor_of

MARK = "# Aligned by mixpose"


def align_session(request: AlignRequest) -> None:
    """Write the session in the frame of the floor."""
    path = request.session
    session = load_session(path, allow_code=request.allow_code)
    rewriting.refuse_held_directions(session)
    rewriting.refuse_lost_code(session, request.output)
    files = [Path(text) for text in request.floor if "@" not in text or Path(text).is_file()]
    refuse_to_overwrite_but(request.output, [path, *files], MARK)
    refuse_suffix(request.output, (".toml",), "it is a session that is written")
    sources = request.source or ()
    estimates = [e for text in request.floor for e in _floor_poses(text, session, sources)]
    floor = floor_of(estimates, request.up, _places(session))
    write_text(request.output, _aligned_text(session, floor, request.output), "-o")
    _report_floor(session, floor, request.up)
    say(f"{session.path.name} in the frame of {floor.defined_by} -> {shown(request.output)}")


def _floor_poses(text: str, session: Session, sources: Sequence[str]) -> list[Estimate]:
    """Return poses that are ok, of a file or of a body in a frame of the recording."""
    if Path(text).is_file():
        poses = read_poses(text)
        poses.require_unit(session.unit, RecordingError, "--floor")
        lines = [line for line in poses.poses if line.status == "ok"]
        if not lines:
            raise RecordingError(f"--floor {text}: found no pose that is ok")
        return list(lines)
    label, separator, frame = text.rpartition("@")
    if not separator or label not in session.labels or not frame.isdecimal():
        raise SessionError(
            f"--floor {text}: no such file; allowed: a file of poses, or OBJECT@FRAME with one of "
            f"{', '.join(session.labels)}"
        )
    number, replaced = int(frame), named_sources(sources)
    selection = Selection(number, number + 1)
    with closing(run(session, sources=replaced, selection=selection)) as estimates:
        of_body = [estimate for estimate in estimates if estimate.label == label]
    if not of_body:
        raise RecordingError(f"--floor {text}: there is no frame {number}; name another one")
    ok = [estimate for estimate in of_body if estimate.status == "ok"]
    if not ok:
        raise RecordingError(f"--floor {text}: {label} is not ok in this frame; name another one")
    return ok


def _places(session: Session) -> Floats:
    return np.stack([centre_of(setup.sensor) for setup in session.sensors])


def _aligned_text(session: Session, floor: Floor, target: Path) -> str:
    document = rewriting.document_of(session, target)
    T_old_new, T_new_old = floor.T_old_new, rigid.inverse(floor.T_old_new)
    for table, setup in zip(document["sensor"], session.sensors, strict=True):
        sensor: Any = setup.sensor.moved(T_old_new)
        if hasattr(sensor, "position"):
            place = rewriting.rounded(sensor.position, rewriting.ALL_DIGITS)
            rewriting.put(table, "position", place)
        else:
            T, digits = sensor.T_sensor_world, rewriting.ALL_DIGITS
            rewriting.put_motion(table, "T_sensor_world", T, digits=digits)
    rewriting.put_starts(document, session, T_new_old)
    rewriting.put_gravity(document, session, T_new_old)
    head = f"{MARK} {__version__} from {session.path.name}, {floor.defined_by}.\n"
    return rewriting.text_of(document, session, head)


def _report_floor(session: Session, floor: Floor, up: Axis) -> None:
    if floor.rms_distance is not None:
        say(f"the points are {floor.rms_distance:.3g} {session.unit} RMS off the floor")
    if floor.tilt_deg:
        say(f"the floor is level to {floor.tilt_deg:.2g} deg, one standard deviation")
    heights = rigid.transform(rigid.inverse(floor.T_old_new), _places(session))
    if heights[:, "xyz".index(up)].mean() < 0:
        warn(
            f"sensors are below the floor: {up} of the body points down; if it lies as it should, "
            "name its axis that points up with --up"
        )
