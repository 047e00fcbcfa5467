"""Maximise the matched objective over rig and poses, through narrowing blurs.

At each blur the objective is climbed by Gauss-Newton; the blurs end at twice the noise that the
residuals show, which is learnt on the way.  Pairs are known by then, and the last steps weigh them
as Cauchy errors: where sensors are out of step, a frame that is far off is less wrong than it is
far, and a Gaussian kernel would drop it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from mixpose.calibration.bundle import Bundle, Rows, normal_equations, rows_of, solved, stepped
from mixpose.calibration.matching import Pairs, feature_spacing, match, nearest_distance
from mixpose.calibration.rig import Rig
from mixpose.calibration.rules import CalibrationRules
from mixpose.records import Floats

GaugeOf = Callable[[Rig], Floats]
Weighted = tuple[int, Pairs, Rows, Floats]

_MOST_BLURS = 40
_UNKNOWN = 0.1  # of a parameter's squared length along directions that are not determined
_SHARPEST = 1e-3  # of σ_ε: residuals of data without any noise
_BLUNTEST = 2.0  # of σ_ε, which is the largest error of the extraction


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Rig and poses at the maximum."""

    rig: Rig
    poses: Floats  # (K, 4, 4)
    noise: Floats  # (L,): standard deviation of a detection's coordinate by sensor
    covariance: Floats  # (G, G): of the free parameters, in the gauge
    unknown: Floats  # (G, u): directions that are not determined, in the parameters' sizes
    # pairs of each sensor with residuals and weights, 1 for what agrees
    weighted: tuple[tuple[Pairs, Floats, Floats], ...]
    # by which variances are larger than independent errors of detections would make them
    inflation: float

    @property
    def undetermined(self) -> NDArray[np.bool_]:
        """Parameters (G,) of which data tell nothing."""
        return np.asarray((self.unknown**2).sum(axis=1) > _UNKNOWN)

    @property
    def certainty(self) -> float:
        """Share of the weight of pairs of which each is the nearest that the other has."""
        nearest = sum(float(weight @ pairs.nearest) for pairs, _, weight in self.weighted)
        return nearest / max(sum(float(weight.sum()) for _, _, weight in self.weighted), 1e-9)


def first_blurs(
    bundle: Bundle, rig: Rig, poses: Floats, sigmas: Floats, rules: CalibrationRules
) -> Floats:
    """Blurs (L,) to begin with: wide enough for what the start is off, not for neighbours."""
    blurs = np.array(sigmas, dtype=np.float64)
    for sensor in range(len(rig.sensors)):
        off = nearest_distance(rig, poses, bundle.frames, bundle.clock, sensor)
        if len(off):
            widest = rules.widest * feature_spacing(rig, poses, sensor)
            wanted = rules.first_blur * float(np.median(off))
            blurs[sensor] = max(min(wanted, widest), _SHARPEST * sigmas[sensor])
    return blurs


def adjust(
    bundle: Bundle,
    rig: Rig,
    poses: Floats,
    gauge_of: GaugeOf,
    sigmas: Floats,
    rules: CalibrationRules,
    *,
    blurs: Floats | None = None,
    noise: Floats | None = None,
) -> Adjusted:
    """Climb from a start to the maximum.

    Parameters
    ----------
    poses : (K, 4, 4) array
    gauge_of : callable
        Rows of the gauge at a rig.
    sigmas : (L,) array
        σ_ε by sensor.
    blurs : (L,) array or None
        To begin with; None: as the start needs.
    noise : (L,) array or None
        Known noise, of which none is learnt.
    """
    blur = first_blurs(bundle, rig, poses, sigmas, rules) if blurs is None else blurs
    for _ in range(_MOST_BLURS):
        for _ in range(rules.steps):
            weighted, _ = _weighted(bundle, rig, poses, blur, blur, rules)
            rig, poses, _ = _climbed(bundle, rig, poses, gauge_of, weighted)
        learnt = (
            noise if noise is not None else _noise(bundle, rig, poses, blur, sigmas, rules, 1.0)
        )
        # features that crowd look like noise at a wide blur, which must not widen it further
        last = np.minimum(rules.blur * learnt, _widest_alike(rig, blur, sigmas))
        if (blur <= last / rules.narrowing).all():
            break
        blur = np.maximum(blur * rules.narrowing, last)
    learnt = last / rules.blur
    if noise is not None:
        return _ended(bundle, rig, poses, gauge_of, noise, lambda *_: noise, rules)

    def alike(rig: Rig, poses: Floats, blur: Floats, unlike: float = 1.0) -> Floats:
        return _noise(bundle, rig, poses, blur, sigmas, rules, unlike)

    found = _ended(bundle, rig, poses, gauge_of, learnt, alike, rules)
    if found.inflation > 1:
        return found
    own = partial(alike, unlike=rules.unlike)
    return _ended(bundle, found.rig, found.poses, gauge_of, found.noise, own, rules)


