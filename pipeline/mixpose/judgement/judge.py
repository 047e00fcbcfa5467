"""Judge a pose: its matches, noise and covariance, and the evidence that the body is there."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, expit

from mixpose.body import Body
from mixpose.judgement.clutter import ClutterRates
from mixpose.judgement.evidence import DetectionModel, Prior, flat_prior, log_evidence
from mixpose.judgement.information import information_of, inverted
from mixpose.judgement.noise import NoiseModel, RememberedNoise, noise_of
from mixpose.matching import AssociationRules, Matches, NoiseEstimate, associate
from mixpose.objective import MatchedObjective
from mixpose.records import Floats, Indices, Mask, SensorReport, replace


class Case(NamedTuple):
    """A pose to be judged, with what is known before its frame."""

    objective: MatchedObjective
    T_world_object: Floats  # (4, 4)
    before: RememberedNoise = RememberedNoise()
    clutter: ClutterRates = ClutterRates()
    prior: Prior | None = None
    # from the fit, if it has them
    matches: Matches | None = None
    noise: NoiseEstimate | None = None

    @property
    def body(self) -> Body:
        """The body whose pose it is."""
        return self.objective.projection.body


@dataclass(frozen=True)
class JudgementRules:
    """The models that a pose is judged by."""

    association: AssociationRules = AssociationRules()
    detection: DetectionModel = DetectionModel()
    noise: NoiseModel = NoiseModel()


# standard deviations of directions that a frame leaves open, over those of the flat prior: the body
# is turned in any way and farther away than any place that is searched
_FARTHEST = np.repeat([100.0, 1 / math.sqrt(3)], 3)
MEETS_NOTHING = "it meets nothing of the body"


@dataclass(frozen=True, eq=False)
class ScoredPose:
    """A pose with how well it explains the frame."""

    T_world_object: Floats  # (4, 4)
    matches: Matches  # in all sensors that saw something
    covariance: Floats  # (6, 6) zero in directions that are not estimated
    log_evidence: float  # log odds of the pose against mere clutter
    noise: RememberedNoise = RememberedNoise()  # of frames up to this one, for the next
    log_missed: float = DetectionModel().log_missed  # log odds of a feature that is missed
    left_out: Mapping[str, str] = field(default_factory=dict)  # sensors not fitted to, and why
    # (6, 6) part of the covariance by fields that last from frame to frame
    persistent: Floats = field(default_factory=lambda: np.zeros((6, 6)))
    variances: Floats = field(default_factory=lambda: np.ones(1))  # (L,) of noise, of `used`
    residual_ratio: float = 0.0  # of its residuals to the largest that chance makes
    # (6, 6) covariance if features are off by as much as the body's spreads allow
    bent: Floats = field(default_factory=lambda: np.zeros((6, 6)))
    spread: Floats | None = None  # (6,) standard deviations, where as large as its motion
    # log odds that a better pose of single ranges was not looked at; None: not computed
    elsewhere: float | None = None
    failing: Mapping[str, float] = field(default_factory=dict)  # see `Track`, after this frame
    by_count: float = 0.0  # log evidence by count, less that by volume
    proposer: str = ""  # where the pose came from
    blurs: tuple[Mapping[str, float], ...] = ()  # by sensor, at which it was fitted
    T_moved: Floats | None = None  # (4, 4) the pose whose prior it has, if not its own

    @cached_property
    def used(self) -> Matches:
        """The matches of the sensors that are not left out."""
        return taken_part(self.matches, self.left_out)

    @property
    def log_density(self) -> float:
        """Log probability among poses of the body, up to a common constant.

        Against clutter a pose may pay by count; among themselves all pay by volume.
        """
        return self.log_evidence - self.by_count

    @cached_property
    def coverage(self) -> float:
        """Mean share of the body's features in view that are met."""
        return float(sum(self.used.coverage.tolist())) / len(self.used.names)

    @cached_property
    def measurements(self) -> float:
        """Number of sensor coordinates that are met."""
        return float(sum(self.used.measurements.tolist()))

    @property
    def gained(self) -> float:
        """Log evidence per coordinate met."""
        return self.log_evidence / max(self.measurements, 1.0)

    @cached_property
    def features(self) -> tuple[int, int]:
        """Numbers of features that some sensor meets, and that some sensor has in view."""
        in_view = self.matches.weights.any(axis=0)
        return int(np.count_nonzero(self.matches.met_by)), int(np.count_nonzero(in_view))

    @property
    def score(self) -> float:
        """Mean cosine between predicted and observed densities, 0 to 1."""
        return float(sum(np.sqrt(self.used.explained).tolist())) / len(self.used.names)

    def reports(
        self, residuals: Mapping[str, Mapping[str, float | None]]
    ) -> dict[str, SensorReport]:
        """Report how each sensor took part; `residuals` are by sensor and feature."""
        matches = self.matches
        idle = [name for name, met in zip(matches.names, matches.met.tolist()) if not met]
        why = dict.fromkeys(idle, MEETS_NOTHING) | dict(self.left_out)
        rows = zip(matches.explained.tolist(), matches.rms)
        return {
            name: SensorReport(name not in why, *row, why.get(name), residuals.get(name, {}))
            for name, row in zip(matches.names, rows)
        }


def taken_part(matches: Matches, left_out: Mapping[str, str]) -> Matches:
    """Return the matches of the sensors that are not left out."""
    kept = [name not in left_out for name in matches.names]
    return matches if all(kept) else matches.of_sensors(kept)


def judge(
    objective: MatchedObjective,
    T_world_object: Floats,
    free: Mask,
    rules: JudgementRules = JudgementRules(),
    *,
    prior: Prior | None = None,
    left_out: Mapping[str, str] | None = None,
) -> ScoredPose:
    """Judge a pose that was estimated in free directions (6,), without frames before."""
    case = Case(objective, T_world_object, prior=prior)
    return judge_together([case], free, rules, left_out)[0]


