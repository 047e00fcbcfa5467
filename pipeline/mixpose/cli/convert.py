"""``mixpose convert``: write pose lines in the formats of other programs."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from mixpose import __version__
from mixpose.cli.app import ConvertRequest
from mixpose.cli.notices import counted, say, warn
from mixpose.cli.output import Output, refuse_to_overwrite, written_paths
from mixpose.cli.request import SUFFIXES, by_suffix, output_of
from mixpose.cli.session_formats import MARKER_FORMATS, session_of, write_markers, write_rerun
from mixpose.errors import SessionError
from mixpose.poses import estimates
from mixpose.poses.jsonl import PoseFile, read_poses
from mixpose.poses.poseline import PoseLine
from mixpose.poses.writers import ONE_TRAJECTORY
from mixpose.records import Floats
from mixpose.sensors import RangeSensor
from mixpose.units import UNITS_PER_METRE

_BY_SUFFIX = {**SUFFIXES, ".rrd": "rerun", ".c3d": "c3d", ".trc": "trc"}


def convert_poses(request: ConvertRequest) -> None:
    """Write the poses of a file in another format."""
    request = replace(request, output=output_of(request.output))
    path, name = request.poses, _format(request)
    _refuse_options_of_other_formats(name, request)
    poses = read_poses(path)
    T_sensor_world = np.eye(4)
    if request.relative_to in {line.label for line in poses.poses}:
        _refuse_of_other_references(name, request)
        poses = _relative_to_body(poses, request.relative_to)
    elif request.relative_to is not None:
        T_sensor_world = _T_sensor_world(poses, request.relative_to, request)
    lines = _selected(poses, name, request)
    if request.only_ok and not lines:
        warn(f"{path}: no pose is ok, and --only-ok leaves out the others; nothing is left")
    labels = tuple(dict.fromkeys(line.label for line in lines))
    outputs = written_paths(request.output, name, labels)
    for target in outputs if name not in MARKER_FORMATS else ():
        if target.is_file() | (not target.exists()):
            refuse_to_overwrite(target, [path])
    if name == "rerun":
        write_rerun(poses, lines, request)
    elif name in MARKER_FORMATS:
        write_markers(poses, lines, _unit(poses, request), name, request)
        return
    else:
        frame_id = request.relative_to if name == "ros" else None
        values = {"scene_id": request.scene_id, "obj_id": request.obj_id, "frame_id": frame_id}
        options = {key: value for key, value in values.items() if value is not None}
        header = estimates.header_of(poses, _unit(poses, request), __version__)
        if name != "bop" or (request.object is not None and request.obj_id is not None):
            header = replace(header, objects=estimates.objects_of(lines))
        with Output(request.output, name, header, labels, options=options, whole=True) as output:
            for line in lines:
                output.write(estimates.relative_to(T_sensor_world, line))
    if request.output is not None:
        # other formats have no place for frames without a pose
        posed = sum(line.T_world_object is not None for line in lines)
        count = len(lines) if name in ("jsonl", "csv", "rerun") else posed
        say(f"{counted(count, 'pose')} -> {', '.join(map(str, outputs))}")


def _refuse_of_other_references(name: str, request: ConvertRequest) -> None:
    if name == "bop":
        raise SessionError(
            f"--relative-to {request.relative_to}: is a body, and --format bop holds poses "
            "relative to a camera; choose csv, ros or tum"
        )
    if request.relative_to == request.object:
        raise SessionError(f"--object {request.object}: is what poses are told relative to")
    if request.session is not None:
        raise SessionError("--session: found beside a body at --relative-to, which needs none")


def _relative_to_body(poses: PoseFile, reference: str) -> PoseFile:
    """Return the poses of the other bodies of a file in the axes of a reference body."""
    lines = [line for line in poses.poses if line.label == reference]
    by_frame = {line.frame: line for line in estimates.first_answers(lines)}
    if len(by_frame) < len(lines):
        warn(f"{poses.path}: several right answers for {reference!r}; the first is taken")
    others = [line for line in poses.poses if line.label != reference]
    if not others:
        raise SessionError(f"--relative-to {reference}: {poses.path} has poses of no other body")
    relative = tuple(estimates.relative_to_body(line, by_frame.get(line.frame)) for line in others)
    lost = sum(
        before.status != "lost" and after.status == "lost"
        for before, after in zip(others, relative, strict=True)
    )
    if lost:
        warn(
            f"{poses.path}: {lost} of {len(others)} poses are lost, as {reference!r} has none then"
        )
    return replace(poses, poses=relative)


def _T_sensor_world(poses: PoseFile, name: str, request: ConvertRequest) -> Floats:
    """Return T_sensor_world (4, 4) of a camera of the poses' session."""
    bodies = ", ".join(dict.fromkeys(line.label for line in poses.poses))
    try:
        session = session_of(poses, request.session, unit=request.unit)
    except SessionError as error:
        raise SessionError(f"--relative-to {name}: no body, which are {bodies}; {error}") from error
    cameras = {s.name: s.sensor for s in session.sensors if not isinstance(s.sensor, RangeSensor)}
    if name in cameras:
        return np.asarray(cameras[name].T_sensor_world)  # type: ignore[attr-defined]
    allowed = f"cameras are {', '.join(cameras)}" if cameras else "the session has no camera"
    raise SessionError(
        f"--relative-to {name}: no such camera or body; {allowed}, bodies are {bodies}"
    )


