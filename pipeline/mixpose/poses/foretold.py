"""Where a body truly is at the moments that poses were foretold for.

A pose that ``mixpose run --publish --predict`` sent bears the number of the frame that it was
foretold from, and says how much later it is for, ``ahead_s``. It is held against the truth of then:
between frames the body moves on cubic splines, of position and of rotation.
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

_GAP = 2.5  # intervals of frames that a body is followed through: one frame may be missing


def truth_of_then(truth: PoseFile, poses: PoseFile) -> PoseFile:
    """The truth with each body where it is at the moment that the poses of a frame are for.

    Where that is between frames too far apart, or after the last one, the line says that it is
    lost. Raises RecordingError if the truth has no times, or several right answers for a frame.
    """
    ahead_s = {line.frame: line.ahead_s for line in poses.poses if line.ahead_s}
    if not ahead_s:
        return truth
    posed = (line for line in truth.poses if line.T_world_object is not None)
    moved: dict[int, PoseLine] = {}
    for _, each in groupby(sorted(posed, key=attrgetter("label", "frame")), attrgetter("label")):
        lines = list(each)
        moved |= _moved(lines, _times(truth, lines), ahead_s)
    return replace(truth, poses=tuple(moved.get(id(line), line) for line in truth.poses))


def _times(truth: PoseFile, lines: Sequence[PoseLine]) -> Floats:
    """When lines of a body are of, one later than the other: else nobody knows what is between."""
    told = "; poses that were foretold (ahead_s) are held against the truth between its frames"
    for line in lines:
        if line.time_s is None:
            raise RecordingError(f"{truth.path}:{line.line}: time_s is missing{told}")
    times = np.array([line.time_s for line in lines], dtype=np.float64)
    for (before, line), step in zip(pairwise(lines), np.diff(times), strict=True):
        if before.frame == line.frame or step <= 0:
            raise RecordingError(
                f"{truth.path}:{line.line}: frame {line.frame} of {line.label!r} is not later than "
                f"line {before.line}{told}"
            )
    return times


def _moved(
    lines: Sequence[PoseLine], times: Floats, ahead_s: Mapping[int, float]
) -> dict[int, PoseLine]:
    """Lines of a body at later moments, by the `id` of what they stand for."""
    ahead = np.array([ahead_s.get(line.frame, 0.0) for line in lines])
    wanted = times + ahead
    poses = np.stack([line.T_world_object for line in lines if line.T_world_object is not None])
    found = np.full_like(poses, np.nan)
    steps = np.diff(times)
    usual = float(np.median(steps)) if len(steps) else 0.0
    for run in np.split(np.arange(len(lines)), np.flatnonzero(steps > _GAP * usual) + 1):
        within = (wanted >= times[run[0]]) & (wanted <= times[run[-1]])
        if len(run) > 1 and within.any():
            found[within] = _between(times[run], poses[run], wanted[within])
    return {
        id(line): replace(line, T_world_object=T)
        if np.isfinite(T).all()
        else replace(line, T_world_object=None, status="lost")
        for line, T, later in zip(lines, found, ahead, strict=True)
        if later
    }


def _between(times: Floats, poses: Floats, wanted: Floats) -> Floats:
    rotations = RotationSpline(times, Rotation.from_matrix(poses[:, :3, :3]))(wanted)
    places = CubicSpline(times, poses[:, :3, 3])(wanted)
    return np.stack([from_parts(R, t) for R, t in zip(rotations.as_matrix(), places, strict=True)])