def _widest_alike(rig: Rig, blur: Floats, sigmas: Floats) -> Floats:
    """Of each sensor (L,) the widest blur, by σ_ε, of sensors of its kind."""
    units = np.array([eye.unit for eye in rig.sensors])
    return np.array([sigma * (blur / sigmas)[units == u].max() for sigma, u in zip(sigmas, units)])


def _ended(
    bundle: Bundle,
    rig: Rig,
    poses: Floats,
    gauge_of: GaugeOf,
    noise: Floats,
    learnt: Callable[[Rig, Floats, Floats], Floats],
    rules: CalibrationRules,
) -> Adjusted:
    """The last steps, at the noise that is learnt."""
    most = rules.unlike * noise
    for _ in range(rules.last_steps):
        weighted, _ = _weighted(bundle, rig, poses, rules.blur * noise, noise, rules, last=True)
        rig, poses, size = _climbed(bundle, rig, poses, gauge_of, weighted)
        before, noise = noise, np.minimum(learnt(rig, poses, rules.blur * noise), most)
        if size < rules.converged and np.allclose(before, noise, rtol=1e-3):
            break
    return _finished(bundle, rig, poses, gauge_of, noise, rules)


def _weighted(
    bundle: Bundle,
    rig: Rig,
    poses: Floats,
    blur: Floats,
    noise: Floats,
    rules: CalibrationRules,
    *,
    last: bool = False,
) -> tuple[list[Weighted], list[Floats]]:
    """Pairs of all sensors, weighted by the objective and the noise; and by the objective alone."""
    found: list[Weighted] = []
    alone: list[Floats] = []
    faintest = rules.faintest_last if last else rules.faintest
    for sensor in range(len(rig.sensors)):
        pairs = match(rig, poses, bundle.frames, bundle.clock, sensor, blur[sensor], faintest)
        rows = rows_of(bundle, rig, poses, sensor, pairs)
        squared = (rows.residual**2).sum(axis=1)
        share = pairs.share * rows.known
        weight = share * np.exp(-squared / (4 * blur[sensor] ** 2))
        alone.append(weight)
        if last:
            weight = share / (1 + squared / (rules.tail * noise[sensor]) ** 2)
        found.append((sensor, pairs, rows, weight / noise[sensor] ** 2))
    return found, alone


def _climbed(
    bundle: Bundle,
    rig: Rig,
    poses: Floats,
    gauge_of: GaugeOf,
    weighted: Sequence[Weighted],
) -> tuple[Rig, Floats, float]:
    """One step; its size in standard deviations of the rig's parameters."""
    normal = normal_equations(bundle, len(poses), weighted, 1e-9)
    step = solved(bundle, normal, gauge_of(rig), len(poses))
    largest = np.abs(step.poses[:, 3:]).max(initial=0.0)
    for block in bundle.blocks:
        turns = [abs(v) for v, u in zip(step.rig[block.place], block.units) if u == "rad"]
        largest = max(largest, *turns, 0.0) if turns else largest
    if largest > 0.3:  # the linear model does not reach that far
        step = replace(step, rig=step.rig * 0.3 / largest, poses=step.poses * 0.3 / largest)
    deviations = np.sqrt(np.maximum(np.diag(step.covariance), 0.0))
    moved = step.rig[deviations > 0] / deviations[deviations > 0]
    size = float(np.abs(moved).max(initial=0.0))
    if not bundle.count:
        size = float(np.abs(step.poses).max(initial=0.0)) * 1e3
    rig, poses = stepped(bundle, rig, poses, step)
    return rig, poses, size


