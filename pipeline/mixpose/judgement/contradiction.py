"""Two sensors that contradict each other: no pose of the body is right for both.

Of three sensors the one that disagrees is left out.  Of two, nobody can tell which is wrong: one
may have been bumped, be a frame late, show an old image, or be calibrated for another place; then
their common pose is in between, or that of one of them, and is not to be believed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import fdtri

from mixpose.density import Noise
from mixpose.judgement.acceptance import AcceptanceRules
from mixpose.judgement.association import Association
from mixpose.judgement.judge import Judged
from mixpose.judgement.noise import NoiseModel

APART = "two sensors contradict each other"


def contradict(
    judged: Judged, before: Noise, agreed: bool, rules: AcceptanceRules, model: NoiseModel
) -> bool:
    """Whether the two sensors of a frame contradict each other.

    Parameters
    ----------
    judged : Judged
        The frame's best pose.
    before : Noise
        Residuals of the frames before.
    agreed : bool
        Whether two sensors met the body in some frame before: then one may miss it now.
    rules : AcceptanceRules
    model : NoiseModel
    """
    used = [one for one in judged.associations if judged.sensors[one.name].used]
    if len(used) != 2 or any(one.J.shape[1] != 2 for one in used):
        return False
    return _is_unmet(used, agreed, rules) or _is_between(used, before, rules, model)


def _is_unmet(used: Sequence[Association], agreed: bool, rules: AcceptanceRules) -> bool:
    """One meets most of the body; the other misses it, and sees as much beside it.

    Where the two never agreed, wherever it sees that.
    """
    least, most = sorted(used, key=lambda one: one.coverage)
    if not least.coverage < rules.agreeing <= most.coverage:
        return False
    if not agreed:
        return least.count - least.met >= rules.agreeing * most.met
    return least.missed > 0 and least.surplus >= rules.agreeing * least.missed


def _is_between(
    used: Sequence[Association], before: Noise, rules: AcceptanceRules, model: NoiseModel
) -> bool:
    """Offsets far beyond the noise so far, which a pose of its own takes away in each sensor."""
    if not is_far_off(used, before, rules, model):
        return False
    apart = [_left_alone(one) for one in used]
    own = sum(one.measurements - rank for one, (_, rank) in zip(used, apart, strict=True))
    if own < 1:
        return False
    degrees = sum(one.measurements for one in used) - 6
    alone = sum(left for left, _ in apart)
    gained = (sum(one.squares for one in used) - alone) / max(degrees - own, 1.0)
    return bool(gained > fdtri(max(degrees - own, 1.0), own, model.by_chance) * alone / own)


def is_far_off(
    used: Sequence[Association], before: Noise, rules: AcceptanceRules, model: NoiseModel
) -> bool:
    """Whether features are met far beyond the noise so far, or what is typical."""
    degrees = sum(one.measurements for one in used) - 6
    if degrees < 1:
        return False
    is_known = before.degrees >= model.known
    known = before.variance if is_known else model.errors.typical**2
    times = rules.disagreeing if is_known else rules.strange
    squares = sum(one.squares for one in used)
    return bool(squares / degrees >= times * max(known, model.smallest**2))


def _left_alone(one: Association) -> tuple[float, int]:
    """Squared offsets in σ² that a sensor's best own pose leaves, and what that pose takes up."""
    J, offsets = one.rows[:, :6], one.rows[:, 6]
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-12)
    taken, _, rank, _ = np.linalg.lstsq(J / scale, offsets, rcond=1e-6)
    return float(((offsets - J / scale @ taken) ** 2).sum()), int(rank)
