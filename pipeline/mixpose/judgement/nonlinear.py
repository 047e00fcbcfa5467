"""Covariances whose ellipsoids hold the pose although images are not linear in its turns.

A covariance is the curvature of the likelihood at the pose, which is not enough for wide turns: the
origin goes along an arc, and away from the pose the likelihood may fall more slowly, as of a flat
body that nearly faces its one camera, where turns to either side look almost alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

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


class Curved(NamedTuple):
    """A pose with the covariance of its curvature, and what it meets."""

    covariance: Floats  # (6, 6)
    T_world_object: Floats  # (4, 4)
    seen: Matches  # at the pose, of the sensors that took part
    variances: Floats  # (L,) of their noise, σ_ε²
    projection: BodyProjection  # of these sensors


def with_likely_turns(poses: Sequence[Curved], free: Mask) -> list[Floats]:
    """Return covariances (6, 6) whose ellipsoids of 99.9 % hold all turns as likely as their edges.

    Turns are tried on rays in the plane of the two that are least known, with the other directions
    at their likeliest; those of equal bodies in the same sensors all at once.  If a twist x as
    likely as the edge is m > h squared deviations away, h at the edge, the covariance grows by
    (1/h − 1/m) x xᵀ, which puts x on the edge.
    """
    covariances, equal = [pose.covariance for pose in poses], dict[BodyProjection, list[int]]()
    for k, pose in enumerate(poses):
        if _is_wide(pose.covariance):
            equal.setdefault(pose.projection, []).append(k)
    angles = np.arange(_RAYS) * (2 * np.pi / _RAYS)
    rays = math.sqrt(_HELD) * np.array([np.cos(angles), np.sin(angles)]).T
    tried = (rays[:, None] * _REACHES[:, None]).reshape(-1, 2)
    for group in equal.values():
        wide, turns = _Turns.about([poses[k] for k in group], free)
        if turns is None:
            continue
        fallen, states = turns.fallen(tried)
        away = fallen.reshape(-1, _RAYS, len(_REACHES))
        likely = away[..., 0] < _HELD
        beyond = np.append(away, np.full((*likely.shape, 1), np.inf), axis=2) >= _HELD
        last = np.maximum(np.argmax(beyond, axis=2) - 1, 0)[..., None, None, None]
        reached = states.reshape(*away.shape, 4, 4)
        ends = np.take_along_axis(reached, last, axis=2)[:, :, 0]
        for j in np.flatnonzero(likely.any(axis=1)).tolist():
            pose = poses[k := group[wide[j]]]
            twists = twist_between(pose.T_world_object, ends[j, likely[j]])
            covariances[k] = _holding(covariances[k], twists[:, free], free)
    return covariances


def _holding(covariance: Floats, twists: Floats, free: Mask) -> Floats:
    """Return a covariance (6, 6) that grows until its ellipsoid holds free twists (K, k)."""
    wider, inner = covariance.copy(), np.ix_(free, free)
    inverse = inverted(wider[inner])
    for x in twists:
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
    """The likelihood near poses of B equal bodies, a term of steps along axes of each.

    The first two axes turn the body.
    """

    poses: Floats  # (B, 4, 4)
    observed: Floats  # (B, L, N, 2) places, σ_ε
    roots: Floats  # (B, R) of the weights of offsets, R = 2 L N
    projection: BodyProjection
    sigmas: Floats  # (L, 1, 1) σ_ε in sensor units
    axes: Floats  # (B, 6, k) twists of a standard deviation each
    curvature: Floats  # (B, 2, 2) of −2 ln p by the two turns at the pose, of noise that is known
    at_pose: Floats  # (B,) values of ln p

    @classmethod
    def about(cls, poses: Sequence[Curved], free: Mask) -> tuple[list[int], _Turns | None]:
        """Choose axes by the turns that are least known, at poses where these are wide enough.

        Returns the numbers of these poses, too; None where there are none.
        """
        covariances = np.array([pose.covariance for pose in poses])[:, free][..., free]
        scales = np.sqrt(np.maximum(np.einsum("bkk->bk", covariances), 1e-300))
        values, vectors = np.linalg.eigh(covariances / (scales[..., None] * scales[:, None]))
        deviations = np.zeros((len(poses), 6, scales.shape[1]))
        roots = np.sqrt(np.maximum(values, 1e-12))
        deviations[:, free] = scales[..., None] * vectors * roots[:, None]
        _, turns, across = np.linalg.svd(deviations[:, 3:])
        wide = np.flatnonzero(turns[:, 0] > _LEAST_TURN).tolist() if scales.shape[1] > 2 else []
        if not wide:
            return wide, None
        chosen = [poses[k] for k in wide]
        axes = deviations[wide] @ across[wide].swapaxes(1, 2)
        return wide, cls._along(axes, chosen)

    @classmethod
    def _along(cls, axes: Floats, poses: Sequence[Curved]) -> _Turns:
        """Return the likelihood near poses by steps along axes (B, 6, k)."""
        seen, B = [pose.seen for pose in poses], len(poses)
        variances = np.array([pose.variances[:, None] + pose.seen.extra for pose in poses])
        weights = np.array([matches.shares for matches in seen]) / variances
        roots = np.sqrt(weights).reshape(B, -1).repeat(2, axis=1)
        offsets = np.array([matches.offsets for matches in seen])
        sigmas = seen[0].sigmas[:, None, None]
        observed = np.array([matches.places for matches in seen]) / sigmas + offsets
        J = roots[..., None] * (np.array([m.J for m in seen]).reshape(B, -1, 6) @ axes)
        H = J.swapaxes(1, 2) @ J
        turned, crossed = H[:, :2, :2], H[:, :2, 2:]
        curvature = turned - crossed @ np.linalg.pinv(H[:, 2:, 2:]) @ crossed.swapaxes(1, 2)
        at_pose = -0.5 * ((roots * offsets.reshape(B, -1)) ** 2).sum(axis=1)
        T, projection = np.array([pose.T_world_object for pose in poses]), poses[0].projection
        return cls(T, observed, roots, projection, sigmas, axes, curvature, at_pose)

    def fallen(self, turns: Floats) -> tuple[Floats, Floats]:
        """Return the increase (B, K) of −2 ln p at turns (K, 2), in deviations, and poses there.

        It is scaled to the noise of the covariance, which is wider than that of the curvature.
        Poses are (B, K, 4, 4).
        """
        (B, _, count), K = self.axes.shape, len(turns)
        twists = self.axes.swapaxes(1, 2)
        begun = perturb(self.poses[:, None], turns @ twists[:, :2])

        def moved(T: Floats, steps: Floats) -> Floats:
            return perturb(T, (steps.reshape(B, K, count) @ twists).reshape(-1, 6))

        ends = stepped(self, begun.reshape(-1, 4, 4), moved, np.arange(count) > 1, _STEPS)
        wide = np.linalg.norm(turns @ twists[:, :2, 3:], axis=2) > _WIDEST_TURN
        # wide turns may be without curvature
        known = np.where(wide, np.inf, np.vecdot(turns @ self.curvature, turns))
        values = ends.values.reshape(B, K)
        fallen = 2 * (self.at_pose[:, None] - values) * (np.vecdot(turns, turns) / known)
        return np.where(wide, np.inf, fallen), ends.states.reshape(B, K, 4, 4)

    def linearise(self, states: Floats) -> Quadratic:
        """Return models of ln p at poses (B K, 4, 4), by the detections that each pose meets."""
        match, (B, rows) = self.projection.project(states), self.roots.shape
        y, J = (of_sensors.swapaxes(0, 1) for of_sensors in (match.y, match.J))
        r = self.observed[:, None] - (y / self.sigmas).reshape(B, -1, *self.observed.shape[1:])
        r = self.roots[:, None] * r.reshape(B, -1, rows)
        J = (J / self.sigmas[..., None]).reshape(B, -1, 6) @ self.axes
        J = self.roots[:, None, :, None] * J.reshape(B, -1, rows, J.shape[2])
        return squares_of(r.reshape(-1, rows), J.reshape(-1, *J.shape[2:]))
