"""The matched objective: normalised density matching, without the bias of the paper's.

For sensor l let g be the observed density and h_β the predicted one, a mixture of the projected
features with the observation's own blur σ.  The share of g that h_β explains once its amplitude
is solved for (variable projection) is

    S_l(β) = ⟨g, h_β⟩² / (⟨g, g⟩ ⟨h_β, h_β⟩),

and the objective is Σ_l ω_l S_l.  For point features ⟨g, h_β⟩ = Σ_i C(p_i), where C is g blurred
once more by σ and is looked up with `cv2.remap`; ⟨h_β, h_β⟩ = Σ_ij N(p_i − p_j; 0, 2σ²).  Nothing
is sampled at random.  The curvature is Gauss-Newton's of the residual g − a h_β.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.density import TILE_REACH, Atlas, Density, close_pairs, peak
from mixpose.objective.base import (
    Quadratic,
    View,
    facing,
    pose_jacobian,
    region_of_interest,
)
from mixpose.rigid import transform
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]

_NEGLIGIBLE = -28.0  # exponent below which two features do not overlap: 1e-12

REACH = 4.0
"""Margin of a window around the predicted features, in standard deviations of C."""


@dataclass(frozen=True)
class MatchedTerm:
    """One sensor's share of the objective, at one level of blur.

    Attributes
    ----------
    name : str
    sensor : Sensor
    matched : Density
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
    matched: Density | Atlas
    variance: float
    energy: float
    weight: float


class MatchedObjective:
    """Σ_l ω_l ⟨g_l, h_l⟩² / (⟨g_l, g_l⟩ ⟨h_l, h_l⟩) over the pose.

    Parameters
    ----------
    terms : sequence of MatchedTerm
    body : Body
        Its nodes are what is predicted; spreads Σ_i do not widen the prediction, as a template
        wider than the data is biased (see `docs/method.md`).
    """

    def __init__(self, terms: Sequence[MatchedTerm], body: Body) -> None:
        self.terms = tuple(terms)
        self.points = body.nodes.points
        self.weights = body.nodes.weights
        self.normals = body.node_normals

    def value(self, T_world_object: Floats) -> Floats:
        """Values (...,) at poses (..., 4, 4)."""
        points = transform(T_world_object, self.points)
        total = np.zeros(T_world_object.shape[:-2])
        for term in self.terms:
            y, seen = term.sensor.project(points)
            seen = seen & facing(term.sensor, T_world_object, points, self.normals)
            weights = np.where(seen, self.weights, 0.0)
            product = (weights * term.matched.sample(y)[..., 0]).sum(axis=-1)
            norm = _self_overlaps(y, weights, term.variance)
            total += term.weight * product**2 / (term.energy * norm)
        return total

    def linearise(self, T_world_object: Floats) -> Quadratic:
        """Value, gradient and Gauss-Newton curvature at one pose (4, 4).

        On fine tiles the Hessian is given too, but for the second derivatives of the projection,
        which act on residuals only.
        """
        value, gradient, curvature = 0.0, np.zeros(6), np.zeros((6, 6))
        hessian: Floats | None = np.zeros((6, 6))
        points = transform(T_world_object, self.points)
        for term in self.terms:
            y, by_world, seen = term.sensor.linearise(points)
            seen = seen & facing(term.sensor, T_world_object, points, self.normals)
            if not seen.any():
                continue
            J = pose_jacobian(by_world[seen], T_world_object, self.points[seen])
            sampled, second = _look_up(term.matched, y, seen)
            share = _share(term, sampled, second, y[seen], J, self.weights[seen])
            value += share.value
            gradient += share.gradient
            curvature += share.curvature
            known = hessian is not None and share.hessian is not None
            hessian = hessian + share.hessian if known else None  # type: ignore[operator]
        return Quadratic(value, gradient, curvature, hessian)


def _look_up(
    matched: Density | Atlas, y: Floats, seen: NDArray[np.bool_]
) -> tuple[Floats, Floats | None]:
    """C with its gradient, and its second derivatives where they are known."""
    if isinstance(matched, Density):
        return matched.sample(y[seen]).astype(np.float64), None
    sampled, second = matched.sample_all(y)
    return sampled[seen].astype(np.float64), second[seen].astype(np.float64)


def _share(
    term: MatchedTerm,
    sampled: Floats,
    second: Floats | None,
    y: Floats,
    J: Floats,
    weights: Floats,
) -> Quadratic:
    """One sensor's weighted share ω S with its derivatives; y (n, m), J (n, m, 6)."""
    flat = (weights[:, None, None] * J).reshape(-1, J.shape[-1])
    product = float(weights @ sampled[:, 0])
    by_pose = sampled[:, 1:].reshape(-1) @ flat
    overlap = overlap_terms(y, J, weights, term.variance)
    amplitude = product / overlap.norm
    scale = term.weight / term.energy
    by_amplitude = (by_pose - 2 * amplitude * overlap.half_gradient) / overlap.norm
    gradient = 2 * amplitude * (by_pose - amplitude * overlap.half_gradient)
    curvature = overlap.gram - np.outer(overlap.half_gradient, overlap.half_gradient) / overlap.norm
    hessian = None
    if second is not None:
        # of c²/n, with a = c/n: 2 n ∇a∇aᵀ + 2 a ∇²c − a² ∇²n
        bend = flat.T @ (second @ J).reshape(-1, J.shape[-1])
        hessian = -scale * (
            2 * overlap.norm * np.outer(by_amplitude, by_amplitude)
            + 2 * amplitude * bend
            - amplitude**2 * overlap.second
        )
    return Quadratic(
        scale * product * amplitude,
        scale * gradient,
        2 * scale * amplitude**2 * curvature,
        hessian,
    )


