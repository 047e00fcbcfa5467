"""What a pose is worth: per-sensor reports, covariance and evidence."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.density import AssociationRules
from mixpose.judgement.association import Association, Matches, associate
from mixpose.judgement.evidence import DetectionModel, Prior, flat_prior, log_evidence
from mixpose.judgement.moments import inverses
from mixpose.judgement.noise import NoiseModel, Residuals, information_of, noises_of
from mixpose.objective import MatchedObjective
from mixpose.records import Floats, SensorReport


@dataclass(frozen=True)
class JudgementRules:
    """The models that a pose is judged by."""

    association: AssociationRules = AssociationRules()
    detection: DetectionModel = DetectionModel()
    noise: NoiseModel = NoiseModel()


@dataclass(frozen=True)
class Judged:
    """A pose, and how well it explains the frame."""

    T_world_object: Floats  # (4, 4)
    sensors: dict[str, SensorReport]
    score: float  # mean cosine between predicted and observed densities, 0 to 1
    coverage: float  # mean share of the body's features in view that are met
    measurements: float  # number of met sensor coordinates
    covariance: Floats  # (6, 6) zero in directions that are not estimated
    log_evidence: float  # logarithm of the odds for this pose against mere clutter
    residuals: Residuals  # of this frame and, fading, of those before it, for the next frame
    associations: tuple[Association, ...] = ()  # the pose against each sensor that saw something
    spread: Floats | None = None  # (6,) standard deviations where they are as large as its motion
    proposer: str = ""  # where the pose came from
    blurs: tuple[Mapping[str, float], ...] = ()  # by sensor, through which it was fitted
    value: float = 0.0  # of what was climbed, at the pose
    # (6, 6) of the covariance, what lasts from frame to frame
    lasting: Floats = field(default_factory=lambda: np.zeros((6, 6)))
    surplus: float = 0.0  # how many times larger its residuals are than chance makes them
    # (6, 6) where features are off by all that the spreads of a body that gives way let them be
    bent: Floats = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def used(self) -> list[Association]:
        """The pose against each sensor that took part."""
        return [one for one in self.associations if self.sensors[one.name].used]

    @property
    def is_unlike(self) -> bool:
        """Whether its residuals are larger than chance makes them."""
        return self.surplus > 1


@dataclass(frozen=True)
class Case:
    """A pose that is to be judged, and what was known before."""

    objective: MatchedObjective  # at σ_ε of every sensor
    T_world_object: Floats  # (4, 4)
    before: Residuals = Residuals()  # of the frames before
    prior: Prior | None = None  # what was known of the pose; None: nothing
    unmet: Sequence[Association] = ()  # other sensors, which count as if they had met nothing


def judge(case: Case, free: NDArray[np.bool_], rules: JudgementRules = JudgementRules()) -> Judged:
    """Judge a pose, estimated in free directions (6,), by matched densities at the finest blur."""
    return judge_together([case], free, rules)[0]


def judge_together(
    cases: Sequence[Case], free: NDArray[np.bool_], rules: JudgementRules = JudgementRules()
) -> list[Judged]:
    """Judge poses that the same sensors see, at once: as `judge` does each."""
    narrowest = rules.noise.errors.narrowest
    pairs = [
        associate(one.objective, one.T_world_object, rules.association, narrowest) for one in cases
    ]
    found = Matches.of([associations for associations, _ in pairs])
    noises = noises_of(found, free, [one.before for one in cases], rules.noise)
    variances = np.array([noise.variances for noise in noises])
    evidence, bent = _evidence(cases, found, variances, free, rules.detection)
    parts = zip(cases, pairs, noises, evidence.tolist(), bent, strict=True)
    return [
        Judged(
            T_world_object=case.T_world_object,
            sensors={one.name: SensorReport(True, one.explained, one.rms) for one in own},
            score=sum(math.sqrt(one.explained) for one in own) / len(own),
            coverage=sum(one.coverage for one in own) / len(own),
            measurements=sum(one.measurements for one in own),
            covariance=noise.covariance,
            lasting=noise.lasting,
            log_evidence=log_odds,
            residuals=noise.remembered,
            associations=tuple(own),
            value=value,
            surplus=noise.surplus,
            bent=apart,
        )
        for case, (own, value), noise, log_odds, apart in parts
    ]


def _evidence(
    cases: Sequence[Case],
    found: Matches,
    variances: Floats,
    free: NDArray[np.bool_],
    detection: DetectionModel,
) -> tuple[Floats, Floats]:
    """Log odds (K,), and the covariances (K, 6, 6) of bodies that give way."""
    bodies = [one.objective.projection.body for one in cases]
    whole, widened = found, variances
    blind = [[replace(s, shares=np.zeros(len(s.features))) for s in one.unmet] for one in cases]
    if any(blind):
        whole = Matches.of([[*own, *others] for own, others in zip(found.each, blind, strict=True)])
        widened = np.hstack([variances, np.ones((len(cases), len(blind[0])))])
    priors = [
        one.prior or flat_prior(body, free, detection)
        for one, body in zip(cases, bodies, strict=True)
    ]
    sizes = np.array([2 * body.radius for body in bodies])
    beside = whole, widened, free, priors, sizes, detection
    evidence = log_evidence(*beside, information_of(found, variances))
    bent = np.zeros((len(cases), 6, 6))
    if any(body.spread for body in bodies):
        spreads = np.zeros((len(cases), whole.shares.shape[2], 3, 3))
        for own, body, case in zip(spreads, bodies, cases, strict=True):
            turned = body.node_spreads(case.T_world_object)[: len(own)]
            own[: len(turned)] = turned
        # rigid as a rule, and bent now and then: as often the one as the other
        information = information_of(whole, widened, spreads)
        at_all = spreads.any(axis=(1, 2, 3))
        both = np.logaddexp(evidence, log_evidence(*beside, information, spreads)) - math.log(2)
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
    return np.asarray(alike[int(np.argmax(traces))])


def beliefs(judged: Sequence[Judged]) -> list[float]:
    """Share of belief of each pose among its rivals."""
    if not judged:
        return []
    logs = np.array([one.log_evidence for one in judged])
    if not np.isfinite(logs.max()):  # none meets anything
        return [1.0 / len(judged)] * len(judged)
    weights = np.exp(logs - logs.max())
    return [float(w) for w in weights / weights.sum()]
