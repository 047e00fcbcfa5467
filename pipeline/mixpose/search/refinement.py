"""Many poses at once descend through narrowing blurs, fewer at each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.objective import MatchedObjective, View, matched_objective
from mixpose.rigid import perturb, transform
from mixpose.search.budget import DescentOptions

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Stage:
    """One blur of a descent.

    Attributes
    ----------
    factors : tuple of float
        Blur per sensor, as a multiple of its σ_ε.
    steps : int
    survivors : int
        How many poses go on.
    """

    factors: tuple[float, ...]
    steps: int
    survivors: int


class Descent:
    """Refines poses on the blurred observations of all sensors, which are drawn once per blur.

    Parameters
    ----------
    views : sequence of View
    body : Body
    free : (6,) bool
        Directions that may change.
    options : DescentOptions
    """

    def __init__(
        self,
        views: Sequence[View],
        body: Body,
        free: NDArray[np.bool_],
        options: DescentOptions,
    ) -> None:
        self._views = views
        self._body = body
        self._free = free
        self._options = options
        self._objectives: dict[tuple[float, ...], MatchedObjective] = {}

    def objective(self, factors: Sequence[float] | None = None) -> MatchedObjective:
        """The matched objective with features wider than σ_ε by factors per sensor; None: 1."""
        key = tuple(factors or [1.0] * len(self._views))
        if key not in self._objectives:
            sigmas = [f * view.observation.sigma for f, view in zip(key, self._views, strict=True)]
            self._objectives[key] = matched_objective(self._views, self._body, sigmas)
        return self._objectives[key]

    def refine(self, poses: Floats, stages: Sequence[Stage]) -> Floats:
        """Refine poses (H, 4, 4) stage by stage.

        Returns
        -------
        (K, 4, 4) array
            The poses left.  Where they are too many, the best: by the cosine between observed and
            predicted densities, summed over sensors.
        """
        for stage in stages:
            objective = self.objective(stage.factors)
            for _ in range(stage.steps):
                poses = self._stepped(objective, poses)
            if len(poses) > stage.survivors:
                # of shares k/n, not of their squares: what counts is how many features are met
                values = np.sqrt(objective.shares(poses, whole=True)).sum(axis=0)
                poses = poses[np.argsort(-values, kind="stable")]
            poses = poses[unlike(self._body, poses, self._options.same)[: stage.survivors]]
        return poses

    def _stepped(self, objective: MatchedObjective, poses: Floats) -> Floats:
        """One damped Newton step of every pose."""
        if not len(poses):
            return poses
        model, free = objective.slopes(poses), self._free
        A = model.curvature[:, free][:, :, free]
        b = model.gradient[:, free]
        diagonal = np.einsum("hkk->hk", A)
        largest = diagonal.max(axis=1, keepdims=True)
        tiny = np.finfo(np.float64).tiny
        scale = 1 / np.sqrt(np.maximum(diagonal, 1e-12 * largest + tiny))
        A = A * scale[:, :, None] * scale[:, None, :] + self._options.damping * np.eye(A.shape[1])
        twists = np.zeros((len(poses), 6))
        twists[:, free] = scale * np.linalg.solve(A, (scale * b)[..., None])[..., 0]
        twists[largest[:, 0] <= 0] = 0.0
        turn = np.linalg.norm(twists[:, 3:], axis=1)
        shift = np.linalg.norm(twists[:, :3], axis=1) / max(self._body.radius, 1e-12)
        most = self._options.max_turn
        longest = np.maximum(turn, most / 2 * shift)
        twists *= np.minimum(1.0, most / np.maximum(longest, 1e-12))[:, None]
        return perturb(poses, twists)


def unlike(body: Body, poses: Floats, cell: float) -> NDArray[np.intp]:
    """Indices, ascending, of poses that do not put the features where an earlier one does.

    Parameters
    ----------
    body : Body
    poses : (H, 4, 4) array
    cell : float
        Side of the cells in which places are one, as a share of the body's radius.
    """
    corners = body.means[[0, len(body) // 2, -1]]
    places = transform(poses, corners).reshape(len(poses), corners.size)
    cells = np.round(places / (cell * body.radius)).astype(np.int64)
    keys = cells @ np.random.default_rng(0).integers(1, 2**40, cells.shape[1])
    return np.sort(np.unique(keys, return_index=True)[1])


def first_of_each(body: Body, poses: Floats, values: Floats, count: int, alike: float) -> list[int]:
    """Indices of the best poses, no two of which put the features in about the same places.

    Parameters
    ----------
    body : Body
    poses : (H, 4, 4) array
    values : (H,) array
    count : int
    alike : float
        Root mean square distance of features of poses that are one, as a share of the radius.
    """
    points = body.means
    kept: list[int] = []
    images: list[Floats] = []
    for k in np.argsort(-values, kind="stable"):
        here = transform(poses[k], points)
        if all(
            np.sqrt(((here - image) ** 2).sum(axis=-1).mean(axis=-1)).min() > alike * body.radius
            for image in images
        ):
            kept.append(int(k))
            images.append(transform(poses[k] @ body.symmetries, points))
        if len(kept) == count:
            break
    return kept
