"""Bring truth and poses together: truth at the times of predicted poses, numbers of bodies.

A pose sent by ``mixpose run --publish --predict`` has the number of the frame from which it was
predicted, and states in ``ahead_s`` how much later it holds. It is compared with the truth at that
time: between frames, position and rotation follow cubic splines.

Identical bodies of the poses get the numbers of the truth once for a whole file, so that as many
poses as possible are nearest to the truth with their number.  It is a swap if a body is followed
into the place of another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from operator import attrgetter
from typing import TypeAlias

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation, RotationSpline

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.jsonl import PoseFile
from mixpose.poses.poseline import PoseLine
from mixpose.records import Floats

_GAP = 2.5  # frame intervals over which splines go on: one frame may be missing
_SWAP_RATIO = 0.5  # largest distance to the new body, in that to the old one, for a swap

_Distances: TypeAlias = Mapping[int, tuple[list[int], list[int], Floats]]
"""Numbers of the poses, numbers of the truth and distances between them, by frame."""


def truth_ahead(truth: PoseFile, poses: PoseFile) -> PoseFile:
    """Return the truth with each line moved to the time for which poses of its frame hold.

    Lines are lost if that time lies between frames too far apart, or after the last one. Raises
    RecordingError if the truth has no times, or several right answers for a frame.
    """
    ahead_s = {line.frame: line.ahead_s for line in poses.poses if line.ahead_s}
    if not ahead_s:
        return truth
    posed = (line for line in truth.poses if line.T_world_object is not None)
    moved: dict[int, PoseLine] = {}
    for _, group in groupby(sorted(posed, key=attrgetter("label", "frame")), attrgetter("label")):
        body_lines = list(group)
        moved |= _moved(body_lines, _times(truth, body_lines), ahead_s)
    return replace(truth, poses=tuple(moved.get(id(line), line) for line in truth.poses))


def _times(truth: PoseFile, lines: Sequence[PoseLine]) -> Floats:
    """Return the times of a body's lines, which have to ascend to be interpolated."""
    rule = "; poses that were foretold (ahead_s) are held against the truth between its frames"
    for line in lines:
        if line.time_s is None:
            raise RecordingError(f"{truth.path}:{line.line}: time_s is missing{rule}")
    times = np.array([line.time_s for line in lines], dtype=np.float64)
    for (before, line), step in zip(pairwise(lines), np.diff(times), strict=True):
        if before.frame == line.frame or step <= 0:
            raise RecordingError(
                f"{truth.path}:{line.line}: frame {line.frame} of {line.label!r} is not later than "
                f"line {before.line}{rule}"
            )
    return times


def _moved(
    lines: Sequence[PoseLine], times: Floats, ahead_s: Mapping[int, float]
) -> dict[int, PoseLine]:
    """Return the lines of a body moved to later times, by the `id` of the line replaced."""
    ahead = np.array([ahead_s.get(line.frame, 0.0) for line in lines])
    wanted = times + ahead
    poses = np.stack([line.T_world_object for line in lines if line.T_world_object is not None])
    moved = np.full_like(poses, np.nan)
    steps = np.diff(times)
    usual = float(np.median(steps)) if len(steps) else 0.0
    for run in np.split(np.arange(len(lines)), np.flatnonzero(steps > _GAP * usual) + 1):
        within = (wanted >= times[run[0]]) & (wanted <= times[run[-1]])
        if len(run) > 1 and within.any():
            moved[within] = _between(times[run], poses[run], wanted[within])
    return {
        id(line): replace(line, T_world_object=T)
        if np.isfinite(T).all()
        else replace(line, T_world_object=None, status="lost")
        for line, T, later in zip(lines, moved, ahead, strict=True)
        if later
    }


def _between(times: Floats, poses: Floats, wanted: Floats) -> Floats:
    rotations = RotationSpline(times, Rotation.from_matrix(poses[:, :3, :3]))(wanted)
    origins = CubicSpline(times, poses[:, :3, 3])(wanted)
    return np.stack(
        [rigid.from_parts(R, t) for R, t in zip(rotations.as_matrix(), origins, strict=True)]
    )


@dataclass(frozen=True)
class Swaps:
    """How often identical bodies changed places."""

    count: int = 0  # of changes to the place of another body of the truth
    announced: int = 0  # of these, of bodies not ok then, or since they last were in their place


