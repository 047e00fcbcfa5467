"""How sure it is that the body is there: the odds of a pose against clutter.

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
"""What is known of a pose before its frame: log of its density, per length and radian of each free
direction, and how uncertain it is (6,), which matters where the data leave a direction open."""


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
    gained = _gained_by(found, roots, detection, spreads)
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


def _gained_by(
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
