"""Terms added to the matched objective: the prior of a pose, and features of unequal brightness.

With a common amplitude, two features that overlap pull each other aside if one is brighter.  Here
each feature i in a grid of values has an amplitude α_i.  With
b_i = ⟨g, h_i⟩ = w_i C(p_i) and B_ij = ⟨h_i, h_j⟩,

    Q = max_α 2 αᵀb − αᵀBα − λ |α − mean α|²,     α = (B + λP)⁻¹ b,

where P removes the mean and λ = N / (s a)² for noise N of cells, relative spread s and common
amplitude a.  As α are at their maximum, the gradient is that at fixed α; the curvature is
Gauss-Newton's of the residual g − Σ_i α_i h_i with α solved for (variable projection).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mixpose.objective.matched import MatchedObjective
from mixpose.optimise import Quadratic, Sum, Term
from mixpose.records import Floats, Mask, replace
from mixpose.rigid import perturb, twist_between


@dataclass(frozen=True)
class NormalPrior:
    """Logarithm of a normal density of the pose, without its constant."""

    T_world_object: Floats  # (4, 4) its mean
    uncertainty: Floats  # (6,) standard deviations, lengths and radians; positive where free
    free: Mask  # (6,) directions in which the pose may change

    def linearise(self, poses: Floats) -> Quadratic:
        """Return second-order models at poses (H, 4, 4)."""
        information = np.where(self.free, 1 / np.maximum(self.uncertainty, 1e-12) ** 2, 0.0)
        away = twist_between(self.T_world_object, poses)
        pull = -information * away
        C = np.broadcast_to(np.diag(information), (len(poses), 6, 6))
        return Quadratic(0.5 * (away * pull).sum(axis=1), pull, C, C)

    def points(self) -> Floats:
        """Return the mean, and points √k standard deviations to either side along k directions."""
        steps = np.sqrt(self.free.sum()) * np.diag(self.uncertainty)[self.free]
        twists = np.concatenate([np.zeros((1, 6)), np.stack([steps, -steps], 1).reshape(-1, 6)])
        return perturb(self.T_world_object, twists)


@dataclass(frozen=True, eq=False)
class AmplitudesObjective:
    """Σ_l Q_l / (2 N_l) over the pose, in nats, of sensors whose density is a grid."""

    matched: MatchedObjective  # at σ_ε
    noise: Floats  # (L,) variance of a cell's noise times the size of a cell
    spread: float  # s, relative

    def linearise(self, poses: Floats) -> Quadratic:
        """Return second-order models at poses (H, 4, 4)."""
        return Quadratic(*map(np.array, zip(*map(self._model, poses), strict=True)))

    def _model(self, T_world_object: Floats) -> tuple[float, Floats, Floats]:
        """Return value, gradient and curvature at one pose (4, 4)."""
        value, gradient, curvature = 0.0, np.zeros(6), np.zeros((6, 6))
        for k, (a, B, inner, C, away, J) in self._mixtures(T_world_object):
            v, scale = float(self.matched.variances[k, 0]), 0.5 / float(self.noise[k])
            alpha, (n, _, m) = a[:, None], away.shape
            bells = alpha * B * a
            pull = alpha * C[:, 1:] + (bells[..., None] * away).sum(axis=1) / v
            value += scale * float(a @ C[:, 0])
            gradient += 2 * scale * (pull.ravel() @ J)
            # ⟨∂h_i, ∂h_jᵀ⟩, and ⟨∂h_i, h_j⟩
            outer = away[..., :, None] * away[..., None, :] / v
            gram = (bells / v)[..., None, None] * (np.eye(m) - outer)
            gram = gram.swapaxes(1, 2).reshape(n * m, n * m)
            cross = -((alpha * B / v)[..., None] * away).swapaxes(1, 2)
            mixed = cross.reshape(n * m, n).T @ J
            curvature += 2 * scale * (J.T @ gram @ J - mixed.T @ np.linalg.solve(inner, mixed))
        return value, gradient, curvature

    def unexplained(self, T_world_object: Floats) -> Floats:
        """Return ⟨g − Σ α_i h_i, g − Σ α_i h_i⟩ per sensor (L,) at a pose (4, 4)."""
        energies = self.matched.energies[:, 0].copy()
        for k, (a, B, _, C, _, _) in self._mixtures(T_world_object):
            energies[k] -= a @ (2 * C[:, 0] - B @ a)
        return energies

    def _mixtures(self, T_world_object: Floats) -> Iterator[tuple[int, tuple[Floats, ...]]]:
        """Yield by sensor α, B, B + λP, b, ∇b (n, 1 + m), p_i − p_j (n, n, m), J (n m, 6)."""
        match = self.matched.match(T_world_object[None])
        dimensions = self.matched.projection.dimensions.tolist()
        for k in np.flatnonzero(self.matched.are_grids).tolist():
            m = dimensions[k]
            seen = np.flatnonzero(match.weights[k, 0] > 0)
            w, y = match.weights[k, 0, seen], match.y[k, 0, seen, :m]
            C = w[:, None] * match.sampled[k, 0, seen, : 1 + m]
            away = y[:, None] - y[None]
            v, top = float(self.matched.variances[k, 0]), float(self.matched.tops[k, 0])
            B = top * np.outer(w, w) * np.exp(-0.5 * (away * away).sum(axis=2) / v)
            common = max(float(C[:, 0].sum()), 0.0) / float(match.norm[k, 0])
            # bounded, as coinciding features and features not seen do not determine amplitudes
            least = 1e-9 * top * float(w @ w)
            squares = max((self.spread * common) ** 2, 1e-300)
            strength = min(float(self.noise[k]) / squares, 1e18 * least) + least
            inner = B + strength * (np.eye(len(w)) - 1 / max(len(w), 1)) + least * np.eye(len(w))
            alpha, J = np.linalg.solve(inner, C[:, 0]), match.J[k, 0, seen, :m].reshape(-1, 6)
            yield k, (alpha, B, inner, C, away, J)


def with_heights(likelihood: MatchedObjective, spread: float) -> Term:
    """Give features in grids amplitudes of a relative spread, in an objective in nats."""
    if not likelihood.are_grids.any():
        return likelihood
    points = replace(
        likelihood, weights=np.where(likelihood.are_grids[:, None], 0.0, likelihood.weights)
    )
    noise = 0.5 * likelihood.energies[:, 0] / likelihood.weights[:, 0]
    return Sum((points, AmplitudesObjective(likelihood, noise, spread)))