def renumbered(
    poses: Sequence[PoseLine], truth: Sequence[PoseLine], symmetries: Mapping[str, Floats]
) -> tuple[tuple[PoseLine, ...], Swaps]:
    """Number identical bodies as in the truth, and count swaps; symmetries (n, 4, 4) by name."""
    swaps, numbers = Swaps(), dict[tuple[str, int | None], int | None]()
    for name in dict.fromkeys(line.object for line in truth if line.instance is not None):
        true_lines = [line for line in truth if line.object == name]
        numbered = [line for line in poses if line.object == name and line.instance is not None]
        frames = _distances_by_frame(numbered, true_lines, symmetries.get(name))
        for number, true_number in _assigned_numbers(numbered, true_lines, frames).items():
            numbers[name, number] = true_number
        of_name = _counted_swaps(numbered, frames)
        swaps = Swaps(swaps.count + of_name.count, swaps.announced + of_name.announced)
    lines = tuple(
        replace(line, instance=numbers.get((line.object, line.instance), line.instance))
        for line in poses
    )
    return lines, swaps


def _distances_by_frame(
    poses: Sequence[PoseLine], truth: Sequence[PoseLine], symmetries: Floats | None
) -> _Distances:
    truths = _by_frame(truth)
    paired = {}
    for frame, lines in _by_frame(poses).items():
        rows = [line for line in lines if line.T_world_object is not None]
        columns = [b for b in truths.get(frame, []) if b.T_world_object is not None]
        if not rows or not columns:
            continue
        costs = np.array([[_distance(a, b, symmetries) for b in columns] for a in rows])
        paired[frame] = ([a.instance or 0 for a in rows], [b.instance or 0 for b in columns], costs)
    return paired


def _distance(a: PoseLine, b: PoseLine, symmetries: Floats | None) -> float:
    """Return the distance of the origins of two poses, at the symmetry nearest in rotation."""
    assert a.T_world_object is not None
    assert b.T_world_object is not None
    alike = b.T_world_object[None] if symmetries is None else b.T_world_object @ symmetries
    twists = rigid.twist_between(alike, a.T_world_object[None])
    nearest = int(np.argmin(np.linalg.norm(twists[:, 3:], axis=1)))
    return float(np.linalg.norm(twists[nearest, :3]))


def _by_frame(lines: Sequence[PoseLine]) -> dict[int, list[PoseLine]]:
    frame_of = attrgetter("frame")
    return {frame: list(group) for frame, group in groupby(sorted(lines, key=frame_of), frame_of)}


def _assigned_numbers(
    poses: Sequence[PoseLine], truth: Sequence[PoseLine], frames: _Distances
) -> dict[int, int]:
    """Return the numbers of the truth by numbers of the poses."""
    pose_numbers = sorted({line.instance or 0 for line in poses})
    true_numbers = sorted({line.instance or 0 for line in truth})
    counts = np.zeros((len(pose_numbers), len(true_numbers)))
    for rows, columns, distances in frames.values():
        for i, j in zip(*linear_sum_assignment(distances), strict=True):
            counts[pose_numbers.index(rows[i]), true_numbers.index(columns[j])] += 1
    assigned = linear_sum_assignment(counts, maximize=True)
    numbers = {pose_numbers[i]: true_numbers[j] for i, j in zip(*assigned, strict=True)}
    # bodies in excess get numbers that the truth does not have
    unused = iter(range(max([*true_numbers, *pose_numbers], default=0) + 1, 10**9))
    return {n: numbers[n] if n in numbers else next(unused) for n in pose_numbers}


def _counted_swaps(poses: Sequence[PoseLine], frames: _Distances) -> Swaps:
    status = {(line.frame, line.instance or 0): line.status for line in poses}
    followed: dict[int, int] = {}
    is_doubted: dict[int, bool] = {}
    count = announced = 0
    for frame in sorted({line.frame for line in poses}):
        for number in {line.instance or 0 for line in poses}:
            if status.get((frame, number), "lost") != "ok":
                is_doubted[number] = True
        if frame not in frames:
            continue
        rows, columns, distances = frames[frame]
        for i, j in zip(*linear_sum_assignment(distances), strict=True):
            number, true_number = rows[i], columns[j]
            before = followed.get(number)
            if before is not None and before != true_number and before in columns:
                if distances[i, j] > _SWAP_RATIO * distances[i, columns.index(before)]:
                    continue  # near neither body: a wrong pose, and no swap
                count += 1
                announced += is_doubted.get(number, False)
            followed[number] = true_number
            is_doubted[number] = status[frame, number] != "ok"
    return Swaps(count, announced)
