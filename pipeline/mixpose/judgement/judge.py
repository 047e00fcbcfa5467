"""What a pose is worth: matches, noise, covariance and evidence, worked out once and kept."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.judgement.evidence import DetectionModel, Prior, flat_prior, log_evidence
from mixpose.judgement.moments import inverses
from mixpose.judgement.noise import NoiseModel, RememberedNoise, information_of, noises_of
from mixpose.matching import AssociationRules, Matches, NoiseEstimate, associate
from mixpose.objective import MatchedObjective
from mixpose.records import Floats, SensorReport


@dataclass(frozen=True)
class JudgementRules:
    """The models that a pose is judged by."""

    association: AssociationRules = AssociationRules()
    detection: DetectionModel = DetectionModel()
    noise: NoiseModel = NoiseModel()


@dataclass(frozen=True, eq=False)
class ScoredPose:
    """A pose, and how well it explains the frame.

    Attributes
    ----------
    T_world_object : (4, 4)
    matches : Matches
        Against each sensor that saw something.
    covariance : (6, 6)
        Zero in directions that are not estimated.
    log_evidence : float
        Logarithm of the odds for this pose against mere clutter.
    noise : RememberedNoise
        Of this frame and, fading, of those before it, for the next frame.
    left_out : mapping of str to str
        Sensors that the pose was fitted without, and why.
    persistent : (6, 6)
        Of the covariance, what lasts from frame to frame.
    residual_ratio : float
        Of its residuals to the largest that chance makes.
    bent : (6, 6)
        Covariance where features are off by all that the spreads of a body that gives way allow.
    spread : (6,) or None
        Standard deviations where they are as large as the body's motion.
    proposer : str
        Where the pose came from.
    blurs : tuple of mapping of str to float
        By sensor, through which it was fitted.
    """

    T_world_object: Floats
    matches: Matches
    covariance: Floats
    log_evidence: float
    noise: RememberedNoise = RememberedNoise()
    left_out: Mapping[str, str] = field(default_factory=dict)
    persistent: Floats = field(default_factory=lambda: np.zeros((6, 6)))
    residual_ratio: float = 0.0
    bent: Floats = field(default_factory=lambda: np.zeros((6, 6)))
    spread: Floats | None = None
    proposer: str = ""
    blurs: tuple[Mapping[str, float], ...] = ()
    # what the rules of acceptance make of it, once they are asked
    checked: list[Any] = field(default_factory=list, init=False, repr=False)

    @cached_property
    def used(self) -> Matches:
        """The matches of the sensors that took part."""
        return taken_part(self.matches, self.left_out)

    @cached_property
    def coverage(self) -> float:
        """Mean share of the body's features in view that are met."""
        return float(self.used.coverage.mean())

    @cached_property
    def measurements(self) -> float:
        """Number of sensor coordinates that are met."""
        return float(self.used.measurements.sum())

    @cached_property
    def score(self) -> float:
        """Mean cosine between predicted and observed densities, 0 to 1."""
        return float(np.sqrt(self.used.explained).mean())

    @property
    def is_unlike(self) -> bool:
        """Whether its residuals are larger than chance makes them."""
        return self.residual_ratio > 1

    @property
    def sensors(self) -> dict[str, SensorReport]:
        """How each sensor took part."""
        rows = zip(self.matches.names, self.matches.explained.tolist(), self.matches.rms)
        return {
            name: SensorReport(name not in self.left_out, explained, rms, self.left_out.get(name))
            for name, explained, rms in rows
        }


def taken_part(matches: Matches, left_out: Mapping[str, str]) -> Matches:
    """The matches of the sensors that are not left out."""
    if not left_out:
        return matches
    return matches.of_sensors([k for k, name in enumerate(matches.names) if name not in left_out])


@dataclass(frozen=True)
class Case:
    """A pose that is to be judged, and what was known before."""

    objective: MatchedObjective  # at σ_ε of every sensor
    T_world_object: Floats  # (4, 4)
    before: RememberedNoise = RememberedNoise()  # of the frames before
    prior: Prior | None = None  # what was known of the pose; None: nothing
    left_out: Mapping[str, str] = field(default_factory=dict)  # count as if they had met nothing
    matches: Matches | None = None  # of the pose, where the fit has them
    noise: NoiseEstimate | None = None  # likewise


def judge(
    case: Case, free: NDArray[np.bool_], rules: JudgementRules = JudgementRules()
) -> ScoredPose:
    """Judge a pose, estimated in free directions (6,), by matched densities at the finest blur."""
    return judge_together([case], free, rules)[0]


