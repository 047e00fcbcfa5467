"""Maximise the matched objective over rig and poses, through narrowing blurs.

At each blur the objective is climbed by Gauss-Newton; the blurs end at twice the noise that the
residuals show, which is estimated on the way.  Pairs are known by then, and the last steps weigh
them as Cauchy errors: if sensors are out of step, the errors of a frame far off are smaller than
they look, and a Gaussian kernel would drop it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mixpose.calibration.bundle import Bundle, Weighted, apply_step, rows_of, solve_step
from mixpose.calibration.matching import feature_spacing, match, nearest_distance
from mixpose.calibration.rig import Rig, State
from mixpose.calibration.rules import CalibrationRules
from mixpose.records import Floats, Mask

MET = 0.05
"""Least weight of a pair that is met: pairs 5 standard deviations off have 0.2."""

_MOST_BLURS = 40
_UNKNOWN = 0.1  # of a parameter's squared length along undetermined directions
_SHARPEST = 1e-3  # of σ_ε: least noise, of data without any
_BLUNTEST = 2.0  # of σ_ε: largest noise, as σ_ε is the largest error of the extraction
_FARTHEST = 0.3  # rad: largest turn of a step, as the linear model reaches no farther
_CLIMBS = 12
_CLIMBED = 1e-6  # of the squared residuals: with a smaller gain, the fit has converged


def deviations_of(covariance: Floats) -> Floats:
    """Return standard deviations (G,) of parameters."""
    return np.asarray(np.sqrt(np.maximum(covariance.diagonal(), 0.0)))


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Rig and poses at the maximum."""

    state: State
    noise: Floats  # (L,): standard deviation of a detection's coordinate by sensor
    covariance: Floats  # (G, G): of the free parameters, in the gauge
    unknown: Floats  # (G, u): undetermined directions, in the parameters' sizes
    weighted: tuple[Weighted, ...]  # by sensor; the weight of a pair that agrees is 1
    inflation: float  # of variances, relative to those by independent errors of detections

    @property
    def undetermined(self) -> Mask:
        """Return a mask of the parameters (G,) that data do not determine."""
        return np.asarray((self.unknown**2).sum(axis=1) > _UNKNOWN)

    @property
    def deviations(self) -> Floats:
        """Return standard deviations of the parameters (G,); infinite if not determined."""
        return np.where(self.undetermined, np.inf, deviations_of(self.covariance))

    @property
    def certainty(self) -> float:
        """Return the share of the weight of pairs that are the nearest to each other."""
        nearest = sum(float(weight @ rows.pairs.nearest) for rows, weight in self.weighted)
        return nearest / max(sum(float(weight.sum()) for _, weight in self.weighted), 1e-9)


def _first_blurs(bundle: Bundle, state: State) -> Floats:
    """Return first blurs (L,), wide enough for errors of the start and not for neighbours."""
    rules, blurs = bundle.rules, np.array(bundle.sigmas, dtype=np.float64)
    for sensor, sigma in enumerate(bundle.sigmas):
        distances = nearest_distance(state, bundle.frames, bundle.clock, sensor)
        if len(distances):
            widest = rules.widest * feature_spacing(state, sensor)
            wanted = rules.first_blur * float(np.median(distances))
            blurs[sensor] = max(min(wanted, widest), _SHARPEST * sigma)
    return blurs


def adjust(
    bundle: Bundle, state: State, *, blurs: Floats | None = None, noise: Floats | None = None
) -> Adjusted:
    """Climb from a start to the maximum.

    The first blurs (L,) suit the start if left out.  Noise (L,) is estimated if left out.
    """
    rules = bundle.rules
    blur = _first_blurs(bundle, state) if blurs is None else blurs
    for _ in range(_MOST_BLURS):
        for _ in range(rules.steps):
            state, _ = _take_step(bundle, state, _weighted_pairs(bundle, state, blur, blur)[0])
        estimate = noise if noise is not None else _estimate_noise(bundle, 1.0, state, blur)
        # crowded features look like noise at a wide blur, which must not widen it further
        last = np.minimum(rules.blur * estimate, _widest_alike(state.rig, blur, bundle.sigmas))
        if (blur <= last / rules.narrowing).all():
            break
        blur = np.maximum(blur * rules.narrowing, last)
    if noise is not None:
        return _finish(bundle, state, noise, None)
    adjusted = _finish(bundle, state, last / rules.blur, 1.0)
    if adjusted.inflation > 1:
        return adjusted
    return _finish(bundle, adjusted.state, adjusted.noise, rules.unlike)


def _widest_alike(rig: Rig, blur: Floats, sigmas: Floats) -> Floats:
    """Return the widest blur, by σ_ε, of sensors of the same kind for each sensor (L,)."""
    units = np.array([sensor.unit for sensor in rig.sensors])
    return np.array([sigma * (blur / sigmas)[units == u].max() for sigma, u in zip(sigmas, units)])