def judge_together(
    cases: Sequence[Case],
    free: Mask,
    rules: JudgementRules = JudgementRules(),
    left_out: Mapping[str, str] | None = None,
) -> list[ScoredPose]:
    """Judge K poses in the same sensors; sensors that are left out count as meeting nothing."""
    left_out, all_matches, noises, clutter_odds = left_out or {}, [], [], []
    association = rules.association, rules.noise.errors.narrowest
    for case in cases:
        posed = case.objective, case.T_world_object
        all_matches.append(case.matches or associate(*posed, *association))
        anywhere = flat_prior(case.body, free, rules.detection)[1]
        uncertainty = case.prior[1] if case.prior else anywhere
        used = taken_part(all_matches[-1], left_out)
        known_before = case.before, rules.noise, case.noise, uncertainty, _FARTHEST * anywhere
        noises.append(noise_of(used, free, *known_before))
        clutter_odds.append(case.clutter.log_odds(used, rules.detection.log_blind))
    # one pose needs no axis of poses
    variances, stacked = noises[0][0], all_matches[0]
    if len(cases) > 1:
        variances, stacked = np.array([noise[0] for noise in noises]), Matches.stacked(all_matches)
    if left_out:
        is_used = np.array([name not in left_out for name in all_matches[0].names])
        measured, variances = variances, np.ones((*variances.shape[:-1], len(is_used)))
        variances[..., is_used] = measured
        stacked = replace(stacked, shares=stacked.shares * is_used[:, None])
    log_odds, bent, chances = _evidence(cases, stacked, variances, free, rules.detection)
    evidence, densities = log_odds + clutter_odds + [noise[-1] for noise in noises]
    shares = chances
    if chances.any():
        shares = _share_of_bent(chances, int(free.sum()), 1 - rules.noise.by_chance)
    return [
        ScoredPose(
            case.T_world_object,
            all_matches[k],
            (1 - shares[k]) * covariance + shares[k] * bent[k],
            float(evidence[k]),
            noise=remembered.bent_once(chances[k], rules.noise.bias_memory)
            if case.body.spread
            else remembered,
            log_missed=rules.detection.log_missed,
            left_out=left_out,
            persistent=persistent,
            residual_ratio=ratio,
            variances=own_variances,
            bent=bent[k],
            by_count=float(evidence[k] - densities[k]) if evidence[k] > -np.inf else 0.0,
        )
        for k, (case, (own_variances, covariance, persistent, remembered, ratio, _)) in enumerate(
            zip(cases, noises, strict=True)
        )
    ]


def _evidence(
    cases: Sequence[Case], matches: Matches, variances: Floats, free: Mask, model: DetectionModel
) -> tuple[Floats, Floats, Floats]:
    """Return log odds (2, K) as `log_evidence`, and covariances (K, 6, 6) and chances (K,) if bent.

    The latter are zero of bodies without spreads.
    """
    bodies = [case.body for case in cases]
    priors = [case.prior or flat_prior(case.body, free, model) for case in cases]
    sizes = np.array([2 * body.radius for body in bodies]).reshape(variances.shape[:-1])
    bent, chances = np.zeros((len(cases), 6, 6)), np.zeros(len(cases))
    arguments = matches, variances, free, priors, sizes, model
    surfaces = _surfaces_of(bodies, (*sizes.shape, matches.shares.shape[-1]))
    evidence = log_evidence(*arguments, information_of(matches, variances), None, surfaces)
    if soft := [k for k, body in enumerate(bodies) if body.spread]:
        spreads = np.zeros((*sizes.shape, matches.shares.shape[-1], 3, 3))
        by_pose = spreads.reshape(len(cases), *spreads.shape[-3:])
        for spreads_of_pose, body, case in zip(by_pose, bodies, cases, strict=True):
            by_node = body.node_spreads(case.T_world_object)
            spreads_of_pose[: len(by_node)] = by_node
        information = information_of(matches, variances, spreads)
        bent_odds = log_evidence(*arguments, information, spreads, surfaces)
        inner = np.ix_(free, free)
        for k in soft:
            bent[k][inner] = inverted(information.reshape(-1, 6, 6)[k][inner])
            # rigid and bent are as probable as in the frames before
            rigid_prior, bent_prior = cases[k].before.log_bent
            log_joint = np.array([rigid_prior + evidence[:, k], bent_prior + bent_odds[:, k]])
            evidence[:, k] = np.logaddexp(*log_joint)
            if np.isfinite(log_joint).all():
                chances[k] = expit(log_joint[1, 1] - log_joint[0, 1])
    return evidence, bent, chances


def _share_of_bent(chances: Floats, count: int, outside: float) -> Floats:
    """Return the share (K,) of the covariance of the bent body in that of the pose.

    For a body that is bent by a chance p, 1 - outside / p of the bent poses have to be inside the
    ellipsoid; the share is at least p, as in a mixture.
    """
    tail = np.minimum(outside / np.maximum(chances, 1e-300), 1.0)
    return np.asarray(np.maximum(chdtri(count, tail) / chdtri(count, outside), chances))


def _surfaces_of(bodies: Sequence[Body], shape: tuple[int, ...]) -> Indices | None:
    """Return the surface of each feature (K, N), -1 for none; None if no body has surfaces."""
    if all(body.surfaces is None for body in bodies):
        return None
    stacked = np.full(shape, -1)
    for of_body, body in zip(stacked.reshape(len(bodies), -1), bodies, strict=True):
        if body.surfaces is not None:
            of_body[: len(body.surfaces)] = body.surfaces
    return stacked
