"""From judged poses to a status: what is possible, sure, the same, and what contradicts itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from scipy.linalg import block_diag
from scipy.special import fdtri

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement.judge import ScoredPose
from mixpose.judgement.noise import NoiseModel, information_of, inverted
from mixpose.matching import LEAST_VARIANCE, Matches
from mixpose.records import Floats, Mask, Status
from mixpose.rigid import rotation_angle_deg, twist_between

APART = "two sensors contradict each other"


@dataclass(frozen=True)
class AcceptanceRules:
    """When a pose is believed."""

    sure: float = constant(7.0, "log odds against clutter from which a pose is ok: 1 in 1000 errs")
    possible: float = constant(0.5, "log odds to tell a pose: a little over even, as best of many")
    doubtful: float = constant(-4.5, "log odds to tell one that stands out: sure less two misses")
    doubtful_coverage: float = constant(0.6, "share of the body that a pose must meet to stand out")
    # of frames of one camera with five features and five false detections
    spare: float = constant(
        4.0, "coordinates beyond six that it must meet: of two fewer chance makes enough, in 9 %"
    )
    standing_out: float = constant(1.5, "log odds against all others: told without the body in 4 %")
    enough: float = constant(8.0, "features met that are enough however many are missed: a shape")
    rival: float = constant(0.01, "belief from which a pose is a rival; from a tenth, a hypothesis")
    widest_turn_deg: float = constant(15.0, "95 % bound on a turn that ranges may leave open")
    convincing: float = constant(0.75, "share of the body to look nowhere else: a slip meets less")
    agreeing: float = constant(0.5, "share that a sensor that agrees, and a sure pose, must meet")
    disagreeing: float = constant(25.0, "variance of a sensor over the others' to leave it out")
    open: float = constant(300.0, "sum of variances by those if all in view were met, and whole")
    changed: float = constant(10.0, "times the residuals that chance makes: frames have up to 7")
    same: float = constant(0.02, "of the body's radius, and rad: nearer poses are one")
    same_peak: float = constant(3.0, "deviations of their distance within which poses are one")
    same_peak_deg: float = constant(5.0, "turn of two poses all the same: tilts of a flat body")


@dataclass(frozen=True)
class Verdict:
    """The decision about a frame."""

    status: Status
    best: ScoredPose | None  # None where the frame is lost
    kept: list[tuple[ScoredPose, float]]  # poses worth telling with their beliefs, best first
    doubt: str = ""  # why a frame is ambiguous, other than for its rivals

    def doubted(self, doubt: str) -> Verdict:
        """The same, ambiguous for a reason; no reason leaves it as it is."""
        return replace(self, status="ambiguous", doubt=doubt) if doubt else self


def is_fixed(pose: ScoredPose, free: Mask) -> bool:
    """Whether what is met fixes a pose in its free directions (6,)."""
    return bool(pose.measurements >= np.count_nonzero(free))


def is_possible(pose: ScoredPose, free: Mask, rules: AcceptanceRules) -> bool:
    """Whether a pose is worth telling."""
    return is_fixed(pose, free) and pose.log_evidence > rules.possible


def is_sure(pose: ScoredPose, free: Mask, rules: AcceptanceRules) -> bool:
    """Whether a pose is believed, if no rival casts doubt on it.

    So much of the body is met that another one cannot pass for it, as three markers of it may; and
    no wide sector of turns is left open, as by ranges.
    """
    turn = 0.0 if pose.spread is None else 1.96 * float(pose.spread[3:].max())
    met, in_view = pose.features
    return bool(
        is_fixed(pose, free)
        and pose.log_evidence > rules.sure
        and turn < math.radians(rules.widest_turn_deg)
        and met >= min(rules.agreeing * in_view, rules.enough)
    )


def convinces(pose: ScoredPose, free: Mask, rules: AcceptanceRules) -> bool:
    """Whether a sure pose, near its prediction, meets so much that it could not be elsewhere.

    Beside two sensors that agree, others may be covered, blind or out of step.
    """
    agreeing = [share for share in pose.matches.coverage.tolist() if share >= rules.agreeing]
    share = sum(agreeing) / len(agreeing) if len(agreeing) > 1 else pose.coverage
    return is_sure(pose, free, rules) and share > rules.convincing


def decide(ranked: Sequence[ScoredPose], free: Mask, rules: AcceptanceRules) -> Verdict:
    """Decide about a frame from all its poses, the most evident first."""
    told = [one for one in ranked if is_possible(one, free, rules)]
    if ranked and _stands_out(ranked, free, rules):
        told.insert(0, ranked[0])
    if not told:
        return Verdict("lost", None, [])
    best, weights = told[0], beliefs(ranked)
    # what is not possible by itself still casts doubt on the others
    rivals = [weight for one, weight in zip(ranked, weights, strict=True) if one is not best]
    clear = max(rivals, default=0.0) < rules.rival
    if clear := clear and is_sure(best, free, rules):
        # nor is a turn unknown (π²/3 rad²), as about the line that all features met lie on
        clear = bool(best.covariance[3:, 3:].trace() < math.pi**2 / 3)
    kept = [
        (one, weight)
        for one, weight in zip(ranked, weights, strict=True)
        if one is best or (weight >= rules.rival / 10 and is_fixed(one, free))
    ]
    return Verdict("ok" if clear else "ambiguous", best, kept)


def is_open(pose: ScoredPose, free: Mask, rules: AcceptanceRules, model: NoiseModel) -> bool:
    """Whether what would fix some direction is hidden or cut.

    The sum of variances is compared with that if all features in view were met, and whole, by this
    noise and by what is usual.
    """
    used = pose.used
    if not (np.count_nonzero(used.shares < used.weights) or np.count_nonzero(used.extra)):
        return False
    inner = np.ix_(free, free)
    whole = replace(used, shares=used.weights, extra=np.zeros(used.extra.shape))
    C = inverted(information_of(used, pose.variances)[inner])
    usual = np.full(len(used.names), model.usual**2)
    ratio, by_usual = (
        float(np.vdot(C, information_of(whole, noise)[inner])) for noise in (pose.variances, usual)
    )
    return ratio > rules.open and by_usual > 2 * len(C)


def _stands_out(ranked: Sequence[ScoredPose], free: Mask, rules: AcceptanceRules) -> bool:
    """Whether the first pose meets most of the body and is far likelier than all others.

    Poses that meet detections by chance come in numbers, and about equally good.
    """
    first, *others = ranked
    rest = float(reduce(np.logaddexp, [one.log_evidence for one in others], -math.inf))
    return bool(
        first.coverage >= rules.doubtful_coverage
        and first.measurements >= np.count_nonzero(free) + rules.spare
        and first.log_evidence > max(rules.doubtful, rest + rules.standing_out)
    )


def insert(
    ranked: list[ScoredPose], new: ScoredPose, body: Body, free: Mask, rules: AcceptanceRules
) -> None:
    """Keep a list of distinct poses, the most evident first."""
    for k, old in enumerate(ranked):
        if _alike(old, new, body, free, rules):
            # that residuals are larger than those before them is as rare as that a sure pose is
            # wrong, though more spots are off for smaller ones; of two as good the later says more
            more = rules.sure * (int(new.is_unlike) - int(old.is_unlike))
            if new.log_evidence > old.log_evidence + more - 0.01:
                ranked[k] = new
            break
    else:
        ranked.append(new)
    ranked.sort(key=lambda one: -one.log_evidence)


def _alike(a: ScoredPose, b: ScoredPose, body: Body, free: Mask, rules: AcceptanceRules) -> bool:
    """Whether two poses are one: at the same place, or on one peak of which one is not the top."""
    T_a = a.T_world_object
    T_b = nearest_alike(b.T_world_object, body, T_a)
    away = twist_between(T_a, T_b)[free]
    both = (a.covariance + b.covariance + a.bent)[np.ix_(free, free)]
    inside = bool(away @ inverted(both) @ away < rules.same_peak**2)
    if a.spread is not None:
        return inside  # of the likelihood, drawn to different priors
    turned = float(rotation_angle_deg(T_a, T_b))
    centre = np.append(body.means.mean(axis=0), 1.0)
    apart = float(np.linalg.norm((T_a - T_b) @ centre)) / body.radius
    if max(apart, math.radians(turned)) < rules.same:
        return True
    # features that may be off leave a turn as open as that
    open_turn = rules.same_peak * np.degrees(np.sqrt(np.linalg.eigvalsh(a.bent[3:, 3:]).max()))
    return inside and turned < max(rules.same_peak_deg, min(open_turn, rules.widest_turn_deg))


def contradict(
    judged: ScoredPose, before: Floats, agreed: bool, rules: AcceptanceRules, model: NoiseModel
) -> bool:
    """Whether the two sensors of a frame contradict each other: no pose is right for both.

    `before` are squares and degrees of freedom (2,) of residuals of the frames before; where two
    sensors `agreed` in one of them, one may miss the body now.
    """
    used = judged.used
    if used.dimensions.tolist() != [2, 2]:
        return False
    variance = _variance(before, model, model.errors.typical)
    # one meets most of the body; the other misses it, and sees as much beside it, or, where the
    # two never agreed, anywhere
    least, most = sorted(range(2), key=used.coverage.tolist().__getitem__)
    if used.coverage[least] < rules.agreeing <= used.coverage[most]:
        beside, needed = used.unmatched_nearby[least], used.missed[least]
        if not agreed:
            beside, needed = used.count[least] - used.met[least], used.met[most]
        if needed > 0 and beside >= rules.agreeing * needed:
            # of the body's, against detections anywhere near
            v = min(variance, model.usual**2) + used.extra[least]
            odds = np.log(model.errors.met**2 / (2 * v)) - used.squared[least] / (2 * v)
            return bool(used.shares[least] @ odds < rules.sure)
    # offsets far beyond the noise so far, which a pose of its own takes away in each sensor
    if not is_far_off(used, before, rules, model):
        return False
    used = _by_noise(used, variance, model)
    rows, offsets = used.rows()
    J = block_diag(*rows)
    J /= np.maximum(np.linalg.norm(J, axis=0), 1e-12)
    taken, _, rank, _ = np.linalg.lstsq(J, offsets.ravel(), rcond=1e-6)
    alone = float(((offsets.ravel() - J @ taken) ** 2).sum())
    # two poses take up more than the one that both have in common
    own, more = float(used.measurements.sum()) - rank, max(rank - 6, 1.0)
    gained = (float(used.squares.sum()) - alone) / more
    return bool(own >= 1 and gained > fdtri(more, own, model.by_chance) * alone / own)


def _variance(before: Floats, model: NoiseModel, typical: float) -> float:
    """Of the noise so far (2,), squares and degrees of freedom, or what is typical before that."""
    is_known = before[1] >= model.known
    return max(float(before[0] / before[1]), LEAST_VARIANCE) if is_known else typical**2


def _by_noise(used: Matches, variance: float, model: NoiseModel) -> Matches:
    """Matches of which what errs by more than noise counts less, and a few far off not at all."""
    wide, met = variance + used.extra, used.shares > 0
    far = met & (used.squared > model.errors.outlying**2 * wide)
    # where most of a sensor are far off it is out of step, or turned
    far &= (
        np.count_nonzero(far, axis=1, keepdims=True) <= np.count_nonzero(met, axis=1)[:, None] / 2
    )
    return replace(used, shares=np.where(far, 0.0, used.shares * variance / wide))


def is_far_off(used: Matches, before: Floats, rules: AcceptanceRules, model: NoiseModel) -> bool:
    """Whether features are met far beyond the noise so far (2,), squares and degrees of freedom.

    Where that is not known, half as far beyond what is typical: half of σ_ε; right geometry has
    0.2.
    """
    variance = _variance(before, model, model.errors.typical / 2)
    used = _by_noise(used, variance, model)
    degrees, squares = sum(used.measurements.tolist()) - 6, sum(used.squares.tolist())
    return bool(degrees >= 1 and squares >= degrees * rules.disagreeing * variance)


def nearest_alike(T_world_object: Floats, body: Body, T_reference: Floats | None) -> Floats:
    """Of the poses that look the same, the one turned least against a reference, or the world."""
    if len(body.symmetries) == 1:
        return T_world_object
    R = T_world_object[:3, :3]
    turned = R if T_reference is None else T_reference[:3, :3].T @ R
    # the angle grows as the trace of the difference falls
    nearest = int((body.symmetries[:, :3, :3] * turned.T).sum(axis=(1, 2)).argmax())
    # the very same, where it is that: what was worked out for it holds
    return T_world_object if nearest == body.identity else T_world_object @ body.symmetries[nearest]


def beliefs(judged: Sequence[ScoredPose]) -> list[float]:
    """Share of belief of each pose among its rivals; even where none meets anything."""
    top = max([one.log_evidence for one in judged], default=0.0)
    odds = [math.exp(one.log_evidence - top) if top > -math.inf else 1.0 for one in judged]
    return [one / sum(odds) for one in odds]
