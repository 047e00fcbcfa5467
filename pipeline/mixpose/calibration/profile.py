"""Errors that the linear model of a fit misses: wider deviations, and wrong held parameters.

If a flat body faces a camera, tilts of its poses by noise look like information about the focal
length.  So a parameter is held some of its deviations off, poses and all other parameters are
fitted again, and the fall of the likelihood is compared with what a deviation means (S. S. Wilks,
Ann. Math. Statist. 9 (1938) 60).

Whether the recording contradicts held parameters (the body, lenses, delays, biases of ranges), or
that each sensor stands where it stood in the first frame, is a score test: at the maximum the
gradient by held parameters, or by a pose from some frame on, is 0 but for errors of detections.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from mixpose.calibration.adjust import Adjusted, final_weights, fit_pairs, variance_ratio
from mixpose.calibration.bundle import Bundle, Weighted, normal_equations, rows_of
from mixpose.calibration.rig import Block, Kind, Rig, blocks_of, kinds_of, moved
from mixpose.calibration.rules import CalibrationRules
from mixpose.records import Floats

_LENSES = ("focal", "principal_point", "distortion")
_WIDER, _TIMES = 10.0, 4  # largest factor of one widening, and number of widenings
_MOMENTS = 9  # frames from which a change of a sensor is tried, before the best of them is refined


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
    """What a calibration takes for right, and the recording contradicts."""

    # kind of held parameters, as of --free; or sensors one of which changed its pose, none if no
    # single change explains what differs
    names: tuple[str, ...]
    parameter: str = ""  # with the most significant score by itself
    deviations: float = 0.0  # standard deviations by which freeing it moves free parameters
    frames: tuple[int, int] | None = None  # first and last number of those with another pose


@dataclass(frozen=True, eq=False)
class _Score:
    """The score of a block of parameters that are not free."""

    block: Block
    squared: float  # chi-square distributed if the parameters are right
    freedom: int
    moves: float  # standard deviations by which a step of the block moves free parameters
    parameter: str

    @property
    def worth(self) -> float:
        """Return Akaike's measure of what freeing the block explains."""
        return self.squared - 2 * self.freedom

    def contradicts(self, rules: CalibrationRules) -> bool:
        """Test whether the block is not right, by more than deviations of free parameters tell."""
        by_chance = chi2.sf(self.squared, max(self.freedom, 1))
        return bool(by_chance < rules.by_chance and self.moves > 1)


def find_contradiction(
    bundle: Bundle, adjusted: Adjusted, *, length: float, interval: float
) -> Contradiction | None:
    """Return what the recording contradicts most: held parameters, or that no sensor moved.

    None if no contradiction is significant and moves a parameter by more than its deviation.
    Held parameters of sensors whose errors are stated are not tested. `length` and `interval` are
    as of `blocks_of`.
    """
    state, rules = adjusted.state, bundle.rules
    known = replace(bundle, errors={})
    weighted, _ = final_weights(known, state, adjusted.noise)
    held = _blocks_held(bundle, adjusted, length, interval)
    poses = _pose_blocks(adjusted, length)
    changes = _likeliest_changes(known, adjusted, weighted, poses)
    scores = [s for s in _scores(known, adjusted, weighted, held) if s.contradicts(rules)]
    changes = [s for s in changes if s.contradicts(rules)]
    if not scores and not changes:
        return None
    worst = max([*scores, *changes], key=lambda score: score.worth)
    block = worst.block
    if not block.since:
        sensor_name = "" if block.sensor is None else f"{state.rig.names[block.sensor]}:"
        return Contradiction((f"{sensor_name}{block.kind}",), worst.parameter, worst.moves)
    frames = bundle.frames[block.since].number, bundle.frames[-1].number
    freed = replace(known, blocks=(*known.blocks, replace(block, start=bundle.count)))
    others = _likeliest_changes(freed, adjusted, weighted, poses)
    by_chance = float(chi2.isf(rules.left_by_chance, max(score.freedom for score in others)))
    if max(score.squared for score in others) > max(rules.left * worst.squared, by_chance):
        return Contradiction((), worst.parameter, worst.moves, frames)
    # that explain as much as the likeliest
    alike = -2 * np.log(rules.by_chance)
    sensors = [s.block.sensor for s in changes if s.worth > worst.worth - alike]
    names = tuple(state.rig.names[s] for s in sensors if s is not None)
    return Contradiction(names, worst.parameter, worst.moves, frames)