def _format(request: ConvertRequest) -> str:
    name, suffixes = request.format or by_suffix(request.output, _BY_SUFFIX), ", ".join(_BY_SUFFIX)
    if name is None and request.output is None:
        raise SessionError(
            "--format: missing, where there is no -o whose suffix tells the format; add "
            f"--format csv, or -o with a name that ends in {suffixes}"
        )
    if name is None:
        raise SessionError(
            f"-o {request.output}: no format has this suffix; add --format, or choose a name that "
            f"ends in {suffixes}"
        )
    return name


def _refuse_options_of_other_formats(name: str, request: ConvertRequest) -> None:
    options = {
        "--scene-id": (request.scene_id, ("bop",)),
        "--obj-id": (request.obj_id, ("bop",)),
        "--relative-to": (request.relative_to, ("bop", "csv", "ros", "tum")),
        "--source": (request.source, ("rerun",)),
        "--measured": (request.measured or None, MARKER_FORMATS),
        "--fps": (request.fps, MARKER_FORMATS),
    }
    for option, (value, owners) in options.items():
        if value is not None and name not in owners:
            raise SessionError(
                f"{option}: belongs to --format {' or '.join(owners)}, found --format {name}"
            )
    with_session = ("rerun", *MARKER_FORMATS)
    if request.session is not None and name not in with_session and request.relative_to is None:
        raise SessionError(
            f"--session: belongs to --format {', '.join(with_session)} and to --relative-to"
        )


def _unit(poses: PoseFile, request: ConvertRequest) -> str:
    allowed = ", ".join(UNITS_PER_METRE)
    if request.unit is not None and request.unit not in UNITS_PER_METRE:
        raise SessionError(f"--unit {request.unit}: allowed are {allowed}")
    unit = poses.unit or request.unit
    if unit is None:
        raise SessionError(
            f"{poses.path}: no header says the unit of its lengths; add --unit, one of {allowed}"
        )
    if request.unit not in (None, unit):
        raise SessionError(f"--unit {request.unit}: {poses.path} says that its unit is {unit}")
    return unit


def _selected(poses: PoseFile, name: str, request: ConvertRequest) -> list[PoseLine]:
    """Return the lines to write, in the order of the file."""
    bodies = list(dict.fromkeys(line.label for line in poses.poses))
    objects = {*bodies, *(line.object for line in poses.poses)}
    if request.object is not None and request.object not in objects:
        raise SessionError(f"--object {request.object}: {poses.path} has {', '.join(bodies)}")
    lines = [
        line
        for line in poses.poses
        if request.object in (None, line.object, line.label)
        and (line.status == "ok" or not request.only_ok)
    ]
    chosen = {line.label for line in lines}
    if name in ONE_TRAJECTORY and request.output is None and len(chosen) > 1:
        raise SessionError(
            f"{poses.path}: holds {', '.join(bodies)}, and format {name!r} holds one object; "
            "choose with --object, or name a file with -o: each gets one of its own"
        )
    if name == "jsonl":
        return lines
    answers = Counter((line.frame, line.label) for line in lines)
    repeated = sum(count > 1 for count in answers.values())
    if repeated:
        frames = counted(repeated, "frame")
        warn(f"{poses.path}: several right answers in {frames}; the first is written")
    return estimates.first_answers(lines)
