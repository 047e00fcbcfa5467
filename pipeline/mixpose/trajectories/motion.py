"""How a body moves between frames: white noise in the highest derivative of its pose.

A state is a pose and its first derivatives, velocity first; a turn has its angular velocity in
world axes and the derivatives of that.  With white noise of the intensity q in the derivative of
order p, over a time τ (Y. Bar-Shalom, *Estimation with Applications to Tracking and Navigation*,
6.2),

    F_ij = τ^(j-i) / (j-i)!,      Q_ij = q τ^(2p-1-i-j) / ((2p-1-i-j) (p-1-i)! (p-1-j)!)

Of a turn, ω(s) = Σ_j ω_j s^j / j!, the rotation over τ is exp(Ω), by W. Magnus' series,

    Ω = ∫ ω ds + ½ ∫ ω(s) × ∫_0^s ω dr ds + O(τ⁵)

Errors of a state are twists as in `mixpose.rigid`, then errors of the derivatives.  All functions
take many states at once, along the leading axes.
"""

from __future__ import annotations

from functools import lru_cache
from math import factorial
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs

from mixpose import rigid
from mixpose.records import Floats, Indices, Mask

ORDERS = {"acceleration": 2, "jerk": 3, "snap": 4, "crackle": 5}
"""What takes white noise, and the order of that derivative."""

# [ω] of x -> ω × x is ω of these, row by row
_ACROSS = np.array(
    [[0.0, 0, 0, 0, 0, -1, 0, 1, 0], [0.0, 0, 1, 0, 0, 0, -1, 0, 0], [0.0, -1, 0, 1, 0, 0, 0, 0, 0]]
)
_JITTER = 1e-13  # of correlations: rounding must not make them indefinite


class States(NamedTuple):
    """States of a body at one time, as G filters that run side by side know them."""

    poses: Floats  # (G, 4, 4)
    # (G, p - 1, 6): derivatives of the pose, lengths and radians per second to the power of 1 on
    rates: Floats
    # (G, 6 p, 6 p): of the pose and of its derivatives, in this order, six numbers of each
    covariances: Floats

    @property
    def order(self) -> int:
        """p, of the derivative that takes white noise."""
        return int(self.rates.shape[1]) + 1

    def minus(self, other: States) -> Floats:
        """The errors (G, 6 p) that lead from other states to these."""
        twists = rigid.twist_between(other.poses, self.poses).reshape(-1, 6)
        rates = (self.rates - other.rates).reshape(len(twists), -1)
        return np.concatenate([twists, rates], axis=1)

    def moved(self, errors: Floats, covariances: Floats) -> States:
        """These states moved by errors (G, 6 p), with other covariances."""
        poses = rigid.perturb(self.poses, errors[:, :6])
        return States(poses, self.rates + errors[:, 6:].reshape(self.rates.shape), covariances)

    def mixed(self, others: States, is_other: Mask) -> States:
        """These states, and others where (G,) says so."""
        which = is_other[:, None, None]
        return States(*(np.where(which, b, a) for a, b in zip(self, others, strict=True)))

    def of(self, which: Indices | list[int]) -> States:
        """Some of the states."""
        return States(*(each[which] for each in self))


def foretold(states: States, elapsed: float, noise: Floats) -> tuple[States, Floats]:
    """The states `elapsed` seconds later, and derivatives (G, 6 p, 6 p) by the states.

    Noise are the intensities q (G, 6), one per coordinate of a pose.
    """
    p = states.order
    powers = np.array([elapsed**j / factorial(j) for j in range(p + 1)])
    turned = _turned(states.rates[..., 3:], elapsed)
    shift = np.einsum("j,gji->gi", powers[1:p], states.rates[..., :3])
    moved = np.concatenate([shift, turned], axis=1)
    rates = np.stack(
        [np.einsum("j,gji->gi", powers[: p - 1 - k], states.rates[:, k:]) for k in range(p - 1)],
        axis=1,
    )
    F = _transition(turned, powers)
    covariances = F @ states.covariances @ F.swapaxes(1, 2) + _process_noise(elapsed, p, noise)
    return States(rigid.perturb(states.poses, moved), rates, covariances), F


def updated(states: States, pose: Floats, covariance: Floats) -> tuple[States, Floats, Floats]:
    """The states with measured poses, (4, 4) or (G, 4, 4), and their covariances.

    Beside them the Mahalanobis distances squared (G,) of the poses from what was foretold, and the
    log-likelihoods (G,) without the constant −3 log 2π.
    """
    rest = rigid.twist_between(states.poses, np.broadcast_to(pose, states.poses.shape))
    rest = rest.reshape(-1, 6)
    P = states.covariances
    S = P[:, :6, :6] + covariance
    gains, whitened, log_determinants = _solved(S, P[:, :6], rest)
    squared = np.einsum("gi,gi->g", whitened, rest)
    errors = np.einsum("gij,gj->gi", gains, rest)
    # Joseph's form: symmetric, and positive whatever rounding does
    left = np.eye(P.shape[1]) - np.concatenate(
        [gains, np.zeros((len(P), P.shape[1], P.shape[1] - 6))], axis=2
    )
    covariances = left @ P @ left.swapaxes(1, 2) + gains @ covariance @ gains.swapaxes(1, 2)
    return states.moved(errors, covariances), squared, -0.5 * (squared + log_determinants)


