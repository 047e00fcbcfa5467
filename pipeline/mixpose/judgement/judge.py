"""What a pose is worth: matches, noise, covariance and evidence, worked out once and kept."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.judgement.covariance import information_of, inverses
from mixpose.judgement.evidence import DetectionModel, Prior, flat_prior, log_evidence
from mixpose.judgement.noise import NoiseModel, RememberedNoise, noise_of
from mixpose.matching import AssociationRules, Matches, NoiseEstimate, associate
from mixpose.objective import MatchedObjective
from mixpose.records import Floats, SensorReport

# objective, pose (4, 4), noise before, prior, and matches and noise where the fit has them
Case: TypeAlias = tuple[
    MatchedObjective, Floats, RememberedNoise, Prior | None, Matches | None, NoiseEstimate | None
]


@dataclass(frozen=True)
class JudgementRules:
    """The models that a pose is judged by."""

    association: AssociationRules = AssociationRules()
    detection: DetectionModel = DetectionModel()
    noise: NoiseModel = NoiseModel()


@dataclass(frozen=True, eq=False)
class ScoredPose:
    """A pose, and how well it explains the frame."""

    T_world_object: Floats  # (4, 4)
    matches: Matches  # against each sensor that saw something
    covariance: Floats  # (6, 6) zero in directions that are not estimated
    log_evidence: float  # logarithm of the odds for this pose against mere clutter
    noise: RememberedNoise = RememberedNoise()  # of this frame and those before it, for the next
    left_out: Mapping[str, str] = field(default_factory=dict)  # sensors not fitted to, and why
    # (6, 6) of the covariance, what lasts from frame to frame
    persistent: Floats = field(default_factory=lambda: np.zeros((6, 6)))
    residual_ratio: float = 0.0  # of its residuals to the largest that chance makes
    # (6, 6) where features are off by all that the spreads of a body that gives way allow
    bent: Floats = field(default_factory=lambda: np.zeros((6, 6)))
    spread: Floats | None = None  # (6,) deviations, where as large as the body's motion
    proposer: str = ""  # where the pose came from
    blurs: tuple[Mapping[str, float], ...] = ()  # by sensor, through which it was fitted

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
    def features(self) -> tuple[int, int]:
        """Numbers of features that some sensor meets, and that some sensor has in view."""
        met, in_view = self.matches.met_by, self.matches.weights.any(axis=0)
        return int(np.count_nonzero(met)), int(np.count_nonzero(in_view))

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
        out, rows = self.left_out, zip(self.matches.explained.tolist(), self.matches.rms)
        by_name = zip(self.matches.names, rows)
        return {name: SensorReport(name not in out, *row, out.get(name)) for name, row in by_name}


def taken_part(matches: Matches, left_out: Mapping[str, str]) -> Matches:
    """The matches of the sensors that are not left out."""
    if not left_out:
        return matches
    return matches.of_sensors([k for k, name in enumerate(matches.names) if name not in left_out])


def judge(
    objective: MatchedObjective,
    T_world_object: Floats,
    free: NDArray[np.bool_],
    rules: JudgementRules = JudgementRules(),
    *,
    before: RememberedNoise = RememberedNoise(),
    prior: Prior | None = None,
    left_out: Mapping[str, str] | None = None,
    matches: Matches | None = None,
    noise: NoiseEstimate | None = None,
) -> ScoredPose:
    """Judge a pose (4, 4), estimated in free directions (6,), by the matched objective at σ_ε.

    `before` is the noise of earlier frames, `prior` what was known of the pose; sensors left out
    count as if they had met nothing.  `matches` and `noise` are the fit's, where it has them.
    """
    case = objective, T_world_object, before, prior, matches, noise
    return judge_together([case], free, rules, left_out)[0]


def judge_together(
    cases: Sequence[Case],
    free: NDArray[np.bool_],
    rules: JudgementRules = JudgementRules(),
    left_out: Mapping[str, str] | None = None,
) -> list[ScoredPose]:
    """Judge K poses that the same sensors see and take part in, at once: as `judge` does each."""
    left_out, narrowest = left_out or {}, rules.noise.errors.narrowest
    whole, noises = [], []
    for objective, T, before, _, matches, noise in cases:
        whole.append(matches or associate(objective, T, rules.association, narrowest))
        part = taken_part(whole[-1], left_out)
        noises.append(noise_of(part, free, before, rules.noise, noise))
    used = np.array([name not in left_out for name in whole[0].names])
    variances, seen = np.ones((len(whole), len(used))), Matches.stacked(whole)
    variances[:, used] = [noise[0] for noise in noises]
    if left_out:
        seen = replace(seen, shares=seen.shares * used[:, None])
    evidence, bent = _evidence(cases, seen, variances, free, rules.detection)
    return [
        ScoredPose(
            T_world_object=cases[k][1],
            matches=whole[k],
            covariance=covariance,
            log_evidence=float(evidence[k]),
            noise=remembered,
            left_out=left_out,
            persistent=persistent,
            residual_ratio=ratio,
            bent=bent[k],
        )
        for k, (_, covariance, persistent, remembered, ratio) in enumerate(noises)
    ]


def _evidence(
    cases: Sequence[Case],
    seen: Matches,
    variances: Floats,
    free: NDArray[np.bool_],
    detection: DetectionModel,
) -> tuple[Floats, Floats]:
    """Log odds (K,), and the covariances (K, 6, 6) of bodies that give way."""
    bodies = [case[0].projection.body for case in cases]
    priors = [
        case[3] or flat_prior(body, free, detection)
        for case, body in zip(cases, bodies, strict=True)
    ]
    sizes = np.array([2 * body.radius for body in bodies])
    given = seen, variances, free, priors, sizes, detection
    evidence = log_evidence(*given, information_of(seen, variances))
    bent = np.zeros((len(cases), 6, 6))
    if any(body.spread for body in bodies):
        spreads = np.zeros((len(cases), seen.shares.shape[2], 3, 3))
        for own, body, case in zip(spreads, bodies, cases, strict=True):
            turned = body.node_spreads(case[1])
            own[: len(turned)] = turned
        # rigid as a rule, and bent now and then: as often the one as the other
        information, at_all = information_of(seen, variances, spreads), spreads.any(axis=(1, 2, 3))
        both = np.logaddexp(evidence, log_evidence(*given, information, spreads)) - math.log(2)
        evidence = np.where(at_all, both, evidence)
        bent[np.ix_(at_all, free, free)] = inverses(information[:, free][..., free])[at_all]
    return evidence, bent


def nearest_alike(T_world_object: Floats, body: Body, T_reference: Floats | None) -> Floats:
    """Of the poses that look the same, the one turned least against a reference, or the world."""
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
