"""What a pose is worth: matches, noise, covariance, and how sure it is that the body is there."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
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
from mixpose.records import Floats, Indices, Mask, SensorReport


class Case(NamedTuple):
    """A pose to be judged, and what is known before its frame."""

    objective: MatchedObjective
    T_world_object: Floats  # (4, 4)
    before: RememberedNoise = RememberedNoise()
    clutter: ClutterRates = ClutterRates()
    prior: Prior | None = None
    # as the fit has them
    matches: Matches | None = None
    noise: NoiseEstimate | None = None

    @property
    def body(self) -> Body:
        """The object whose pose it is."""
        return self.objective.projection.body


@dataclass(frozen=True)
class JudgementRules:
    """The models that a pose is judged by."""

    association: AssociationRules = AssociationRules()
    detection: DetectionModel = DetectionModel()
    noise: NoiseModel = NoiseModel()


# deviations of what a frame leaves open, in those of where nothing is known: a turn is any, and a
# place is farther away than anybody looks
_FARTHEST = np.repeat([100.0, 1 / math.sqrt(3)], 3)
MEETS_NOTHING = "it meets nothing of the body"


@dataclass(frozen=True, eq=False)
class ScoredPose:
    """A pose, and how well it explains the frame."""

    T_world_object: Floats  # (4, 4)
    matches: Matches  # against each sensor that saw something
    covariance: Floats  # (6, 6) zero in directions that are not estimated
    log_evidence: float  # logarithm of the odds for this pose against mere clutter
    noise: RememberedNoise = RememberedNoise()  # of this frame and those before it, for the next
    log_missed: float = DetectionModel().log_missed  # what a feature costs that is not met
    left_out: Mapping[str, str] = field(default_factory=dict)  # sensors not fitted to, and why
    persistent: Floats = field(default_factory=lambda: np.zeros((6, 6)))  # of it, what lasts
    # (L,) of the noise, of those used
    variances: Floats = field(default_factory=lambda: np.ones(1))
    residual_ratio: float = 0.0  # of its residuals to the largest that chance makes
    # (6, 6) where features are off by all that the body's spreads allow
    bent: Floats = field(default_factory=lambda: np.zeros((6, 6)))
    spread: Floats | None = None  # (6,) deviations, where as large as the body's motion
    # log odds that there may be a pose elsewhere as well, of single ranges; None: not asked
    elsewhere: float | None = None
    by_count: float = 0.0  # by how much its evidence is larger as it pays by count, not by volume
    proposer: str = ""  # where the pose came from
    blurs: tuple[Mapping[str, float], ...] = ()  # by sensor, through which it was fitted
    T_moved: Floats | None = None  # (4, 4) the pose by whose prior it was judged, if not its own

    @cached_property
    def used(self) -> Matches:
        """The matches of the sensors that took part."""
        return taken_part(self.matches, self.left_out)

    @property
    def log_density(self) -> float:
        """Logarithm of its probability among poses of the body, but for what they have in common.

        Whichever they pay by against clutter, among themselves all pay by volume.
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
        """Log evidence per coordinate that is met."""
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
        """How each sensor took part, with residuals of features by sensor."""
        found = self.matches
        idle = [name for name, met in zip(found.names, found.met.tolist()) if not met]
        out = dict.fromkeys(idle, MEETS_NOTHING) | dict(self.left_out)
        rows = zip(found.explained.tolist(), found.rms)
        return {
            name: SensorReport(name not in out, *row, out.get(name), residuals.get(name, {}))
            for name, row in zip(found.names, rows)
        }


def taken_part(matches: Matches, left_out: Mapping[str, str]) -> Matches:
    """The matches of the sensors that are not left out."""
    kept = [name not in left_out for name in matches.names]
    return matches if all(kept) else matches.of_sensors(kept)


def judge(
    objective: MatchedObjective,
    T_world_object: Floats,
    free: Mask,
    rules: JudgementRules = JudgementRules(),
    *,
    before: RememberedNoise = RememberedNoise(),
    clutter: ClutterRates = ClutterRates(),
    prior: Prior | None = None,
    left_out: Mapping[str, str] | None = None,
    matches: Matches | None = None,
    noise: NoiseEstimate | None = None,
) -> ScoredPose:
    """Judge a pose, estimated in free directions (6,); arguments as in `Case`."""
    return judge_together(
        [Case(objective, T_world_object, before, clutter, prior, matches, noise)],
        free,
        rules,
        left_out,
    )[0]


