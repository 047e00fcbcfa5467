"""What a pose is worth: matches, noise, covariance, and how sure it is that the body is there.

The log of the odds against clutter is a sum over the features in view.  With the probability of
detection P_D, the noise s and the density ρ of observed features in a sensor, or ρ₃ of points in
space that cameras see together, d standard deviations away by their information A,

    met:  ln P_D + ln N(offset; 0, s²) − ln ρ,    missed:  ln (1 − P_D),
    met together:  − d²/2 + ½ ln det(A / 2π) − ln ρ₃;

what makes clutter likelier counts, feature by feature.  A pose was chosen to fit, and pays for it
by volume, + ½ ln det(2π Cov) + ln p(pose), or by count: features that fix it earn nothing, and cost
the logarithm of the ways to choose them.  See *Evidence* in `docs/method.md`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.special import gammaln

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement.clutter import ClutterRates
from mixpose.judgement.information import information_of, inverted, log_determinants, with_wide_turn
from mixpose.judgement.noise import NoiseModel, RememberedNoise, noise_of
from mixpose.matching import AssociationRules, Matches, NoiseEstimate, associate
from mixpose.objective import MatchedObjective
from mixpose.records import Floats, Indices, Mask, SensorReport

Prior: TypeAlias = tuple[float, Floats]
"""What is known of a pose before its frame: log of its density, per length and radian of each free
direction, and how uncertain it is (6,), which matters where the data leave a direction open."""


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
class DetectionModel:
    """How likely features are seen, and where a body may be."""

    probability: float = constant(0.75, "P_D of a feature in view: one or two of eight are hidden")
    log_unseen: float = constant(-1.2, "per feature that faces a sensor out of its view: ln 0.3")
    log_blind: float = constant(
        -5.0, "at least, for a sensor that misses all: 1 in 150 does, or shows what is new"
    )
    by_count: bool = constant(True, "whether features that fix a pose may pay for its freedom")
    in_space: bool = constant(True, "whether clutter may be a point in space, and counts once")
    room: float = constant(10.0, "radii of the body: how far it may be where nothing is known")

    @property
    def log_missed(self) -> float:
        """Of a feature in view without a detection."""
        return math.log(1 - self.probability)


@dataclass(frozen=True)
class JudgementRules:
    """The models that a pose is judged by."""

    association: AssociationRules = AssociationRules()
    detection: DetectionModel = DetectionModel()
    noise: NoiseModel = NoiseModel()


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
    by_count: float = 0.0  # by how much its evidence is larger as it pays by count, not by volume
    proposer: str = ""  # where the pose came from
    blurs: tuple[Mapping[str, float], ...] = ()  # by sensor, through which it was fitted

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
        known = (case.prior or flat_prior(case.body, free, rules.detection))[1]
        part = taken_part(whole[-1], left_out)
        noises.append(noise_of(part, free, case.before, rules.noise, case.noise, known))
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
    odds, bent = _evidence(cases, seen, variances, free, rules.detection)
    evidence, densities = odds + counted + [noise[-1] for noise in noises]
    return [
        ScoredPose(
            case.T_world_object,
            whole[k],
            with_wide_turn(covariance, case.T_world_object, case.body.means),
            float(evidence[k]),
            noise=remembered,
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
) -> tuple[Floats, Floats]:
    """Log odds (2, K) as in `log_evidence`, and covariances (K, 6, 6) of bodies that give way."""
    bodies = [case.body for case in cases]
    priors = [case.prior or flat_prior(case.body, free, detection) for case in cases]
    sizes = np.array([2 * body.radius for body in bodies]).reshape(variances.shape[:-1])
    bent = np.zeros((len(cases), 6, 6))
    given = seen, variances, free, priors, sizes, detection
    surfaces = _surfaces_of(bodies, (*sizes.shape, seen.shares.shape[-1]))
    evidence = log_evidence(*given, information_of(seen, variances), None, surfaces)
    if any(body.spread for body in bodies):
        spreads = np.zeros((*sizes.shape, seen.shares.shape[-1], 3, 3))
        by_pose = spreads.reshape(len(cases), *spreads.shape[-3:])
        for own, body, case in zip(by_pose, bodies, cases, strict=True):
            turned = body.node_spreads(case.T_world_object)
            own[: len(turned)] = turned
        # rigid as a rule, and bent now and then: as often the one as the other
        information = information_of(seen, variances, spreads)
        at_all = spreads.any(axis=(-3, -2, -1))
        bent_odds = log_evidence(*given, information, spreads, surfaces)
        both = np.logaddexp(evidence, bent_odds) - math.log(2)
        evidence = np.where(at_all, both, evidence)
        for k in np.flatnonzero(at_all).tolist():
            inner = np.ix_(free, free)
            bent[k][inner] = inverted(information.reshape(-1, 6, 6)[k][inner])
    return evidence, bent


def _surfaces_of(bodies: Sequence[Body], shape: tuple[int, ...]) -> Indices | None:
    """Surfaces (K, N) of bodies side by side, -1 of none; None where no body has any."""
    if all(body.surfaces is None for body in bodies):
        return None
    surfaces = np.full(shape, -1)
    for own, body in zip(surfaces.reshape(len(bodies), -1), bodies, strict=True):
        if body.surfaces is not None:
            own[: len(body.surfaces)] = body.surfaces
    return surfaces


def flat_prior(body: Body, free: Mask, detection: DetectionModel) -> Prior:
    """Nothing is known: anywhere within some radii of the body, turned in any way."""
    return _flat_prior(body, tuple(free.tolist()), detection.room * body.radius)


@lru_cache(maxsize=64)
def _flat_prior(body: Body, free: tuple[bool, ...], room: float) -> Prior:
    wide = np.array([room] * 3 + [math.pi] * 3)
    wide.flags.writeable = False  # all frames have the same
    shifts, turns = sum(free[:3]), sum(free[3:])
    rotations = 8 * math.pi**2 if turns == 3 else (2 * math.pi) ** turns
    volume = room**shifts * rotations / len(body.symmetries)
    return -math.log(volume), wide


def log_evidence(
    found: Matches,
    variances: Floats,
    free: Mask,
    priors: Sequence[Prior],
    sizes: Floats,
    detection: DetectionModel,
    information: Floats,  # (K, 6, 6)
    spreads: Floats | None = None,
    surfaces: Indices | None = None,
) -> Floats:
    """Log odds (2, K) for bodies at K poses against clutter, of arguments as in `odds_of`.

    As the pose pays by volume or by count, whichever is cheaper; and as it pays by volume.
    """
    odds = odds_of(found, variances, sizes, detection, spreads, surfaces)
    # a direction that the data leave open is as uncertain as before
    log_densities, wide = (np.array(parts) for parts in zip(*priors, strict=True))
    (chosen,) = free.nonzero()
    inner, before = information[..., chosen[:, None], chosen], 1 / wide[:, chosen] ** 2
    inner = inner + np.eye(len(chosen)) * before[..., None]
    laplace = -0.5 * log_determinants(inner / (2 * np.pi), before / (2 * np.pi))
    by_volume = odds[0] + odds[1] + laplace + log_densities
    evidence = by_volume
    if detection.by_count:
        evidence = np.maximum(by_volume, paid_by_count(odds, found, free))
    return np.where(found.met.any(axis=-1), [evidence, by_volume], -np.inf)


def odds_of(
    found: Matches,
    variances: Floats,  # (K, L) of the noise of each sensor, in σ_ε²
    sizes: Floats,  # (K,) of the body, length units
    detection: DetectionModel,
    spreads: Floats | None = None,  # (K, N, 3, 3) of features in the world, where a body gives way
    surfaces: Indices | None = None,  # (K, N) or (N,) of features, as `Body.surfaces`
) -> tuple[Floats, Floats, Floats]:
    """What features met gain (K,) against clutter, others lose, and coordinates that tell anything.

    Of K poses as if they had not been chosen to fit; three coordinates for a point in space.
    """
    roots, m = np.sqrt(variances[..., None] + found.extra), found.dimensions[:, None]
    gained = gained_by(found, roots, detection, spreads)
    # what a cloud misses, it misses in all of its images at once
    images = found.images[found.owner]
    missed = (found.weights - found.shares) * (detection.log_missed / images[:, None])
    if surfaces is not None and surfaces.max() > 0:
        missed *= _each_of_hidden(found, surfaces)
    # what a sensor that is covered, blurred or out of step meets, it meets by chance
    is_blind = (gained + missed).sum(axis=-1) < detection.log_blind / images
    shares = found.shares
    if np.count_nonzero(is_blind):
        even = found.weights / np.maximum(found.expected, 1.0)[..., None]
        missed = np.where(
            is_blind[..., None], even * (detection.log_blind / images)[:, None], missed
        )
        gained, shares = (one * ~is_blind[..., None] for one in (gained, shares))
    # a detection that chance puts as near is not the feature's
    near = (gained > 0) & (m == 2)
    (gained, missed), coordinates = np.array([gained, missed]).sum(axis=-2), m[:, 0] @ shares
    # a feature that no sensor sees is covered, as if two had missed it: not one by one
    most = 2 * detection.log_missed * found.weights.max(axis=-2)
    missed = np.where(shares.any(axis=-2), missed, np.maximum(missed, most))
    are_several = near.sum(axis=-2) > 1
    if detection.in_space and np.count_nonzero(are_several):
        others = found.others[..., None] * roots**3
        space, share = _in_space(found, roots, others, near, sizes, spreads)
        likelier = are_several & (space < gained + missed)
        gained, missed = np.where(likelier, space, gained), np.where(likelier, 0.0, missed)
        coordinates = np.where(likelier, np.minimum(coordinates, 3 * share), coordinates)
    unseen = found.unseen.sum(axis=-1) * detection.log_unseen
    gained, missed, coordinates = np.array([gained, missed, coordinates]).sum(axis=-1)
    return gained, missed + unseen, coordinates


def gained_by(
    found: Matches, roots: Floats, detection: DetectionModel, spreads: Floats | None = None
) -> Floats:
    """What each feature (..., L, N) gains against clutter in each sensor by itself, in nats."""
    m = found.dimensions[:, None]
    crowd = found.crowd[..., None] * roots**m
    rarity = np.log(detection.probability / np.maximum(crowd * (2 * np.pi) ** (m / 2), 1e-300))
    return np.asarray(found.shares * np.maximum(rarity - _costs(found, roots, spreads), 0.0))


def _each_of_hidden(found: Matches, surfaces: Indices) -> Floats:
    """How much each feature (K, L, N) counts of what is missed.

    A surface of which a sensor meets nothing, while it meets others, is hidden as one feature is.
    """
    counts, met = np.ones(found.shares.shape), found.shares > 0
    meets = met.any(axis=-1)
    for number in range(int(surfaces.max()) + 1):
        own = (surfaces == number)[..., None, :]
        several = np.maximum((found.weights * own).sum(axis=-1), 1.0)
        hidden = meets & ~(met & own).any(axis=-1)
        counts = np.where(own & hidden[..., None], 1 / several[..., None], counts)
    return counts


def _costs(found: Matches, roots: Floats, spreads: Floats | None) -> Floats:
    """What offsets (K, L, N) cost: − ln N(offset; 0, s² + J Σ Jᵀ), beside 2 π s²."""
    if spreads is None:
        return np.asarray(found.squared / (2 * roots**2))
    r = (found.offsets / roots[..., None])[..., None]
    by_world = found.J[..., :3] / roots[..., None, None]
    S = np.eye(2) + by_world @ spreads[..., None, :, :, :] @ by_world.swapaxes(-2, -1)
    away = (r * np.linalg.solve(S, r)).sum(axis=(-2, -1))
    return np.asarray(0.5 * (away + np.linalg.slogdet(S)[1]))


def _in_space(
    found: Matches, roots: Floats, crowd: Floats, near: Mask, sizes: Floats, spreads: Floats | None
) -> tuple[Floats, Floats]:
    """What features met by several cameras say if clutter are points in space (K, N), and shares.

    A clutter point lies where the cameras see it; only that it lies at the feature tells.
    """
    *K, L, N = near.shape
    J, r = found.J[..., :3] / roots[..., None, None], found.offsets / roots[..., None]
    roots_of_parts = np.sqrt(found.each_part)[:, None]
    r, weighed = r * roots_of_parts[..., None], near * roots_of_parts
    rows = (J * weighed[..., None, None]).swapaxes(-4, -3).reshape(*K, N, 2 * L, 3).swapaxes(-2, -1)
    A = rows @ rows.swapaxes(-2, -1)
    A.reshape(*K, N, 9)[..., ::4] += 1 / sizes[..., None, None] ** 2
    pull = rows @ r.swapaxes(-3, -2).reshape(*K, N, 2 * L, 1)
    share = (near * found.shares).max(axis=-2)
    # as dense as the camera shows that has the least about the body
    a, b = J[..., 0, :], J[..., 1, :]
    areas = np.vecdot(a, a) * np.vecdot(b, b) - np.vecdot(a, b) ** 2
    squared = (crowd**2 * areas**1.5).min(axis=-2, initial=1e300, where=near)
    if spreads is not None:  # as far as it is known, and as far as the feature may be off
        place = np.linalg.solve(A, pull)
        A = np.asarray(np.linalg.solve(np.eye(3) + A @ spreads, A))
        pull = A @ place
    # det(A + p pᵀ) is det(A) (1 + pᵀA⁻¹p)
    tight, both = np.linalg.slogdet(np.array([A, A + pull @ pull.swapaxes(-2, -1)]))[1]
    rarity = -np.log(np.maximum(squared, 1e-300)) - 3 * math.log(2 * math.pi)
    return share * np.maximum(0.5 * (rarity + tight - np.expm1(both - tight)), 0.0), share


def paid_by_count(odds: tuple[Floats, Floats, Floats], found: Matches, free: Mask) -> Floats:
    """Evidence (K,) of poses that pay by count: by the ways to fix them by what was observed."""
    gained, missed, coordinates = odds
    expected, count = found.expected, np.count_nonzero(free)
    pins = -(-count // max(found.dimensions.tolist()))
    observed, features = np.vecdot(found.count, expected > 0), expected.max(axis=-1)
    # ways to choose detections, and to assign them to features
    some = np.maximum([observed, features], pins)
    chosen, assigned = gammaln(some + 1) - gammaln(some - pins + 1)
    spare = np.maximum(1.0 - count / np.maximum(coordinates, 1.0), 0.0)
    return np.asarray(
        gained * spare + missed - chosen - assigned + (math.lgamma(pins + 1) - math.log(2))
    )
