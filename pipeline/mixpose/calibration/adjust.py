"""Maximise the matched objective over rig and poses, through narrowing blurs.

At each blur the objective is climbed by Gauss-Newton; the blurs end at twice the noise that the
residuals show, which is learnt on the way.  Pairs are known by then, and the last steps weigh them
as Cauchy errors: where sensors are out of step, a frame that is far off is less wrong than it is
far, and a Gaussian kernel would drop it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mixpose.calibration.bundle import Bundle, Weighted, rows_of, solved, stepped
from mixpose.calibration.matching import feature_spacing, match, nearest_distance
from mixpose.calibration.rig import Rig, State
from mixpose.calibration.rules import CalibrationRules
from mixpose.records import Floats, Mask

MET = 0.05
"""Weight of a pair: 5 standard deviations off have 0.2."""

_MOST_BLURS = 40
_UNKNOWN = 0.1  # of a parameter's squared length along directions that are not determined
_SHARPEST = 1e-3  # of σ_ε: residuals of data without any noise
_BLUNTEST = 2.0  # of σ_ε, which is the largest error of the extraction
_FARTHEST = 0.3  # rad: the linear model reaches no farther
_CLIMBS = 12
_CLIMBED = 1e-6  # of the squared residuals: less gained, and poses are fitted


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Rig and poses at the maximum."""

    state: State
    noise: Floats  # (L,): standard deviation of a detection's coordinate by sensor
    covariance: Floats  # (G, G): of the free parameters, in the gauge
    unknown: Floats  # (G, u): directions that are not determined, in the parameters' sizes
    weighted: tuple[Weighted, ...]  # of each sensor; weights are 1 for what agrees
    inflation: float  # of variances, over what independent errors of detections make of them

    @property
    def undetermined(self) -> Mask:
        """Parameters (G,) of which data tell nothing."""
        return np.asarray((self.unknown**2).sum(axis=1) > _UNKNOWN)

    @property
    def deviations(self) -> Floats:
        """Standard deviations of the parameters (G,); infinite where not determined."""
        told = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return np.where(self.undetermined, np.inf, told)

    @property
    def certainty(self) -> float:
        """Share of the weight of pairs of which each is the nearest that the other has."""
        nearest = sum(float(weight @ rows.pairs.nearest) for rows, weight in self.weighted)
        return nearest / max(sum(float(weight.sum()) for _, weight in self.weighted), 1e-9)


def _first_blurs(bundle: Bundle, state: State) -> Floats:
    """Blurs (L,) to begin with: wide enough for what the start is off, not for neighbours."""
    rules, blurs = bundle.rules, np.array(bundle.sigmas, dtype=np.float64)
    for sensor, sigma in enumerate(bundle.sigmas):
        off = nearest_distance(state, bundle.frames, bundle.clock, sensor)
        if len(off):
            widest = rules.widest * feature_spacing(state, sensor)
            wanted = rules.first_blur * float(np.median(off))
            blurs[sensor] = max(min(wanted, widest), _SHARPEST * sigma)
    return blurs


def adjust(
    bundle: Bundle, state: State, *, blurs: Floats | None = None, noise: Floats | None = None
) -> Adjusted:
    """Climb from a start to the maximum.

    The blurs (L,) to begin with are as the start needs if left out.  Noise (L,) that is given is
    known, and none is learnt.
    """
    rules = bundle.rules
    blur = _first_blurs(bundle, state) if blurs is None else blurs
    for _ in range(_MOST_BLURS):
        for _ in range(rules.steps):
            state, _ = _climbed(bundle, state, _weighted(bundle, state, blur, blur)[0])
        learnt = noise if noise is not None else _noise(bundle, 1.0, state, blur)
        # features that crowd look like noise at a wide blur, which must not widen it further
        last = np.minimum(rules.blur * learnt, _widest_alike(state.rig, blur, bundle.sigmas))
        if (blur <= last / rules.narrowing).all():
            break
        blur = np.maximum(blur * rules.narrowing, last)
    if noise is not None:
        return _ended(bundle, state, noise, None)
    found = _ended(bundle, state, last / rules.blur, 1.0)
    if found.inflation > 1:
        return found
    return _ended(bundle, found.state, found.noise, rules.unlike)


def _widest_alike(rig: Rig, blur: Floats, sigmas: Floats) -> Floats:
    """Of each sensor (L,) the widest blur, by σ_ε, of sensors of its kind."""
    units = np.array([eye.unit for eye in rig.sensors])
    return np.array([sigma * (blur / sigmas)[units == u].max() for sigma, u in zip(sigmas, units)])