def judge_together(
    cases: Sequence[Case], free: NDArray[np.bool_], rules: JudgementRules = JudgementRules()
) -> list[ScoredPose]:
    """Judge poses that the same sensors see and take part in, at once: as `judge` does each."""
    narrowest, left_out = rules.noise.errors.narrowest, cases[0].left_out
    whole = [
        one.matches or associate(one.objective, one.T_world_object, rules.association, narrowest)
        for one in cases
    ]
    matches = Matches.stacked([taken_part(one, left_out) for one in whole])
    before, estimates = [one.before for one in cases], [one.noise for one in cases]
    noises = noises_of(matches, free, before, rules.noise, estimates)
    variances = np.array([noise.variances for noise in noises])
    scored, widened = matches, variances
    if left_out:
        scored, widened = _unmet(whole, variances, left_out)
    evidence, bent = _evidence(cases, scored, widened, free, rules.detection)
    return [
        ScoredPose(
            T_world_object=case.T_world_object,
            matches=own,
            covariance=noise.covariance,
            log_evidence=log_odds,
            noise=noise.remembered,
            left_out=left_out,
            persistent=noise.persistent,
            residual_ratio=noise.residual_ratio,
            bent=apart,
        )
        for case, own, noise, log_odds, apart in zip(
            cases, whole, noises, evidence.tolist(), bent, strict=True
        )
    ]


def _unmet(
    whole: Sequence[Matches], variances: Floats, left_out: Mapping[str, str]
) -> tuple[Matches, Floats]:
    """All sensors with noise (K, L), those left out as if they had met nothing."""
    stacked = Matches.stacked(whole)
    used = np.array([name not in left_out for name in stacked.names])
    all_of_them = np.ones((len(whole), len(used)))
    all_of_them[:, used] = variances
    return replace(stacked, shares=stacked.shares * used[:, None]), all_of_them


def _evidence(
    cases: Sequence[Case],
    whole: Matches,
    variances: Floats,
    free: NDArray[np.bool_],
    detection: DetectionModel,
) -> tuple[Floats, Floats]:
    """Log odds (K,), and the covariances (K, 6, 6) of bodies that give way."""
    bodies = [one.objective.projection.body for one in cases]
    priors = [
        one.prior or flat_prior(body, free, detection)
        for one, body in zip(cases, bodies, strict=True)
    ]
    sizes = np.array([2 * body.radius for body in bodies])
    given = whole, variances, free, priors, sizes, detection
    evidence = log_evidence(*given, information_of(whole, variances))
    bent = np.zeros((len(cases), 6, 6))
    if any(body.spread for body in bodies):
        spreads = np.zeros((len(cases), whole.shares.shape[2], 3, 3))
        for own, body, case in zip(spreads, bodies, cases, strict=True):
            turned = body.node_spreads(case.T_world_object)
            own[: len(turned)] = turned
        # rigid as a rule, and bent now and then: as often the one as the other
        information = information_of(whole, variances, spreads)
        at_all = spreads.any(axis=(1, 2, 3))
        both = np.logaddexp(evidence, log_evidence(*given, information, spreads)) - math.log(2)
        evidence = np.where(at_all, both, evidence)
        bent[np.ix_(at_all, free, free)] = inverses(information[:, free][..., free])[at_all]
    return evidence, bent


def nearest_alike(T_world_object: Floats, body: Body, T_reference: Floats | None) -> Floats:
    """Of the poses that look the same, the one turned least against a reference.

    Without a reference it is the one turned least against the world.
    """
    if len(body.symmetries) == 1:
        return T_world_object
    alike = T_world_object @ body.symmetries
    reference = np.eye(4) if T_reference is None else T_reference
    # the angle grows as the trace of the difference falls
    traces = np.einsum("ij,kij->k", reference[:3, :3], alike[:, :3, :3])
    nearest = int(np.argmax(traces))
    # the very same, where it is that: what was worked out for it holds
    return T_world_object if nearest == body.identity else np.asarray(alike[nearest])


def beliefs(judged: Sequence[ScoredPose]) -> list[float]:
    """Share of belief of each pose among its rivals."""
    if not judged:
        return []
    logs = np.array([one.log_evidence for one in judged])
    if not np.isfinite(logs.max()):  # none meets anything
        return [1.0 / len(judged)] * len(judged)
    weights = np.exp(logs - logs.max())
    return [float(w) for w in weights / weights.sum()]
