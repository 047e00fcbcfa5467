"""From judged poses to a status: what is possible, sure, the same, and what contradicts itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, expit, logit

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement.information import information_of, inverted
from mixpose.judgement.judge import ScoredPose
from mixpose.judgement.noise import NoiseModel
from mixpose.judgement.shape import Shape
from mixpose.matching import LEAST_VARIANCE, Matches
from mixpose.records import Floats, Mask, Status
from mixpose.rigid import twist_between

LEAST_BELIEF = 1e-12
"""In a pose: what is less likely is as good as what nobody thought of."""


@dataclass(frozen=True)
class AcceptanceRules:
    """When a pose is believed."""

    confidence: float = constant(0.999, "that a pose is right, to be ok: one of 1000 may err")
    mistaken: float = constant(
        2e-4, "of sessions, each: a body mirrored or of another size, a sensor elsewhere"
    )
    widest_turn_deg: float = constant(
        15.0, "95 % bound on a turn that is known; of one pose's peak"
    )
    convincing: float = constant(0.75, "share of the body to look nowhere else: a slip meets less")
    agreeing: float = constant(0.5, "share of the body that a sensor that agrees must meet")
    disagreeing: float = constant(25.0, "variance of a sensor over the others' to leave it out")
    changed: float = constant(10.0, "times the residuals that chance makes: frames have up to 7")
    open: float = constant(300.0, "sum of variances by those if all in view were met, and whole")

    @property
    def log_doubt(self) -> float:
        """Log odds against a pose that is just ok."""
        return -float(logit(self.confidence))


class Alternative(NamedTuple):
    """Something else that a frame may show."""

    what: str  # in words; empty for mere clutter, and for other poses of the body
    log_odds: float = 0.0  # against the pose in question; even where nobody knows


_NOTHING = Alternative("", -math.inf)
TURNS = "what is met leaves it open how the body is turned"


class Second(NamedTuple):
    """What else in a frame looks like the body."""

    pose: ScoredPose | None  # None where there is nothing
    there: float  # log odds that it is there
    either: float  # that it is the body, and not the best pose
    told: bool = False  # whether one of them is seen to be an image in a mirror, or another thing


@dataclass(frozen=True)
class Verdict:
    """The decision about a frame: ok where nothing else is likely."""

    best: ScoredPose | None  # None where the frame is lost
    kept: list[tuple[ScoredPose, float]]  # poses worth telling with their beliefs, best first
    # less likely ones that further frames may make likely, of single ranges
    faint: tuple[tuple[ScoredPose, float], ...] = ()
    against: tuple[Alternative, ...] = ()  # the best of them
    most: float = -math.inf  # log odds against it up to which it is ok
    # detections that sensors had left where the body was sought a second time
    tried: Mapping[str, int] = field(default_factory=dict)
    second: Second | None = None  # None where nobody asked
    # log odds of mistakes in the session, by name; None where it was not asked for them
    mistaken: Mapping[str, float] | None = None
    shape: Shape | None = None  # what frames told of it, while none was ok

    @cached_property
    def confidence(self) -> float:
        """Probability that the best pose is right, by all alternatives."""
        return 0.0 if self.best is None else float(expit(-self._log_odds))

    @cached_property
    def _log_odds(self) -> float:
        return float(np.logaddexp.reduce([one.log_odds for one in self.against]))

    @property
    def status(self) -> Status:
        """What is told of the frame."""
        if self.best is None:
            return "lost"
        return "ok" if self._log_odds <= self.most else "ambiguous"

    @property
    def doubt(self) -> str:
        """Why the frame is ambiguous, other than for its rivals: the likeliest in words."""
        named = [one for one in self.against if one.what and one.log_odds > self.most]
        told = named if self.status == "ambiguous" else []
        return max(told, key=lambda one: one.log_odds, default=_NOTHING).what

    def doubted(self, more: Iterable[Alternative]) -> Verdict:
        """The same, with more alternatives."""
        return replace(self, against=(*self.against, *more))

    def without(self, *what: str) -> Verdict:
        """The same, but for some alternatives."""
        return replace(self, against=tuple([one for one in self.against if one.what not in what]))


def is_fixed(pose: ScoredPose, free: Mask) -> bool:
    """Whether what is met fixes a pose in its free directions (6,)."""
    return bool(pose.measurements >= np.count_nonzero(free))


def is_possible(pose: ScoredPose, free: Mask) -> bool:
    """Whether a pose is worth telling: if one feature that it misses would make it even."""
    return is_fixed(pose, free) and pose.log_evidence > pose.log_missed


def is_sure(pose: ScoredPose, free: Mask, rules: AcceptanceRules) -> bool:
    """Whether a pose is believed, if no rival casts doubt on it."""
    return is_fixed(pose, free) and pose.log_evidence > -rules.log_doubt


def convinces(pose: ScoredPose, free: Mask, rules: AcceptanceRules) -> bool:
    """Whether a sure pose, near its prediction, meets so much that it could not be elsewhere.

    Beside two sensors that agree, others may be covered, blind or out of step.
    """
    agreeing = [share for share in pose.matches.coverage.tolist() if share >= rules.agreeing]
    share = sum(agreeing) / len(agreeing) if len(agreeing) > 1 else pose.coverage
    return is_sure(pose, free, rules) and share > rules.convincing


def ahead(one: ScoredPose, other: ScoredPose) -> float:
    """Log odds of one pose of a body against another."""
    return one.log_density - other.log_density


def decide(
    ranked: Sequence[ScoredPose],
    free: Mask,
    rules: AcceptanceRules,
    ahead_of: Callable[[ScoredPose, ScoredPose], float] = ahead,
) -> Verdict:
    """Decide about a frame from all its poses, the most evident first.

    Against the best there is clutter, then the others, by log odds of them: what is not possible by
    itself still casts doubt.
    """
    told = [one for one in ranked if is_possible(one, free)]
    if not told:
        return Verdict(None, [])
    best, odds = told[0], _odds_against(told[0], ranked, ahead_of)
    likeliest = max(told, key=lambda one: odds[ranked.index(one)])
    if likeliest is not best:
        best, odds = likeliest, _odds_against(likeliest, ranked, ahead_of)
    weights = beliefs(odds)
    rivals = [each for one, each in zip(ranked, odds, strict=True) if one is not best]
    against = [Alternative("", each) for each in (-best.log_evidence, *rivals)]
    if not is_turn_known(best, rules):
        against.append(Alternative(TURNS))
    kept = [
        (one, weight)
        for one, weight in zip(ranked, weights, strict=True)
        if one is best or (weight >= 1 - rules.confidence and is_fixed(one, free))
    ]
    kept.sort(key=lambda each: each[0] is not best)
    # a pose that is less likely needs more than three frames that err as seldom as one that is ok
    least = max((1 - rules.confidence) ** 3, LEAST_BELIEF)
    faint = [
        (one, weight)
        for one, weight in zip(ranked, weights, strict=True)
        if one.spread is not None and least <= weight < 1 - rules.confidence
        if one is not best and is_fixed(one, free)
    ]
    return Verdict(best, kept, tuple(faint), tuple(against), rules.log_doubt)


def _odds_against(
    best: ScoredPose,
    ranked: Sequence[ScoredPose],
    ahead_of: Callable[[ScoredPose, ScoredPose], float],
) -> list[float]:
    """Log odds of each pose against one of them."""
    return [0.0 if one is best else ahead_of(one, best) for one in ranked]


def is_turn_known(pose: ScoredPose, rules: AcceptanceRules) -> bool:
    """Whether no wide sector of turns is left open, as by ranges, or about a line of features."""
    turns = pose.covariance[3:, 3:]
    if pose.spread is not None:
        turns = np.diag(pose.spread[3:] ** 2)
    widest = math.radians(rules.widest_turn_deg) / 1.96
    # no axis has more than all together
    largest = float(np.trace(turns))
    if widest**2 <= largest < math.inf:
        largest = float(np.linalg.eigvalsh(turns)[-1])
    return largest < widest**2


def is_open(pose: ScoredPose, free: Mask, rules: AcceptanceRules, model: NoiseModel) -> bool:
    """Whether what would fix some direction is hidden or cut.

    The sum of variances is compared with that if all features in view were met, and whole, by all
    sensors, by this noise and by what is usual.
    """
    used, seen = pose.used, pose.matches
    is_less = pose.left_out or np.count_nonzero(used.shares < used.weights)
    if not (is_less or np.count_nonzero(used.extra)):
        return False
    if np.count_nonzero(used.merged):  # one of two that share a detection may be hidden instead
        by = used.detections
        is_shared = (by >= 0) & ((by[..., None] == by[:, None]).sum(axis=2) > 1)
        used = replace(used, shares=np.where(is_shared, 0.0, used.shares))
    inner = np.ix_(free, free)
    whole = replace(seen, shares=seen.weights, extra=np.zeros(seen.extra.shape))
    C, noise = inverted(information_of(used, pose.variances)[inner]), pose.variances
    if pose.left_out:
        noise = np.full(len(seen.names), noise.mean())
    if np.vdot(C, information_of(whole, noise)[inner]) <= rules.open:
        return False
    usual = np.full(len(seen.names), model.usual**2)
    return bool(np.vdot(C, information_of(whole, usual)[inner]) > 2 * len(C))


def insert(
    ranked: list[ScoredPose], new: ScoredPose, body: Body, free: Mask, rules: AcceptanceRules
) -> None:
    """Keep a list of distinct poses, the most evident first; each covers those it stands for."""
    limit = float(chdtri(np.count_nonzero(free), 1 - rules.confidence))
    for k, old in enumerate(ranked):
        T_new = nearest_alike(new.T_world_object, body, old.T_world_object)
        away = np.where(free, twist_between(old.T_world_object, T_new), 0.0)
        if _are_one(old, new, away, free, limit, rules):
            # of two as good the later says more
            is_better = _worth(new, rules, 0.01) > _worth(old, rules)
            told, other = (new, old) if is_better else (old, new)
            belief = beliefs([told.log_density, other.log_density])[1]
            if belief > 1 - rules.confidence:
                told = _with_moments_of(told, other, belief, max(belief, 1 / limit), away)
            ranked[k] = told
            break
    else:
        ranked.append(new)
    ranked.sort(key=lambda one: -one.log_density)


def _with_moments_of(
    told: ScoredPose, other: ScoredPose, belief: float, apart: float, away: Floats
) -> ScoredPose:
    """A pose with the covariance about it of both, where the other, a twist (6,) away, may be it.

    The other may be it by a `belief`, and its distance counts by `apart`.
    """
    covariance, persistent = (
        (1 - belief) * own + belief * beside
        for own, beside in (
            (told.covariance, other.covariance),
            (told.persistent, other.persistent),
        )
    )
    covariance += apart * away[:, None] * away
    spread = None if told.spread is None else np.sqrt(covariance.diagonal())
    return replace(told, covariance=covariance, persistent=persistent, spread=spread)


def _worth(pose: ScoredPose, rules: AcceptanceRules, more: float = 0.0) -> tuple[bool, float]:
    """Which of two poses on one peak stands for both: what is likelier clutter for no other.

    That residuals are larger than those before them is as rare as that a sure pose is wrong, though
    more spots are off for smaller ones.
    """
    doubt = rules.log_doubt * int(pose.residual_ratio > 1)
    return pose.log_evidence > 0, pose.log_density + doubt + more


def _are_one(
    a: ScoredPose, b: ScoredPose, away: Floats, free: Mask, limit: float, rules: AcceptanceRules
) -> bool:
    """Whether two poses, a twist (6,) apart, are on one peak of which one is not the top."""
    both = (a.covariance + b.covariance + a.bent)[free][:, free]
    inside = bool(away[free] @ inverted(both) @ away[free] < limit)
    # those of a likelihood may be drawn to different priors; tilts of a flat body are two
    turned = math.hypot(*away[3:].tolist())
    return inside and (a.spread is not None or turned < math.radians(rules.widest_turn_deg))


def met_by_one(judged: ScoredPose, rules: AcceptanceRules) -> list[str]:
    """Sensors that should see a body and that its pose is not of, as one alone meets most of it.

    None where two do.
    """
    seen, of, others = judged.matches, list[str](), list[str]()
    given = zip(seen.names, seen.coverage.tolist(), seen.expected.tolist(), strict=True)
    for name, coverage, expected in given:
        if coverage >= rules.agreeing and name not in judged.left_out:
            of.append(name)
        elif expected > 0:
            others.append(name)
    return others if len(of) == 1 else []


def others_miss(
    judged: ScoredPose, before: Floats, agreed: bool, rules: AcceptanceRules, model: NoiseModel
) -> bool:
    """Whether one sensor alone meets most of the body, and another sees as much elsewhere.

    `before` are squares and degrees of freedom (2,) of residuals of the frames before; where two
    sensors `agreed` in one of them, others may miss the body now.
    """
    used = judged.matches  # of sensors that are left out as well
    if len(used.images) < 2 or (used.dimensions != 2).any():
        return False
    coverage, nearby, missed, count, met = (
        used.summed(each) / used.images
        for each in (used.coverage, used.unmatched_nearby, used.missed, used.count, used.met)
    )
    *_, second, first = sorted(range(len(coverage)), key=coverage.tolist().__getitem__)
    if not coverage[second] < rules.agreeing <= coverage[first]:
        return False
    # beside the body, or, where no two ever agreed, anywhere
    beside, needed = nearby, missed
    if not agreed:
        beside, needed = count - met, np.full(len(met), met[first])
    sees = (needed > 0) & (beside >= rules.agreeing * needed)
    sees[first] = False
    # what each meets is of the body, against detections anywhere near
    variance = _variance(before, model, model.errors.typical)
    v = min(variance, model.usual**2) + used.extra
    odds = np.log(model.errors.met**2 / (2 * v)) - used.squared / (2 * v)
    odds = used.summed(np.vecdot(used.shares, odds) * used.each_part)
    return bool((odds[sees] < -rules.log_doubt).any())


def two_agree(judged: ScoredPose, rules: AcceptanceRules, model: NoiseModel) -> bool:
    """Whether two sensors meet most of the body where one pose has it, no farther off than chance.

    One that is off by more than noise as the most exact of them has it sees it elsewhere.
    """
    used = judged.used
    squares, degrees = (used.summed(each) for each in (used.squares, used.measurements))
    variances = squares / np.maximum(degrees, 1e-12)
    meet = used.covered >= rules.agreeing
    least = max(float(variances[meet].min(initial=np.inf)), model.usual**2)
    agree = meet & (variances <= model.errors.outlying**2 * least)
    return bool(judged.residual_ratio <= 1 and np.count_nonzero(agree) > 1)


def _variance(before: Floats, model: NoiseModel, typical: float) -> float:
    """Of the noise so far (2,), squares and degrees of freedom, or what is typical before that."""
    is_known = before[1] >= model.known
    return max(float(before[0] / before[1]), LEAST_VARIANCE) if is_known else typical**2


def is_far_off(used: Matches, before: Floats, rules: AcceptanceRules, model: NoiseModel) -> bool:
    """Whether features are met far beyond the noise so far (2,), squares and degrees of freedom.

    Where that is not known, half as far beyond what is typical: half of σ_ε; right geometry has
    0.2.  What errs by more than noise counts less, and a few far off not at all.
    """
    variance = _variance(before, model, model.errors.typical / 2)
    wide, met = variance + used.extra, used.shares > 0
    far = model.errors.are_off(used, wide)
    # where most of a sensor are far off it is out of step, or turned
    far &= 2 * np.count_nonzero(far, axis=1, keepdims=True) <= met.sum(axis=1, keepdims=True)
    used = replace(used, shares=np.where(far, 0.0, used.shares * variance / wide))
    degrees, squares = sum(used.measurements.tolist()) - 6, sum(used.squares.tolist())
    return bool(degrees >= 1 and squares >= degrees * rules.disagreeing * variance)


def nearest_alike(T_world_object: Floats, body: Body, T_reference: Floats | None) -> Floats:
    """Of those that look like poses (..., 4, 4), the ones turned least against a reference.

    Or against the world.
    """
    if len(body.symmetries) == 1:
        return T_world_object
    R = T_world_object[..., :3, :3]
    turned = R if T_reference is None else T_reference[:3, :3].T @ R
    # the angle grows as the trace of the difference falls
    traces = body.symmetries[:, :3, :3] * turned.swapaxes(-1, -2)[..., None, :, :]
    nearest = traces.sum(axis=(-2, -1)).argmax(axis=-1)
    # the very same, where it is that: what was worked out for it holds
    is_same = not np.count_nonzero(nearest - body.identity)
    return T_world_object if is_same else T_world_object @ body.symmetries[nearest]


def beliefs(logs: Sequence[float]) -> list[float]:
    """Share of each among rivals, by their log odds against anything; even where none has any."""
    top = max(logs, default=0.0)
    odds = [math.exp(each - top) if top > -math.inf else 1.0 for each in logs]
    return [each / sum(odds) for each in odds]
