"""Two features that run into each other: one detection, in their middle.

It pulls at both and bends the pose, or is taken for one of them while the other seems hidden.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from mixpose.judgement import Association, Judged
from mixpose.rigid import perturb
from mixpose.tracking.likelihood import FrameData, Likelihood, Start

_STEPS = 2  # of least squares: the second starts within 0.01 σ_ε of the first's end


def merged_pair(data: FrameData, likelihood: Likelihood, judged: Judged) -> Iterable[Start]:
    """Least squares with merged features in their middle."""
    if not likelihood.knows_detections:
        return []
    reach = data.rules.judgement.association.reach_squared
    at, associations = judged, tuple(_paired(one, reach) for one in judged.associations)
    for _ in range(_STEPS):
        if not any(one.merged for one in associations):
            break
        rows = np.concatenate([one.rows for one in associations])
        step = np.zeros(6)
        step[data.free] = np.linalg.lstsq(rows[:, :6][:, data.free], rows[:, 6], rcond=None)[0]
        start = Start(perturb(at.T_world_object, step))
        at = likelihood.judge(likelihood.fit(start), start)
        associations = at.associations
    return [] if at is judged else [Start(at.T_world_object)]


def _paired(one: Association, reach: float) -> Association:
    """Two features in one: the one not met that is nearest to the detection of another.

    `reach` is how far that may be, squared, in variances of C.
    """
    met = np.flatnonzero(one.detections >= 0)
    lost = np.flatnonzero((one.shares == 0) & (one.detections < 0))
    if not len(met) or not len(lost) or one.merged:
        return one
    away = (one.places[met] + one.offsets[met])[None] - one.places[lost, None]
    squared = (away * away).sum(axis=2) / (2 * one.sigma**2)
    i, k = np.unravel_index(int(squared.argmin()), squared.shape)
    if squared[i, k] > reach:
        return one
    pair = [lost[i], met[k]]
    shares, offsets, J = one.shares.copy(), one.offsets.copy(), one.J.copy()
    shares[pair] = one.shares[met[k]] / 2
    offsets[pair] = (away[i, k] + one.offsets[met[k]]) / 2
    J[pair] = one.J[pair].mean(axis=0)
    return replace(one, shares=shares, offsets=offsets, J=J, merged=1)
