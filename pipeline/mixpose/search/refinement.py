"""Many poses at once descend through narrowing blurs, fewer at each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.objective import MatchedObjective, View, matched_objective
from mixpose.optimise import NewtonOptions, ascend
from mixpose.records import Floats
from mixpose.rigid import perturb, transform
from mixpose.search.budget import SearchBudget


class Stage(NamedTuple):
    """One blur of a descent: factors of σ_ε per sensor, steps at it, and how many poses go on."""

    factors: tuple[float, ...]
    steps: int
    survivors: int


@dataclass(frozen=True, eq=False)
class Descent:
    """Refines poses on the blurred observations of all sensors, which are drawn once per blur.

    Directions (6,) that are `free` may change.
    """

    views: Sequence[View]
    body: Body
    free: NDArray[np.bool_]
    budget: SearchBudget
    _objectives: dict[tuple[float, ...], MatchedObjective] = field(default_factory=dict)

    def objective(self, factors: tuple[float, ...] = ()) -> MatchedObjective:
        """The matched objective with features wider than σ_ε by factors per sensor; none: 1."""
        key = factors or (1.0,) * len(self.views)
        if key not in self._objectives:
            sigmas = [f * one.observation.sigma for f, one in zip(key, self.views, strict=True)]
            self._objectives[key] = matched_objective(self.views, self.body, sigmas)
        return self._objectives[key]

    def refine(self, poses: Floats, stages: Sequence[Stage]) -> Floats:
        """Refine poses (H, 4, 4) stage by stage.

        Returns
        -------
        (K, 4, 4) array
            The poses left.  Where they are too many, the best: by the cosine between observed and
            predicted densities, summed over sensors.
        """
        for stage in stages if len(poses) else ():
            objective = self.objective(stage.factors)
            if stage.steps:
                options = NewtonOptions(stage.steps, damping=self.budget.damping, unchecked=True)
                poses = ascend(objective, poses, self._moved, self.free, options).states
            if len(poses) > stage.survivors:
                # of shares k/n, not of their squares: what counts is how many features are met
                values = np.sqrt(objective.shares(poses, whole=True)).sum(axis=0)
                poses = poses[np.argsort(-values, kind="stable")]
            poses = poses[unlike(self.body, poses, self.budget.alike / 5)[: stage.survivors]]
        return poses

    def _moved(self, poses: Floats, twists: Floats) -> Floats:
        """Poses (H, 4, 4) moved by twists (H, 6), not farther than the linear model holds."""
        most = self.budget.max_turn
        shift, turn = (np.linalg.norm(each, axis=1) for each in (twists[:, :3], twists[:, 3:]))
        longest = np.maximum(turn, most / 2 * (shift / max(self.body.radius, 1e-12)))
        return perturb(poses, twists * np.minimum(1.0, most / np.maximum(longest, 1e-12))[:, None])


def unlike(body: Body, poses: Floats, cell: float) -> NDArray[np.intp]:
    """Indices, ascending, of poses (H, 4, 4) that do not put the body where an earlier one does.

    Places of features are one within cells whose side is a share `cell` of the body's radius.
    """
    corners = body.means[[0, len(body) // 2, -1]]
    places = transform(poses, corners).reshape(len(poses), corners.size)
    cells = np.round(places / (cell * body.radius)).astype(np.int64)
    keys = cells @ np.random.default_rng(0).integers(1, 2**40, cells.shape[1])
    return np.sort(np.unique(keys, return_index=True)[1])


def first_of_each(body: Body, poses: Floats, count: int, alike: float) -> list[int]:
    """Indices of the first `count` poses (H, 4, 4) that put the body somewhere else each.

    Poses are one where the root mean square distance of their features, symmetries aside, is less
    than a share `alike` of the body's radius.
    """
    kept: list[int] = []
    images: list[Floats] = []
    for k, pose in enumerate(poses):
        here = transform(pose, body.means)
        squares = [((here - image) ** 2).sum(axis=-1).mean(axis=-1).min() for image in images]
        if np.sqrt(min(squares, default=np.inf)) > alike * body.radius:
            kept.append(k)
            images.append(transform(pose @ body.symmetries, body.means))
        if len(kept) == count:
            break
    return kept
