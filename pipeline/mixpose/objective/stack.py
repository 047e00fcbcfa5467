"""The matched terms of sensors of one dimension, evaluated side by side.

Arrays have the sensors first: places y (L, n, m), Jacobians J (L, n, m, 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.density import Atlas, Density, Mixture
from mixpose.objective.base import Quadratic
from mixpose.objective.gaze import Gaze, Projected
from mixpose.objective.overlaps import (
    Overlap,
    apart_at,
    are_apart,
    overlap_terms,
    overlaps_of_few,
)
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]

_FEW = 40  # features up to which all pairs at once are faster than those that overlap


@dataclass(frozen=True)
class MatchedTerm:
    """One sensor's share of the matched objective, at one level of blur.

    Attributes
    ----------
    name : str
    sensor : Sensor
    matched : Density, Atlas or Mixture
        C with its gradient.
    variance : float
        2σ², that of the product of two features, in squared sensor units.
    energy : float
        ⟨g, g⟩.
    weight : float
        ω_l.
    """

    name: str
    sensor: Sensor
    matched: Density | Atlas | Mixture
    variance: float
    energy: float
    weight: float


class Stack:
    """Terms of sensors of one dimension, as one function of the pose."""

    def __init__(self, terms: Sequence[MatchedTerm], gaze: Gaze) -> None:
        self.terms = tuple(terms)
        self.gaze = gaze
        self.variances = np.array([term.variance for term in terms])
        self._tops = (2 * np.pi * self.variances) ** (-0.5 * terms[0].sensor.dimension)
        self._apart = apart_at(self.variances)
        self._scales = np.array([term.weight / term.energy for term in terms])
        self._mixtures = _joined([term.matched for term in terms])

    def look_up(self, y: Floats) -> tuple[Floats, Floats | None]:
        """C with gradient (L, n, 1 + m) at places y, and second derivatives where known."""
        if self._mixtures is not None:
            return self._mixtures.sample_all(y)
        values: list[NDArray[Any]] = []
        seconds: list[NDArray[Any]] = []
        for term, places in zip(self.terms, y, strict=True):
            if isinstance(term.matched, Density):
                values.append(term.matched.sample(places))
            else:
                value, second = term.matched.sample_all(places)
                values.append(value)
                seconds.append(second)
        known = np.array(seconds, dtype=np.float64) if len(seconds) == len(values) else None
        return np.array(values, dtype=np.float64), known

    def overlaps(self, at: Projected) -> Overlap:
        """Overlaps of the predicted mixture in every sensor, all with a leading axis L."""
        if self._mixtures is not None and at.y.shape[1] <= _FEW:
            squares = at.weights * at.weights
            if are_apart(at.y, at.weights, self._apart):
                return Overlap(self._tops * (squares @ self.gaze.ones), apart=True)
        if at.y.shape[1] <= _FEW:
            return overlaps_of_few(at.y, at.J, at.weights, self.variances)
        each = [
            overlap_terms(y[seen], J[seen], weights[seen], variance)
            for y, J, weights, seen, variance in zip(
                at.y, at.J, at.weights, at.seen, self.variances.tolist(), strict=True
            )
        ]
        return Overlap(
            norm=np.array([one.norm for one in each]),
            half_gradient=np.array([one.half_gradient for one in each]),
            gram=np.array([one.gram for one in each]),
            second=np.array([one.second for one in each]),
        )

    def linearise(self, T_world_object: Floats) -> Quadratic:
        """Σ_l ω_l S_l at one pose, with its derivatives."""
        at = self.gaze.project(T_world_object)
        if self._mixtures is None:
            return self._on_grids(at)
        return self._between_detections(at, self._mixtures)

    def _between_detections(self, at: Projected, mixtures: Mixture) -> Quadratic:
        """The curvature is that of mean-shift, 2 a Σ_i C_i J_iᵀ J_i / 2σ².

        Every feature is drawn to where the detections around it lie, and the value never falls.
        The Hessian has in place of C_i / 2σ² what Σ_j b_j d dᵀ / 4σ⁴ leaves of it.
        """
        C, pull, spread = mixtures.sums(at.y)
        if not (self.gaze.is_even and np.count_nonzero(at.seen) == at.seen.size):
            C = C * at.weights
            pull = pull * at.weights[..., None]
            spread = spread * at.weights[..., None, None]
        L, v = len(self.terms), self.variances
        J = at.J.reshape(-1, 6)
        overlap = self.overlaps(at)
        product = C @ self.gaze.ones
        rest = (pull.reshape(L, 1, -1) @ at.J.reshape(L, -1, 6))[:, 0] / v[:, None]
        norm = overlap.norm
        if np.count_nonzero(norm) < L:  # a sensor that sees no feature has no product either
            norm = np.where(norm > 0, norm, 1.0)
        amplitude = product / norm
        strength = 2 * self._scales * amplitude
        drawn = ((strength / v)[:, None] * C)[..., None, None] * at.J
        curvature = J.T @ drawn.reshape(-1, 6)
        bent = ((strength / v**2)[:, None, None, None] * spread) @ at.J
        hessian = curvature - J.T @ bent.reshape(-1, 6)
        by_norm = rest
        if not overlap.apart:
            half = amplitude[:, None] * overlap.half_gradient
            rest, by_norm = rest - half, rest - 2 * half
            level = self._scales * amplitude**2
            hessian += (level[:, None, None] * overlap.second).sum(axis=0)
        # of c²/n, with a = c/n: 2 n ∇a∇aᵀ + 2 a ∇²c − a² ∇²n
        hessian -= ((2 * self._scales / norm)[:, None] * by_norm).T @ by_norm
        value = float(self._scales @ (product * amplitude))
        return Quadratic(value, strength @ rest, curvature, hessian)

    def _on_grids(self, at: Projected) -> Quadratic:
        """The curvature is Gauss-Newton's of g − a h: on grids features overlap."""
        sampled, second = self.look_up(at.y)
        overlap = self.overlaps(at)
        L = len(self.terms)
        flat = (at.J * at.weights[..., None, None]).reshape(L, -1, 6)
        product = (sampled[..., 0] * at.weights).sum(axis=1)
        norm = np.where(overlap.norm > 0, overlap.norm, 1.0)
        amplitude = product / norm
        strength = 2 * self._scales * amplitude
        half = amplitude[:, None] * overlap.half_gradient
        rest = (sampled[..., 1:].reshape(L, 1, -1) @ flat)[:, 0] - half
        level = (self._scales * amplitude**2)[:, None, None]
        across = overlap.half_gradient[:, :, None] * overlap.half_gradient[:, None]
        gram = overlap.gram - across / norm[:, None, None]
        curvature = (2 * level * gram).sum(axis=0)
        hessian = None
        if second is not None:
            bent = (strength[:, None, None, None] * second) @ at.J
            hessian = (level * overlap.second).sum(axis=0)
            hessian -= flat.reshape(-1, 6).T @ bent.reshape(-1, 6)
            by_norm = rest - half
            hessian -= ((2 * self._scales / norm)[:, None] * by_norm).T @ by_norm
        value = float(self._scales @ (product * amplitude))
        return Quadratic(value, strength @ rest, curvature, hessian)


def _joined(parts: Sequence[Density | Atlas | Mixture]) -> Mixture | None:
    """Mixtures of all sensors with a leading axis L; None where some are drawn on grids."""
    mixtures = [part for part in parts if isinstance(part, Mixture)]
    if len(mixtures) < len(parts):
        return None
    if len({mixture.points.shape for mixture in mixtures}) == 1:
        points = np.array([mixture.points for mixture in mixtures])
        heights = np.array([mixture.heights for mixture in mixtures])
    else:
        rows = max(mixture.points.shape[0] for mixture in mixtures)
        most = max(mixture.points.shape[1] for mixture in mixtures)
        points = np.zeros((len(parts), rows, most, mixtures[0].points.shape[2]))
        heights = np.zeros((len(parts), rows, most))
        for k, mixture in enumerate(mixtures):
            count = mixture.points.shape[1]
            points[k, :, :count] = mixture.points
            heights[k, :, :count] = mixture.heights
    variances = np.array([mixture.variance for mixture in mixtures])
    return Mixture(points, heights, variances[:, None, None])
