"""``mixpose pivot``: find the tip of a tool, and write it into a session."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mixpose.cli.app import PivotRequest
from mixpose.cli.notices import say, warn
from mixpose.cli.output import print_lines, write_text
from mixpose.errors import RecordingError, SessionError
from mixpose.poses.jsonl import PoseFile, read_poses
from mixpose.poses.poseline import PoseLine
from mixpose.session import load_session
from mixpose.session.rewriting import document_of, objects_of, put, rounded, text_of
from mixpose.trajectories.pivot import Pivoting, PivotRules, Tip, find_tip, fixed_in, fixed_in_world
from mixpose.trajectories.track import require_covariances, require_frames_once

_DIGITS = 8
_SLIPPED = 2.0  # times the deviations: a tip that stays gives 1 within a few percent, parts 1.7


def pivot_poses(request: PivotRequest) -> None:
    """Find the tip of a tool, print it, and write it into a session."""
    path = request.poses
    poses = read_poses(path)
    tool = _tool(poses, request)
    try:
        pivoting = _pivoting(poses, tool, request.reference)
        tip = find_tip(pivoting)
    except RecordingError as error:
        raise RecordingError(f"{path}: {tool}: {error}") from error
    unit = poses.unit or "units"
    frames = {line.frame for line in poses.poses if line.label == tool}
    unsure = len(frames) - tip.frames - tip.left_out
    print_lines(_lines(tool, request.reference, tip, unit, unsure))
    _warn(tip)
    if request.into is not None:
        _put_into(request.into, tool, poses, tip)
        say(f"tip of {tool!r} -> {request.into}")


def _tool(poses: PoseFile, request: PivotRequest) -> str:
    labels = list(dict.fromkeys(line.label for line in poses.poses))
    for option, name in (("--object", request.object), ("--reference", request.reference)):
        if name is not None and name not in labels:
            raise SessionError(f"{option} {name}: {poses.path} has {', '.join(labels)}")
    others = [label for label in labels if label != request.reference]
    if request.object is None and len(others) != 1:
        raise SessionError(
            f"--object: found none, and {poses.path} has {', '.join(labels) or 'no poses'}; "
            "allowed: the name of the tool"
        )
    tool = request.object or others[0]
    if tool == request.reference:
        raise SessionError(f"--reference {tool}: is the tool; allowed: another body")
    return tool


def _pivoting(poses: PoseFile, tool: str, reference: str | None) -> Pivoting:
    """Return poses of the tool that are ok, with those of the reference in the same frames."""
    of_tool = _ok_lines(poses, tool)
    of_reference = of_tool if reference is None else _ok_lines(poses, reference)
    frames = [frame for frame in of_tool if frame in of_reference]

    def stacked(lines: Mapping[int, PoseLine]) -> list[np.ndarray]:
        return [
            np.array([getattr(lines[frame], name) for frame in frames], float).reshape(-1, n, n)
            for name, n in (("T_world_object", 4), ("covariance", 6))
        ]

    pivoting = fixed_in_world(*stacked(of_tool))
    return pivoting if reference is None else fixed_in(pivoting, *stacked(of_reference))


def _ok_lines(poses: PoseFile, label: str) -> dict[int, PoseLine]:
    lines = [line for line in poses.poses if line.label == label]
    require_frames_once(sorted(lines, key=lambda line: line.frame))
    ok_lines = [line for line in lines if line.status == "ok"]
    require_covariances(ok_lines)
    return {line.frame: line for line in ok_lines}


def _lines(tool: str, reference: str | None, tip: Tip, unit: str, unsure: int) -> list[str]:
    """Return the lines about a tip; in `unsure` frames not all poses of both bodies are ok."""
    deviations = np.sqrt(tip.covariance.diagonal())
    swings = ", ".join(f"{value:.3g}" for value in tip.turns_deg[::-1])
    where = "the world" if reference is None else reference
    not_ok = f", {unsure} not ok" if unsure else ""
    return [
        f"tip of {tool}: ({_numbers(tip.place, deviations)}) {unit}",
        f"one standard deviation: ({', '.join(f'{d:.2g}' for d in deviations)}) {unit}",
        f"it stays at ({_numbers(tip.pivot, deviations)}) {unit} in {where}",
        f"from it: {tip.residual:.3g} {unit} RMS, {tip.held_out:.3g} in frames held out; "
        f"{tip.expected:.3g} by the covariances of the poses",
        f"{tip.frames} frames, {tip.left_out} left out{not_ok}; directions of the body swing by "
        f"{swings} deg RMS",
    ]


def _numbers(values: np.ndarray, deviations: np.ndarray) -> str:
    """Return values in words, to two digits of their smallest deviation."""
    places = max(0, 1 - int(np.floor(np.log10(max(float(deviations.min()), 1e-9)))))
    return ", ".join(f"{value:.{places}f}" for value in values)


def _warn(tip: Tip) -> None:
    if tip.scale > _SLIPPED**2:
        warn(
            f"the tip is {np.sqrt(tip.scale):.2g} times as far off the point as poses err: it "
            "slipped, or the body bends; the deviations are as much larger"
        )
    if tip.held_out_ratio > _SLIPPED**2:
        warn(
            f"parts of the recording tell tips {np.sqrt(tip.held_out_ratio):.2g} times as far "
            "apart as errors of single frames would: the point moved on, or sensors and body err "
            "alike for long; the deviations allow for it"
        )
    values, vectors = np.linalg.eigh(tip.covariance)
    if values[-1] > PivotRules().uneven ** 2 * values[0]:
        axis = ", ".join(f"{value:.2f}" for value in vectors[:, -1])
        warn(
            f"least known is the tip along ({axis}) of the body, to {np.sqrt(values[-1]):.2g}: "
            "turns that swing this direction are missing"
        )


def _put_into(path: Path, tool: str, poses: PoseFile, tip: Tip) -> None:
    session = load_session(path)
    if poses.unit not in (None, session.unit):
        raise SessionError(
            f"--into {path}: lengths in {session.unit}, but {poses.path} has {poses.unit}"
        )
    document = document_of(session, path)
    names = [setup.body.name for setup in session.objects]
    name = next(line.object for line in poses.poses if line.label == tool)
    if name not in names:
        raise SessionError(f"--into {path}: has {', '.join(names)}, and the poses are of {name}")
    table = list(objects_of(document))[names.index(name)]
    deviations = ", ".join(f"{d:.2g}" for d in np.sqrt(tip.covariance.diagonal()))
    put(table, "tip", rounded(tip.place, _DIGITS), f"one standard deviation: {deviations}")
    write_text(path, text_of(document, session), "--into")
