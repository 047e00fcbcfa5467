"""Decide about a frame from judged poses: which are possible, sure, the same, or contradicted."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, expit, logit

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement.information import information_of, inverted
from mixpose.judgement.judge import ScoredPose
from mixpose.judgement.mistakes import Mistake
from mixpose.judgement.noise import NoiseModel
from mixpose.judgement.shape import Shape
from mixpose.matching import LEAST_VARIANCE, Matches
from mixpose.records import Floats, Mask, Status, replace
from mixpose.rigid import twist_between

LEAST_BELIEF = 1e-12
"""Belief in a pose below which it is no more likely than poses that were not thought of."""


@dataclass(frozen=True)
class AcceptanceRules:
    """Thresholds from which a pose is believed."""

    confidence: float = constant(0.999, "from which a pose is ok: one of 1000 may err")
    mistaken: float = constant(
        2e-4, "of sessions, by each mistake: a body mirrored or of another size, a sensor elsewhere"
    )
    widest_turn_deg: float = constant(
        15.0, "95 % bound on a turn that is known, and on that between two poses of one peak"
    )
    convincing: float = constant(0.75, "share of the body to need no search: a slip meets less")
    agreeing: float = constant(0.5, "share of the body that a sensor that agrees must meet")
    disagreeing: float = constant(25.0, "variance of a sensor over the others' to leave it out")
    changed: float = constant(10.0, "times the residuals that chance makes: frames have up to 7")
    open: float = constant(300.0, "sum of variances over that if all in view were met and whole")

    @property
    def log_doubt(self) -> float:
        """Log odds against a pose that is just sure enough to be ok."""
        return -float(logit(self.confidence))


class Alternative(NamedTuple):
    """An alternative to a pose: something else that the frame may show."""

    what: str  # in words; empty for mere clutter, and for other poses of the body
    log_odds: float = 0.0  # against the pose; even odds where they are unknown


_NOTHING = Alternative("", -math.inf)
TURNS = "what is met leaves it open how the body is turned"


class Second(NamedTuple):
    """A second pose of a frame that looks like the body."""

    pose: ScoredPose | None  # None where there is no second one
    log_odds: float  # that it is there
    odds_over_best: float  # log odds that it is the body, and not the best pose
    is_explained: bool = False  # whether one of them is seen to be a mirror image or another thing


@dataclass(frozen=True)
class Verdict:
    """The decision about a frame: ok if no alternative to the best pose is likely."""

    best: ScoredPose | None  # None where the frame is lost
    kept: list[tuple[ScoredPose, float]]  # poses to be reported, with beliefs, best first
    # of single ranges, less likely poses that further frames may make likely
    faint: tuple[tuple[ScoredPose, float], ...] = ()
    against: tuple[Alternative, ...] = ()  # the best pose
    most: float = -math.inf  # log odds against the best pose up to which it is ok
    # by sensor: unclaimed detections among which the body was searched a second time
    tried: Mapping[str, int] = field(default_factory=dict)
    second: Second | None = None  # None where it was not searched
    # mistakes in the session, by name; None where they were not computed
    mistaken: Mapping[str, Mistake] | None = None
    shape: Shape | None = None  # evidence of the body's shape so far, while no frame was ok

    @cached_property
    def confidence(self) -> float:
        """Probability that the best pose is right and none of the alternatives."""
        return 0.0 if self.best is None else float(expit(-self._log_odds))

    @property
    def open_share(self) -> float:
        """Share of the explanations that have no pose; then the best is within its covariance."""
        weight = sum(weight for pose, weight in self.kept if pose is self.best)
        return max(1 - self.confidence / max(weight, LEAST_BELIEF), 0.0)

    @cached_property
    def _log_odds(self) -> float:
        return float(np.logaddexp.reduce([other.log_odds for other in self.against]))

    @property
    def status(self) -> Status:
        """The status that is reported."""
        if self.best is None:
            return "lost"
        return "ok" if self._log_odds <= self.most else "ambiguous"

    @property
    def doubt(self) -> str:
        """The likeliest cause of ambiguity other than rivals, in words; empty for none."""
        named = [other for other in self.against if other.what and other.log_odds > self.most]
        reported = named if self.status == "ambiguous" else []
        return max(reported, key=lambda other: other.log_odds, default=_NOTHING).what

    def doubted(self, more: Iterable[Alternative]) -> Verdict:
        """Return this verdict with more alternatives."""
        return replace(self, against=(*self.against, *more))

    def without(self, *what: str) -> Verdict:
        """Return this verdict without the alternatives of these names."""
        return replace(self, against=tuple([a for a in self.against if a.what not in what]))


def is_fixed(pose: ScoredPose, free: Mask) -> bool:
    """Test whether the coordinates met are enough to fix the free directions (6,) of a pose."""
    return bool(pose.measurements >= np.count_nonzero(free))


def is_possible(pose: ScoredPose, free: Mask) -> bool:
    """Test whether a pose is worth reporting: one more feature met would make its odds even."""
    return is_fixed(pose, free) and pose.log_evidence > pose.log_missed


def is_sure(pose: ScoredPose, free: Mask, rules: AcceptanceRules) -> bool:
    """Test whether a pose is believed, as long as it has no rival."""
    return is_fixed(pose, free) and pose.log_evidence > -rules.log_doubt


def convinces(pose: ScoredPose, free: Mask, rules: AcceptanceRules) -> bool:
    """Test whether a pose is sure and meets so much of the body that no search is needed.

    If two sensors agree, others do not count: they may be covered, blind or out of step.
    """
    agreeing = [share for share in pose.matches.coverage.tolist() if share >= rules.agreeing]
    share = sum(agreeing) / len(agreeing) if len(agreeing) > 1 else pose.coverage
    return is_sure(pose, free, rules) and share > rules.convincing


def ahead(pose: ScoredPose, other: ScoredPose) -> float:
    """Return the log odds of a pose of a body against another."""
    return pose.log_density - other.log_density


def decide(
    ranked: Sequence[ScoredPose],
    free: Mask,
    rules: AcceptanceRules,
    ahead_of: Callable[[ScoredPose, ScoredPose], float] = ahead,
) -> Verdict:
    """Decide about a frame from all its poses, the most evident first.

    Alternatives to the best pose are clutter and all other poses, also those too unlikely to be
    reported.  `ahead_of` gives the log odds of a pose against another.
    """
    possible = [pose for pose in ranked if is_possible(pose, free)]
    if not possible:
        return Verdict(None, [])

    def odds_against(best: ScoredPose) -> list[float]:
        return [0.0 if pose is best else ahead_of(pose, best) for pose in ranked]

    best, odds = possible[0], odds_against(possible[0])
    likeliest = max(possible, key=lambda pose: odds[ranked.index(pose)])
    if likeliest is not best:
        best, odds = likeliest, odds_against(likeliest)
    weights = beliefs(odds)
    rivals = [log_odds for pose, log_odds in zip(ranked, odds, strict=True) if pose is not best]
    against = [Alternative("", log_odds) for log_odds in (-best.log_evidence, *rivals)]
    if not is_turn_known(best, rules):
        against.append(Alternative(TURNS))
    kept = [
        (pose, weight)
        for pose, weight in zip(ranked, weights, strict=True)
        if pose is best or (weight >= 1 - rules.confidence and is_fixed(pose, free))
    ]
    kept.sort(key=lambda entry: entry[0] is not best)
    # to become ok, a pose less likely than this needs more than three frames that are as sure as ok
    least = max((1 - rules.confidence) ** 3, LEAST_BELIEF)
    faint = [
        (pose, weight)
        for pose, weight in zip(ranked, weights, strict=True)
        if pose.spread is not None and least <= weight < 1 - rules.confidence
        if pose is not best and is_fixed(pose, free)
    ]
    return Verdict(best, kept, tuple(faint), tuple(against), rules.log_doubt)


def is_turn_known(pose: ScoredPose, rules: AcceptanceRules) -> bool:
    """Test whether no wide sector of turns is open, as by ranges or about a line of features."""
    turns = pose.covariance[3:, 3:]
    if pose.spread is not None:
        turns = np.diag(pose.spread[3:] ** 2)
    widest = math.radians(rules.widest_turn_deg) / 1.96
    # the largest variance of an axis is at most the sum of all
    largest = float(np.trace(turns))
    if widest**2 <= largest < math.inf:
        largest = float(np.linalg.eigvalsh(turns)[-1])
    return largest < widest**2


def is_open(pose: ScoredPose, free: Mask, rules: AcceptanceRules, model: NoiseModel) -> bool:
    """Test whether a direction is open because the features that would fix it are hidden or cut.

    The sum of variances is compared with that if all sensors met all features in view by whole
    spots, with the noise of this frame and with the usual noise.
    """
    used, seen = pose.used, pose.matches
    is_less = pose.left_out or np.count_nonzero(used.shares < used.weights)
    if not (is_less or np.count_nonzero(used.extra)):
        return False
    if np.count_nonzero(used.merged):  # one of the two may be hidden
        met_by = used.detections
        is_shared = (met_by >= 0) & ((met_by[..., None] == met_by[:, None]).sum(axis=2) > 1)
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
    """Insert a pose into a list of distinct ones, most evident first, or merge it with its like."""
    limit = float(chdtri(np.count_nonzero(free), 1 - rules.confidence))
    for k, old in enumerate(ranked):
        T_new = nearest_alike(new.T_world_object, body, old.T_world_object)
        away = np.where(free, twist_between(old.T_world_object, T_new), 0.0)
        if _are_one(old, new, away, free, limit, rules):
            # of two that are as good the later is preferred
            is_better = _worth(new, rules, 0.01) > _worth(old, rules)
            better, other = (new, old) if is_better else (old, new)
            belief = beliefs([better.log_density, other.log_density])[1]
            if belief > 1 - rules.confidence:
                better = _with_moments_of(better, other, belief, max(belief, 1 / limit), away)
            ranked[k] = better
            break
    else:
        ranked.append(new)
    ranked.sort(key=lambda pose: -pose.log_density)


def _with_moments_of(
    pose: ScoredPose, other: ScoredPose, belief: float, apart: float, away: Floats
) -> ScoredPose:
    """Return a pose with the covariance, about itself, of a mixture with another one.

    `belief` is the share of the other, and `apart` the weight of the twist (6,) between them.
    """
    covariance, persistent = (
        (1 - belief) * of_pose + belief * of_other
        for of_pose, of_other in (
            (pose.covariance, other.covariance),
            (pose.persistent, other.persistent),
        )
    )
    covariance += apart * away[:, None] * away
    spread = None if pose.spread is None else np.sqrt(covariance.diagonal())
    return replace(pose, covariance=covariance, persistent=persistent, spread=spread)


def _worth(pose: ScoredPose, rules: AcceptanceRules, more: float = 0.0) -> tuple[bool, float]:
    """Return the key by which the larger of two poses on one peak stands for both.

    Residuals larger than before are as rare as a sure pose that is wrong, even if the smaller ones
    of the other pose have more spots that are off.
    """
    doubt = rules.log_doubt * int(pose.residual_ratio > 1)
    return pose.log_evidence > 0, pose.log_density + doubt + more


def _are_one(
    a: ScoredPose, b: ScoredPose, away: Floats, free: Mask, limit: float, rules: AcceptanceRules
) -> bool:
    """Test whether two poses, a twist (6,) apart, are on one peak of the likelihood."""
    both = (a.covariance + b.covariance + a.bent)[free][:, free]
    inside = bool(away[free] @ inverted(both) @ away[free] < limit)
    # poses of single ranges may have different priors; two tilts of a flat body are not one pose
    turned = math.hypot(*away[3:].tolist())
    return inside and (a.spread is not None or turned < math.radians(rules.widest_turn_deg))


def unconfirming_sensors(judged: ScoredPose, rules: AcceptanceRules) -> list[str]:
    """Return the other sensors with the body in view, if a single sensor meets most of it.

    The list is empty if several sensors do, or none.
    """
    seen, meeting, others = judged.matches, list[str](), list[str]()
    rows = zip(seen.names, seen.coverage.tolist(), seen.expected.tolist(), strict=True)
    for name, coverage, expected in rows:
        if coverage >= rules.agreeing and name not in judged.left_out:
            meeting.append(name)
        elif expected > 0:
            others.append(name)
    return others if len(meeting) == 1 else []


def is_seen_elsewhere(
    judged: ScoredPose,
    before: Floats,
    agreed: bool,
    rules: AcceptanceRules,
    model: NoiseModel,
    is_exact: bool = True,  # False for a body whose features may be met off
) -> bool:
    """Test whether a single sensor meets most of the body while another sees as much elsewhere.

    `before` has squares and degrees of freedom (2,) of the residuals of earlier frames, in one of
    which two sensors may have `agreed`: then detections elsewhere count only about the body.
    """
    used = judged.matches  # of sensors that are left out as well
    if len(used.images) < 2 or (used.dimensions != 2).any():
        return False
    variance = min(_variance(before, model, model.errors.typical), model.usual**2)
    v = variance + used.extra
    # what is met far off, by the noise of this frame too, may as well be seen elsewhere
    noise = dict(zip(judged.used.names, judged.variances.tolist(), strict=True))
    least = [[max(noise.get(name, 0.0), variance)] for name in used.names]
    is_off = model.errors.are_off(used, least + used.extra) & is_exact
    close = replace(used, shares=np.where(is_off, 0.0, used.shares))
    nearby = used.unmatched_nearby + used.met - close.met
    coverage, nearby, missed, count, met = (
        used.summed(values) / used.images
        for values in (close.coverage, nearby, close.missed, used.count, close.met)
    )
    *_, second, first = sorted(range(len(coverage)), key=coverage.tolist().__getitem__)
    if not coverage[second] < rules.agreeing <= coverage[first]:
        return False
    # detections of no feature, about the body or, if no two sensors ever agreed, anywhere
    unmatched, needed = nearby, missed
    if not agreed:
        unmatched, needed = count - met, np.full(len(met), met[first])
    sees = (needed > 0) & (unmatched >= rules.agreeing * needed)
    sees[first] = False
    # odds that what a sensor meets is the body, against detections anywhere near
    odds = np.log(model.errors.met**2 / (2 * v)) - used.squared / (2 * v)
    odds = used.summed(np.vecdot(used.shares, odds) * used.coordinate_weight)
    return bool((odds[sees] < -rules.log_doubt).any())


def has_two_agreeing(judged: ScoredPose, rules: AcceptanceRules, model: NoiseModel) -> bool:
    """Test whether two sensors meet most of the body at a pose, no farther off than chance.

    A sensor that is off by more than the noise of the most exact one sees the body elsewhere.
    """
    used = judged.used
    squares, degrees = (used.summed(values) for values in (used.squares, used.measurements))
    variances = squares / np.maximum(degrees, 1e-12)
    meet = used.covered >= rules.agreeing
    least = max(float(variances[meet].min(initial=np.inf)), model.usual**2)
    agree = meet & (variances <= model.errors.outlying**2 * least)
    return bool(judged.residual_ratio <= 1 and np.count_nonzero(agree) > 1)


def _variance(before: Floats, model: NoiseModel, typical: float) -> float:
    """Return the variance of squares and degrees of freedom (2,), or the typical one of too few."""
    is_known = before[1] >= model.known
    return max(float(before[0] / before[1]), LEAST_VARIANCE) if is_known else typical**2


def is_far_off(used: Matches, before: Floats, rules: AcceptanceRules, model: NoiseModel) -> bool:
    """Test whether residuals are far beyond the noise so far (2,), squares and degrees of freedom.

    As long as the noise is unknown the limit is half of σ_ε, from half of the typical error; right
    geometry has 0.2.  Detections with extra variance count less, a few that are far off do not.
    """
    variance = _variance(before, model, model.errors.typical / 2)
    wide, met = variance + used.extra, used.shares > 0
    far = model.errors.are_off(used, wide)
    # a sensor with most features far off is out of step or turned: these do count
    far &= 2 * np.count_nonzero(far, axis=1, keepdims=True) <= met.sum(axis=1, keepdims=True)
    used = replace(used, shares=np.where(far, 0.0, used.shares * variance / wide))
    degrees, squares = sum(used.measurements.tolist()) - 6, sum(used.squares.tolist())
    return bool(degrees >= 1 and squares >= degrees * rules.disagreeing * variance)


def nearest_alike(T_world_object: Floats, body: Body, T_reference: Floats | None) -> Floats:
    """Return the look-alikes of poses (..., 4, 4) that are turned least against references.

    References broadcast over leading axes.  Without a reference, against the world.
    """
    if len(body.symmetries) == 1:
        return T_world_object
    R = T_world_object[..., :3, :3]
    turned = R if T_reference is None else T_reference[..., :3, :3].swapaxes(-1, -2) @ R
    # the angle grows as the trace of the difference falls
    turns_back = body.symmetries[:, :3, :3].swapaxes(1, 2).reshape(-1, 9)
    nearest = (turned.reshape(*turned.shape[:-2], 9) @ turns_back.T).argmax(axis=-1)
    # the same array, if nothing is turned: results cached for it are valid
    is_same = not np.count_nonzero(nearest - body.identity)
    return T_world_object if is_same else T_world_object @ body.symmetries[nearest]


def beliefs(logs: Sequence[float]) -> list[float]:
    """Return the shares of rivals of these log odds; equal shares if all are −∞."""
    top = max(logs, default=0.0)
    odds = [math.exp(log - top) if top > -math.inf else 1.0 for log in logs]
    return [share / sum(odds) for share in odds]
