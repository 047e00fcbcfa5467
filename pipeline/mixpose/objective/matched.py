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
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.density import FEW, TILE_REACH, Atlas, Density, Mixture, peak
from mixpose.objective.base import Quadratic, View, facing, region_of_interest
from mixpose.objective.gaze import Gaze
from mixpose.objective.stack import MatchedTerm, Stack
from mixpose.records import PointPattern
from mixpose.rigid import transform
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]

REACH = 4.0
"""Margin of a window around the predicted features, in standard deviations of C."""


class MatchedObjective:
    """Σ_l ω_l ⟨g_l, h_l⟩² / (⟨g_l, g_l⟩ ⟨h_l, h_l⟩) over the pose.

    Parameters
    ----------
    terms : sequence of MatchedTerm
    body : Body
        Its nodes are what is predicted; spreads Σ_i do not widen the prediction, as a template
        wider than the data is biased (see `docs/method.md`).
    gazes : sequence of Gaze
        Of the terms' sensors at the body, where they are at hand.
    """

    def __init__(
        self, terms: Sequence[MatchedTerm], body: Body, gazes: Sequence[Gaze] = ()
    ) -> None:
        self._gazes = tuple(gazes)
        self.terms = tuple(terms)
        self.body = body
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

        Where densities are exact the Hessian is given too, but for the second derivatives of the
        projection, which act on residuals only.
        """
        parts = [stack.linearise(T_world_object) for stack in self.stacks]
        if len(parts) == 1:
            return parts[0]
        hessians = [part.hessian for part in parts if part.hessian is not None]
        return Quadratic(
            sum(part.value for part in parts),
            np.sum([part.gradient for part in parts] or [np.zeros(6)], axis=0),
            np.sum([part.curvature for part in parts] or [np.zeros((6, 6))], axis=0),
            np.sum(hessians, axis=0) if parts and len(hessians) == len(parts) else None,
        )

    @cached_property
    def stacks(self) -> list[Stack]:
        """Terms side by side, those of cameras and those of ranges apart."""
        stacks = []
        for m in sorted({term.sensor.dimension for term in self.terms}):
            terms = [term for term in self.terms if term.sensor.dimension == m]
            sensors = [term.sensor for term in terms]
            gaze = next((one for one in self._gazes if _are_same(one.sensors, sensors)), None)
            stacks.append(Stack(terms, gaze or Gaze(sensors, self.body)))
        return stacks


def _are_same(some: Sequence[Sensor], others: Sequence[Sensor]) -> bool:
    return len(some) == len(others) and all(a is b for a, b in zip(some, others, strict=True))


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
    gazes: Sequence[Gaze] = (),
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
        Whether grids are wanted on fine tiles around the projection, for the last digits;
        densities of detections are always exact.
    reach : float
        Half-width of such tiles, in standard deviations of the matched density.
    gazes : sequence of Gaze
        Of the views' sensors at the body, where they are at hand.
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
    return MatchedObjective(terms, body, gazes)


def _matched_density(
    view: View, body: Body, sigma: float, near: Floats | None, reach: float | None
) -> Density | Atlas | Mixture | None:
    """C around a pose, or over the whole sensor; None where the sensor sees nothing of it."""
    observation = view.observation
    if isinstance(observation.pattern, PointPattern) and len(observation.pattern.points) <= FEW:
        return observation.matched_near(sigma, None)
    if near is None:
        return observation.matched(sigma, (view.sensor.lower, view.sensor.upper))
    y, visible = view.sensor.project(transform(near, body.nodes.points))
    if not visible.any():
        return None
    if reach is not None or isinstance(observation.pattern, PointPattern):
        exact = observation.matched_near(sigma, y, reach or TILE_REACH)
        if exact is not None:
            return exact
    box = region_of_interest(view.sensor, y[visible], REACH * np.sqrt(2) * sigma)
    return observation.matched(sigma, box)