def _ended(bundle: Bundle, state: State, noise: Floats, unlike: float | None) -> Adjusted:
    """The last steps, at the noise that is learnt as of `_noise`; None: that is known."""
    rules = bundle.rules
    most = rules.unlike * noise
    for _ in range(rules.last_steps):
        weighted, _ = weighted_at_the_end(bundle, state, noise)
        state, size = _climbed(bundle, state, weighted)
        before = noise
        if unlike is not None:
            noise = np.minimum(_noise(bundle, unlike, state, rules.blur * noise), most)
        if size < rules.converged and np.allclose(before, noise, rtol=1e-3):
            break
    weighted, alone = weighted_at_the_end(bundle, state, noise)
    step = solved(bundle, state, weighted)
    scattered = step.covariance * variance_ratio(state.rig, rules)
    inflation = _inflation(bundle, weighted, scattered)
    covariance = scattered * inflation + step.of_held
    pairs = tuple((rows, weight) for (rows, _), weight in zip(weighted, alone, strict=True))
    return Adjusted(state, noise, covariance, step.unknown, pairs, inflation)


def weighted_at_the_end(
    bundle: Bundle, state: State, noise: Floats
) -> tuple[list[Weighted], list[Floats]]:
    """Pairs as the last steps weigh them; and by the objective alone."""
    return _weighted(bundle, state, bundle.rules.blur * noise, noise, last=True)


def moved_by_held(bundle: Bundle, found: Adjusted) -> Floats:
    """Standard deviations (G,) of the rig's parameters that come of errors of what is held."""
    weighted, _ = weighted_at_the_end(bundle, found.state, found.noise)
    return np.asarray(np.sqrt(np.diag(solved(bundle, found.state, weighted).of_held)))


def _weighted(
    bundle: Bundle, state: State, blur: Floats, noise: Floats, *, last: bool = False
) -> tuple[list[Weighted], list[Floats]]:
    """Pairs of all sensors, weighted by the objective and the noise; and by the objective alone."""
    rules = bundle.rules
    found: list[Weighted] = []
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
        found.append((rows, weight / noise[sensor] ** 2))
    return found, alone


def _climbed(bundle: Bundle, state: State, weighted: Sequence[Weighted]) -> tuple[State, float]:
    """One step; its size in standard deviations of the rig's parameters."""
    step = solved(bundle, state, weighted, 1e-9)
    is_turn = [unit == "rad" for block in bundle.blocks for unit in block.units]
    turns = np.concatenate([step.poses[:, 3:].ravel(), step.rig[is_turn]])
    largest = float(np.abs(turns).max(initial=0.0))
    if largest > _FARTHEST:
        share = _FARTHEST / largest
        step = replace(step, rig=step.rig * share, poses=step.poses * share)
    deviations = np.sqrt(np.maximum(np.diag(step.covariance), 0.0))
    moved = step.rig[deviations > 0] / deviations[deviations > 0]
    size = float(np.abs(moved).max(initial=0.0))
    if not bundle.count:
        size = float(np.abs(step.poses).max(initial=0.0)) * 1e3
    return stepped(bundle, state, step), size


def _noise(bundle: Bundle, unlike: float, state: State, blur: Floats) -> Floats:
    """Standard deviation of detections (L,) from residuals under a Gaussian weight."""
    # that of a sensor is like that of others of its kind, within the factor `unlike`. Where frames
    # err as a whole it is 1: poses would be drawn to the sensor that happens to fit best until it
    # had no noise at all
    rules, sigmas, sensors = bundle.rules, bundle.sigmas, state.rig.sensors
    count, spent = np.zeros((2, len(sensors)))
    weighted, alone = _weighted(bundle, state, blur, np.ones(len(blur)))
    for s, ((rows, _), weight) in enumerate(zip(weighted, alone, strict=True)):
        near = weight * rows.pairs.nearest
        count[s] = sensors[s].dimension * float(near.sum())
        spent[s] = near @ (rows.residual**2).sum(axis=1)
    unknowns = bundle.count + bundle.pose_free.sum() * len(bundle.frames)
    used = unknowns / np.maximum(blur**2 * (count / blur**2).sum(), 1.0)
    left = count * (1 - np.minimum(used, 0.9))
    found = np.array(sigmas, dtype=np.float64)
    units = np.array([eye.unit for eye in sensors])
    for unit in sorted(set(units)):
        alike = units == unit
        if count[alike].sum() <= 6:
            continue
        scaled = spent[alike] / sigmas[alike] ** 2
        common = scaled.sum() / left[alike].sum()
        own = (scaled + rules.alike * common) / (left[alike] + rules.alike)
        tilted = np.clip(own, common / unlike**2, common * unlike**2)
        # a Gaussian of variance s² under the weight exp(-d²/4b²) has 1/(1/s² + 1/2b²)
        width = blur[alike] / sigmas[alike]
        inverse = np.maximum(1 / np.maximum(tilted, 1e-300) - 1 / (2 * width**2), 1e-300)
        found[alike] *= np.clip(np.sqrt(1 / inverse), _SHARPEST, _BLUNTEST)
    return found


