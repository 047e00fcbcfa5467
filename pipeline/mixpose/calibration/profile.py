"""Deviations by how much worse a fit gets, where the normal equations tell too much.

Of a flat body that faces a camera the tilts which its poses have by noise pass for information
about the focal length.  So a parameter is moved by some of its deviations, the others as their
covariance has it, poses are fitted again, and what the likelihood falls by is compared with what a
deviation means (S. S. Wilks, Ann. Math. Statist. 9 (1938) 60).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mixpose.calibration.adjust import Adjusted, fitted_poses, variance_ratio
from mixpose.calibration.bundle import Bundle
from mixpose.calibration.rig import moved

_LENSES = ("focal", "principal_point", "distortion")
_WIDER, _TIMES = 10.0, 4  # at a time, and how often


def profiled(bundle: Bundle, found: Adjusted) -> Adjusted:
    """With wider deviations of lenses whose errors hardly make the fit worse."""
    by, far = variance_ratio(found.state.rig, bundle.rules) * found.inflation, bundle.rules.far
    alone = replace(bundle, blocks=(), gauge=lambda _: np.zeros((0, 0)), errors={})
    lenses = [block for block in bundle.blocks if block.kind in _LENSES]
    asked = [k for block in lenses for k in range(bundle.count)[block.place]]
    asked = [k for k in asked if found.covariance[k, k] > 0 and not found.undetermined[k]]
    best = fitted_poses(alone, found.state, found.noise) if asked else 0.0
    covariance = found.covariance.copy()
    for k in asked:
        along = found.covariance[:, k] / np.sqrt(found.covariance[k, k])  # of one deviation
        most = bundle.rules.undetermined * bundle.scales[k] / max(along[k], 1e-300)
        wider = 1.0
        for _ in range(_TIMES):
            steps = [sign * far * wider * along for sign in (-1.0, 1.0)]
            rigs = [moved(found.state.rig, bundle.blocks, step) for step in steps]
            ends = [found.state._replace(rig=rig) for rig in rigs]
            falls = [fitted_poses(alone, end, found.noise) - best for end in ends]
            share = float(np.mean(falls)) / (far**2 * by)
            if share > bundle.rules.flat or wider >= most:
                break
            wider = min(wider * min(_WIDER, 1 / np.sqrt(max(share, 1e-9))), most)
        covariance += max(wider**2 - 1, 0.0) * np.outer(along, along)
    return replace(found, covariance=covariance)
