"""How sure it is that the body is there at all, and not mere clutter.

The log of the odds is a sum over the features in view.  With the probability of detection P_D, the
noise s and the density ρ of observed features in a sensor, or ρ₃ of points in space that cameras
see together, at a distance of d standard deviations by their information A,

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

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.matching import Matches
from mixpose.records import Floats, Mask


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
        True, "whether features that fix a pose may pay for its freedom: cheaper by wide priors"
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


@dataclass(frozen=True)
class Prior:
    """What is known of a pose before its frame."""

    log_density: float  # of its probability, per length and radian of each free direction
    spread: Floats  # (6,) how uncertain it is; matters where the data leave a direction open


def flat_prior(body: Body, free: Mask, detection: DetectionModel) -> Prior:
    """Nothing is known: anywhere within some radii of the body, turned in any way."""
    room = detection.room * body.radius
    turns = int(free[3:].sum())
    rotations = 8 * np.pi**2 if turns == 3 else (2 * np.pi) ** turns
    volume = room ** int(free[:3].sum()) * rotations / len(body.symmetries)
    return Prior(-float(np.log(volume)), np.repeat([room, np.pi], 3))


def log_evidence(
    found: Matches,
    variances: Floats,
    free: Mask,
    priors: Sequence[Prior],
    sizes: Floats,
    detection: DetectionModel,
    information: Floats,
    spreads: Floats | None = None,
) -> Floats:
    """Logarithm of the odds (K,) for bodies at K poses of an information (K, 6, 6) against clutter.

    All else as `odds_of` has it.
    """
    odds = odds_of(found, variances, sizes, detection, spreads)
    # a direction that the data leave open is as uncertain as before
    wide = np.array([prior.spread for prior in priors])[:, free]
    inner = information[:, free][..., free] + np.eye(wide.shape[1]) / wide[:, None] ** 2
    laplace = -0.5 * np.linalg.slogdet(inner / (2 * np.pi))[1]
    log_densities = np.array([prior.log_density for prior in priors])
    evidence = odds[0] + odds[1] + laplace + log_densities
    if detection.by_count:
        evidence = np.maximum(evidence, paid_by_count(odds, found, free))
    return np.where(found.shares.any(axis=(1, 2)), evidence, -np.inf)


def odds_of(
    found: Matches,
    variances: Floats,  # (K, L) of the noise of each sensor, in σ_ε²
    sizes: Floats,  # (K,) of the body, length units
    detection: DetectionModel,
    spreads: Floats | None = None,  # (K, N, 3, 3) of features in the world, where a body gives way
) -> tuple[Floats, Floats, Floats]:
    """What features met gain (K,) against clutter, others lose, and coordinates that tell anything.

    Of K poses as if they had not been chosen to fit; three coordinates for a point in space.
    """
    roots, m = np.sqrt(variances), found.dimensions
    crowd = found.crowd * roots**m
    rarity = np.log(detection.probability / np.maximum(crowd * (2 * np.pi) ** (m / 2), 1e-300))
    gained = found.shares * np.maximum(rarity[..., None] - _costs(found, roots, spreads), 0.0)
    missed = (found.weights - found.shares) * detection.log_missed
    # what a sensor that is covered, blurred or out of step meets, it meets by chance
    is_blind = (gained + missed).sum(axis=2, keepdims=True) < detection.log_blind
    even = found.weights / np.maximum(found.expected, 1.0)[..., None]
    missed = np.where(is_blind, even * detection.log_blind, missed)
    gained, shares = np.where(is_blind, 0.0, gained), np.where(is_blind, 0.0, found.shares)
    missed = missed.sum(axis=1)
    # a detection that chance puts as near is not the feature's
    near = (gained > 0) & (m == 2)[:, None]
    gained, coordinates = gained.sum(axis=1), (m[:, None] * shares).sum(axis=1)
    # a feature that no sensor sees is covered, as if two had missed it: not one by one
    most = 2 * detection.log_missed * found.weights.max(axis=1)
    missed = np.where((shares > 0).any(axis=1), missed, np.maximum(missed, most))
    together = np.nonzero(near.sum(axis=1) > 1)
    if detection.in_space and len(together[0]):
        space, share = _in_space(found, roots, crowd, near, together, sizes, spreads)
        likelier = space < (gained + missed)[together]
        pose, feature = (index[likelier] for index in together)
        gained[pose, feature], missed[pose, feature] = space[likelier], 0.0
        most = 3 * share[likelier]
        coordinates[pose, feature] = np.minimum(coordinates[pose, feature], most)
    unseen = found.unseen.sum(axis=1) * detection.log_unseen
    return gained.sum(axis=1), missed.sum(axis=1) + unseen, coordinates.sum(axis=1)


def _costs(found: Matches, roots: Floats, spreads: Floats | None) -> Floats:
    """What offsets (K, L, N) cost: − ln N(offset; 0, s² + J Σ Jᵀ), beside 2 π s²."""
    if spreads is None:
        return np.asarray(found.squared / (2 * roots**2)[..., None])
    r = (found.offsets / roots[..., None, None])[..., None]
    by_world = found.J[..., :3] / roots[..., None, None, None]
    S = np.eye(2) + by_world @ spreads[:, None] @ by_world.swapaxes(3, 4)
    away = (r * np.linalg.solve(S, r)).sum(axis=(3, 4))
    return np.asarray(0.5 * (away + np.linalg.slogdet(S)[1]))


def _in_space(
    found: Matches,
    roots: Floats,
    crowd: Floats,
    near: Mask,
    chosen: tuple[NDArray[np.intp], ...],
    sizes: Floats,
    spreads: Floats | None,
) -> tuple[Floats, Floats]:
    """What features met by several cameras say if clutter are points in space (C,), and shares.

    A clutter point lies where the cameras see it; only that it lies at the feature tells.
    """
    pose, feature = chosen
    at, sizes, roots = (pose, slice(None), feature), sizes[pose], roots[pose][..., None]
    met, J, r = near[at], found.J[at][..., :3] / roots[..., None], found.offsets[at] / roots
    rows = (J * met[..., None, None]).reshape(len(pose), -1, 3).swapaxes(1, 2)
    A = np.eye(3) / sizes[:, None, None] ** 2 + rows @ rows.swapaxes(1, 2)
    pull = rows @ r.reshape(len(pose), -1, 1)
    place = np.linalg.solve(A, pull)
    share = (met * found.shares[at]).max(axis=1)
    # detections per area, of which each has a depth
    (aa, ab), (_, bb) = (J @ J.swapaxes(2, 3)).transpose(2, 3, 0, 1)
    across = 0.5 * np.log(np.maximum(aa * bb - ab * ab, 1e-300))
    rarity = np.log(sizes)[:, None] - np.log(np.maximum(crowd[pose], 1e-300)) - across
    if spreads is not None:  # as far as it is known, and as far as the feature may be off
        A = np.asarray(np.linalg.solve(np.eye(3) + A @ spreads[chosen], A))
        pull = A @ place
    away = (place * pull).sum(axis=(1, 2))
    tight = 0.5 * np.linalg.slogdet(A / (2 * np.pi))[1]
    log_rarity = np.where(met, rarity, -np.inf).max(axis=1)
    return share * np.maximum(log_rarity + tight - 0.5 * away, 0.0), share


def paid_by_count(odds: tuple[Floats, Floats, Floats], found: Matches, free: Mask) -> Floats:
    """Evidence (K,) of poses that pay by count: by the ways to fix them by what was observed."""
    gained, missed, coordinates = odds
    expected, count = found.weights.sum(axis=2), int(free.sum())
    pins = -(-count // int(found.dimensions.max()))
    observed = np.maximum((found.count * (expected > 0)).sum(axis=1), pins)
    features = np.maximum(expected.max(axis=1), pins)
    ways = gammaln(observed + 1) - gammaln(observed - pins + 1) - math.lgamma(pins + 1)
    assigned = gammaln(features + 1) - gammaln(features - pins + 1)
    spare = np.maximum(1.0 - count / np.maximum(coordinates, 1.0), 0.0)
    return np.asarray(gained * spare + missed - (ways + assigned + math.log(2)))