def _scores(
    bundle: Bundle, adjusted: Adjusted, weighted: Sequence[Weighted], blocks: Sequence[Block]
) -> list[_Score]:
    """Return the scores of blocks which follow the free ones."""
    rules, count, rig = bundle.rules, bundle.count, adjusted.state.rig
    wide = replace(bundle, blocks=(*bundle.blocks, *blocks))
    rows = [
        (rows_of(wide, adjusted.state, s, known.pairs), weight)
        for s, (known, weight) in enumerate(weighted)
    ]
    S, _, b, _ = normal_equations(wide, rows, 0.0)
    scales = wide.scales
    S, b = S * np.outer(scales, scales), b * scales
    inverse = np.linalg.pinv(S[:count, :count], rcond=1e-10, hermitian=True)
    free = len(adjusted.covariance)
    deviations = np.sqrt(np.diag(adjusted.covariance)) / scales[:free]
    ratio = variance_ratio(rig, rules) * adjusted.inflation
    scores = []
    for block in blocks:
        along = inverse @ S[:count, block.place]
        information = S[block.place, block.place] - S[block.place, :count] @ along
        values, vectors = np.linalg.eigh(information)
        kept = values > 1 / rules.undetermined**2
        V = vectors[:, kept]
        score = b[block.place] - along.T @ b[:count]
        step = V @ ((V.T @ score) / values[kept])
        shares = np.abs(along[:free] @ step)[deviations > 0] / deviations[deviations > 0]
        likeliest = np.argmax(score**2 / np.maximum(np.diag(information), 1e-300))
        squared, moves = float(score @ step) / ratio, float(shares.max(initial=0.0))
        scores.append(_Score(block, squared, V.shape[1], moves, block.names[int(likeliest)]))
    return scores


def _likeliest_changes(
    bundle: Bundle, adjusted: Adjusted, weighted: Sequence[Weighted], poses: Sequence[Block]
) -> list[_Score]:
    """Return the score of each pose from the frame on in which it changed most likely.

    None of a recording with too few frames before or after any.
    """
    changes = []
    for pose in poses:
        first, width = bundle.rules.elsewhere, len(pose.names)
        last = len(bundle.frames) - first
        while first <= last:
            moments = np.unique(np.linspace(first, last, _MOMENTS).astype(int))
            starts = bundle.count + width * np.arange(len(moments))
            blocks = [
                replace(pose, start=int(start), since=int(moment))
                for start, moment in zip(starts, moments, strict=True)
            ]
            best = max(_scores(bundle, adjusted, weighted, blocks), key=lambda s: s.squared)
            apart = int(np.diff(moments).max(initial=1)) - 1
            if not apart:
                changes.append(best)
                break
            moment = best.block.since
            first, last = max(first, moment - apart), min(last, moment + apart)
    return changes


def _pose_blocks(adjusted: Adjusted, length: float) -> tuple[Block, ...]:
    """Return blocks of the poses, or positions, of all sensors that meet anything."""
    kinds: dict[int, tuple[Kind, ...]] = {
        s: tuple(kind for kind in kinds_of(sensor) if kind in ("pose", "position"))
        for s, sensor in enumerate(adjusted.state.rig.sensors)
        if len(adjusted.weighted[s][1])
    }
    return blocks_of(adjusted.state.rig, kinds, body=False, length=length, interval=1.0)


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
