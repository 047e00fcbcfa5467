"""Which of identical bodies is which.

Nothing in a frame tells identical bodies apart; only where they were before does.  The poses of a
frame are given to them so that all together are most likely by what was predicted.  Where two of
them might as well have changed places, because they met or were lost together, both are in doubt
in that frame, with each other's pose among their hypotheses; afterwards they go on as assigned.

Bodies that nothing was known of before get the poses that are left in the order of the world's
x coordinate (then y, then z) of their origins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment

from mixpose.judgement import ScoredPose
from mixpose.tracking.explain import Explanation

# poses that a body may have instead of its own, with odds; its own, with those that it has none
Rivals: TypeAlias = list[tuple[ScoredPose, float]]


def identify(
    group: Sequence[int], found: Mapping[int, Explanation]
) -> tuple[dict[int, int], dict[int, Rivals]]:
    """Tell which of some identical bodies found the pose of each, and which are in doubt."""
    verdicts = {k: found[k].verdict.best for k in group}
    bests = {k: best for k, best in verdicts.items() if best is not None}
    finders = sorted(bests, key=lambda k: tuple(np.round(bests[k].T_world_object[:3, 3], 6)))
    poses, known = [bests[k] for k in finders], [k for k in group if found[k].frame.predictions]
    data = [found[k].frame for k in known]
    # a body may have none, which says nothing
    likely = np.zeros((len(known), len(poses) + 1))
    for row, one in zip(likely, data, strict=True):
        row[:-1] = [one.prior(pose.T_world_object).log_density for pose in poses]
    rows, columns = linear_sum_assignment(likely[:, :-1], maximize=True)
    has = {known[i]: int(j) for i, j in zip(rows, columns, strict=True)}
    spare = [j for j in range(len(poses)) if j not in has.values()]
    has |= dict(zip([k for k in group if k not in known], spare, strict=False))
    given = {k: finders[j] for k, j in has.items()}
    without = iter([k for k in group if k not in bests])
    assigned = {k: given[k] if k in given else next(without) for k in group}
    # how much likelier two bodies (rows, columns) are with each other's poses
    of = likely[:, [has.get(k, -1) for k in known]]
    odds = of + of.T - of.diagonal() - of.diagonal()[:, None]
    # no velocity is believed any more: they may have changed places, wherever they were before
    lost = np.array([one.track.misses > one.rules.motion.coasting for one in data], np.bool_)
    odds = np.where(lost & lost[:, None], np.maximum(odds, np.log(0.5)), odds)
    rivals: dict[int, Rivals] = {}
    limit = np.log(found[group[0]].frame.rules.acceptance.rival)
    for i, j in zip(*np.nonzero(odds > limit), strict=True):
        if i != j and known[i] in has:
            other = has.get(known[j], has[known[i]])
            share = float(np.exp(min(odds[i, j], 0.0)))
            rivals.setdefault(known[i], []).append((poses[other], share))
    return assigned, rivals
