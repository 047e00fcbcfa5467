"""Evidence of a pose: the log odds that the body is there against the frame being mere clutter.

The log odds are a sum over the features in view.  With the probability of
detection P_D, the noise s and the density ρ of observed features in a sensor, or ρ₃ of points in
space that cameras see together, d standard deviations away by their information A,

    met:  ln P_D + ln N(offset; 0, s²) − ln ρ,    missed:  ln (1 − P_D),
    met together:  − d²/2 + ½ ln det(A / 2π) − ln ρ₃;

feature by feature the kind of clutter counts that is likelier.  A pose was chosen to fit.  It pays
by volume, + ½ ln det(2π Cov) + ln p(pose), or by count: the features that fix it gain nothing, and
the number of ways to choose them is a factor of the odds.  See *Evidence* in `docs/method.md`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from scipy.special import gammaln

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement.information import log_determinants
from mixpose.matching import Matches
from mixpose.records import Floats, Indices, Mask

Prior: TypeAlias = tuple[float, Floats]
"""The log density of a pose before its frame, per length and radian of each free direction, and its
standard deviations (6,), which count in directions that the data leave open."""


@dataclass(frozen=True)
class DetectionModel:
    """Probabilities that features are detected, and the room in which a body may be."""

    probability: float = constant(0.75, "P_D of a feature in view: one or two of eight are hidden")
    log_unseen: float = constant(-1.2, "per feature that faces a sensor out of its view: ln 0.3")
    log_blind: float = constant(
        -5.0, "at least, for a sensor that misses all: 1 in 150 does, or shows something new"
    )
    by_count: bool = constant(True, "whether features that fix a pose may pay for its freedom")
    in_space: bool = constant(True, "whether clutter may be a point in space, and counts once")
    room: float = constant(10.0, "radii of the body: how far it may be where nothing is known")

    @property
    def log_missed(self) -> float:
        """Log odds of a feature in view without a detection: ln (1 − P_D)."""
        return math.log(1 - self.probability)


def flat_prior(body: Body, free: Mask, detection: DetectionModel) -> Prior:
    """Return the prior of an unknown pose: within some radii of the body, turned in any way."""
    return _flat_prior(body, tuple(free.tolist()), detection.room * body.radius)


@lru_cache(maxsize=64)
def _flat_prior(body: Body, free: tuple[bool, ...], room: float) -> Prior:
    uncertainty = np.array([room] * 3 + [math.pi] * 3)
    uncertainty.flags.writeable = False  # the array is shared by all frames
    shifts, turns = sum(free[:3]), sum(free[3:])
    rotations = 8 * math.pi**2 if turns == 3 else (2 * math.pi) ** turns
    volume = room**shifts * rotations / len(body.symmetries)
    return -math.log(volume), uncertainty


def log_evidence(
    matches: Matches,
    variances: Floats,
    free: Mask,
    priors: Sequence[Prior],
    sizes: Floats,
    detection: DetectionModel,
    information: Floats,  # (K, 6, 6)
    spreads: Floats | None = None,
    surfaces: Indices | None = None,
) -> Floats:
    """Return log odds (2, K) of K poses against clutter; arguments as in `odds_of`.

    The first row pays by volume or by count, whichever is cheaper; the second by volume.
    """
    odds = odds_of(matches, variances, sizes, detection, spreads, surfaces)
    # the prior bounds the variance of directions that the data leave open
    log_densities, uncertainties = (np.array(parts) for parts in zip(*priors, strict=True))
    (chosen,) = free.nonzero()
    inner, before = information[..., chosen[:, None], chosen], 1 / uncertainties[:, chosen] ** 2
    inner = inner + np.eye(len(chosen)) * before[..., None]
    laplace = -0.5 * log_determinants(inner / (2 * np.pi), before / (2 * np.pi))
    by_volume = odds[0] + odds[1] + laplace + log_densities
    evidence = by_volume
    if detection.by_count:
        evidence = np.maximum(by_volume, paid_by_count(odds, matches, free))
    return np.where(matches.met.any(axis=-1), [evidence, by_volume], -np.inf)


def odds_of(
    matches: Matches,
    variances: Floats,  # (K, L) of the noise of each sensor, in σ_ε²
    sizes: Floats,  # (K,) of the body, length units
    detection: DetectionModel,
    spreads: Floats | None = None,  # (K, N, 3, 3) of features in the world, where a body gives way
    surfaces: Indices | None = None,  # (K, N) or (N,) of features, as `Body.surfaces`
) -> tuple[Floats, Floats, Floats]:
    """Return what met features gain (K,), what missed ones lose, and the number of coordinates met.

    K poses count as if they had not been chosen to fit; a point in space has three coordinates.
    """
    roots, m = np.sqrt(variances[..., None] + matches.extra), matches.dimensions[:, None]
    gained = _gained_by(matches, roots, detection, spreads)
    # the images of a cloud miss a feature together, and share its loss
    images = matches.images[matches.owner]
    missed = (matches.weights - matches.shares) * (detection.log_missed / images[:, None])
    if surfaces is not None and surfaces.max() > 0:
        missed *= _weights_of_missed(matches, surfaces)
    # a sensor that is covered, blurred or out of step meets features by chance only
    is_blind = (gained + missed).sum(axis=-1) < detection.log_blind / images
    shares = matches.shares
    if np.count_nonzero(is_blind):
        even = matches.weights / np.maximum(matches.expected, 1.0)[..., None]
        missed = np.where(
            is_blind[..., None], even * (detection.log_blind / images)[:, None], missed
        )
        gained, shares = (values * ~is_blind[..., None] for values in (gained, shares))
    # a detection no nearer than chance puts one is not the feature's
    near = (gained > 0) & (m == 2)
    (gained, missed), coordinates = np.array([gained, missed]).sum(axis=-2), m[:, 0] @ shares
    # sensors do not miss a covered feature independently: two of them count at most
    floor = 2 * detection.log_missed * matches.weights.max(axis=-2)
    missed = np.where(shares.any(axis=-2), missed, np.maximum(missed, floor))
    are_several = near.sum(axis=-2) > 1
    if detection.in_space and np.count_nonzero(are_several):
        space, share = _in_space(matches, roots, near, sizes, spreads)
        likelier = are_several & (space < gained + missed)
        gained, missed = np.where(likelier, space, gained), np.where(likelier, 0.0, missed)
        coordinates = np.where(likelier, np.minimum(coordinates, 3 * share), coordinates)
    unseen = matches.unseen.sum(axis=-1) * detection.log_unseen
    gained, missed, coordinates = np.array([gained, missed, coordinates]).sum(axis=-1)
    return gained, missed + unseen, coordinates


def _gained_by(
    matches: Matches, roots: Floats, detection: DetectionModel, spreads: Floats | None = None
) -> Floats:
    """Return what each feature gains (..., L, N) against clutter in a single sensor, in nats."""
    m = matches.dimensions[:, None]
    crowd = matches.crowd[..., None] * roots**m
    rarity = np.log(detection.probability / np.maximum(crowd * (2 * np.pi) ** (m / 2), 1e-300))
    return np.asarray(matches.shares * np.maximum(rarity - _costs(matches, roots, spreads), 0.0))


def _weights_of_missed(matches: Matches, surfaces: Indices) -> Floats:
    """Return the weight of each feature (K, L, N) if missed: 1, or 1 / n on a hidden surface.

    A sensor that meets other features but none of the n on a surface misses them as one feature.
    """
    weights, met = np.ones(matches.shares.shape), matches.shares > 0
    meets = met.any(axis=-1)
    for number in range(int(surfaces.max()) + 1):
        on_surface = (surfaces == number)[..., None, :]
        in_view = np.maximum((matches.weights * on_surface).sum(axis=-1), 1.0)
        is_hidden = meets & ~(met & on_surface).any(axis=-1)
        weights = np.where(on_surface & is_hidden[..., None], 1 / in_view[..., None], weights)
    return weights


def _costs(matches: Matches, roots: Floats, spreads: Floats | None) -> Floats:
    """Return the cost of offsets (K, L, N): − ln N(offset; 0, s² + J Σ Jᵀ) without ln 2 π s²."""
    if spreads is None:
        return np.asarray(matches.squared / (2 * roots**2))
    r = (matches.offsets / roots[..., None])[..., None]
    by_world = matches.J[..., :3] / roots[..., None, None]
    S = np.eye(2) + by_world @ spreads[..., None, :, :, :] @ by_world.swapaxes(-2, -1)
    away = (r * np.linalg.solve(S, r)).sum(axis=(-2, -1))
    return np.asarray(0.5 * (away + np.linalg.slogdet(S)[1]))


def _in_space(
    matches: Matches, roots: Floats, near: Mask, sizes: Floats, spreads: Floats | None
) -> tuple[Floats, Floats]:
    """Return gains (K, N) of features met by several cameras against clutter points in space.

    Cameras agree about a clutter point, too, so that only its place counts.  Also shares (K, N).
    """
    *K, L, N = near.shape
    J, r = matches.J[..., :3] / roots[..., None, None], matches.offsets / roots[..., None]
    roots_of_parts = np.sqrt(matches.coordinate_weight)[:, None]
    r, weighed = r * roots_of_parts[..., None], near * roots_of_parts
    rows = (J * weighed[..., None, None]).swapaxes(-4, -3).reshape(*K, N, 2 * L, 3).swapaxes(-2, -1)
    A = rows @ rows.swapaxes(-2, -1)
    A.reshape(*K, N, 9)[..., ::4] += 1 / sizes[..., None, None] ** 2
    pull = rows @ r.swapaxes(-3, -2).reshape(*K, N, 2 * L, 1)
    shares = (near * matches.shares).max(axis=-2)
    # clutter is as dense in space as the camera with the least of it shows
    by_u, by_v = J[..., 0, :], J[..., 1, :]
    crowd = matches.space_crowd[..., None] * roots**3
    areas = np.vecdot(by_u, by_u) * np.vecdot(by_v, by_v) - np.vecdot(by_u, by_v) ** 2
    squared = (crowd**2 * areas**1.5).min(axis=-2, initial=1e300, where=near)
    if spreads is not None:  # the covariance of the place grows by that of the feature
        place = np.linalg.solve(A, pull)
        A = np.asarray(np.linalg.solve(np.eye(3) + A @ spreads, A))
        pull = A @ place
    # det(A + p pᵀ) is det(A) (1 + pᵀA⁻¹p)
    alone, with_pull = np.linalg.slogdet(np.array([A, A + pull @ pull.swapaxes(-2, -1)]))[1]
    rarity = -np.log(np.maximum(squared, 1e-300)) - 3 * math.log(2 * math.pi)
    return shares * np.maximum(0.5 * (rarity + alone - np.expm1(with_pull - alone)), 0.0), shares


def paid_by_count(odds: tuple[Floats, Floats, Floats], matches: Matches, free: Mask) -> Floats:
    """Return the evidence (K,) of poses that pay by count: the number of ways to fix them."""
    gained, missed, coordinates = odds
    expected, count = matches.expected, np.count_nonzero(free)
    pins = -(-count // max(matches.dimensions.tolist()))
    observed, features = np.vecdot(matches.count, expected > 0), expected.max(axis=-1)
    # ways to choose detections, and to assign them to features
    available = np.maximum([observed, features], pins)
    chosen, assigned = gammaln(available + 1) - gammaln(available - pins + 1)
    spare = np.maximum(1.0 - count / np.maximum(coordinates, 1.0), 0.0)
    return np.asarray(
        gained * spare + missed - chosen - assigned + (math.lgamma(pins + 1) - math.log(2))
    )
