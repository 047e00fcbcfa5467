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
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from mixpose.records import Floats
from mixpose.tracking.explain import Explanation
from mixpose.tracking.frame import Frame

_EVEN = float(np.log(0.5))  # odds of an exchange where nobody knows, against the likelier way


@dataclass(frozen=True)
class Identities:
    """The outcome for one group of identical bodies.

    Attributes
    ----------
    poses : mapping of int to int
        The member that found the pose that each member gets; none for those without a pose.
    exchanged : mapping of int to sequence of (int, float)
        By member in doubt: members whose poses it may have instead, and the odds of each.
    """

    poses: Mapping[int, int]
    exchanged: Mapping[int, Sequence[tuple[int, float]]]


def identify(group: Sequence[int], explained: Mapping[int, Explanation]) -> Identities:
    """Tell which of some identical bodies has which pose.

    Where two were lost together for so long that no velocity is believed any more, they may have
    changed places, wherever they were before.
    """
    data = {k: explained[k].frame for k in group}
    bests = {k: explained[k].verdict.best for k in group}
    found = {k: best.T_world_object for k, best in bests.items() if best is not None}
    rules = explained[group[0]].tracked.rules
    known = [k for k in group if data[k].predictions]
    finders = sorted(found, key=lambda k: tuple(np.round(found[k][:3, 3], 6)))
    if not finders:
        return Identities({}, {})
    likely = _likelihoods(known, finders, found, data)
    poses = _assigned(group, known, finders, likely)
    lost = {k for k in known if data[k].track.misses > rules.motion.coasting}
    limit = float(np.log(rules.acceptance.rival))
    return Identities(poses, _exchanges(known, poses, finders, likely, limit, lost))


def _likelihoods(
    known: Sequence[int],
    finders: Sequence[int],
    found: Mapping[int, Floats],
    data: Mapping[int, Frame],
) -> Floats:
    """Log density of each pose (columns) for each body that was known (rows), where it counts.

    It is not worked out where the pose is far from all that was predicted: there it is that of
    a surprise.
    """
    likely = np.zeros((len(known), len(finders)))
    for i, k in enumerate(known):
        one = data[k]
        surprise = _surprise(one)
        for j, finder in enumerate(finders):
            T = found[finder]
            near = any(_may_be(T, p.T_world_object, p.uncertainty) for p in one.predictions)
            likely[i, j] = one.prior(T).log_density if near else surprise
    return likely


def _surprise(data: Frame) -> float:
    """Log density of a pose that is where nothing was predicted."""
    chance = min(data.rules.motion.surprise * (1 + data.track.misses), 1.0)
    return float(np.log(chance)) + data.anywhere.log_density


def _may_be(T: Floats, T_predicted: Floats, uncertainty: Floats) -> bool:
    """Whether a position is within ten standard deviations of a prediction."""
    spread = np.maximum(uncertainty[:3], 1e-12)
    return bool((np.abs(T[:3, 3] - T_predicted[:3, 3]) < 10 * spread).all())


def _assigned(
    group: Sequence[int], known: Sequence[int], finders: Sequence[int], likely: Floats
) -> dict[int, int]:
    """Poses for known bodies, as likely as can be; then for the others, in order."""
    poses: dict[int, int] = {}
    if known:
        for i, j in zip(*linear_sum_assignment(likely, maximize=True), strict=True):
            poses[known[i]] = finders[j]
    left = [finder for finder in finders if finder not in poses.values()]
    rest = [k for k in group if k not in known and k not in poses]
    poses.update(zip(rest, left, strict=False))
    return poses


def _exchanges(
    known: Sequence[int],
    poses: Mapping[int, int],
    finders: Sequence[int],
    likely: Floats,
    limit: float,
    lost: set[int],
) -> dict[int, list[tuple[int, float]]]:
    """Members whose poses might be each other's; one without a pose might have any other's."""
    exchanged: dict[int, list[tuple[int, float]]] = {}
    row = {k: i for i, k in enumerate(known)}
    column = {finder: j for j, finder in enumerate(finders)}
    for a in known:
        for b in known:
            if a == b or a not in poses:
                continue
            mine, theirs = column[poses[a]], column.get(poses.get(b, -1))
            if theirs is None:
                # b has none: a's pose may be b's, and a the one that is lost
                odds = likely[row[b], mine] - likely[row[a], mine]
            elif a < b:
                odds = likely[row[a], theirs] + likely[row[b], mine]
                odds -= likely[row[a], mine] + likely[row[b], theirs]
            else:
                continue
            if {a, b} <= lost:
                odds = max(odds, _EVEN)
            if odds > limit:
                share = float(np.exp(min(odds, 0.0)))
                exchanged.setdefault(a, []).append((poses.get(b, poses[a]), share))
                if theirs is not None:
                    exchanged.setdefault(b, []).append((poses[a], share))
    return exchanged