def _noise(
    bundle: Bundle,
    rig: Rig,
    poses: Floats,
    blur: Floats,
    sigmas: Floats,
    rules: CalibrationRules,
    unlike: float,
) -> Floats:
    """Standard deviation of detections (L,) from residuals under a Gaussian weight.

    That of a sensor is like that of others of its kind, within the factor `unlike`.  Where frames
    err as a whole it is 1: poses would be drawn to the sensor that happens to fit best until it had
    no noise at all.
    """
    weighted, alone = _weighted(bundle, rig, poses, blur, np.ones(len(blur)), rules)
    alone = [w * one[1].nearest for one, w in zip(weighted, alone)]
    count = np.array([eye.dimension * float(w.sum()) for eye, w in zip(rig.sensors, alone)])
    spent = np.array(
        [float(w @ (one[2].residual ** 2).sum(axis=1)) for one, w in zip(weighted, alone)]
    )
    unknowns = bundle.count + bundle.pose_free.sum() * len(bundle.frames)
    used = unknowns / np.maximum(blur**2 * (count / blur**2).sum(), 1.0)
    left = count * (1 - np.minimum(used, 0.9))
    found = np.array(sigmas, dtype=np.float64)
    units = np.array([eye.unit for eye in rig.sensors])
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


def moved_by_held(
    bundle: Bundle, found: Adjusted, gauge_of: GaugeOf, rules: CalibrationRules
) -> Floats:
    """Standard deviations (G,) of the rig's parameters that come of errors of what is held."""
    weighted, _ = _weighted(
        bundle, found.rig, found.poses, rules.blur * found.noise, found.noise, rules, last=True
    )
    normal = normal_equations(bundle, len(found.poses), weighted, 0.0)
    step = solved(bundle, normal, gauge_of(found.rig), len(found.poses))
    return np.asarray(np.sqrt(np.diag(step.of_held)))


def _finished(
    bundle: Bundle,
    rig: Rig,
    poses: Floats,
    gauge_of: GaugeOf,
    noise: Floats,
    rules: CalibrationRules,
) -> Adjusted:
    weighted, alone = _weighted(bundle, rig, poses, rules.blur * noise, noise, rules, last=True)
    normal = normal_equations(bundle, len(poses), weighted, 0.0)
    step = solved(bundle, normal, gauge_of(rig), len(poses))
    dimension = float(np.mean([eye.dimension for eye in rig.sensors]))
    scattered = step.covariance * _of_cauchy(dimension, rules.tail)
    inflation = _inflation(bundle, weighted, scattered, len(poses))
    covariance = scattered * inflation + step.of_held
    parts = tuple(
        (pairs, rows.residual, weight)
        for (_, pairs, rows, _), weight in zip(weighted, alone, strict=True)
    )
    return Adjusted(rig, poses, noise, covariance, step.unknown, parts, inflation)


def _of_cauchy(dimension: float, tail: float) -> float:
    """Covariance of an M-estimator with Cauchy weights over the inverse of its normal equations.

    Of Gaussian errors with radius r in units of their deviation, whose weight is w = 1/(1 + r²/c²):
    E[w² r²/m] E[w] / E[w + w' r/m]².
    """
    r = np.linspace(0, 10, 2001)
    density = r ** (dimension - 1) * np.exp(-(r**2) / 2)
    density /= density.sum()
    weight = 1 / (1 + (r / tail) ** 2)
    slope = weight - 2 * (r / tail) ** 2 * weight**2 / dimension
    spread = density @ (weight * r) ** 2 / dimension
    return float(spread * (density @ weight) / (density @ slope) ** 2)


def _inflation(
    bundle: Bundle, weighted: Sequence[Weighted], covariance: Floats, frames: int
) -> float:
    """By how much frames differ more than independent errors of detections would let them.

    Each frame's pull on the rig has the covariance of its information; a common error of its
    detections, as of a sensor out of step, makes it larger.
    """
    G = bundle.count
    if not G:
        return 1.0
    pulls = np.zeros((frames, G))
    for _, pairs, rows, weight in weighted:
        flat = rows.residual * weight[:, None]
        for block, J in rows.by_rig:
            columns = np.arange(block.place.start, block.place.stop)
            pull = np.einsum("nmk,nm->nk", J, flat)
            np.add.at(pulls, (pairs.frame[:, None], columns[None]), pull)
        if rows.by_point is not None:
            start = next(b.start for b in bundle.blocks if b.kind == "body")
            pull = np.einsum("nmk,nm->nk", rows.by_point, flat)
            columns = start + 3 * pairs.feature[:, None] + np.arange(3)
            np.add.at(pulls, (pairs.frame[:, None], columns), pull)
    active = int(np.count_nonzero(pulls.any(axis=1)))
    rank = int(np.linalg.matrix_rank(covariance)) if G else 0
    if active <= rank + 2 or not rank:
        return 1.0
    seen = float(np.einsum("ki,ij,kj->", pulls, covariance, pulls)) / rank
    seen *= active / (active - rank)
    return seen if seen > 1.3 else 1.0
