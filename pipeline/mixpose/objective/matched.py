"""The matched objective: one number from predicted features and densities.

For sensor l let g be the observed density and h the predicted one, a mixture of the projected
features p_i(β) with the observation's own blur σ.  The share of g that h explains once its
amplitude is solved for (variable projection) is S_l = ⟨g, h⟩² / (⟨g, g⟩ ⟨h, h⟩), and the objective
is Σ_l ω_l S_l.  Let C be g blurred once more by σ, an image that `cv2.remap` looks up.  With
c = ⟨g, h⟩ = Σ_i w_i C(p_i), n = ⟨h, h⟩ = Σ_ij w_i w_j N(p_i − p_j; 0, v), v = 2σ², and the
amplitude a = c / n that fits h to g best,

    S = c a,     ∇S = 2 a (∇c − a ∇n / 2).

Curvatures are never negative.  Where predicted features lie apart it is that of mean-shift,
2 a Σ_i w_i C_i J_iᵀ J_i / v.  A Gaussian around a detection at y_i has ∇C = C (y_i − p_i) / v, so
that the step is that of least squares to the detections around the features, with weights C_i: one
step suffices from any distance, and a feature without a detection does not hold the others back.
Where features overlap it is Gauss-Newton's of the residual g − a h,
2 a² (⟨∂h, ∂hᵀ⟩ − ⟨h, ∂h⟩⟨h, ∂hᵀ⟩ / n).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from mixpose.body import Body
from mixpose.density import (
    DRAWING,
    Atlas,
    all_pairs,
    close_pairs,
    matched_atlas,
    pairs_by_picture,
    peak,
)
from mixpose.objective.projection import BodyProjection, Match, View, project_body
from mixpose.optimise import Quadratic
from mixpose.records import Floats, Indices, Mask, replace

_NONE = np.finfo(np.float64).tiny  # ⟨h, h⟩ of a sensor that sees no feature
STEPS_PER_SIGMA, FINE_STEPS = DRAWING.steps_per_sigma, DRAWING.fine_steps


def value_error(steps_per_sigma: float) -> float:
    """Return the relative error of values: √3/216 n⁻³ of two third derivatives, of squares."""
    return 4 * 0.011 / steps_per_sigma**3


def overlaps(
    y: Floats, weights: Floats, variances: Floats, tops: Floats
) -> tuple[Floats, Indices, Floats, Floats]:
    """Return ⟨h, h⟩, and `pairs`, `bells` and `away` of `Match`, of features y (L, H, n, 2).

    They have weights (L, H, n); `variances` and `tops` (L, 1) are v and N(0; 0, v).
    """
    norm, n = tops * np.vecdot(weights, weights), y.shape[2]
    if n * n <= DRAWING.few_pairs:
        pairs = all_pairs(n)
    else:
        pairs = close_pairs(y.reshape(-1, n, 2), variances.repeat(y.shape[1]))
    i, j = pairs.T
    away = y.take(i, axis=2) - y.take(j, axis=2)
    exponents = np.vecdot(away, away) * (-0.5 / variances)[..., None]
    overlap = exponents > -DRAWING.negligible
    if not np.count_nonzero(overlap):
        return np.maximum(norm, _NONE), pairs[:0], exponents[..., :0], away[:, :, :0]
    near = overlap.any(axis=(0, 1))
    if np.count_nonzero(near) < len(near):
        pairs, away = pairs[near], away[:, :, near]
        overlap, exponents = overlap[..., near], exponents[..., near]
    products = weights.take(pairs[:, 0], axis=2) * weights.take(pairs[:, 1], axis=2)
    bells = overlap * products * np.exp(exponents) * tops[..., None]
    return np.maximum(norm + 2 * bells.sum(axis=2), _NONE), pairs, bells, away


def norms(y: Floats, weights: Floats, variances: Floats, tops: Floats) -> Floats:
    """Return ⟨h, h⟩ (L, H) of `overlaps` alone, faster where few pairs of all overlap in a pose."""
    L, H, n = weights.shape
    if L * H == 1 or n * n <= DRAWING.few_pairs:
        return overlaps(y, weights, variances, tops)[0]
    flat_weights, variance = weights.reshape(-1), variances.repeat(H)
    picture, i, j = pairs_by_picture(y.reshape(-1, n, 2), variance)
    i, j = n * picture + i, n * picture + j
    away = y.reshape(-1, 2).take(i, axis=0) - y.reshape(-1, 2).take(j, axis=0)
    bells = np.exp(np.vecdot(away, away) * (-0.5 / variance)[picture])
    crossed = np.bincount(picture, flat_weights[i] * flat_weights[j] * bells, L * H).reshape(L, H)
    return np.asarray(np.maximum(tops * (np.vecdot(weights, weights) + 2 * crossed), _NONE))


def slopes(match: Match, variances: Floats, tops: Floats, scales: Floats) -> Quadratic:
    """Return second-order models of Σ_l s_l c_l² / n_l at H poses.

    `variances`, `tops` and `scales` (L, 1) are v, N(0; 0, v), and the factor s of each sensor.
    """
    L, H, n = match.weights.shape
    weighed = match.sampled * match.weights[..., None]
    pull = weighed[..., 1:].reshape(L, H, 1, 2 * n)
    product_gradient = (pull @ match.J.reshape(L, H, 2 * n, 6))[:, :, 0]
    product = np.vecdot(match.sampled[..., 0], match.weights)
    amplitude = product / match.norm
    strength = 2 * scales * amplitude
    value = 0.5 * np.vecdot(strength.T, product.T)
    gradient = (strength[..., None] * product_gradient).sum(axis=0)
    drawn = (strength / variances)[..., None] * weighed[..., 0]
    curvature = _gram(match.J, drawn[..., None, None] * match.J).sum(axis=0)
    if not len(match.pairs):
        return Quadratic(value, gradient, curvature)
    (near,) = np.logical_or.reduce(match.bells, axis=(0, 2)).nonzero()
    overlapping = match if len(near) == H else match.of(near)
    J_i, J_j = (overlapping.J.take(column, axis=2) for column in overlapping.pairs.T)
    scaled = (overlapping.bells / variances[..., None])[..., None]
    apart = scaled * overlapping.away
    # ⟨h, ∂h⟩ (L, h, 6) and ⟨∂h, ∂hᵀ⟩ (L, h, 6, 6): of each feature with itself, and of pairs
    rows = L, len(near), 2 * len(overlapping.pairs)
    half = (apart.reshape(*rows, 1).swapaxes(2, 3) @ (J_j - J_i).reshape(*rows, 6))[:, :, 0]
    along_j = overlapping.away[..., None, :] @ J_j
    weighted_J = overlapping.J * overlapping.weights[..., None, None]
    gram = _gram(weighted_J, weighted_J) * (tops / variances)[..., None, None]
    bent = (apart / variances[..., None, None])[..., None] * along_j
    cross = _gram(J_i, scaled[..., None] * J_j - bent)
    gram += cross + cross.swapaxes(2, 3)
    level = (strength * amplitude)[:, near, None]
    gradient[near] -= (level * half).sum(axis=0)
    outer = half[..., :, None] * half[..., None, :] / overlapping.norm[..., None, None]
    curvature[near] = (level[..., None] * (gram - outer)).sum(axis=0)
    return Quadratic(value, gradient, curvature)


def _gram(A: Floats, B: Floats) -> Floats:
    """Return Σ_p A_pᵀ B_p (L, H, 6, 6) of A and B (L, H, P, 2, 6)."""
    L, H, P = A.shape[:3]
    return A.reshape(L, H, 2 * P, 6).swapaxes(2, 3) @ B.reshape(L, H, 2 * P, 6)


@dataclass(frozen=True, eq=False)
class MatchedObjective:
    """Σ_l ω_l ⟨g_l, h_l⟩² / (⟨g_l, g_l⟩ ⟨h_l, h_l⟩) over the pose.

    Of K bodies at once (`together`), at poses (K, 4, 4).  Spreads Σ_i of features do not widen the
    prediction, as a template wider than the data is biased (see `docs/method.md`).
    """

    views: tuple[View, ...]
    projection: BodyProjection
    atlas: Atlas  # C of all sensors
    variances: Floats  # (L, 1) v = 2σ², of the product of two features, in squared sensor units
    tops: Floats  # (L, 1) N(0; 0, v)
    energies: Floats  # (L, 1) ⟨g, g⟩; (L, K) of several bodies, by the detections of each
    weights: Floats  # (L, 1) ω_l; (L, K)
    # a pose and its match, if it was looked up together with those of other bodies
    known: tuple[Floats, Match] | None = None
    # the last match, if any: a pose is first tested for being near, and then climbed from
    last: list[Match] = field(default_factory=list, repr=False)

    def value(self, T_world_object: Floats) -> Floats:
        """Return values (...,) at poses (..., 4, 4)."""
        poses = T_world_object.reshape(-1, 4, 4)
        return np.asarray(self.shares(poses).sum(axis=0).reshape(T_world_object.shape[:-2]))

    def shares(self, poses: Floats, *, whole: bool = False) -> Floats:
        """Return ω_l S_l (L, H) at poses (H, 4, 4).

        With `whole`, features out of view count as predicted and not met: otherwise a pose gains by
        moving missed features out of the image.
        """
        parts, v_and_tops = [np.zeros((len(self.views), 0))], (self.variances, self.tops)
        for block in self._blocks(poses):
            if len(block) == 1:  # it may be climbed from next
                match = self.match(block)
            else:
                match = self.projection.project(block)
                norm = norms(match.y, match.weights, *v_and_tops)
                match = match._replace(sampled=self.atlas.look_up(match.y), norm=norm)
            product = np.vecdot(match.sampled[..., 0], match.weights)
            terms = self.weights / self.energies * product**2 / match.norm
            if whole:
                hidden = np.where(match.seen, 0.0, self.projection.body.nodes.weights)
                terms = terms * (match.norm / (match.norm + self.tops * np.vecdot(hidden, hidden)))
            parts.append(terms)
        return np.concatenate(parts, axis=1)

    @cached_property
    def are_grids(self) -> Mask:
        """Mask (L,) of sensors whose density is a grid of values instead of detections."""
        return np.array([view.observation.cell is not None for view in self.views])

    def in_nats(self, precisions: Floats) -> MatchedObjective:
        """Return the objective in nats, for noise of precisions σ²/s² (L,) in units of the blur.

        One of n features met that is off by r takes r²/(2 n σ²) from a share S_l.
        """
        weights = self.weights * len(self.projection.body.features)
        return replace(self, weights=weights * precisions[:, None])

    def match(self, poses: Floats) -> Match:
        """Project the body at poses (H, 4, 4) and look up the densities there."""
        if self.known and len(poses) == 1 and np.array_equal(poses[0], self.known[0]):
            return self.known[1]
        match, last = self.projection.project(poses), self.last
        if not (last and last[0].y is match.y):
            sampled = self.atlas.look_up(match.y)
            overlap = overlaps(match.y, match.weights, self.variances, self.tops)
            last[:] = [Match(*match[:5], sampled, *overlap)]
        return last[0]

    def linearise(self, poses: Floats) -> Quadratic:
        """Return second-order models at poses (H, 4, 4)."""
        arguments = self.variances, self.tops, self.weights / self.energies
        parts = [slopes(self.match(block), *arguments) for block in self._blocks(poses)]
        if len(parts) == 1:
            return parts[0]
        return Quadratic(*map(np.concatenate, zip(*(part[:3] for part in parts))))

    def split(self, parts: Sequence[MatchedObjective], poses: Floats) -> list[MatchedObjective]:
        """Return the objectives put `together`, with the match of each at its pose (K, 4, 4)."""
        match = self.match(poses)
        return [
            replace(objective, known=(T, match.of(slice(k, k + 1), len(body.nodes.points))))
            for k, (objective, T, body) in enumerate(zip(parts, poses, self.projection.bodies))
        ]

    def _blocks(self, poses: Floats) -> list[Floats]:
        n = len(self.projection.body.nodes.points)
        rows = max(DRAWING.held // (n * min(n, 12)), len(self.projection.bodies))
        return [poses[k : k + rows] for k in range(0, len(poses), rows)]


class SharedDensities:
    """C of all sensors at σ_ε, drawn once for several bodies; views are not empty."""

    def __init__(self, views: Sequence[View]) -> None:
        observations = [view.observation for view in views]
        self.atlas = matched_atlas(observations, [o.sigma for o in observations], STEPS_PER_SIGMA)
        self.totals = [o.weight for o in observations]  # of all detections, by sensor


def matched_objective(
    views: Sequence[View],
    body: Body,
    sigmas: Sequence[float],
    *,
    steps_per_sigma: float | None = None,
    shared: SharedDensities | None = None,
) -> MatchedObjective:
    """Build the matched objective of views that are not empty.

    Features have standard deviations `sigmas`, by view in sensor units, each of `steps_per_sigma`
    cells of C; None: fine for grey values at σ_ε.  If densities at σ_ε are `shared` with other
    bodies, views hold the detections of this body, and others that are out of its reach.
    """
    observations = [view.observation for view in views]
    pairs = list(zip(observations, sigmas, strict=True))
    if steps_per_sigma is None:
        is_finest = all(o.cell is not None and sigma <= o.sigma for o, sigma in pairs)
        steps_per_sigma = FINE_STEPS if is_finest else STEPS_PER_SIGMA
    projection = project_body(tuple([view.sensor for view in views]), body)
    energies = np.array([[o.energy(sigma)] for o, sigma in pairs])
    variances = np.array([[2 * sigma * sigma] for sigma in sigmas])
    tops = peak(variances, projection.dimensions[:, None])
    # ω_l: the number of equal features with this energy, per feature of the body, so that clutter
    # in a sensor does not take weight from its true features
    weights = tops / energies / len(body.features)
    if shared is None:
        atlas = matched_atlas(observations, sigmas, steps_per_sigma)
    else:
        atlas = shared.atlas
        parts = [[o.weight / total] for o, total in zip(observations, shared.totals, strict=True)]
        energies = energies * np.square(parts)
    return MatchedObjective(tuple(views), projection, atlas, variances, tops, energies, weights)


def together(objectives: Sequence[MatchedObjective]) -> MatchedObjective:
    """Join the objectives of several bodies, of bare points, on the same densities and blurs."""
    bodies = [objective.projection.body for objective in objectives]
    projection = project_body(objectives[0].projection.sensors, *bodies)
    return replace(
        objectives[0],
        projection=projection,
        energies=np.concatenate([objective.energies for objective in objectives], axis=1),
        weights=np.concatenate([objective.weights for objective in objectives], axis=1),
    )
