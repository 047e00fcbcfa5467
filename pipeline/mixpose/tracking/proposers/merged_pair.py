"""Two features that run into each other: one detection, in their middle.

At σ_ε it pulls at both and bends the pose.  The pose that puts their middle where the one
detection is seen is a rival; its evidence tells whether it is the better one.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.judgement import Judged
from mixpose.rigid import perturb
from mixpose.tracking.likelihood import FrameData, Likelihood, Start
from mixpose.tracking.outliers import (
    has_outlier,
    least_squares_step,
    step_without_loosest,
)

Floats: TypeAlias = NDArray[np.float64]

_STEPS = 2  # of least squares: the second starts within 0.01 σ_ε of the first's end


def merged_pair(data: FrameData, likelihood: Likelihood, judged: Judged) -> Iterable[Start]:
    """Least squares with merged features in their middle, from the pose and without outliers."""
    if not likelihood.knows_detections or not has_outlier(judged, data.rules.proposals):
        return
    step = step_without_loosest(judged.associations, data.free, data.rules.proposals)
    T = perturb(judged.T_world_object, step)
    for begin in (judged, _judged(likelihood, T)):
        at = begin
        for _ in range(_STEPS):
            if any(one.merged for one in at.associations):
                step = least_squares_step(at.associations, data.free)
                at = _judged(likelihood, perturb(at.T_world_object, step))
        if at is not begin:
            yield Start(at.T_world_object)


def _judged(likelihood: Likelihood, T_world_object: Floats) -> Judged:
    start = Start(T_world_object)
    return likelihood.judge(likelihood.fit(start), start)
