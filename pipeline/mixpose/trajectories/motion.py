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

# what takes white noise, and the order of that derivative
ORDERS = {"acceleration": 2, "jerk": 3, "snap": 4, "crackle": 5}
# [ω] of x -> ω × x is ω of these, row by row
_ACROSS = np.array(
    [[0.0, 0, 0, 0, 0, -1, 0, 1, 0], [0.0, 0, 1, 0, 0, 0, -1, 0, 0], [0.0, -1, 0, 1, 0, 0, 0, 0, 0]]
)
_EYE = np.eye(3)
_TRACE = _EYE.ravel()
_JITTER = 1e-13  # of correlations: rounding must not make them indefinite


class States(NamedTuple):
    """States of a body at one time, as G filters that run side by side know them."""

    poses: Floats  # (G, 4, 4)
    rates: Floats  # (G, p - 1, 6): derivatives of the pose, lengths and radians per s, s² ...
    covariances: Floats  # (G, 6 p, 6 p): of the pose and of its derivatives, in this order

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
        poses = _perturbed(self.poses, errors[:, :3], _turn(across_by(errors[:, 3:6])))
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
    powers, by_taylor, by_rate = _step(elapsed, p)
    moved = powers[1:p] @ states.rates
    if p > 2:  # Magnus: a turn that changes its axis
        changing = (powers[3:5] * [0.5, 1.0])[: p - 2] @ states.rates[:, 1:3, 3:]
        moved[:, 3:] += (across_by(changing) @ states.rates[:, 0, 3:, None])[..., 0]
    across = across_by(moved[:, 3:])
    turn = _turn(across)
    F = by_taylor[None].repeat(len(turn), axis=0)
    # what a turn does to errors of rates is told to first order in it
    F[:, 0, 3:, 0, 3:] = turn
    F[:, 0, 3:, 1:, 3:] += across[:, :, None] * by_rate[:, None]
    F = F.reshape(states.covariances.shape)
    covariances = F @ states.covariances @ F.swapaxes(1, 2) + _process_noise(elapsed, p, noise)
    rates = by_taylor[: p - 1, 0, : p - 1, 0] @ states.rates
    return States(_perturbed(states.poses, moved[:, :3], turn), rates, covariances), F


def updated(states: States, pose: Floats, covariance: Floats) -> tuple[States, Floats, Floats]:
    """The states with measured poses, (4, 4) or (G, 4, 4), and their covariances.

    Beside them the Mahalanobis distances squared (G,) of the poses from what was foretold, and the
    log-likelihoods (G,) without the constant −3 log 2π.
    """
    rest = _twists(states.poses, pose)
    P = states.covariances
    S = P[:, :6, :6] + covariance
    scale = 1 / np.sqrt(np.diagonal(S, axis1=1, axis2=2))
    both = scale[:, :, None] * scale[:, None]
    scaled = S * both
    inverse = np.linalg.inv(scaled) * both
    gains = P[:, :, :6] @ inverse
    squared = ((inverse @ rest[..., None])[..., 0] * rest).sum(axis=1)
    log_determinants = np.linalg.slogdet(scaled)[1] - 2 * np.log(scale).sum(axis=1)
    # Joseph's form: symmetric, and positive whatever rounding does
    left = P - gains @ P[:, :6]
    covariances = left + (gains @ covariance - left[:, :, :6]) @ gains.swapaxes(1, 2)
    state = states.moved((gains @ rest[..., None])[..., 0], covariances)
    return state, squared, -0.5 * (squared + log_determinants)


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


# For a few poses at a time the functions of `mixpose.rigid` take five times as long.


def across_by(vectors: Floats) -> Floats:
    """[ω] (G, 3, 3) of vectors (G, 3): x -> ω × x."""
    return np.asarray((vectors @ _ACROSS).reshape(-1, 3, 3))


def _turn(across: Floats) -> Floats:
    """Rotations exp [ω] (G, 3, 3), by O. Rodrigues."""
    angle = np.sqrt((across**2).sum(axis=(1, 2), keepdims=True) / 2) + 1e-300
    half = np.sin(angle / 2) / angle
    return np.asarray(_EYE + np.sin(angle) / angle * across + 2 * half**2 * across @ across)


def _perturbed(poses: Floats, shift: Floats, turn: Floats) -> Floats:
    """Poses (G, 4, 4) after shifts (G, 3) and turns (G, 3, 3) in world axes."""
    moved = poses.copy()
    moved[:, :3, :3] = turn @ poses[:, :3, :3]
    moved[:, :3, 3] += shift
    return moved


def _twists(T_from: Floats, T_to: Floats) -> Floats:
    """Twists (G, 6) from poses (G, 4, 4) to others, or to one (4, 4)."""
    R = T_to[..., :3, :3] @ T_from[:, :3, :3].swapaxes(1, 2)
    flat = R.reshape(-1, 9)
    cosine = flat @ _TRACE - 1  # twice that of the angle, as the axis is of its sine
    if (cosine <= 0).any():
        return rigid.twist_between(T_from, np.broadcast_to(T_to, T_from.shape)).reshape(-1, 6)
    axis = flat @ _ACROSS.T
    length = np.sqrt((axis**2).sum(axis=1)) + 1e-300
    turn = axis * (np.arctan2(length, cosine) / length)[:, None]
    return np.concatenate([T_to[..., :3, 3] - T_from[:, :3, 3], turn], axis=1)


@lru_cache(maxsize=64)
def _step(elapsed: float, p: int) -> tuple[Floats, Floats, Floats]:
    """Powers τ^j / j! (p + 1,), Taylor's F (p, 6, p, 6), and what a turn does by each rate."""
    powers = np.array([elapsed**j / factorial(j) for j in range(max(p + 1, 5))])
    i, j = np.indices((p, p))
    single = np.where(j >= i, powers[np.maximum(j - i, 0)], 0.0)
    F = np.multiply.outer(single, np.eye(6)).swapaxes(1, 2).copy()
    return powers, F, powers[1:p] / np.arange(2, p + 1)


def _process_noise(elapsed: float, p: int, noise: Floats) -> Floats:
    """Q (G, 6 p, 6 p)."""
    Q = np.zeros((len(noise), p, 6, p, 6))
    # what each coordinate of a pose has with itself: (6, G, p, p)
    Q[:, :, range(6), :, range(6)] = noise.T[:, :, None, None] * _noise_of_step(elapsed, p)
    return Q.reshape(len(noise), 6 * p, 6 * p)


@lru_cache(maxsize=64)
def _noise_of_step(elapsed: float, p: int) -> Floats:
    """Q (p, p) of one coordinate for the intensity 1."""
    i, j = np.indices((p, p))
    ahead = 2 * p - 1 - i - j
    down = np.array([factorial(p - 1 - k) for k in range(p)])
    return np.asarray(elapsed**ahead / (ahead * down[i] * down[j]))