def judge_together(
    cases: Sequence[Case],
    free: Mask,
    rules: JudgementRules = JudgementRules(),
    left_out: Mapping[str, str] | None = None,
) -> list[ScoredPose]:
    """Judge K poses that the same sensors see and take part in; those left out meet nothing."""
    left_out, whole, noises, counted = left_out or {}, [], [], []
    association = rules.association, rules.noise.errors.narrowest
    for case in cases:
        at = case.objective, case.T_world_object
        whole.append(case.matches or associate(*at, *association))
        anywhere = flat_prior(case.body, free, rules.detection)[1]
        known = case.prior[1] if case.prior else anywhere
        part = taken_part(whole[-1], left_out)
        given = case.before, rules.noise, case.noise, known, _FARTHEST * anywhere
        noises.append(noise_of(part, free, *given))
        counted.append(case.clutter.log_odds(part, rules.detection.log_blind))
    # one pose needs no axis of poses
    variances, seen = noises[0][0], whole[0]
    if len(cases) > 1:
        variances, seen = np.array([noise[0] for noise in noises]), Matches.stacked(whole)
    if left_out:
        used = np.array([name not in left_out for name in whole[0].names])
        measured, variances = variances, np.ones((*variances.shape[:-1], len(used)))
        variances[..., used] = measured
        seen = replace(seen, shares=seen.shares * used[:, None])
    odds, bent, chances = _evidence(cases, seen, variances, free, rules.detection)
    evidence, densities = odds + counted + [noise[-1] for noise in noises]
    shares = chances
    if chances.any():
        shares = _share_of_bent(chances, int(free.sum()), 1 - rules.noise.by_chance)
    return [
        ScoredPose(
            case.T_world_object,
            whole[k],
            (1 - shares[k]) * covariance + shares[k] * bent[k],
            float(evidence[k]),
            noise=remembered.bent_once(chances[k], rules.noise.bias_memory)
            if case.body.spread
            else remembered,
            log_missed=rules.detection.log_missed,
            left_out=left_out,
            persistent=persistent,
            residual_ratio=ratio,
            variances=own,
            bent=bent[k],
            by_count=float(evidence[k] - densities[k]) if evidence[k] > -np.inf else 0.0,
        )
        for k, (case, (own, covariance, persistent, remembered, ratio, _)) in enumerate(
            zip(cases, noises, strict=True)
        )
    ]


def _evidence(
    cases: Sequence[Case], seen: Matches, variances: Floats, free: Mask, detection: DetectionModel
) -> tuple[Floats, Floats, Floats]:
    """Log odds (2, K) as in `log_evidence`; of bodies that give way also covariances (K, 6, 6).

    These are of where they are bent, with the chances (K,) that they are.
    """
    bodies = [case.body for case in cases]
    priors = [case.prior or flat_prior(case.body, free, detection) for case in cases]
    sizes = np.array([2 * body.radius for body in bodies]).reshape(variances.shape[:-1])
    bent, chances = np.zeros((len(cases), 6, 6)), np.zeros(len(cases))
    given = seen, variances, free, priors, sizes, detection
    surfaces = _surfaces_of(bodies, (*sizes.shape, seen.shares.shape[-1]))
    evidence = log_evidence(*given, information_of(seen, variances), None, surfaces)
    if soft := [k for k, body in enumerate(bodies) if body.spread]:
        spreads = np.zeros((*sizes.shape, seen.shares.shape[-1], 3, 3))
        by_pose = spreads.reshape(len(cases), *spreads.shape[-3:])
        for own, body, case in zip(by_pose, bodies, cases, strict=True):
            turned = body.node_spreads(case.T_world_object)
            own[: len(turned)] = turned
        information = information_of(seen, variances, spreads)
        bent_odds = log_evidence(*given, information, spreads, surfaces)
        inner = np.ix_(free, free)
        for k in soft:
            bent[k][inner] = inverted(information.reshape(-1, 6, 6)[k][inner])
            # as often the one and the other as in frames before
            rigid, bend = cases[k].before.log_bent
            likely = np.array([rigid + evidence[:, k], bend + bent_odds[:, k]])
            evidence[:, k] = np.logaddexp(*likely)
            if np.isfinite(likely).all():
                chances[k] = expit(likely[1, 1] - likely[0, 1])
    return evidence, bent, chances


def _share_of_bent(chances: Floats, count: int, outside: float) -> Floats:
    """Of covariances of bent bodies (K,), so that ellipsoids of that share hold all but some poses.

    Of a body that is bent by a chance p, 1 - outside / p of its poses where it is bent are to be
    inside; at least p of it, as of a mixture.
    """
    rest = np.minimum(outside / np.maximum(chances, 1e-300), 1.0)
    return np.asarray(np.maximum(chdtri(count, rest) / chdtri(count, outside), chances))


def _surfaces_of(bodies: Sequence[Body], shape: tuple[int, ...]) -> Indices | None:
    """Surfaces (K, N) of bodies side by side, -1 of none; None where no body has any."""
    if all(body.surfaces is None for body in bodies):
        return None
    surfaces = np.full(shape, -1)
    for own, body in zip(surfaces.reshape(len(bodies), -1), bodies, strict=True):
        if body.surfaces is not None:
            own[: len(body.surfaces)] = body.surfaces
    return surfaces
