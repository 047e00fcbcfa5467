"""``mixpose convert`` to markers (.c3d, .trc) and recordings (.rrd), which need the session."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mixpose.body import Body
from mixpose.cli.app import ConvertRequest
from mixpose.cli.notices import counted, say, warn
from mixpose.cli.output import refuse_to_overwrite_but
from mixpose.errors import SessionError, require_package
from mixpose.frames import Source
from mixpose.poses import trajectories
from mixpose.poses.jsonl import PoseFile
from mixpose.poses.poseline import PoseLine
from mixpose.poses.trajectories import Trajectories
from mixpose.rigid import transform
from mixpose.session import Session, load_session
from mixpose.whole_files import appearing_whole

MARKER_FORMATS = ("c3d", "trc")

MOST_PLACES = 50_000_000
"""Limit of places of markers in all frames, which are held in memory with 50 bytes each."""


def write_markers(
    poses: PoseFile,
    lines: Sequence[PoseLine],
    unit: str,
    format_name: str,
    request: ConvertRequest,
) -> None:
    """Write the places of all markers: measured ones, else by the pose; lengths are in `unit`."""
    session = session_of(poses, request.session, allow_code=request.allow_code, unit=unit)
    output, measured = request.output, request.measured
    if format_name == "c3d":
        _require_output(output, "c3d", "c3d", "ezc3d", "; .trc needs none")
    if output is not None:
        begins, mark = trajectories.MARKS[format_name]
        refuse_to_overwrite_but(output, [poses.path, session.path], mark, begins=begins)
    if not any(line.points for line in lines):
        without = f"{poses.path}: no frame has a marker that was measured"
        hint = "run again with --labels, and two sensors or more that see a marker"
        if measured:
            raise SessionError(f"--measured: {without}; {hint}")
        warn(f"{without}; all places are by the pose; {hint}")
    collected = trajectories_of(poses, lines, session, measured=measured, fps=request.fps)
    if output is None:
        trajectories.write_trc(sys.stdout, collected, "markers.trc")
        return
    with appearing_whole(output) as part:
        if format_name == "trc":
            with part.open("w", encoding="utf-8", newline="\n") as stream:
                trajectories.write_trc(stream, collected, output.name)
        elif not trajectories.write_c3d(part, collected):
            warn(f"{output}: frames are numbered from 1, not from {collected.first}")
    frames, markers = collected.is_known.shape
    known, direct = collected.is_known.sum(), collected.is_measured.sum()
    say(
        f"{counted(markers, 'marker')} in {counted(frames, 'frame')}: "
        f"{direct} places measured, {known - direct} by the pose, "
        f"{collected.is_known.size - known} gaps -> {output}"
    )


def trajectories_of(
    poses: PoseFile,
    lines: Sequence[PoseLine],
    session: Session,
    *,
    measured: bool,
    fps: float | None = None,
) -> Trajectories:
    """Collect the places of all markers; `measured` leaves gaps, `fps` replaces the times."""
    bodies = _bodies(poses, lines, session)
    names = [(label, name) for label, body in bodies.items() for name in body.labels]
    columns = {pair: k for k, pair in enumerate(names)}
    numbers = trajectories.numbers_of(poses.poses)
    first, last = min(numbers.values()), max(numbers.values())
    if any(number != frame for frame, number in numbers.items()):
        warn(f"{poses.path}: frames are numbered by stamps; in the file they count from {first}")
    count = last - first + 1
    if count * len(names) > MOST_PLACES:
        raise SessionError(
            f"{poses.path}: {len(names)} markers in frames {first} to {last}, allowed are "
            f"{MOST_PLACES} places; convert one object with --object, or run a part"
        )
    shape = count, len(names)
    places, residuals = np.full((*shape, 3), np.nan), np.full(shape, np.nan)
    sensors = [setup.name for setup in session.sensors]
    by_sensor = np.zeros((*shape, len(sensors)), dtype=np.bool_)
    for line in lines:
        if line.T_world_object is None:
            continue
        row, body = numbers[line.frame] - first, bodies[line.label]
        body_columns = [columns[line.label, name] for name in body.labels]
        if not measured:
            places[row, body_columns] = transform(line.T_world_object, body.means)
        for name, point in line.points.items():
            k = columns.get((line.label, name))
            if k is None:
                raise SessionError(
                    f"{poses.path}: frame {line.frame}: {line.label} has no marker {name!r} in "
                    f"{session.path}; name the session of the poses with --session"
                )
            places[row, k], residuals[row, k] = point.at, point.residual
            by_sensor[row, k] = [
                sensor in line.sensors and name in line.sensors[sensor].labels for sensor in sensors
            ]
    has_several = len(bodies) > 1
    return Trajectories(
        tuple(f"{label}:{name}" if has_several else name for label, name in names),
        places,
        residuals,
        by_sensor,
        first,
        fps or _rate(poses, numbers),
        session.unit,
    )


def _bodies(poses: PoseFile, lines: Sequence[PoseLine], session: Session) -> Mapping[str, Body]:
    """Return the bodies of lines by their labels, in the order of the session."""
    bodies = session.bodies
    labels = {line.label for line in lines}
    for label in labels - bodies.keys():
        raise SessionError(
            f"{poses.path}: has poses of {label}, and {session.path} has {', '.join(bodies)}; "
            "name the session of the poses with --session"
        )
    if not labels:
        raise SessionError(f"{poses.path}: no pose is left to write")
    return {label: body for label, body in bodies.items() if label in labels}


def _rate(poses: PoseFile, numbers: Mapping[int, int]) -> float:
    rate_and_error = trajectories.rate_of(poses.poses, numbers)
    if rate_and_error is None:
        warn(f"{poses.path}: has no times; the rate is told as 1 frame a second; --fps says more")
        return 1.0
    rate, off = rate_and_error
    if off > 0.5:
        warn(
            f"{poses.path}: frames are up to {off:.2g} of a frame's time off an even rate of "
            f"{rate:.6g} a second, which is all that the file can say"
        )
    return rate


def _require_output(output: Path | None, name: str, suffix: str, package: str, more: str) -> Path:
    """Return the output of a binary format; SessionError if it or a package is missing."""
    if output is None:
        raise SessionError(f"--format {name}: needs -o FILE.{suffix}, it is no text")
    require_package(f"--format {name}", package, name, more)
    return output


def write_rerun(poses: PoseFile, lines: Sequence[PoseLine], request: ConvertRequest) -> None:
    """Write poses and the recording of their session as an ``.rrd`` file."""
    output = _require_output(request.output, "rerun", "rrd", "rerun-sdk", "")
    from mixpose.rerun_file import write_rerun_file  # noqa: PLC0415 - only where it is written

    session = session_of(poses, request.session, allow_code=request.allow_code)
    opened = recording_of(poses, session, request.source or ())
    with appearing_whole(output) as part:
        write_rerun_file(part, session, opened, lines)


def recording_of(poses: PoseFile, session: Session, named: Sequence[str]) -> dict[str, Source]:
    """Open the recording of poses: those `named`, else that of their header or of the session."""
    from mixpose.cli.run import named_sources  # noqa: PLC0415 - only where it is read again
    from mixpose.runner import open_sources  # noqa: PLC0415

    sensors = [setup.name for setup in session.sensors]
    recorded = {name: source for name, source in poses.sources.items() if name in sensors}
    opened = open_sources(session, {**recorded, **named_sources(named)})
    for name, source in opened.items():
        if source.kind == "live":
            raise SessionError(
                f"sensor {name!r} is live, so its frames are gone; name a recording of them "
                f"with --source {name}=PATH"
            )
    return opened


def session_of(
    poses: PoseFile, named: Path | None, *, allow_code: bool = False, unit: str | None = None
) -> Session:
    """Load the session of poses: `named`, or of their header; `unit` is of poses without one."""
    path = named
    if path is None:
        stated = poses.header.get("session")
        if not isinstance(stated, str):
            raise SessionError(f"{poses.path}: names no session; add --session SESSION.toml")
        # truth files are in the folder of their session
        places = (Path(stated), poses.path.parent / stated)
        path = next((place for place in places if place.is_file()), None)
        if path is None:
            raise SessionError(
                f"{poses.path}: its session {stated} is not there; add --session SESSION.toml"
            )
    session = load_session(path, allow_code=allow_code)
    unit = poses.unit or unit
    if unit not in (None, session.unit):
        raise SessionError(
            f"--session {path}: lengths in {session.unit}, but those of {poses.path} are in {unit}"
        )
    if poses.header.get("session_sha256") not in (None, session.sha256):
        warn(f"{path} is not as it was when {poses.path} was written")
    return session
