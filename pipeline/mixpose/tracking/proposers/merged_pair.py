"""Two features that run into each other: one detection, in their middle.

It pulls at both and bends the pose, or is taken for one of them while the other seems hidden.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from mixpose.judgement import ScoredPose
from mixpose.matching import Matches
from mixpose.rigid import perturb
from mixpose.tracking.likelihood import FrameData, Likelihood, Start

_STEPS = 2  # of least squares: the second starts within 0.01 σ_ε of the first's end


def merged_pair(data: FrameData, likelihood: Likelihood, judged: ScoredPose) -> Iterable[Start]:
    """Least squares with merged features in their middle."""
    if not likelihood.knows_detections:
        return []
    at, seen = judged, _paired(judged.matches, data.rules.judgement.association.reach_squared)
    for _ in range(_STEPS):
        if not seen.merged.any():
            break
        J, offsets = (one.reshape(-1, *one.shape[2:]) for one in seen.rows())
        step = np.zeros(6)
        step[data.free] = np.linalg.lstsq(J[:, data.free], offsets, rcond=None)[0]
        start = Start(perturb(at.T_world_object, step))
        at = likelihood.judge(likelihood.fit(start), start)
        seen = at.matches
    return [] if at is judged else [Start(at.T_world_object)]


def _paired(seen: Matches, reach: float) -> Matches:
    """Two features in one: in each sensor the one not met nearest to the detection of another.

    `reach` is how far that may be, squared, in variances of C.
    """
    if not seen.missed.any():
        return seen
    shares, offsets, J = seen.shares.copy(), seen.offsets.copy(), seen.J.copy()
    merged = seen.merged.copy()
    for k in np.flatnonzero((seen.merged == 0) & (seen.missed > 0) & (seen.met > 0)):
        met = np.flatnonzero(seen.detections[k] >= 0)
        lost = np.flatnonzero((seen.weights[k] > 0) & (shares[k] == 0))
        if not len(met) or not len(lost):
            continue
        apart = (seen.places[k, met] - seen.places[k, lost, None]) / seen.sigmas[k]
        away = apart + offsets[k, met]
        squared = (away * away).sum(axis=2) / 2
        i, j = np.unravel_index(int(squared.argmin()), squared.shape)
        if squared[i, j] > reach:
            continue
        pair = [lost[i], met[j]]
        shares[k, pair] = shares[k, met[j]] / 2
        offsets[k, pair] = (away[i, j] + offsets[k, met[j]]) / 2
        J[k, pair] = J[k, pair].mean(axis=0)
        merged[k] = 1
    return replace(seen, shares=shares, offsets=offsets, J=J, merged=merged)
