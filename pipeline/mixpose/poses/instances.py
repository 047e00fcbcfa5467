"""Which of identical bodies in the poses is which in the truth, and how often they change places.

Numbers are assigned once for a whole file, so that as many poses as possible are nearest to the
truth of theirs.  Where a body is followed into another's place, that is a swap.
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

_CLEARLY = 0.5  # of the distance to the body before: nearer to another by so much is a swap

_Paired: TypeAlias = Mapping[int, tuple[list[int], list[int], Floats]]
"""By frame: numbers of the poses, numbers of the truth, and distances between them."""


@dataclass(frozen=True)
class Swaps:
    """How often identical bodies changed places."""

    count: int = 0  # bodies that are followed where another one of the truth is, at each change
    announced: int = 0  # of these, of bodies not ok then, or since they last were where they belong


def renumbered(
    poses: Sequence[PoseLine], truth: Sequence[PoseLine], symmetries: Mapping[str, Floats]
) -> tuple[tuple[PoseLine, ...], Swaps]:
    """Poses whose identical bodies have the numbers of the truth, and how often they swap.

    Poses and truth are in one unit; symmetries (n, 4, 4) are by the name of the object.
    """
    swaps, numbers = Swaps(), dict[tuple[str, int | None], int | None]()
    for name in dict.fromkeys(line.object for line in truth if line.instance is not None):
        right = [line for line in truth if line.object == name]
        found = [line for line in poses if line.object == name and line.instance is not None]
        frames = _paired(found, right, symmetries.get(name))
        for mine, theirs in _assigned(found, right, frames).items():
            numbers[name, mine] = theirs
        more = _swaps(found, frames)
        swaps = Swaps(swaps.count + more.count, swaps.announced + more.announced)
    lines = tuple(
        replace(line, instance=numbers.get((line.object, line.instance), line.instance))
        for line in poses
    )
    return lines, swaps


def _paired(
    found: Sequence[PoseLine], right: Sequence[PoseLine], symmetries: Floats | None
) -> _Paired:
    truths = _by_frame(right)
    paired = {}
    for frame, lines in _by_frame(found).items():
        rows = [line for line in lines if line.T_world_object is not None]
        columns = [one for one in truths.get(frame, []) if one.T_world_object is not None]
        if not rows or not columns:
            continue
        away = np.array([[_distance(a, b, symmetries) for b in columns] for a in rows])
        paired[frame] = ([a.instance or 0 for a in rows], [b.instance or 0 for b in columns], away)
    return paired


def _distance(a: PoseLine, b: PoseLine, symmetries: Floats | None) -> float:
    """How far apart the origins of two poses are, for the way of turning that is nearest."""
    assert a.T_world_object is not None
    assert b.T_world_object is not None
    alike = b.T_world_object[None] if symmetries is None else b.T_world_object @ symmetries
    twists = rigid.twist_between(alike, a.T_world_object[None])
    nearest = int(np.argmin(np.linalg.norm(twists[:, 3:], axis=1)))
    return float(np.linalg.norm(twists[nearest, :3]))


def _by_frame(lines: Sequence[PoseLine]) -> dict[int, list[PoseLine]]:
    frame_of = attrgetter("frame")
    return {frame: list(some) for frame, some in groupby(sorted(lines, key=frame_of), frame_of)}


def _assigned(
    found: Sequence[PoseLine], right: Sequence[PoseLine], frames: _Paired
) -> dict[int, int]:
    """The number of the truth that each number of the poses stands for."""
    mine = sorted({line.instance or 0 for line in found})
    theirs = sorted({line.instance or 0 for line in right})
    nearest = np.zeros((len(mine), len(theirs)))
    for rows, columns, away in frames.values():
        for i, j in zip(*linear_sum_assignment(away), strict=True):
            nearest[mine.index(rows[i]), theirs.index(columns[j])] += 1
    assigned = linear_sum_assignment(nearest, maximize=True)
    numbers = {mine[i]: theirs[j] for i, j in zip(*assigned, strict=True)}
    # more bodies than the truth has keep numbers that it does not know
    spare = iter(range(max([*theirs, *mine], default=0) + 1, 10**9))
    return {number: numbers[number] if number in numbers else next(spare) for number in mine}


def _swaps(found: Sequence[PoseLine], frames: _Paired) -> Swaps:
    status = {(line.frame, line.instance or 0): line.status for line in found}
    holds: dict[int, int] = {}
    doubted: dict[int, bool] = {}
    count = announced = 0
    for frame in sorted({line.frame for line in found}):
        for number in {line.instance or 0 for line in found}:
            if status.get((frame, number), "lost") != "ok":
                doubted[number] = True
        if frame not in frames:
            continue
        rows, columns, away = frames[frame]
        for i, j in zip(*linear_sum_assignment(away), strict=True):
            number, now = rows[i], columns[j]
            before = holds.get(number)
            if before is not None and before != now and before in columns:
                if away[i, j] > _CLEARLY * away[i, columns.index(before)]:
                    continue  # near neither: a wrong pose, and no swap
                count += 1
                announced += doubted.get(number, False)
            holds[number] = now
            doubted[number] = status[frame, number] != "ok"
    return Swaps(count, announced)
