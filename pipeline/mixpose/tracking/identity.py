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

import numpy as np
from scipy.optimize import linear_sum_assignment

from mixpose.records import Floats
from mixpose.tracking.explain import Explanation
from mixpose.tracking.likelihood import FrameData

Rivals = dict[int, list[tuple[int, float]]]


def identify(
    group: Sequence[int], found: Mapping[int, Explanation]
) -> tuple[dict[int, int], Rivals]:
    """Tell which of some identical bodies has which pose.

    Returns the member that found what each member gets; and of members in doubt those whose poses
    they may have instead, with odds: their own, where they may have none.
    """
    bests = {k: found[k].verdict.best for k in group}
    poses = {k: best.T_world_object for k, best in bests.items() if best is not None}
    finders = sorted(poses, key=lambda k: tuple(np.round(poses[k][:3, 3], 6)))
    known = [k for k in group if found[k].frame.predictions]
    if not finders:
        return {k: k for k in group}, {}
    likely = np.array([_log_densities(found[k].frame, [poses[j] for j in finders]) for k in known])
    has: dict[int, int] = {}  # number of the pose of a member, among those found
    if known:
        rows, columns = linear_sum_assignment(likely, maximize=True)
        has = {known[i]: int(j) for i, j in zip(rows, columns, strict=True)}
    spare = [j for j in range(len(finders)) if j not in has.values()]
    has |= dict(zip([k for k in group if k not in known], spare, strict=False))
    given = {k: finders[j] for k, j in has.items()}
    without = iter([k for k in group if k not in given.values()])
    assigned = {k: given[k] if k in given else next(without) for k in group}
    return assigned, _exchanges(known, has, finders, likely, found) if known else {}


def _exchanges(
    known: Sequence[int],
    has: Mapping[int, int],
    finders: Sequence[int],
    likely: Floats,
    found: Mapping[int, Explanation],
) -> Rivals:
    """Members whose poses might be each other's; one without a pose might have any other's."""
    rules = found[known[0]].frame.rules
    # a member without a pose has one that says nothing
    columns = [has.get(k, len(finders)) for k in known]
    of = np.pad(likely, ((0, 0), (0, 1)))[:, columns]
    odds = of + of.T - of.diagonal() - of.diagonal()[:, None]
    # no velocity is believed any more: they may have changed places, wherever they were before
    lost = np.array([found[k].frame.track.misses > rules.motion.coasting for k in known])
    odds = np.where(lost & lost[:, None], np.maximum(odds, np.log(0.5)), odds)
    exchanged: Rivals = {}
    for i, j in zip(*np.nonzero(odds > np.log(rules.acceptance.rival)), strict=True):
        a, b = known[i], known[j]
        if a != b and a in has:
            share = float(np.exp(min(odds[i, j], 0.0)))
            exchanged.setdefault(a, []).append((finders[has[b if b in has else a]], share))
    return exchanged


def _log_densities(data: FrameData, poses: Sequence[Floats]) -> list[float]:
    """Log density of poses for a body that was known, where it counts.

    It is not worked out where the pose is more than ten standard deviations from all that was
    predicted: there it is that of a surprise.
    """
    chance = min(data.rules.motion.surprise * (1 + data.track.misses), 1.0)
    surprise = float(np.log(chance)) + data.anywhere.log_density

    def is_near(T: Floats) -> bool:
        return any(
            (
                np.abs(T - one.T_world_object)[:3, 3] < 10 * np.maximum(one.uncertainty[:3], 1e-12)
            ).all()
            for one in data.predictions
        )

    return [data.prior(T).log_density if is_near(T) else surprise for T in poses]
