"""``mixpose align``: a session in another frame of the world, by what lies on the floor."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from mixpose import __version__, rigid
from mixpose.calibration.rig import centre_of
from mixpose.cli.app_after import AlignRequest
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
    """Write the session in the frame of the floor.

    Raises SessionError if the session or the options are wrong, or directions of the world are
    held in it. Raises RecordingError if the poses tell no floor.
    """
    path = request.session
    session = load_session(path, allow_code=request.allow_code)
    rewriting.refuse_held(session)
    rewriting.refuse_lost_code(session, request.output)
    files = [Path(each) for each in request.floor if "@" not in each or Path(each).is_file()]
    refuse_to_overwrite_but(request.output, [path, *files], MARK)
    refuse_suffix(request.output, "-o", (".toml",), "it is a session that is written")
    sources = request.source or ()
    estimates = [one for each in request.floor for one in _told(each, session, sources)]
    floor = floor_of(estimates, request.up, _places(session))
    write_text(request.output, _aligned_text(session, floor, request.output), "-o")
    _tell(session, floor, request.up)
    say(f"{session.path.name} in the frame of {floor.defined_by} -> {shown(request.output)}")


def _told(words: str, session: Session, sources: Sequence[str]) -> list[Estimate]:
    """Poses that are ok, of a file or of a body in a frame of the recording."""
    if Path(words).is_file():
        poses = read_poses(words)
        poses.require_unit(session.unit, RecordingError, "--floor")
        lines = [line for line in poses.poses if line.status == "ok"]
        if not lines:
            raise RecordingError(f"--floor {words}: found no pose that is ok")
        return list(lines)
    label, at, frame = words.rpartition("@")
    if not at or label not in session.labels or not frame.isdecimal():
        raise SessionError(
            f"--floor {words}: no such file; allowed: a file of poses, or OBJECT@FRAME with one of "
            f"{', '.join(session.labels)}"
        )
    number = int(frame)
    replaced = named_sources(sources)
    with closing(run(session, sources=replaced, selection=Selection(number, number + 1))) as found:
        told = [one for one in found if one.label == label]
    if not told:
        raise RecordingError(f"--floor {words}: there is no frame {number}; name another one")
    ok = [one for one in told if one.status == "ok"]
    if not ok:
        raise RecordingError(f"--floor {words}: {label} is not ok in this frame; name another one")
    return ok


def _places(session: Session) -> Floats:
    """Where sensors are; parallel beams, which come from everywhere, as their frames."""
    return np.stack([centre_of(setup.sensor) for setup in session.sensors])


def _aligned_text(session: Session, floor: Floor, target: Path) -> str:
    document = rewriting.document_of(session, target)
    T_old_new, T_new_old = floor.T_old_new, rigid.inverse(floor.T_old_new)
    for table, setup in zip(document["sensor"], session.sensors, strict=True):
        sensor: Any = setup.sensor.moved(T_old_new)
        if hasattr(sensor, "position"):
            place = rewriting.plain(sensor.position, rewriting.ALL_DIGITS)
            rewriting.put(table, "position", place)
        else:
            T, digits = sensor.T_sensor_world, rewriting.ALL_DIGITS
            rewriting.put_motion(table, "T_sensor_world", T, digits=digits)
    rewriting.put_starts(document, session, T_new_old)
    rewriting.put_gravity(document, session, T_new_old)
    head = f"{MARK} {__version__} from {session.path.name}, {floor.defined_by}.\n"
    return rewriting.text_of(document, session, head)


def _tell(session: Session, floor: Floor, up: Axis) -> None:
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
