"""From judged poses to a status: what is possible, sure, the same, and what contradicts itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import fdtri

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement.judge import ScoredPose, beliefs, nearest_alike
from mixpose.judgement.noise import NoiseModel
from mixpose.matching import Matches, Noise
from mixpose.records import Status
from mixpose.rigid import rotation_angle_deg, twist_between

APART = "two sensors contradict each other"

_OPEN_TURN = np.pi / np.sqrt(3)  # rad, standard deviation of a turn of which nothing is known


@dataclass(frozen=True)
class AcceptanceRules:
    """When a pose is believed."""

    sure: float = constant(
        7.0, "log odds against clutter from which a pose is ok: one in a thousand by chance"
    )
    possible: float = constant(
        0.5, "log odds from which a pose is told: even, and a little more, as the best of many"
    )
    doubtful: float = constant(
        -4.5, "the same of a pose that stands out: sure, less the share of two misses"
    )
    doubtful_coverage: float = constant(0.6, "share of the body that a pose must meet to stand out")
    spare: float = constant(
        4.0,
        "coordinates beyond those that fix it that a pose must meet to stand out: of one feature "
        "more chance makes enough (one camera, body absent: told in 9 % of 110 frames of 5/0/5)",
    )
    standing_out: float = constant(
        1.5,
        "log odds against all other poses of the frame from which one stands out: of 330 frames of "
        "one camera without the body 4 % are told, of 330 with it the right pose in 96 %",
    )
    majority: float = constant(
        0.5, "share of the features in view that some sensor must meet for a pose to be sure"
    )
    enough: float = constant(
        8.0, "features met by some sensor that are enough however many are missed: a shape"
    )
    rival: float = constant(0.01, "belief from which another pose makes a frame ambiguous")
    as_evident: float = constant(
        0.01, "log odds by which the later of two poses that are one may be behind: it says more"
    )
    unlike: float = constant(
        6.9,
        "log odds by which a pose may be behind one that is the same but for residuals larger than "
        "those before let chance make them: one frame of 1000",
    )
    listed: float = constant(0.001, "belief from which a pose stands among the hypotheses")
    widest_turn_deg: float = constant(
        15.0, "95 % bound on a turn, above which ranges leave a frame ambiguous"
    )
    convincing: float = constant(
        0.75,
        "share of the body that must be met for the prediction to be taken without looking "
        "elsewhere: a body slipped by a step of its grid meets less",
    )
    agreeing: float = constant(
        0.5, "share of the body that a sensor must meet to count as one that agrees"
    )
    disagreeing: float = constant(
        25.0,
        "residual variance over that of the other sensors from which one that meets the body is "
        "left out: five times their deviation; web cams a frame late have three and still help",
    )
    strange: float = constant(
        6.25,
        "the same over that of typical noise, where none is known: half of σ_ε; right geometry "
        "has 0.2",
    )
    same_rotation_deg: float = constant(1.0, "poses nearer than this are one, unless both fit")
    same_distance: float = constant(0.02, "the same, of the body's radius")
    same_peak: float = constant(
        9.0, "squared distance in standard deviations below which uncertain poses are one"
    )
    same_peak_deg: float = constant(
        5.0, "turn above which they are two all the same: another tilt of a small flat body"
    )


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


class Checks(NamedTuple):
    """What a pose is worth by itself, by some rules; each check holds only where those before do.

    Attributes
    ----------
    rules : AcceptanceRules
    is_fixed : bool
        Whether what is met fixes a pose in the directions that are estimated.
    is_possible : bool
        Whether it is worth telling.
    is_sure : bool
        Whether it is believed, if no rival casts doubt on it.
    convinces : bool
        Whether, near its prediction, it needs no other to compare with.
    """

    rules: AcceptanceRules
    is_fixed: bool = False
    is_possible: bool = False
    is_sure: bool = False
    convinces: bool = False


def assess(pose: ScoredPose, free: NDArray[np.bool_], rules: AcceptanceRules) -> Checks:
    """Check a pose that is estimated in free directions (6,); once, and kept with the pose."""
    known: list[Checks] = pose.checked
    if known and known[0].rules is rules:
        return known[0]
    fixed = pose.measurements >= int(free.sum())
    possible = fixed and pose.log_evidence > rules.possible
    sure = possible and pose.log_evidence > rules.sure and _is_turned(pose, rules)
    sure = sure and _is_recognised(pose, rules)
    checks = Checks(rules, fixed, possible, sure, sure and _is_complete(pose, rules))
    known[:] = [checks]
    return checks


def _is_turned(pose: ScoredPose, rules: AcceptanceRules) -> bool:
    """Whether no wide sector of turns is left open, as ranges may."""
    turn = 0.0 if pose.spread is None else 1.96 * float(pose.spread[3:].max())
    return bool(turn < np.radians(rules.widest_turn_deg))


def _is_recognised(pose: ScoredPose, rules: AcceptanceRules) -> bool:
    """Whether enough of the body is met that another one cannot pass for it.

    Three markers of another body may well lie as three of this one, where it was expected even.
    """
    in_view = int(np.count_nonzero(pose.matches.weights.any(axis=0)))
    met = int(np.count_nonzero(pose.matches.met_by))
    return met >= min(rules.majority * in_view, rules.enough)


def _is_complete(pose: ScoredPose, rules: AcceptanceRules) -> bool:
    """Whether so much is met that it could not be elsewhere.

    Of two sensors or more that agree, others may be covered, blind or out of step.
    """
    agreeing = [share for share in pose.matches.coverage.tolist() if share >= rules.agreeing]
    share = sum(agreeing) / len(agreeing) if len(agreeing) > 1 else pose.coverage
    return share > rules.convincing


def stands_out(
    ranked: Sequence[ScoredPose], free: NDArray[np.bool_], rules: AcceptanceRules
) -> bool:
    """Whether the first pose meets most of the body and is far likelier than all others.

    Poses that meet detections by chance come in numbers, and about equally good.
    """
    if not ranked or ranked[0].coverage < rules.doubtful_coverage:
        return False
    if ranked[0].measurements < int(free.sum()) + rules.spare:
        return False
    rest = np.logaddexp.reduce([-np.inf, *(one.log_evidence for one in ranked[1:])])
    return ranked[0].log_evidence > max(rules.doubtful, float(rest) + rules.standing_out)


def decide(
    ranked: Sequence[ScoredPose], free: NDArray[np.bool_], rules: AcceptanceRules
) -> Verdict:
    """Decide about a frame from all its poses, the most evident first."""
    told = (one for one in ranked if assess(one, free, rules).is_possible)
    best = ranked[0] if stands_out(ranked, free, rules) else next(told, None)
    if best is None:
        return Verdict("lost", None, [])
    weights = beliefs(ranked)
    # what is not possible by itself still casts doubt on the others
    rivals = [weight for one, weight in zip(ranked, weights, strict=True) if one is not best]
    clear = max(rivals, default=0.0) < rules.rival
    # nor is a turn left open, as about the line that all features met lie on
    if clear := clear and assess(best, free, rules).is_sure:
        clear = bool(np.linalg.eigvalsh(best.covariance[3:, 3:]).max() < _OPEN_TURN**2)
    kept = [
        (one, weight)
        for one, weight in zip(ranked, weights, strict=True)
        if one is best or (weight >= rules.listed and assess(one, free, rules).is_fixed)
    ]
    return Verdict("ok" if clear else "ambiguous", best, kept)


def insert(
    ranked: list[ScoredPose],
    new: ScoredPose,
    body: Body,
    free: NDArray[np.bool_],
    rules: AcceptanceRules,
) -> None:
    """Keep a list of distinct poses, the most evident first."""
    for k, old in enumerate(ranked):
        if _alike(old, new, body, free, rules):
            # residuals as before are likelier than larger ones, though more spots are off for them
            more = rules.unlike * (int(new.is_unlike) - int(old.is_unlike))
            if new.log_evidence > old.log_evidence + more - rules.as_evident:
                ranked[k] = new
            break
    else:
        ranked.append(new)
    ranked.sort(key=lambda one: -one.log_evidence)


def _alike(
    a: ScoredPose, b: ScoredPose, body: Body, free: NDArray[np.bool_], rules: AcceptanceRules
) -> bool:
    T_a = a.T_world_object
    T_b = nearest_alike(b.T_world_object, body, T_a)
    # one peak, of which one of the two is not the top: as in depth, seen by one camera
    away = twist_between(T_a, T_b)[free]
    both = (a.covariance + b.covariance + a.bent)[np.ix_(free, free)]
    inside = bool(away @ np.linalg.solve(both, away) < rules.same_peak)
    if a.spread is not None:
        return inside  # of the likelihood, drawn to different priors
    turned = float(rotation_angle_deg(T_a, T_b))
    centre = np.append(body.means.mean(axis=0), 1.0)
    apart = float(np.linalg.norm((T_a - T_b) @ centre))
    if apart < rules.same_distance * body.radius and turned < rules.same_rotation_deg:
        return True
    # features that may be off leave a turn as open as that
    open_turn = 3 * np.degrees(np.sqrt(np.linalg.eigvalsh(a.bent[3:, 3:]).max()))
    return inside and turned < max(rules.same_peak_deg, min(open_turn, rules.widest_turn_deg))


def contradict(
    judged: ScoredPose, before: Noise, agreed: bool, rules: AcceptanceRules, model: NoiseModel
) -> bool:
    """Whether the two sensors of a frame contradict each other: no pose is right for both.

    Of three sensors the one that disagrees is left out; of two, nobody can tell which is wrong.
    `before` are the residuals of the frames before, and where two sensors `agreed` in one of them,
    one may miss the body now.
    """
    used = judged.used
    if used.dimensions.tolist() != [2, 2]:
        return False
    return _is_unmet(used, agreed, rules) or _is_between(used, before, rules, model)


def _is_unmet(used: Matches, agreed: bool, rules: AcceptanceRules) -> bool:
    """One meets most of the body; the other misses it, and sees as much beside it.

    Where the two never agreed, wherever it sees that.
    """
    least, most = np.argsort(used.coverage, kind="stable").tolist()
    if not used.coverage[least] < rules.agreeing <= used.coverage[most]:
        return False
    if not agreed:
        return bool(used.count[least] - used.met[least] >= rules.agreeing * used.met[most])
    missed = float(used.missed[least])
    return bool(missed > 0 and used.unmatched_nearby[least] >= rules.agreeing * missed)


def _is_between(used: Matches, before: Noise, rules: AcceptanceRules, model: NoiseModel) -> bool:
    """Offsets far beyond the noise so far, which a pose of its own takes away in each sensor."""
    if not is_far_off(used, before, rules, model):
        return False
    rows, offsets = used.rows()
    J = block_diag(*rows)
    J /= np.maximum(np.linalg.norm(J, axis=0), 1e-12)
    taken, _, rank, _ = np.linalg.lstsq(J, offsets.ravel(), rcond=1e-6)
    alone = float(((offsets.ravel() - J @ taken) ** 2).sum())
    # two poses take up more than the one that both have in common
    own, more = float(used.measurements.sum()) - rank, max(rank - 6, 1.0)
    gained = (float(used.squares.sum()) - alone) / more
    return bool(own >= 1 and gained > fdtri(more, own, model.by_chance) * alone / own)


def is_far_off(used: Matches, before: Noise, rules: AcceptanceRules, model: NoiseModel) -> bool:
    """Whether features are met far beyond the noise so far, or what is typical."""
    degrees = float(used.measurements.sum()) - 6
    if degrees < 1:
        return False
    is_known = before.degrees >= model.known
    known = before.variance if is_known else model.errors.typical**2
    times = rules.disagreeing if is_known else rules.strange
    squares = float(used.squares.sum())
    return bool(squares / degrees >= times * max(known, model.smallest**2))
