"""A sensor that disagrees with the others: out of step, or bumped.

Where two sensors or more agree on most of the body, the pose is fitted to them alone; what is left
out counts as missed in the evidence.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.special import fdtri

from mixpose.judgement import AcceptanceRules, NoiseModel, ScoredPose
from mixpose.matching import LEAST_VARIANCE, Matches
from mixpose.tracking.likelihood import FrameData, Likelihood, Start

OUT_OF_STEP = "out of step or bumped"


def without_sensor(data: FrameData, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """The pose fitted without the sensors that disagree with two others or more."""
    if not likelihood.knows_detections or len(data.views) < 3:
        return
    if judged.left_out:
        return  # some are left out already
    rules = data.rules
    if apart := disagreeing(judged.matches, rules.acceptance, rules.judgement.noise):
        yield Start(judged.T_world_object, data.close, left_out=dict.fromkeys(apart, OUT_OF_STEP))


def disagreeing(seen: Matches, rules: AcceptanceRules, model: NoiseModel) -> list[str]:
    """Sensors that see the body elsewhere than two others or more do.

    One that meets little of it, with as many detections beside it that belong to nothing; or one
    whose residuals are far larger than the others', more than chance would make them.
    """
    agreeing = seen.coverage >= rules.agreeing
    apart = ~agreeing & (seen.expected > 0)
    apart &= seen.unmatched_nearby >= rules.agreeing * seen.missed
    squares, degrees = seen.squares * agreeing, seen.measurements * agreeing
    for k in np.flatnonzero(agreeing & (degrees > 0)):
        rest, own = float(degrees.sum() - degrees[k]), float(degrees[k])
        if np.count_nonzero(agreeing) < 3 or rest == 0:
            continue
        variance = float(squares.sum() - squares[k]) / rest
        limit = max(rules.disagreeing, float(fdtri(own, rest, model.by_chance)))
        apart[k] = squares[k] / own > limit * max(variance, LEAST_VARIANCE)
    names = [seen.names[k] for k in np.flatnonzero(apart)]
    return names if np.count_nonzero(agreeing & ~apart) >= 2 else []
