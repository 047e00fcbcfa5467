"""A grid of features, a step aside.

A chessboard of which a rim is hidden, or that has a row less than its session says, explains what
is seen a step off, too.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mixpose.body import Body
from mixpose.judgement import ScoredPose
from mixpose.rigid import from_parts
from mixpose.tracking.likelihood import FrameData, Start

_PASSES = 2  # what has slipped by two steps; and all of them move as the best of them has
ASIDE = "the body explains as much a step of its grid aside"


def stepped_aside(data: FrameData, ranked: list[ScoredPose]) -> Iterable[Start]:
    """The best pose shifted by each step of the body's grid, where about as much is met there.

    All of them move alike.  Where the frame before left open which of them is right, motion does
    not tell: it says less of where a body's origin goes the farther that is from its middle.
    """
    best, steps, rules = None, data.body.grid_steps, data.rules.proposals
    for _ in range(_PASSES if len(steps) else 0):
        if not ranked or ranked[0] is best:
            return
        best = ranked[0]
        met = float(best.matches.met.max())
        if met < 1:
            return
        T, shifts = best.T_world_object, from_parts(np.eye(3), np.vstack([np.zeros(3), steps]))
        poses = T @ shifts
        # the value grows as the square of the features met
        values = np.sqrt(data.finest.shares(poses, whole=True).sum(axis=0))
        for k in np.flatnonzero(values[1:] > (1 - rules.aside / met) * values[0]):
            yield Start(poses[1 + k], data.close, T_moved=data.moves_alike(T))


def is_a_step(body: Body, judged: ScoredPose, other: ScoredPose) -> bool:
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
