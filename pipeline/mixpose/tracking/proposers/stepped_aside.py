"""A grid of features, a step aside.

A chessboard of which a rim is hidden, or that has a row less than its session says, explains what
is seen a step off, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from mixpose.body import Body
from mixpose.judgement import Judged
from mixpose.tracking.likelihood import FrameData, Start

_PASSES = 2  # what has slipped by two steps; and all of them move as the best of them has
ASIDE = "the body explains as much a step of its grid aside"


def stepped_aside(data: FrameData, ranked: list[Judged]) -> Iterable[Start]:
    """The best pose shifted by each step of the body's grid, where about as much is met there.

    All of them move alike.  Where the frame before left open which of them is right, motion does
    not tell: it says less of where a body's origin goes the farther that is from its middle.
    """
    best = None
    for _ in range(_PASSES if len(data.body.grid_steps) else 0):
        if not ranked or ranked[0] is best:
            break
        best = ranked[0]
        yield from _aside(data, best)


def _aside(data: FrameData, judged: Judged) -> Iterator[Start]:
    """One pose shifted by the steps of the body's grid, where that is worth a fit."""
    met = max((float(one.shares.sum()) for one in judged.associations), default=0.0)
    if met < 1:
        return
    T, steps = judged.T_world_object, data.body.grid_steps
    shifts = np.tile(np.eye(4), (1 + len(steps), 1, 1))
    shifts[1:, :3, 3] = steps
    poses = T @ shifts
    # the value grows as the square of the features met
    values = np.sqrt(data.finest.shares(poses, whole=True).sum(axis=0))
    close = data.start_uncertainty / data.rules.proposals.narrowing**2
    for k in np.flatnonzero(values[1:] > (1 - data.rules.proposals.aside / met) * values[0]):
        yield Start(poses[1 + k], close, T_moved=data.moves_alike(T))


def is_a_step(body: Body, judged: Judged, other: Judged) -> bool:
    """Whether one pose is another shifted by a step of the body's grid, within a tenth of it."""
    steps = body.grid_steps
    if not len(steps):
        return False
    T = np.linalg.solve(judged.T_world_object, other.T_world_object)
    alike = T @ body.symmetries
    k = int(np.trace(alike[:, :3, :3], axis1=1, axis2=2).argmax())
    off = alike[k, :3, :3] @ body.means.T + alike[k, :3, 3:] - body.means.T
    away = np.abs(off.T[None] - steps[:, None]).max(axis=(1, 2))
    return bool((away < 0.1 * np.linalg.norm(steps, axis=1)).any())
