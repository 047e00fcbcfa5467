"""Two features that run into each other: one detection, in their middle.

It pulls at both and bends the pose.  The pose that puts their middle where the one detection is
seen is a rival; its evidence tells whether it is the better one.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mixpose.judgement import Judged
from mixpose.rigid import perturb
from mixpose.tracking.likelihood import FrameData, Likelihood, Start

_STEPS = 2  # of least squares: the second starts within 0.01 σ_ε of the first's end


def merged_pair(data: FrameData, likelihood: Likelihood, judged: Judged) -> Iterable[Start]:
    """Least squares with merged features in their middle."""
    at = judged
    for _ in range(_STEPS if likelihood.knows_detections else 0):
        if not any(one.merged for one in at.associations):
            break
        rows = np.concatenate([one.rows for one in at.associations])
        step = np.zeros(6)
        step[data.free] = np.linalg.lstsq(rows[:, :6][:, data.free], rows[:, 6], rcond=None)[0]
        start = Start(perturb(at.T_world_object, step))
        at = likelihood.judge(likelihood.fit(start), start)
    return [] if at is judged else [Start(at.T_world_object)]
