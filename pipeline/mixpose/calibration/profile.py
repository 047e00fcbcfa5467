"""What one linear model of a fit does not tell: wider deviations, and what is held wrongly.

Of a flat body that faces a camera the tilts which its poses have by noise pass for information
about the focal length.  So a parameter is held some of its deviations off, poses and all other
parameters are fitted again, and what the likelihood falls by is compared with what a deviation
means (S. S. Wilks, Ann. Math. Statist. 9 (1938) 60).

Whether the recording contradicts what is held (the body, lenses, delays, biases of ranges) is a
score test: at the maximum the gradient by what is held is 0 but for errors of detections.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from mixpose.calibration.adjust import Adjusted, fitted, variance_ratio, weighted_at_the_end
from mixpose.calibration.bundle import Bundle, normal_equations
from mixpose.calibration.rig import Block, Kind, Rig, blocks_of, kinds_of, moved
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


@dataclass(frozen=True)
class Contradiction:
    """What is held, and the recording says otherwise."""

    words: str  # as of --free
    most: str  # the parameter that tells most by itself
    moves: float  # standard deviations by which it moves what was found


def contradiction(
    bundle: Bundle, found: Adjusted, *, length: float, interval: float
) -> Contradiction | None:
    """What of all that is held, one kind at a time, the recording contradicts most.

    None where nothing is surely otherwise, or what is moves nothing by more than its deviation.
    Sensors of which it is stated how far they may be off are not asked. Sizes are as of
    `blocks_of`.
    """
    rules, count, state = bundle.rules, bundle.count, found.state
    held = _blocks_held(bundle, found, length, interval)
    wide = replace(bundle, blocks=(*bundle.blocks, *held), errors={})
    weighted, _ = weighted_at_the_end(wide, state, found.noise)
    S, _, b, _ = normal_equations(wide, weighted, 0.0)
    scales = wide.scales
    S, b = S * np.outer(scales, scales), b * scales
    known = np.linalg.pinv(S[:count, :count], rcond=1e-10, hermitian=True)
    deviations = np.sqrt(np.diag(found.covariance)) / scales[:count]
    ratio = variance_ratio(state.rig, rules) * found.inflation
    best, told = 0.0, None
    for block in held:
        along = known @ S[:count, block.place]
        information = S[block.place, block.place] - S[block.place, :count] @ along
        values, vectors = np.linalg.eigh(information)
        kept = values > 1 / rules.undetermined**2
        V = vectors[:, kept]
        score = b[block.place] - along.T @ b[:count]
        step = V @ ((V.T @ score) / values[kept])
        squared = float(score @ step) / ratio
        shares = np.abs(along @ step)[deviations > 0] / deviations[deviations > 0]
        moves = float(shares.max(initial=0.0))
        surely = chi2.sf(squared, V.shape[1]) < rules.by_chance if V.size else False
        if surely and moves > 1 and squared > best:
            alone = score**2 / np.maximum(np.diag(information), 1e-300)
            name = "" if block.sensor is None else f"{state.rig.names[block.sensor]}:"
            most = block.names[int(np.argmax(alone))]
            best, told = squared, Contradiction(f"{name}{block.kind}", most, moves)
    return told


def _blocks_held(bundle: Bundle, found: Adjusted, length: float, interval: float) -> list[Block]:
    """Blocks of all that is held, behind those that are free."""
    rig, free = found.state.rig, {(block.sensor, block.kind) for block in bundle.blocks}
    kinds: dict[int, tuple[Kind, ...]] = {
        s: tuple(k for k in kinds_of(eye) if k != "drift" and (s, k) not in free)
        for s, eye in enumerate(rig.sensors)
        if s not in bundle.errors and len(found.weighted[s][1])
    }
    body = (None, "body") not in free
    blocks = blocks_of(rig, kinds, body=body, length=length, interval=interval)
    return [replace(block, start=block.start + bundle.count) for block in blocks]
