"""Interpolate the truth at the times of predicted poses.

A pose sent by ``mixpose run --publish --predict`` has the number of the frame from which it was
predicted, and states in ``ahead_s`` how much later it holds. It is compared with the truth at that
time: between frames, position and rotation follow cubic splines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby, pairwise
from operator import attrgetter

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from mixpose.errors import RecordingError
from mixpose.poses.jsonl import PoseFile
from mixpose.poses.poseline import PoseLine
from mixpose.records import Floats
from mixpose.rigid import from_parts

_GAP = 2.5  # frame intervals over which splines go on: one frame may be missing


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
    return np.stack([from_parts(R, t) for R, t in zip(rotations.as_matrix(), origins, strict=True)])
