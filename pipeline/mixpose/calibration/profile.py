"""Deviations by how much worse a fit gets, where the normal equations tell too much.

Of a flat body that faces a camera the tilts which its poses have by noise pass for information
about the focal length.  So a parameter is held some of its deviations off, poses and all other
parameters are fitted again, and what the likelihood falls by is compared with what a deviation
means (S. S. Wilks, Ann. Math. Statist. 9 (1938) 60).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mixpose.calibration.adjust import Adjusted, variance_ratio
from mixpose.calibration.bundle import Bundle
from mixpose.calibration.result import fitted
from mixpose.calibration.rig import Rig, moved
from mixpose.records import Floats

_LENSES = ("focal", "principal_point", "distortion")
_WIDER, _TIMES = 10.0, 4  # at a time, and how often


def profiled(bundle: Bundle, found: Adjusted) -> Adjusted:
    """With wider deviations of lenses whose errors hardly make the fit worse."""
    rules, covariance = bundle.rules, found.covariance.copy()
    lenses = [block for block in bundle.blocks if block.kind in _LENSES]
    asked = [k for block in lenses for k in range(bundle.count)[block.place]]
    asked = [k for k in asked if covariance[k, k] > 0 and not found.undetermined[k]]
    expected = rules.far**2 * variance_ratio(found.state.rig, rules) * found.inflation
    for k in asked:
        told: Floats = found.covariance[:, k] / np.sqrt(found.covariance[k, k])  # of one deviation
        wider, along, most = 1.0, told, rules.undetermined * bundle.scales[k] / told[k]
        _, best = _held(bundle, found, k, 0 * told)
        for _ in range(_TIMES):
            step = rules.far * wider * along
            ends = [_held(bundle, found, k, each) for each in (-step, step)]
            share = (sum(fall for _, fall in ends) / 2 - best) / expected
            if share > rules.flat or wider >= most:
                break
            along = (ends[1][0] - ends[0][0]) / (2 * rules.far * wider)
            wider = min(wider * min(_WIDER, 1 / np.sqrt(max(share, 1e-9))), most)
        if wider > 1:
            covariance += wider**2 * np.outer(along, along) - np.outer(told, told)
    return replace(found, covariance=covariance)


def _held(bundle: Bundle, found: Adjusted, k: int, step: Floats) -> tuple[Floats, float]:
    """A step (G,) with what else suits it best, as one parameter is held there; and the misfit."""
    stays = np.vstack([found.unknown.T, np.eye(bundle.count)[k]])

    def gauge(rig: Rig) -> Floats:
        return np.vstack([bundle.gauge(rig).reshape(-1, bundle.count), stays])

    there = moved(found.state.rig, bundle.blocks, step)
    rest, squared = fitted(replace(bundle, gauge=gauge), there, found)
    pairs = zip(squared, found.noise, strict=True)
    return step + rest, float(sum(np.nansum(each) / noise**2 for each, noise in pairs))
