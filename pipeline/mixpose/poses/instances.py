"""Match identical bodies of the poses with those of the truth, and count their swaps.

Numbers are assigned once for a whole file, so that as many poses as possible are nearest to the
truth with their number.  It is a swap if a body is followed into the place of another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import attrgetter
from typing import TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment

from mixpose import rigid
from mixpose.poses.poseline import PoseLine
from mixpose.records import Floats

_SWAP_RATIO = 0.5  # largest distance to the new body, in that to the old one, for a swap

_Distances: TypeAlias = Mapping[int, tuple[list[int], list[int], Floats]]
"""Numbers of the poses, numbers of the truth and distances between them, by frame."""


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
