"""Several starts around a guess, for frames where one descent does not convince.

With clutter or hidden features the coarsest blurs can lead astray.  Poses drawn from the
uncertainty of the guess are scored at a medium blur, all at once, and the best of them are worth
a descent of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body, uniforms
from mixpose.estimation.annealing import ladder
from mixpose.objective import View, matched_objective
from mixpose.rigid import perturb

Floats: TypeAlias = NDArray[np.float64]

DRAWN = 512
KEPT = 5
NARROWING = 3.0
"""How much narrower a blur than the uncertainty the candidates are scored at, and start from."""


def starts_around(
    views: Sequence[View], body: Body, T_guess: Floats, uncertainty: Floats, *, seed: int
) -> list[Floats]:
    """The most promising poses around a guess, best first.

    Parameters
    ----------
    views : sequence of View
        At least one, none with an empty observation.
    body : Body
    T_guess : (4, 4) array
    uncertainty : (6,) array
        Standard deviations of the guess; zero for directions that are not free.
    seed : int

    Returns
    -------
    list of (4, 4) array
        At most `KEPT` poses, none close to another.
    """
    sigmas = ladder(views, body, T_guess, uncertainty / NARROWING)[0]
    objective = matched_objective(views, body, sigmas)
    poses = np.concatenate([T_guess[None], perturb(T_guess, _twists(uncertainty, seed))])
    scores = objective.value(poses)
    kept: list[int] = []
    twists = np.concatenate([np.zeros((1, 6)), _twists(uncertainty, seed)])
    scale = np.where(uncertainty > 0, uncertainty / NARROWING, np.inf)
    for k in np.argsort(scores)[::-1]:
        if all(np.linalg.norm((twists[k] - twists[other]) / scale) > 1.0 for other in kept):
            kept.append(int(k))
        if len(kept) == KEPT:
            break
    return [poses[k] for k in kept]


def _twists(uncertainty: Floats, seed: int) -> Floats:
    """Quasi-random twists (n, 6), uniform within √3 standard deviations each way."""
    first = uniforms(DRAWN, sampler="low-discrepancy", seed=seed)
    second = uniforms(DRAWN, sampler="low-discrepancy", seed=seed + 1)
    cube = np.concatenate([first[:, :3], second[:, :3]], axis=1)
    return np.asarray((2 * cube - 1) * np.sqrt(3) * uncertainty)
