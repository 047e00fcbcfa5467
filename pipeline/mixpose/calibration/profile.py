"""Errors that the linear model of a fit misses: wider deviations, and wrong held parameters.

If a flat body faces a camera, tilts of its poses by noise look like information about the focal
length.  So a parameter is held some of its deviations off, poses and all other parameters are
fitted again, and the fall of the likelihood is compared with what a deviation means (S. S. Wilks,
Ann. Math. Statist. 9 (1938) 60).

Whether the recording contradicts held parameters (the body, lenses, delays, biases of ranges) is a
score test: at the maximum the gradient by held parameters is 0 but for errors of detections.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from mixpose.calibration.adjust import Adjusted, final_weights, fit_pairs, variance_ratio
from mixpose.calibration.bundle import Bundle, normal_equations
from mixpose.calibration.rig import Block, Kind, Rig, blocks_of, kinds_of, moved
from mixpose.records import Floats

_LENSES = ("focal", "principal_point", "distortion")
_WIDER, _TIMES = 10.0, 4  # largest factor of one widening, and number of widenings


def with_profiled_lenses(bundle: Bundle, adjusted: Adjusted) -> Adjusted:
    """Return the fit with wider deviations of lenses whose errors hardly make it worse."""
    rules, covariance = bundle.rules, adjusted.covariance.copy()
    lenses = [block for block in bundle.blocks if block.kind in _LENSES]
    candidates = [k for block in lenses for k in range(bundle.count)[block.place]]
    candidates = [k for k in candidates if covariance[k, k] > 0 and not adjusted.undetermined[k]]
    expected = rules.far**2 * variance_ratio(adjusted.state.rig, rules) * adjusted.inflation
    for k in candidates:
        # step of all parameters by one standard deviation of this one
        one_sigma: Floats = adjusted.covariance[:, k] / np.sqrt(adjusted.covariance[k, k])
        wider, along, most = 1.0, one_sigma, rules.undetermined * bundle.scales[k] / one_sigma[k]
        _, least = _misfit_at(bundle, adjusted, k, 0 * one_sigma)
        for _ in range(_TIMES):
            step = rules.far * wider * along
            ends = [_misfit_at(bundle, adjusted, k, end) for end in (-step, step)]
            share = (sum(misfit for _, misfit in ends) / 2 - least) / expected
            if share > rules.flat or wider >= most:
                break
            along = (ends[1][0] - ends[0][0]) / (2 * rules.far * wider)
            wider = min(wider * min(_WIDER, 1 / np.sqrt(max(share, 1e-9))), most)
        if wider > 1:
            covariance += wider**2 * np.outer(along, along) - np.outer(one_sigma, one_sigma)
    return replace(adjusted, covariance=covariance)


def _misfit_at(bundle: Bundle, adjusted: Adjusted, k: int, step: Floats) -> tuple[Floats, float]:
    """Fit all but parameter k, which a step (G,) moves; return the whole step and the misfit."""
    stays = np.vstack([adjusted.unknown.T, np.eye(bundle.count)[k]])

    def gauge(rig: Rig) -> Floats:
        return np.vstack([bundle.gauge(rig).reshape(-1, bundle.count), stays])

    start = moved(adjusted.state.rig, bundle.blocks, step)
    change, squared = fit_pairs(replace(bundle, gauge=gauge), start, adjusted)
    by_sensor = zip(squared, adjusted.noise, strict=True)
    return step + change, float(sum(np.nansum(s) / noise**2 for s, noise in by_sensor))


@dataclass(frozen=True)
class Contradiction:
    """Held parameters that the recording contradicts."""

    name: str  # as of --free
    parameter: str  # with the most significant score by itself
    deviations: float  # standard deviations by which freeing it moves free parameters


def find_contradiction(
    bundle: Bundle, adjusted: Adjusted, *, length: float, interval: float
) -> Contradiction | None:
    """Return the kind of held parameters, tested one by one, that the recording contradicts most.

    None if no contradiction is significant and moves a parameter by more than its deviation.
    Sensors whose errors are stated are not tested. `length` and `interval` are as of `blocks_of`.
    """
    rules, count, state = bundle.rules, bundle.count, adjusted.state
    held = _blocks_held(bundle, adjusted, length, interval)
    wide = replace(bundle, blocks=(*bundle.blocks, *held), errors={})
    weighted, _ = final_weights(wide, state, adjusted.noise)
    S, _, b, _ = normal_equations(wide, weighted, 0.0)
    scales = wide.scales
    S, b = S * np.outer(scales, scales), b * scales
    inverse = np.linalg.pinv(S[:count, :count], rcond=1e-10, hermitian=True)
    deviations = np.sqrt(np.diag(adjusted.covariance)) / scales[:count]
    ratio = variance_ratio(state.rig, rules) * adjusted.inflation
    largest, worst = 0.0, None
    for block in held:
        along = inverse @ S[:count, block.place]
        information = S[block.place, block.place] - S[block.place, :count] @ along
        values, vectors = np.linalg.eigh(information)
        kept = values > 1 / rules.undetermined**2
        V = vectors[:, kept]
        score = b[block.place] - along.T @ b[:count]
        step = V @ ((V.T @ score) / values[kept])
        squared = float(score @ step) / ratio
        shares = np.abs(along @ step)[deviations > 0] / deviations[deviations > 0]
        moves = float(shares.max(initial=0.0))
        is_significant = chi2.sf(squared, V.shape[1]) < rules.by_chance if V.size else False
        if is_significant and moves > 1 and squared > largest:
            scores = score**2 / np.maximum(np.diag(information), 1e-300)
            name = "" if block.sensor is None else f"{state.rig.names[block.sensor]}:"
            parameter = block.names[int(np.argmax(scores))]
            largest, worst = squared, Contradiction(f"{name}{block.kind}", parameter, moves)
    return worst


def _blocks_held(bundle: Bundle, adjusted: Adjusted, length: float, interval: float) -> list[Block]:
    """Return the blocks of held parameters, after those that are free."""
    rig, free = adjusted.state.rig, {(block.sensor, block.kind) for block in bundle.blocks}
    kinds: dict[int, tuple[Kind, ...]] = {
        s: tuple(k for k in kinds_of(sensor) if k != "drift" and (s, k) not in free)
        for s, sensor in enumerate(rig.sensors)
        if s not in bundle.errors and len(adjusted.weighted[s][1])
    }
    body = (None, "body") not in free
    blocks = blocks_of(rig, kinds, body=body, length=length, interval=interval)
    return [replace(block, start=block.start + bundle.count) for block in blocks]
