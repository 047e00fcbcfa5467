"""How sure it is that the body is there at all.

Either the body is there at this pose, or everything seen is clutter.  The log of the odds is a sum
over the features in view.  Clutter is either false in one sensor alone, and then

    met:      ln P_D + ln N(offset; 0, s²) − ln ρ,       missed:   ln (1 − P_D),

with the probability of detection P_D and the density ρ of observed features; or it is a point in
space, a screw or another body's marker, which several cameras see where they see it.  However many
they are, that is one coincidence.  With the information A about the point's place, and d its
distance from the feature in standard deviations,

    met together:   − d²/2 + ½ ln det(A / 2π) − ln ρ₃,

and cameras that miss the feature miss such a point as well.  The density ρ₃ of points in space is
that of the camera with the fewest detections, over a depth of the body's size.  The explanation
that makes clutter likelier counts, feature by feature.  A feature that no sensor meets is covered,
and counts as missed twice at most.

A pose is chosen to fit, and pays for that freedom in one of two ways; the cheaper counts.

* By volume: the odds are integrated over the pose by Laplace's method, + ½ ln det(2π Cov)
  + ln p(pose).  The prior p is flat over everything that can be seen, or Student's distribution
  around what a track predicts.
* By count: a pose is fixed by as many features as it has coordinates (three in a camera).  These
  fit whatever they are, so they earn nothing, and the logarithm of the number of ways to choose
  them among what was observed is taken off.

The more clutter there is, the more features must agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement.stacked import Stacked

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class DetectionModel:
    """How likely features are seen, and where a body may be."""

    probability: float = constant(
        0.75, "P_D that a feature in view is detected: one or two of eight are hidden as a rule"
    )
    log_unseen: float = constant(
        -1.2, "for each feature that faces a sensor out of its view: ln 0.3, bodies are in view"
    )
    log_blind: float = constant(
        -5.0, "at least, for all features that one sensor misses: in 1 of 150 it sees none"
    )
    by_count: bool = constant(
        True,
        "whether a pose may pay for its freedom by the features that fix it: cheaper than by "
        "volume where priors are wide",
    )
    in_space: bool = constant(
        True, "whether clutter may be a point in space that all cameras see: then it counts once"
    )
    room: float = constant(
        10.0, "radii of the body: how far a position may be where nothing is known before"
    )

    @property
    def log_missed(self) -> float:
        """Of a feature in view without a detection."""
        return math.log(1 - self.probability)

    @property
    def log_covered(self) -> float:
        """Of a feature in view of several sensors without any: as if two had missed it."""
        return 2 * self.log_missed


@dataclass(frozen=True)
class Prior:
    """What is known of a pose before its frame.

    Attributes
    ----------
    log_density : float
        Logarithm of the probability density of the pose, per length and radian of each free
        direction.
    spread : (6,) float64
        How uncertain each direction is; matters where the data leave one open.
    """

    log_density: float
    spread: Floats


@dataclass(frozen=True)
class SensorMatches:
    """What one sensor has at the N features of a body at H poses.

    Attributes
    ----------
    weights : (H, N) float64
        Of the features in view; 0 of the others.
    shares : (H, N) float64
        How far each was met, 0 to its weight.
    offsets : (H, N, m) float64
        Observed minus predicted places, in σ_ε or units of the noise; 0 where not met.
    by_world : (H, N, m, 3) float64
        How predicted places change as the feature moves in the world, likewise, per length.
    crowd : (H,) float64
        Observed features per m-th power of that.
    count : (H,) float64
        Number of observed features.
    """

    weights: Floats
    shares: Floats
    offsets: Floats
    by_world: Floats
    crowd: Floats
    count: Floats

    def in_units_of(self, roots: Floats) -> SensorMatches:
        """The same with noise of (H,) standard deviations in the place of σ_ε."""
        r = roots[:, None, None]
        crowd = self.crowd * roots ** self.offsets.shape[2]
        return replace(
            self, offsets=self.offsets / r, by_world=self.by_world / r[..., None], crowd=crowd
        )


class Odds(NamedTuple):
    """Evidence of H poses before they pay for having been chosen, each (H,).

    Attributes
    ----------
    gained : (H,) float64
        Of the features that are met.
    missed : (H,) float64
        Of those that are not; negative.
    coordinates : (H,) float64
        Number of coordinates that tell anything: three for a point in space.
    """

    gained: Floats
    missed: Floats
    coordinates: Floats


def flat_prior(body: Body, free: NDArray[np.bool_], detection: DetectionModel) -> Prior:
    """Nothing is known: anywhere within ten radii of the body, turned in any way."""
    room = detection.room * body.radius
    turns = int(free[3:].sum())
    rotations = 8 * np.pi**2 if turns == 3 else (2 * np.pi) ** turns
    volume = room ** int(free[:3].sum()) * rotations / len(body.symmetries)
    return Prior(-float(np.log(volume)), np.repeat([room, np.pi], 3))


def log_evidence(
    found: Stacked,
    variances: Floats,
    free: NDArray[np.bool_],
    priors: Sequence[Prior],
    sizes: Floats,
    detection: DetectionModel,
    information: Floats,
    spreads: Floats | None = None,
) -> Floats:
    """Logarithm of the odds (K,) for bodies at K poses against mere clutter.

    Parameters
    ----------
    found : Stacked
        Of all sensors that saw something.
    variances : (K, L) array
        Of the noise of each, in σ_ε².
    free : (6,) bool
    priors : sequence of Prior
    sizes : (K,) array
        Of the bodies, length units.
    detection : DetectionModel
    information : (K, 6, 6) array
    spreads : (K, N, 3, 3) array or None
        Covariances of features in the world, of bodies that give way.
    """
    matches = _matches_of(found, variances)
    odds = odds_of(matches, sizes, detection, spreads)
    unseen = found.gathered("unseen").sum(axis=1) * detection.log_unseen
    odds = odds._replace(missed=odds.missed + unseen)
    # a direction that the data leave open is as uncertain as before
    wide = np.array([prior.spread for prior in priors])[:, free]
    inner = information[:, free][..., free] + np.eye(wide.shape[1]) / wide[:, None] ** 2
    laplace = 0.5 * (wide.shape[1] * math.log(2 * math.pi) - _log_det(inner))
    log_densities = np.array([prior.log_density for prior in priors])
    evidence = odds.gained + odds.missed + laplace + log_densities
    if detection.by_count:
        evidence = np.maximum(evidence, paid_by_count(odds, matches, free))
    return np.where(found.shares.any(axis=(1, 2)), evidence, -np.inf)


def odds_of(
    matches: Sequence[SensorMatches],
    sizes: Floats,
    detection: DetectionModel,
    spreads: Floats | None = None,
) -> Odds:
    """Odds of H poses against clutter, as if they had not been chosen to fit.

    Parameters
    ----------
    matches : sequence of SensorMatches
        One per sensor, in units of its noise.
    sizes : (H,) array
        Of the body, length units.
    detection : DetectionModel
    spreads : (H, N, 3, 3) array or None
        Covariances of features in the world, of a body that gives way; None: it does not.
    """
    shape = matches[0].weights.shape
    gained, missed, coordinates = np.zeros((3, *shape))
    near: list[NDArray[np.bool_]] = []
    is_met = np.zeros(shape, dtype=np.bool_)
    for one in matches:
        m = one.offsets.shape[2]
        density = one.crowd * (2 * np.pi) ** (m / 2)
        rarity = np.log(detection.probability / np.maximum(density, 1e-300))
        gain = one.shares * np.maximum(rarity[:, None] - _costs(one, spreads), 0.0)
        miss, shares = (one.weights - one.shares) * detection.log_missed, one.shares
        # what a sensor that is covered, blurred or out of step meets, it meets by chance
        is_blind = (gain + miss).sum(axis=1, keepdims=True) < detection.log_blind
        if is_blind.any():
            even = one.weights / np.maximum(one.weights.sum(axis=1, keepdims=True), 1.0)
            miss = np.where(is_blind, even * detection.log_blind, miss)
            gain, shares = np.where(is_blind, 0.0, gain), np.where(is_blind, 0.0, shares)
        gained += gain
        missed += miss
        coordinates += m * shares
        is_met |= shares > 0
        # a detection that chance puts as near is not the feature's
        near.append((gain > 0) & (m == 2))
    # a feature that no sensor sees is covered: cameras do not miss it one by one
    covered = ~is_met
    most = detection.log_covered * np.max([one.weights for one in matches], axis=0)
    missed[covered] = np.maximum(missed, most)[covered]
    together = np.nonzero(np.sum(near, axis=0) > 1)
    if detection.in_space and len(together[0]):
        given = None if spreads is None else spreads[together]
        space, share = _in_space(matches, near, together, sizes[together[0]], given)
        likelier = space < (gained + missed)[together]
        pose, feature = (index[likelier] for index in together)
        gained[pose, feature], missed[pose, feature] = space[likelier], 0.0
        most = 3 * share[likelier]
        coordinates[pose, feature] = np.minimum(coordinates[pose, feature], most)
    return Odds(gained.sum(axis=1), missed.sum(axis=1), coordinates.sum(axis=1))


def _costs(one: SensorMatches, spreads: Floats | None) -> Floats:
    """What offsets (H, N) cost in a sensor: − ln N(offset; 0, s² + J Σ Jᵀ), beside 2 π s²."""
    if spreads is None:
        return np.asarray((one.offsets**2).sum(axis=2) / 2)
    m = one.offsets.shape[2]
    S = np.eye(m) + one.by_world @ spreads @ one.by_world.swapaxes(2, 3)
    r = one.offsets[..., None]
    away = (r * np.linalg.solve(S, r)).sum(axis=(2, 3))
    return np.asarray(0.5 * (away + np.linalg.slogdet(S)[1]))


def _in_space(
    matches: Sequence[SensorMatches],
    near: Sequence[NDArray[np.bool_]],
    chosen: tuple[NDArray[np.intp], ...],
    sizes: Floats,
    spreads: Floats | None,
) -> tuple[Floats, Floats]:
    """What features met by several cameras say if clutter are points in space (K,), and shares.

    A clutter point lies where the cameras see it; only that it lies at the feature tells.
    """
    A = np.eye(3) / sizes[:, None, None] ** 2
    b, share = np.zeros((len(A), 3)), np.zeros(len(A))
    log_rarity = np.full(len(A), -np.inf)
    for one, is_near in zip(matches, near, strict=True):
        if one.offsets.shape[2] != 2:
            continue
        J, r, met = one.by_world[chosen], one.offsets[chosen], is_near[chosen]
        weighted = J * met[:, None, None]
        A += weighted.swapaxes(1, 2) @ J
        b += (weighted.swapaxes(1, 2) @ r[..., None])[..., 0]
        share = np.maximum(share, met * one.shares[chosen])
        # detections per area, of which each has a depth
        across = 0.5 * np.log(np.maximum(np.linalg.det(J @ J.swapaxes(1, 2)), 1e-300))
        rarity = -np.log(np.maximum(one.crowd[chosen[0]], 1e-300)) - across + np.log(sizes)
        log_rarity = np.maximum(log_rarity, np.where(met, rarity, -np.inf))
    place = np.linalg.solve(A, b[..., None])
    if spreads is not None:  # as far as it is known, and as far as the feature may be off
        A = np.asarray(np.linalg.solve(np.eye(3) + A @ spreads, A))
    away = (place * (A @ place)).sum(axis=(1, 2))
    tight = 0.5 * np.linalg.slogdet(A / (2 * np.pi))[1]
    return share * np.maximum(log_rarity + tight - 0.5 * away, 0.0), share


def paid_by_count(odds: Odds, matches: Sequence[SensorMatches], free: NDArray[np.bool_]) -> Floats:
    """Evidence (H,) of poses that pay for their freedom by the features that fix them."""
    spare = 1.0 - int(free.sum()) / np.maximum(odds.coordinates, 1.0)
    return np.asarray(
        odds.gained * np.maximum(spare, 0.0) + odds.missed - _log_choices(matches, free)
    )


def _log_choices(matches: Sequence[SensorMatches], free: NDArray[np.bool_]) -> Floats:
    """Logarithm (H,) of the number of ways to fix a pose by observed features."""
    expected = np.array([one.weights.sum(axis=1) for one in matches])
    counts = np.array([one.count for one in matches])
    pins = -(-int(free.sum()) // max(one.offsets.shape[2] for one in matches))
    observed = np.maximum((counts * (expected > 0)).sum(axis=0), pins)
    features = np.maximum(expected.max(axis=0), pins)
    ways = gammaln(observed + 1) - gammaln(observed - pins + 1) - math.lgamma(pins + 1)
    assigned = gammaln(features + 1) - gammaln(features - pins + 1)
    return np.asarray(ways + assigned + math.log(2))


def _matches_of(found: Stacked, variances: Floats) -> list[SensorMatches]:
    """Associations of K poses, whose noise stands in the place of σ_ε: their variance is 1."""
    roots = np.sqrt(variances)
    offsets = found.offsets / roots[..., None, None]
    by_world = found.J[..., :3] / roots[..., None, None, None]
    crowds, sigmas, counts = (found.gathered(name) for name in ("crowd", "sigma", "count"))
    crowds = crowds * (roots * sigmas) ** found.dimensions
    return [
        SensorMatches(
            found.weights[:, i],
            found.shares[:, i],
            offsets[:, i, :, :m],
            by_world[:, i, :, :m],
            crowds[:, i],
            counts[:, i],
        )
        for i, m in enumerate(found.dimensions.tolist())
    ]


def _log_det(A: Floats) -> Floats:
    """Logarithms of the determinants of positive definite matrices, however ill conditioned."""
    scale = np.sqrt(A.diagonal(axis1=1, axis2=2))
    values = np.linalg.eigvalsh(A / scale[:, :, None] / scale[:, None])
    logs = np.log(np.maximum(values, 1e-12)).sum(axis=1) + 2 * np.log(scale).sum(axis=1)
    return np.asarray(logs)