def _finish(bundle: Bundle, state: State, noise: Floats, unlike: float | None) -> Adjusted:
    """Take the last steps; estimate noise by `_noise` with `unlike`, unless that is None."""
    rules = bundle.rules
    most = rules.unlike * noise
    for _ in range(rules.last_steps):
        weighted, _ = final_weights(bundle, state, noise)
        state, size = _take_step(bundle, state, weighted)
        before = noise
        if unlike is not None:
            noise = np.minimum(_estimate_noise(bundle, unlike, state, rules.blur * noise), most)
        if size < rules.converged and np.allclose(before, noise, rtol=1e-3):
            break
    weighted, alone = final_weights(bundle, state, noise)
    step = solve_step(bundle, state, weighted)
    scattered = step.covariance * variance_ratio(state.rig, rules)
    inflation = _inflation(bundle, weighted, scattered)
    covariance = scattered * inflation + step.of_held
    pairs = tuple((rows, weight) for (rows, _), weight in zip(weighted, alone, strict=True))
    return Adjusted(state, noise, covariance, step.unknown, pairs, inflation)


def final_weights(
    bundle: Bundle, state: State, noise: Floats
) -> tuple[list[Weighted], list[Floats]]:
    """Return pairs with weights of the last steps, and weights (n,) of the objective alone."""
    return _weighted_pairs(bundle, state, bundle.rules.blur * noise, noise, last=True)


def covariance_by_held(bundle: Bundle, adjusted: Adjusted) -> Floats:
    """Return the covariance (G, G) of the rig's parameters by errors of held parameters."""
    weighted, _ = final_weights(bundle, adjusted.state, adjusted.noise)
    return solve_step(bundle, adjusted.state, weighted).of_held


def _weighted_pairs(
    bundle: Bundle, state: State, blur: Floats, noise: Floats, *, last: bool = False
) -> tuple[list[Weighted], list[Floats]]:
    """Return pairs of all sensors with weights, and their weights by the objective alone."""
    rules = bundle.rules
    weighted: list[Weighted] = []
    alone: list[Floats] = []
    faintest = rules.faintest_last if last else rules.faintest
    for sensor in range(len(state.rig.sensors)):
        pairs = match(state, bundle.frames, bundle.clock, sensor, blur[sensor], faintest)
        rows = rows_of(bundle, state, sensor, pairs)
        squared = (rows.residual**2).sum(axis=1)
        share = pairs.share * rows.known
        weight = share * np.exp(-squared / (4 * blur[sensor] ** 2))
        alone.append(weight)
        if last:
            weight = share / (1 + squared / (rules.tail * noise[sensor]) ** 2)
        weighted.append((rows, weight / noise[sensor] ** 2))
    return weighted, alone


def _take_step(bundle: Bundle, state: State, weighted: Sequence[Weighted]) -> tuple[State, float]:
    """Take a step; return the state and the step's size in standard deviations of the rig."""
    step = solve_step(bundle, state, weighted, 1e-9)
    is_turn = [unit == "rad" for block in bundle.blocks for unit in block.units]
    turns = np.concatenate([step.poses[:, 3:].ravel(), step.rig[is_turn]])
    largest = float(np.abs(turns).max(initial=0.0))
    if largest > _FARTHEST:
        share = _FARTHEST / largest
        step = replace(step, rig=step.rig * share, poses=step.poses * share)
    deviations = deviations_of(step.covariance)
    ratios = step.rig[deviations > 0] / deviations[deviations > 0]
    size = float(np.abs(ratios).max(initial=0.0))
    if not bundle.count:
        size = float(np.abs(step.poses).max(initial=0.0)) * 1e3
    return apply_step(bundle, state, step), size


def _estimate_noise(bundle: Bundle, unlike: float, state: State, blur: Floats) -> Floats:
    """Estimate standard deviations of detections (L,) from residuals under a Gaussian weight."""
    # noise of a sensor is that of its kind, within the factor `unlike`. If whole frames are off the
    # factor is 1: else poses would be drawn to the sensor that happens to fit best until it had no
    # noise at all
    rules, sigmas, sensors = bundle.rules, bundle.sigmas, state.rig.sensors
    count, squares = np.zeros((2, len(sensors)))
    weighted, alone = _weighted_pairs(bundle, state, blur, np.ones(len(blur)))
    for s, ((rows, _), weight) in enumerate(zip(weighted, alone, strict=True)):
        near = weight * rows.pairs.nearest
        count[s] = sensors[s].dimension * float(near.sum())
        squares[s] = near @ (rows.residual**2).sum(axis=1)
    unknowns = bundle.count + bundle.pose_free.sum() * len(bundle.frames)
    used_share = unknowns / np.maximum(blur**2 * (count / blur**2).sum(), 1.0)
    freedom = count * (1 - np.minimum(used_share, 0.9))
    noise = np.array(sigmas, dtype=np.float64)
    units = np.array([sensor.unit for sensor in sensors])
    for unit in sorted(set(units)):
        is_kind = units == unit
        if count[is_kind].sum() <= 6:
            continue
        scaled = squares[is_kind] / sigmas[is_kind] ** 2
        kind_variance = scaled.sum() / freedom[is_kind].sum()
        variance = (scaled + rules.alike * kind_variance) / (freedom[is_kind] + rules.alike)
        bounded = np.clip(variance, kind_variance / unlike**2, kind_variance * unlike**2)
        # a Gaussian of variance s² under the weight exp(-d²/4b²) has variance 1/(1/s² + 1/2b²)
        width = blur[is_kind] / sigmas[is_kind]
        inverse = np.maximum(1 / np.maximum(bounded, 1e-300) - 1 / (2 * width**2), 1e-300)
        noise[is_kind] *= np.clip(np.sqrt(1 / inverse), _SHARPEST, _BLUNTEST)
    return noise


