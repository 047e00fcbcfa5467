"""Two features that run into each other: one detection, in their middle.

It pulls at both and bends the pose.  The pose that puts their middle where the one detection is
seen is a rival; its evidence tells whether it is the better one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.judgement import Association, Judged
from mixpose.rigid import perturb
from mixpose.tracking.likelihood import FrameData, Likelihood, Start

Floats: TypeAlias = NDArray[np.float64]

_STEPS = 2  # of least squares: the second starts within 0.01 σ_ε of the first's end


def merged_pair(data: FrameData, likelihood: Likelihood, judged: Judged) -> Iterable[Start]:
    """Least squares with merged features in their middle."""
    at = judged
    for _ in range(_STEPS if likelihood.knows_detections else 0):
        if not any(one.merged for one in at.associations):
            break
        step = _least_squares(at.associations, data.free)
        start = Start(perturb(at.T_world_object, step))
        at = likelihood.judge(likelihood.fit(start), start)
    return [] if at is judged else [Start(at.T_world_object)]


def _least_squares(associations: Sequence[Association], free: NDArray[np.bool_]) -> Floats:
    """The step (6,) to where the features were met, merged ones in their middle."""
    rows = [(np.sqrt(one.shares) / one.sigma)[:, None] for one in associations]
    J = np.concatenate(
        [(r[..., None] * m.J).reshape(-1, 6) for r, m in zip(rows, associations, strict=True)]
    )
    offsets = [(r * one.offsets).ravel() for r, one in zip(rows, associations, strict=True)]
    step = np.zeros(len(free))
    step[free] = np.linalg.lstsq(J[:, free], np.concatenate(offsets), rcond=None)[0]
    return step
