"""A closer look without the detections that agree least.

A false detection within reach of a hidden feature passes for it.  At σ_ε it bends the pose of all
the others; at a narrower blur, which detections that are more exact than σ_ε allow, it is too far
away to pull.  Whether a pose found so is the better one, its evidence tells.
"""

from __future__ import annotations

from collections.abc import Iterable

from mixpose.fit.near import SHARP
from mixpose.judgement import Judged
from mixpose.optimise import ascend
from mixpose.rigid import perturb
from mixpose.tracking.likelihood import FrameData, Likelihood, Start
from mixpose.tracking.outliers import has_outlier, step_without_loosest


def without_outlier(data: FrameData, likelihood: Likelihood, judged: Judged) -> Iterable[Start]:
    """The pose climbed to at a narrower blur from where most features agree."""
    rules = data.rules.proposals
    if not likelihood.knows_detections or not has_outlier(judged, rules):
        return []
    if any(view.observation.cell is not None for view in data.views):
        return []  # features of grey values cannot be made narrower
    step = step_without_loosest(judged.associations, data.free, rules)
    T = perturb(judged.T_world_object, step)
    objective = data.at_sigma(narrowed=rules.narrow)
    return [Start(ascend(objective.linearise, perturb, T, data.free, SHARP).state)]