def variance_ratio(rig: Rig, rules: CalibrationRules) -> float:
    """Return the covariance of an M-estimator with Cauchy weights over its inverse information."""
    dimension, tail = float(np.mean([sensor.dimension for sensor in rig.sensors])), rules.tail
    # for Gaussian errors, r standard deviations off, with weights w = 1/(1 + r²/c²):
    # E[w² r²/m] E[w] / E[w + w' r/m]²
    r = np.linspace(0, 10, 2001)
    density = r ** (dimension - 1) * np.exp(-(r**2) / 2)
    density /= density.sum()
    weight = 1 / (1 + (r / tail) ** 2)
    slope = weight - 2 * (r / tail) ** 2 * weight**2 / dimension
    spread = density @ (weight * r) ** 2 / dimension
    return float(spread * (density @ weight) / (density @ slope) ** 2)


def _inflation(bundle: Bundle, weighted: Sequence[Weighted], covariance: Floats) -> float:
    """Return the factor by which frames vary more than by independent errors of detections."""
    # the gradient of a frame by the rig has the covariance of its information S, unless a common
    # error of its detections, as of a sensor out of step, makes it larger. The fit absorbs S C S
    rank, observed, absorbed = float(np.linalg.matrix_rank(covariance)), 0.0, 0.0
    for frame in range(len(bundle.frames)):
        r, A, B = _frame_equations(bundle, weighted, frame)
        A = A - B @ np.linalg.lstsq(B, A, rcond=None)[0]
        gradient, share = A.T @ r, covariance @ (A.T @ A)
        observed += float(gradient @ covariance @ gradient)
        absorbed += float((share * share.T).sum())
    expected = rank - absorbed
    return observed / expected if observed > 1.3 * expected and absorbed < rank / 2 else 1.0


def _frame_equations(
    bundle: Bundle, weighted: Sequence[Weighted], frame: int
) -> tuple[Floats, Floats, Floats]:
    """Return residuals (n,) of a frame, Jacobians (n, G) and (n, d), in standard deviations."""
    parts = []
    for rows, weight in weighted:
        in_frame = rows.pairs.frame == frame
        root = np.sqrt(weight[in_frame])[:, None, None]
        by_pose = rows.by_pose[in_frame][:, :, bundle.pose_free]
        columns = (rows.residual[in_frame][..., None], rows.by_rig[in_frame], by_pose)
        parts.append(np.concatenate([root * column for column in columns], axis=2))
    joined = np.concatenate([part.reshape(-1, part.shape[2]) for part in parts])
    return joined[:, 0], joined[:, 1 : 1 + bundle.count], joined[:, 1 + bundle.count :]


def fit_pairs(bundle: Bundle, rig: Rig, adjusted: Adjusted) -> tuple[Floats, list[Floats]]:
    """Fit a bundle's parameters and poses to known pairs; return the parameters' whole step (G,).

    Also return squared residuals (n,) of each sensor's pairs; NaN of pairs that are not met.
    """
    state, misfit, change = State(rig, adjusted.state.poses), np.inf, np.zeros(bundle.count)
    for _ in range(_CLIMBS):
        rows = list[Weighted]()
        for s, (known, weight) in enumerate(adjusted.weighted):
            current = rows_of(bundle, state, s, known.pairs)
            rows.append((current, (weight > MET) * current.known / adjusted.noise[s] ** 2))
        squared = [(r.residual**2).sum(axis=1) for r, _ in rows]
        weighed = zip(rows, squared, strict=True)
        before, misfit = misfit, sum(float(weight @ values) for (_, weight), values in weighed)
        if before - misfit < _CLIMBED * misfit or not bundle.pose_free.any():
            break
        step = solve_step(bundle, state, rows, 1e-6)
        state, change = apply_step(bundle, state, step), change + step.rig
    pairs = zip(rows, squared, strict=True)
    return change, [np.where(w > 0, values, np.nan) for (_, w), values in pairs]
