"""Model the motion of a body between frames: white noise in the highest derivative of its pose.

A state is a pose and its first derivatives, velocity first; those of the rotation are the angular
velocity in world axes and its derivatives.  With white noise of intensity q in the derivative of
order p, over a time τ (Y. Bar-Shalom, *Estimation with Applications to Tracking and Navigation*,
6.2),

    F_ij = τ^(j-i) / (j-i)!,      Q_ij = q τ^(2p-1-i-j) / ((2p-1-i-j) (p-1-i)! (p-1-j)!)

At an angular velocity ω(s) = Σ_j ω_j s^j / j! the rotation is exp(Ω), by W. Magnus' series,

    Ω = ∫ ω ds + ½ ∫ ω(s) × ∫_0^s ω dr ds + O(τ⁵)

Errors of a state are a twist as in `mixpose.rigid`, then errors of the derivatives.  All functions
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

# names of the derivative that has white noise, and its order
ORDERS = {"acceleration": 2, "jerk": 3, "snap": 4, "crackle": 5}
# ω @ _ACROSS is [ω], of x -> ω × x, row by row
_ACROSS = np.array(
    [[0.0, 0, 0, 0, 0, -1, 0, 1, 0], [0.0, 0, 1, 0, 0, 0, -1, 0, 0], [0.0, -1, 0, 1, 0, 0, 0, 0, 0]]
)
_EYE = np.eye(3)
_TRACE = _EYE.ravel()
_JITTER = 1e-13  # added to correlations, so that rounding does not make them indefinite


class States(NamedTuple):
    """States of a body at one time in G filters that run side by side."""

    poses: Floats  # (G, 4, 4)
    rates: Floats  # (G, p - 1, 6): derivatives of the pose, lengths and radians per s, s² ...
    covariances: Floats  # (G, 6 p, 6 p): of the pose and of its derivatives, in this order

    @property
    def order(self) -> int:
        """Order p of the derivative that has white noise."""
        return int(self.rates.shape[1]) + 1

    def minus(self, other: States) -> Floats:
        """Return the errors (G, 6 p) that lead from other states to these."""
        twists = rigid.twist_between(other.poses, self.poses).reshape(-1, 6)
        rates = (self.rates - other.rates).reshape(len(twists), -1)
        return np.concatenate([twists, rates], axis=1)

    def moved(self, errors: Floats, covariances: Floats) -> States:
        """Return these states moved by errors (G, 6 p), with other covariances."""
        poses = _perturbed(self.poses, errors[:, :3], _turn(across_by(errors[:, 3:6])))
        return States(poses, self.rates + errors[:, 6:].reshape(self.rates.shape), covariances)

    def mixed(self, others: States, is_other: Mask) -> States:
        """Return these states, replaced by others where the mask (G,) is True."""
        mask = is_other[:, None, None]
        return States(*(np.where(mask, b, a) for a, b in zip(self, others, strict=True)))

    def of(self, indices: Indices | list[int]) -> States:
        """Return the states with these indices."""
        return States(*(field[indices] for field in self))


def predicted(states: States, elapsed: float, noise: Floats) -> tuple[States, Floats]:
    """Predict states `elapsed` seconds later; also return derivatives (G, 6 p, 6 p) by the states.

    `noise` holds the intensities q (G, 6), one per coordinate of a pose.
    """
    p = states.order
    powers, by_taylor, by_rate = _step(elapsed, p)
    moved = powers[1:p] @ states.rates
    if p > 2:  # second term of the Magnus series: the axis changes
        changing = (powers[3:5] * [0.5, 1.0])[: p - 2] @ states.rates[:, 1:3, 3:]
        moved[:, 3:] += (across_by(changing) @ states.rates[:, 0, 3:, None])[..., 0]
    across = across_by(moved[:, 3:])
    turn = _turn(across)
    F = by_taylor[None].repeat(len(turn), axis=0)
    # the effect of a rotation on errors of rates is linearised in it
    F[:, 0, 3:, 0, 3:] = turn
    F[:, 0, 3:, 1:, 3:] += across[:, :, None] * by_rate[:, None]
    F = F.reshape(states.covariances.shape)
    covariances = F @ states.covariances @ F.swapaxes(1, 2) + _process_noise(elapsed, p, noise)
    rates = by_taylor[: p - 1, 0, : p - 1, 0] @ states.rates
    return States(_perturbed(states.poses, moved[:, :3], turn), rates, covariances), F


def updated(states: States, pose: Floats, covariance: Floats) -> tuple[States, Floats, Floats]:
    """Update states by measured poses, (4, 4) or (G, 4, 4), with their covariances.

    Also returns the squared Mahalanobis distances (G,) of the poses from their predictions, and
    log-likelihoods (G,) without the constant −3 log 2π.
    """
    residuals = _twists(states.poses, pose)
    P = states.covariances
    S = P[:, :6, :6] + covariance
    scale = 1 / np.sqrt(np.diagonal(S, axis1=1, axis2=2))
    scales = scale[:, :, None] * scale[:, None]
    scaled = S * scales
    inverse = np.linalg.inv(scaled) * scales
    gains = P[:, :, :6] @ inverse
    squared = ((inverse @ residuals[..., None])[..., 0] * residuals).sum(axis=1)
    log_determinants = np.linalg.slogdet(scaled)[1] - 2 * np.log(scale).sum(axis=1)
    # Joseph's form stays symmetric and positive in spite of rounding
    unmeasured = P - gains @ P[:, :6]
    covariances = unmeasured + (gains @ covariance - unmeasured[:, :, :6]) @ gains.swapaxes(1, 2)
    state = states.moved((gains @ residuals[..., None])[..., 0], covariances)
    return state, squared, -0.5 * (squared + log_determinants)


class StepNoise(NamedTuple):
    """Estimate of the noise between two poses from all poses, for lengths and for turns.

    The expected values of the two fields are equal.
    """

    squared: Floats  # (2,): bᵀQb, squared size of the noise, in variances
    degrees: Floats  # (2,): tr NQ, number of its components that are known


def smoothed(
    state: States, ahead: States, smoothed_ahead: States, F: Floats, elapsed: float, noise: Floats
) -> tuple[States, StepNoise]:
    """Smooth a state by all later poses (H. E. Rauch, F. Tung and C. T. Striebel, 1965).

    `state` is a single filtered state; `ahead` the prediction of the next, with its derivative F by
    `state`, and `smoothed_ahead` the next state after smoothing.
    """
    P, predicted_P = state.covariances[0], ahead.covariances[0]
    scale = 1 / np.sqrt(predicted_P.diagonal())
    scales = scale[:, None] * scale
    factor, _ = dpotrf(predicted_P * scales + _JITTER * np.eye(len(scale)))
    inverse = dpotrs(factor, np.eye(len(scale)))[0] * scales
    b = inverse @ smoothed_ahead.minus(ahead)[0]
    N = inverse @ (predicted_P - smoothed_ahead.covariances[0]) @ inverse
    gain = P @ F[0].T
    covariance = P - gain @ N @ gain.T
    Q = _process_noise(elapsed, state.order, noise)[0]
    is_turn = np.arange(len(b)) % 6 >= 3
    # given all poses, the noise of this step has the mean Q b and the covariance Q - Q N Q
    moments = b * (Q @ b), (N * Q).sum(axis=1)
    step_noise = StepNoise(*(np.array([n[~is_turn].sum(), n[is_turn].sum()]) for n in moments))
    result = state.moved((gain @ b)[None], ((covariance + covariance.T) / 2)[None])
    return result, step_noise


# With a few poses at a time the functions of `mixpose.rigid` take five times as long.


def across_by(vectors: Floats) -> Floats:
    """Return [ω] (G, 3, 3) of vectors (G, 3): x -> ω × x."""
    return np.asarray((vectors @ _ACROSS).reshape(-1, 3, 3))


def _turn(across: Floats) -> Floats:
    """Return rotations exp [ω] (G, 3, 3), by O. Rodrigues."""
    angle = np.sqrt((across**2).sum(axis=(1, 2), keepdims=True) / 2) + 1e-300
    half = np.sin(angle / 2) / angle
    return np.asarray(_EYE + np.sin(angle) / angle * across + 2 * half**2 * across @ across)


def _perturbed(poses: Floats, shift: Floats, turn: Floats) -> Floats:
    """Return poses (G, 4, 4) after shifts (G, 3) and turns (G, 3, 3) in world axes."""
    moved = poses.copy()
    moved[:, :3, :3] = turn @ poses[:, :3, :3]
    moved[:, :3, 3] += shift
    return moved


def _twists(T_from: Floats, T_to: Floats) -> Floats:
    """Return twists (G, 6) from poses (G, 4, 4) to poses (G, 4, 4) or (4, 4)."""
    R = T_to[..., :3, :3] @ T_from[:, :3, :3].swapaxes(1, 2)
    flat = R.reshape(-1, 9)
    cosine = flat @ _TRACE - 1  # twice the cosine of the angle, as |axis| is twice its sine
    if (cosine <= 0).any():
        return rigid.twist_between(T_from, np.broadcast_to(T_to, T_from.shape)).reshape(-1, 6)
    axis = flat @ _ACROSS.T
    length = np.sqrt((axis**2).sum(axis=1)) + 1e-300
    turn = axis * (np.arctan2(length, cosine) / length)[:, None]
    return np.concatenate([T_to[..., :3, 3] - T_from[:, :3, 3], turn], axis=1)


@lru_cache(maxsize=64)
def _step(elapsed: float, p: int) -> tuple[Floats, Floats, Floats]:
    """Return powers τ^j / j!, Taylor's F (p, 6, p, 6), and factors of a turn by rate (p - 1,)."""
    powers = np.array([elapsed**j / factorial(j) for j in range(max(p + 1, 5))])
    i, j = np.indices((p, p))
    single = np.where(j >= i, powers[np.maximum(j - i, 0)], 0.0)
    F = np.multiply.outer(single, np.eye(6)).swapaxes(1, 2).copy()
    return powers, F, powers[1:p] / np.arange(2, p + 1)


def _process_noise(elapsed: float, p: int, noise: Floats) -> Floats:
    """Return Q (G, 6 p, 6 p) for intensities (G, 6)."""
    Q = np.zeros((len(noise), p, 6, p, 6))
    # coordinates of a pose are independent: blocks (6, G, p, p)
    Q[:, :, range(6), :, range(6)] = noise.T[:, :, None, None] * _noise_of_step(elapsed, p)
    return Q.reshape(len(noise), 6 * p, 6 * p)


@lru_cache(maxsize=64)
def _noise_of_step(elapsed: float, p: int) -> Floats:
    """Return Q (p, p) of one coordinate for the intensity 1."""
    i, j = np.indices((p, p))
    ahead = 2 * p - 1 - i - j
    down = np.array([factorial(p - 1 - k) for k in range(p)])
    return np.asarray(elapsed**ahead / (ahead * down[i] * down[j]))
