"""Many poses at once descend through narrowing blurs, fewer at each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.rigid import perturb, transform
from mixpose.search.levels import Level, levels
from mixpose.search.scoring import scores, slopes
from mixpose.search.sightings import Sighting

Floats: TypeAlias = NDArray[np.float64]

_DAMPING = 1e-3
_LONGEST_TURN = 0.35  # rad in one step: farther the linear model holds no longer
_MOST_CELLS = 1_000_000  # of pairs of predicted features in memory at once
_SAME = 0.01  # of the radius, grid on which poses during a descent are one
_ALIKE = 0.03  # of the radius: root mean square distance of features of poses that are one


@dataclass(frozen=True)
class Stage:
    """One blur of a descent.

    Attributes
    ----------
    factors : sequence of float
        Blur per sighting, as a multiple of its σ_ε.
    steps : int
    survivors : int
        How many poses go on.
    """

    factors: Sequence[float]
    steps: int
    survivors: int


def descend(
    sightings: Sequence[Sighting],
    body: Body,
    poses: Floats,
    stages: Sequence[Stage],
    free: NDArray[np.bool_],
) -> Floats:
    """Refine poses stage by stage.

    Parameters
    ----------
    sightings : sequence of Sighting
    body : Body
    poses : (H, 4, 4) array
    stages : sequence of Stage
    free : (6,) bool
        Directions that may change.

    Returns
    -------
    (K, 4, 4) array
        The poses left, best first: by the cosine between observed and predicted densities,
        summed over sensors.
    """
    rows = max(_MOST_CELLS // len(body.nodes.points) ** 2, 1)
    for stage in stages:
        blurred = levels(sightings, stage.factors, len(body))
        for _ in range(stage.steps):
            chunks = [
                _stepped(blurred, body, poses[start : start + rows], free)
                for start in range(0, len(poses), rows)
            ]
            poses = np.concatenate(chunks) if chunks else poses
        # a sum of shares k/n, not of their squares: what counts is how many features are met
        values = np.sqrt(scores(blurred, body, poses, whole=True)).sum(axis=0)
        order = np.argsort(-values, kind="stable")
        order = order[unlike(body, poses[order], _SAME)][: stage.survivors]
        poses = poses[order]
    return poses


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


def _stepped(
    blurred: Sequence[Level], body: Body, poses: Floats, free: NDArray[np.bool_]
) -> Floats:
    """One damped Newton step of every pose."""
    model = slopes(blurred, body, poses)
    A = model.curvature[:, free][:, :, free]
    b = model.gradient[:, free]
    diagonal = np.einsum("hkk->hk", A)
    largest = diagonal.max(axis=1, keepdims=True)
    scale = 1 / np.sqrt(np.maximum(diagonal, 1e-12 * largest + np.finfo(np.float64).tiny))
    A = A * scale[:, :, None] * scale[:, None, :] + _DAMPING * np.eye(A.shape[1])
    twists = np.zeros((len(poses), 6))
    twists[:, free] = scale * np.linalg.solve(A, (scale * b)[..., None])[..., 0]
    twists[largest[:, 0] <= 0] = 0.0
    turn = np.linalg.norm(twists[:, 3:], axis=1)
    shift = np.linalg.norm(twists[:, :3], axis=1) / max(body.radius, 1e-12)
    longest = np.maximum(turn, _LONGEST_TURN / 2 * shift)
    twists *= np.minimum(1.0, _LONGEST_TURN / np.maximum(longest, 1e-12))[:, None]
    return perturb(poses, twists)


def first_of_each(body: Body, poses: Floats, values: Floats, count: int) -> list[int]:
    """Indices of the best poses, no two of which put the features in about the same places.

    Parameters
    ----------
    body : Body
    poses : (H, 4, 4) array
    values : (H,) array
    count : int
    """
    points = body.means
    kept: list[int] = []
    images: list[Floats] = []
    for k in np.argsort(-values, kind="stable"):
        here = transform(poses[k], points)
        if all(
            np.sqrt(((here - image) ** 2).sum(axis=-1).mean(axis=-1)).min() > _ALIKE * body.radius
            for image in images
        ):
            kept.append(int(k))
            images.append(transform(poses[k] @ body.symmetries, points))
        if len(kept) == count:
            break
    return kept