def _solved(S: Floats, cross: Floats, rest: Floats) -> tuple[Floats, Floats, Floats]:
    """Gains (G, n, 6) Cᵀ S⁻¹, S⁻¹ r (G, 6) and log det S (G,)."""
    scale = 1 / np.sqrt(np.diagonal(S, axis1=1, axis2=2))
    both = np.concatenate([cross, rest[:, :, None]], axis=2) * scale[:, :, None]
    solved = np.linalg.solve(S * scale[:, :, None] * scale[:, None], both) * scale[:, :, None]
    scaled = np.linalg.slogdet(S * scale[:, :, None] * scale[:, None])[1]
    return (
        solved[:, :, :-1].swapaxes(1, 2),
        solved[:, :, -1],
        scaled - 2 * np.log(scale).sum(axis=1),
    )


class Passage(NamedTuple):
    """What all poses say of the time between two of them, of lengths and of turns.

    In the mean the two are equal.
    """

    squared: Floats  # (2,): bᵀQb, how large the noise was, in standard deviations
    degrees: Floats  # (2,): tr NQ, how many numbers of it are known


def smoothed(
    here: States, ahead: States, later: States, F: Floats, elapsed: float, noise: Floats
) -> tuple[States, Passage]:
    """A state with all that is known later (H. E. Rauch, F. Tung and C. T. Striebel, 1965).

    `here` is one state, with all that is known up to it; `ahead` the next one as it was foretold,
    with its derivative F by `here`, and `later` the same with all poses.
    """
    P, foretold_ = here.covariances[0], ahead.covariances[0]
    scale = 1 / np.sqrt(foretold_.diagonal())
    both = scale[:, None] * scale
    factor, _ = dpotrf(foretold_ * both + _JITTER * np.eye(len(scale)))
    inverse = dpotrs(factor, np.eye(len(scale)))[0] * both
    b = inverse @ later.minus(ahead)[0]
    N = inverse @ (foretold_ - later.covariances[0]) @ inverse
    gain = P @ F[0].T
    covariance = P - gain @ N @ gain.T
    Q = _process_noise(elapsed, here.order, noise)[0]
    is_turn = np.arange(len(b)) % 6 >= 3
    # the noise that followed has the mean Q b and the covariance Q - Q N Q
    told = b * (Q @ b), (N * Q).sum(axis=1)
    passage = Passage(*(np.array([n[~is_turn].sum(), n[is_turn].sum()]) for n in told))
    state = here.moved((gain @ b)[None], ((covariance + covariance.T) / 2)[None])
    return state, passage


def _turned(rates: Floats, elapsed: float) -> Floats:
    """Rotation vectors (G, 3) over a time of angular velocities and derivatives (G, p - 1, 3)."""
    angles = sum(
        rates[:, j] * (elapsed ** (j + 1) / factorial(j + 1)) for j in range(rates.shape[1])
    )
    angles = np.asarray(angles)
    if rates.shape[1] > 1:
        changing = rates[:, 1] * (elapsed**3 / 12)
        if rates.shape[1] > 2:
            changing = changing + rates[:, 2] * (elapsed**4 / 24)
        across = (changing @ _ACROSS).reshape(-1, 3, 3)
        angles = angles + (across @ rates[:, 0, :, None])[..., 0]
    return angles


def _transition(turned: Floats, powers: Floats) -> Floats:
    """F (G, 6 p, 6 p); what a turn does to errors of rates is told to first order in it."""
    p = len(powers) - 1
    single = _upper(tuple(powers[:p].tolist()))
    F = np.empty((len(turned), p, 6, p, 6))
    F[...] = np.multiply.outer(single, np.eye(6)).swapaxes(1, 2)
    F[:, 0, 3:, 0, 3:] = rigid.rotation_matrix(turned)
    # [Ω] of x -> Ω × x
    across = (turned @ _ACROSS).reshape(-1, 3, 1, 3)
    by_rate = powers[1:p] / np.arange(2, p + 1)
    F[:, 0, 3:, 1:, 3:] += across * by_rate[:, None]
    return F.reshape(len(turned), 6 * p, 6 * p)


@lru_cache(maxsize=64)
def _upper(powers: tuple[float, ...]) -> Floats:
    """Taylor's coefficients (p, p) of a step."""
    p = len(powers)
    i, j = np.indices((p, p))
    return np.where(j >= i, np.array(powers)[np.maximum(j - i, 0)], 0.0)


def _process_noise(elapsed: float, p: int, noise: Floats) -> Floats:
    """Q (G, 6 p, 6 p)."""
    single = _noise_of_step(elapsed, p)
    Q = np.zeros((len(noise), p, 6, p, 6))
    of_each = range(6)
    Q[:, :, of_each, :, of_each] = single * noise.T[:, :, None, None]
    return Q.reshape(len(noise), 6 * p, 6 * p)


@lru_cache(maxsize=64)
def _noise_of_step(elapsed: float, p: int) -> Floats:
    """Q (p, p) of one coordinate for the intensity 1."""
    i, j = np.indices((p, p))
    ahead = 2 * p - 1 - i - j
    down = np.array([factorial(p - 1 - k) for k in range(p)])
    return np.asarray(elapsed**ahead / (ahead * down[i] * down[j]))