@dataclass(frozen=True)
class Overlap:
    """Inner products of a predicted mixture h with itself and its derivatives by the pose.

    Attributes
    ----------
    norm : float
        ⟨h, h⟩.
    half_gradient : (6,) array
        ⟨h, ∂h⟩, half the gradient of the norm.
    gram : (6, 6) array
        ⟨∂h, ∂h⟩.
    second : (6, 6) array
        Second derivative of the norm, without those of the projection.
    """

    norm: float
    half_gradient: Floats
    gram: Floats
    second: Floats


def overlap_terms(y: Floats, J: Floats, weights: Floats, variance: float) -> Overlap:
    """Overlap of the features of a predicted mixture.

    Parameters
    ----------
    y : (n, m) array
        Projected features.
    J : (n, m, 6) array
        Their Jacobians by the pose.
    weights : (n,) array
    variance : float
        2σ².
    """
    top = peak(variance, y.shape[1])
    size = J.shape[-1]
    flat = (J * weights[:, None, None]).reshape(-1, size)
    gram = flat.T @ flat * (top / variance)
    own = float(weights @ weights)
    pairs = close_pairs(y, variance)
    away = y[pairs[:, 0]] - y[pairs[:, 1]]
    exponent = (away * away).sum(axis=1) * (-0.5 / variance)
    near = exponent > _NEGLIGIBLE
    if not near.any():
        return Overlap(top * own, np.zeros(size), gram, np.zeros((size, size)))
    i, j = pairs[near, 0], pairs[near, 1]
    away, bells = away[near], weights[i] * weights[j] * np.exp(exponent[near]) * top
    J_i, J_j = J[i], J[j]
    along_i = np.einsum("pm,pmk->pk", away, J_i)
    along_j = np.einsum("pm,pmk->pk", away, J_j)
    along = along_i - along_j
    half_gradient = -(bells @ along) / variance
    cross = _weighted(bells, J_i, J_j) / variance - (along_i.T * bells) @ along_j / variance**2
    J_apart = J_i - J_j
    second = (along.T * bells) @ along / variance**2 - _weighted(bells, J_apart, J_apart) / variance
    norm = top * own + 2 * float(bells.sum())
    return Overlap(norm, half_gradient, gram + cross + cross.T, 2 * second)


def _weighted(weights: Floats, A: Floats, B: Floats) -> Floats:
    """Σ_p w_p A_pᵀ B_p for A and B of shape (p, m, k)."""
    size = A.shape[-1]
    return np.asarray((A * weights[:, None, None]).reshape(-1, size).T @ B.reshape(-1, size))


def _self_overlaps(y: Floats, weights: Floats, variance: float) -> Floats:
    """⟨h, h⟩ for batches of projected features (..., n, m) with weights (..., n)."""
    n, dimension = y.shape[-2:]
    # hidden features sit together far outside; their zero weights keep them out of the sum
    total: Floats = (weights * weights).sum(axis=-1)
    for k in range(1, n):
        away = y[..., k:, :] - y[..., :-k, :]
        bells = np.exp(-0.5 / variance * (away * away).sum(axis=-1))
        total = total + 2 * (weights[..., k:] * weights[..., :-k] * bells).sum(axis=-1)
    return np.asarray(np.maximum(total * peak(variance, dimension), np.finfo(np.float64).tiny))


def matched_objective(
    views: Sequence[View],
    body: Body,
    sigmas: Sequence[float],
    near: Floats | None = None,
    *,
    fine: bool = False,
    reach: float = TILE_REACH,
) -> MatchedObjective:
    """Build the matched objective at given blurs.

    Parameters
    ----------
    views : sequence of View
        Sensors whose observation is not empty.
    body : Body
    sigmas : sequence of float
        Standard deviation of a feature at this level, per view, in sensor units.
    near : (4, 4) array or None
        Densities are made only around the projection of this pose; None: wherever a sensor sees.
    fine : bool
        Whether densities are wanted on fine tiles around the projection, for the last digits.
    reach : float
        Half-width of such tiles, in standard deviations of the matched density.
    """
    terms = []
    for view, sigma in zip(views, sigmas, strict=True):
        matched = _matched_density(view, body, sigma, near, reach if fine else None)
        if matched is None:
            continue
        energy = view.observation.energy(sigma)
        variance = 2 * sigma**2
        # ω_l: as many equal features as would give this energy, per feature of the body, so
        # that clutter in one sensor does not take the weight from its true features
        count = peak(variance, view.sensor.dimension) / energy
        weight = count / len(body)
        terms.append(MatchedTerm(view.name, view.sensor, matched, variance, energy, weight))
    return MatchedObjective(terms, body)


def _matched_density(
    view: View, body: Body, sigma: float, near: Floats | None, reach: float | None
) -> Density | Atlas | None:
    """C around a pose, or over the whole sensor; None where the sensor sees nothing of it."""
    if near is None:
        return view.observation.matched(sigma, (view.sensor.lower, view.sensor.upper))
    y, visible = view.sensor.project(transform(near, body.nodes.points))
    if not visible.any():
        return None
    if reach is not None:
        atlas = view.observation.matched_near(sigma, y, reach)
        if atlas is not None:
            return atlas
    box = region_of_interest(view.sensor, y[visible], REACH * np.sqrt(2) * sigma)
    return view.observation.matched(sigma, box)