def variance_ratio(rig: Rig, rules: CalibrationRules) -> float:
    """Covariance of an M-estimator with Cauchy weights over the inverse of its normal equations."""
    dimension, tail = float(np.mean([eye.dimension for eye in rig.sensors])), rules.tail
    # of Gaussian errors with radius r in their deviations, whose weight is w = 1/(1 + r²/c²):
    # E[w² r²/m] E[w] / E[w + w' r/m]²
    r = np.linspace(0, 10, 2001)
    density = r ** (dimension - 1) * np.exp(-(r**2) / 2)
    density /= density.sum()
    weight = 1 / (1 + (r / tail) ** 2)
    slope = weight - 2 * (r / tail) ** 2 * weight**2 / dimension
    spread = density @ (weight * r) ** 2 / dimension
    return float(spread * (density @ weight) / (density @ slope) ** 2)


def _inflation(bundle: Bundle, weighted: Sequence[Weighted], covariance: Floats) -> float:
    """By how much frames differ more than independent errors of detections would let them."""
    # each frame's pull on the rig has the covariance of its information S; a common error of its
    # detections, as of a sensor out of step, makes it larger. The fit takes S C S of it away
    rank, seen, spent = float(np.linalg.matrix_rank(covariance)), 0.0, 0.0
    for frame in range(len(bundle.frames)):
        r, A, B = _of_frame(bundle, weighted, frame)
        A = A - B @ np.linalg.lstsq(B, A, rcond=None)[0]
        pull, share = A.T @ r, covariance @ (A.T @ A)
        seen += float(pull @ covariance @ pull)
        spent += float((share * share.T).sum())
    return seen / (rank - spent) if seen > 1.3 * (rank - spent) and spent < rank / 2 else 1.0


def _of_frame(
    bundle: Bundle, weighted: Sequence[Weighted], frame: int
) -> tuple[Floats, Floats, Floats]:
    """Residuals (n,) of a frame, by the rig (n, G) and by its pose (n, d), in deviations."""
    parts = []
    for rows, weight in weighted:
        own = rows.pairs.frame == frame
        root = np.sqrt(weight[own])[:, None, None]
        by_pose = rows.by_pose[own][:, :, bundle.pose_free]
        each = (rows.residual[own][..., None], rows.by_rig[own], by_pose)
        parts.append(np.concatenate([root * one for one in each], axis=2))
    told = np.concatenate([part.reshape(-1, part.shape[2]) for part in parts])
    return told[:, 0], told[:, 1 : 1 + bundle.count], told[:, 1 + bundle.count :]


def fitted(bundle: Bundle, rig: Rig, adjusted: Adjusted) -> tuple[Floats, list[Floats]]:
    """How far a bundle's parameters go (G,) from a rig to suit pairs best, with poses.

    And squared residuals (n,) of each sensor's pairs then; NaN of pairs that are not met.
    """
    state, spent, gone = State(rig, adjusted.state.poses), np.inf, np.zeros(bundle.count)
    for _ in range(_CLIMBS):
        rows = list[Weighted]()
        for s, (seen, weight) in enumerate(adjusted.weighted):
            found = rows_of(bundle, state, s, seen.pairs)
            rows.append((found, (weight > MET) * found.known / adjusted.noise[s] ** 2))
        squared = [(found.residual**2).sum(axis=1) for found, _ in rows]
        weighed = zip(rows, squared, strict=True)
        before, spent = spent, sum(float(weight @ each) for (_, weight), each in weighed)
        if before - spent < _CLIMBED * spent or not bundle.pose_free.any():
            break
        step = solved(bundle, state, rows, 1e-6)
        state, gone = stepped(bundle, state, step), gone + step.rig
    pairs = zip(rows, squared, strict=True)
    return gone, [np.where(w > 0, each, np.nan) for (_, w), each in pairs]
