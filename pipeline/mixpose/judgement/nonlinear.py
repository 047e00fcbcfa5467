"""Covariances whose ellipsoids hold the pose although images are not linear in its turns.

A covariance is the curvature of the likelihood at the pose, which is not enough for wide turns: the
origin goes along an arc, and away from the pose the likelihood may fall more slowly, as of a flat
body that nearly faces its one camera, where turns to either side look almost alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtri

from mixpose.judgement.information import inverted
from mixpose.matching import Matches
from mixpose.objective import BodyProjection
from mixpose.optimise import Quadratic, squares_of, stepped
from mixpose.records import Floats, Mask
from mixpose.rigid import cross, perturb, twist_between

_LEAST_TURN = 0.01  # rad: the origin leaves its tangent by 5e-5 of its lever
_WIDEST_TURN = 1.0  # rad: a wider turn is another pose
_HELD = float(chdtri(6, 1e-3))  # squared deviations of the ellipsoid of 99.9 %
_RAYS = 12
# on each ray, from the edge of that ellipsoid to twice as far: going eight times as far finds no
# more of boards, triangles and bars at 4 to 40 times their size
_REACHES = np.array([1.0, 1.4, 2.0])
_STEPS = 3
_PAIRS_OF_AXES = np.triu_indices(3)


def with_likely_turns(
    covariance: Floats,  # (6, 6)
    T_world_object: Floats,  # (4, 4)
    seen: Matches,  # at the pose, of the sensors that took part
    variances: Floats,  # (L,) of their noise, σ_ε²
    projection: BodyProjection,  # of these sensors
    free: Mask,
) -> Floats:
    """Return a covariance (6, 6) whose ellipsoid of 99.9 % holds all turns as likely as its edge.

    Turns are tried on rays in the plane of the two that are least known, with the other directions
    at their likeliest.  If a twist x as likely as the edge is m > h squared deviations away, h at
    the edge, the covariance grows by (1/h − 1/m) x xᵀ, which puts x on the edge.
    """
    if not _is_wide(covariance):
        return covariance
    about = _Turns.about(covariance, T_world_object, seen, variances, projection, free)
    if about is None:
        return covariance
    angles = np.arange(_RAYS) * (2 * np.pi / _RAYS)
    rays = math.sqrt(_HELD) * np.array([np.cos(angles), np.sin(angles)]).T
    fallen, poses = about.fallen((rays[:, None] * _REACHES[:, None]).reshape(-1, 2))
    away = np.append(fallen.reshape(_RAYS, -1), np.full((_RAYS, 1), np.inf), axis=1)
    likely = away[:, 0] < _HELD
    last = np.maximum(np.argmax(away >= _HELD, axis=1) - 1, 0)
    ends = poses.reshape(_RAYS, -1, 4, 4)[np.arange(_RAYS), last][likely]
    wider, inner = covariance.copy(), np.ix_(free, free)
    inverse = inverted(wider[inner])
    for x in twist_between(T_world_object, ends)[:, free]:
        by = inverse @ x
        if (m := float(x @ by)) > _HELD:
            wider[inner] += (1 / _HELD - 1 / m) * np.outer(x, x)
            inverse -= (1 / m - _HELD / m**2) * np.outer(by, by)  # Sherman and Morrison
    return wider


def with_wide_turn(covariance: Floats, T_world_object: Floats, points: Floats) -> Floats:
    """Return a covariance (6, 6), enlarged if turns are so wide that the origin goes along an arc.

    By a turn ω about the middle of the features (N, 3) the origin, l away, goes by ω × l, but for
    ω × (ω × l)/2 towards the axis and ω³ l/6 back.  At the 3.3 σ of 99.9 % these are 5.4 σ² l and
    6 σ³ l: 2.7 deviations of 4 σ⁴ l² and 5 σ⁶ l², which an ellipsoid of six dimensions (4.7) still
    holds.  Turns about two axes at once are as wide together: half as much of their product.
    """
    if not _is_wide(covariance):
        return covariance
    variances, axes = np.linalg.eigh(covariance[3:, 3:])
    lever = -T_world_object[:3, :3] @ points.mean(axis=0)
    along = cross(axes, lever[:, None])
    twice = cross(axes[:, :, None], along[:, None])  # about an axis, then about another one
    wider, deviations = covariance.copy(), np.sqrt(np.maximum(variances, 0.0))
    a, b = _PAIRS_OF_AXES
    inwards = deviations[a] * deviations[b] * (twice[:, a, b] + twice[:, b, a])
    back = math.sqrt(5) * deviations**3 * along
    wider[:3, :3] += inwards @ inwards.T + back @ back.T
    return wider


def _is_wide(covariance: Floats) -> bool:
    """Test whether turns are so uncertain that images are not linear in them, yet not unknown."""
    return bool(_LEAST_TURN**2 < np.trace(covariance[3:, 3:]) < math.inf)


@dataclass(frozen=True)
class _Turns:
    """The likelihood near a pose, a term of steps along axes, the first two of which turn it."""

    T_world_object: Floats
    seen: Matches
    roots: Floats  # (R,) of the weights of offsets, R = 2 L N
    projection: BodyProjection
    axes: Floats  # (6, k) twists of a standard deviation each
    curvature: Floats  # (2, 2) of −2 ln p by the two turns at the pose, of noise that is known

    @classmethod
    def about(
        cls,
        covariance: Floats,
        T_world_object: Floats,
        seen: Matches,
        variances: Floats,
        projection: BodyProjection,
        free: Mask,
    ) -> _Turns | None:
        """Choose axes by the turns that are least known; None if no turn is wide enough."""
        inner = np.ix_(free, free)
        scale = np.sqrt(np.maximum(covariance[inner].diagonal(), 1e-300))
        values, vectors = np.linalg.eigh(covariance[inner] / np.outer(scale, scale))
        deviations = np.zeros((6, len(scale)))
        deviations[free] = scale[:, None] * vectors * np.sqrt(np.maximum(values, 1e-12))
        _, turns, across = np.linalg.svd(deviations[3:])
        if not turns[0] > _LEAST_TURN or len(scale) < 3:
            return None
        axes = deviations @ across.T
        roots = np.sqrt(seen.shares / (variances[:, None] + seen.extra)).ravel().repeat(2)
        J = roots[:, None] * (seen.J.reshape(-1, 6) @ axes)
        H = J.T @ J
        curvature = H[:2, :2] - H[:2, 2:] @ np.linalg.pinv(H[2:, 2:]) @ H[2:, :2]
        return cls(T_world_object, seen, roots, projection, axes, curvature)

    def fallen(self, turns: Floats) -> tuple[Floats, Floats]:
        """Return the increase (K,) of −2 ln p at turns (K, 2), in deviations, and poses (K, 4, 4).

        It is scaled to the noise of the covariance, which is wider than that of the curvature.
        """
        rest = np.arange(self.axes.shape[1]) > 1
        begun = perturb(self.T_world_object, turns @ self.axes[:, :2].T)
        ends = stepped(self, begun, lambda T, steps: perturb(T, steps @ self.axes.T), rest, _STEPS)
        wide = np.linalg.norm(turns @ self.axes[3:, :2].T, axis=1) > _WIDEST_TURN
        # wide turns may be without curvature
        known = np.where(wide, np.inf, np.vecdot(turns @ self.curvature, turns))
        fallen = 2 * (self._at_pose - ends.values) * (np.vecdot(turns, turns) / known)
        return np.where(wide, np.inf, fallen), ends.states

    @cached_property
    def _at_pose(self) -> float:
        """Value of ln p at the pose."""
        return -0.5 * float(np.sum((self.roots * self.seen.offsets.ravel()) ** 2))

    def linearise(self, states: Floats) -> Quadratic:
        """Return models of ln p at poses (K, 4, 4), by the detections that the pose meets."""
        match, seen = self.projection.project(states), self.seen
        sigmas = seen.sigmas[:, None, None]
        r = (seen.places - match.y.swapaxes(0, 1)) / sigmas + seen.offsets
        J = (match.J.swapaxes(0, 1) / sigmas[..., None]).reshape(len(states), -1, 6)
        return squares_of(
            self.roots * r.reshape(len(states), -1), self.roots[:, None] * (J @ self.axes)
        )
