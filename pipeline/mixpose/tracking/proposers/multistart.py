"""Several starts around a prediction, for frames where one descent does not convince.

With clutter or hidden features the coarsest blurs can lead astray.  Poses drawn from the
uncertainty of the guess are scored at a medium blur, and the best of them descend, all at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.fit import blur_schedule
from mixpose.judgement import Judged
from mixpose.objective import matched_objective
from mixpose.rigid import perturb
from mixpose.search import Descent, Stage
from mixpose.tracking.likelihood import FrameData, Start
from mixpose.tracking.proposers.predicted import is_doubtful

Floats: TypeAlias = NDArray[np.float64]


def multistart(data: FrameData, ranked: list[Judged]) -> Iterable[Start]:
    """The most promising poses around the first prediction, until something convinces."""
    if not data.predictions or not is_doubtful(data, ranked):
        return
    first = data.predictions[0]
    wide = np.where(data.free, np.maximum(first.uncertainty, data.start_uncertainty), 0.0)
    starts = starts_around(data, first.T_world_object, wide)
    narrow = wide / data.rules.proposals.narrowing
    for T in _descended(data, starts, narrow):
        if is_doubtful(data, ranked):
            yield Start(T, narrow / data.rules.proposals.narrowing)


def _descended(data: FrameData, starts: Sequence[Floats], uncertainty: Floats) -> Floats:
    """Poses (K, 4, 4) that starts lead to and that meet anything, best first."""
    rules, sigmas = data.rules.proposals, np.array(data.sigmas)
    levels = blur_schedule(data.views, data.body, starts[0], uncertainty)
    stages = [Stage(tuple(level / sigmas), rules.steps, len(starts)) for level in levels]
    descent = Descent(data.views, data.body, data.free, data.rules.search.descent)
    poses = descent.refine(np.array(starts), stages)
    values = descent.objective().value(poses)
    order = np.argsort(-values, kind="stable")
    return poses[order[values[order] > data.rules.fit.near * len(data.views)]]


def starts_around(data: FrameData, T_guess: Floats, uncertainty: Floats) -> list[Floats]:
    """The most promising poses (4, 4) around a guess, best first, none close to another.

    Parameters
    ----------
    data : FrameData
    T_guess : (4, 4) array
    uncertainty : (6,) array
        Standard deviations of the guess; zero for directions that are not free.
    """
    rules = data.rules.proposals
    sigmas = blur_schedule(data.views, data.body, T_guess, uncertainty / rules.narrowing)[0]
    objective = matched_objective(data.views, data.body, sigmas)
    twists = np.concatenate(
        [np.zeros((1, 6)), _twists(uncertainty, rules.drawn, data.options.seed)]
    )
    poses = perturb(T_guess, twists)
    scores = objective.value(poses)
    kept: list[int] = []
    scale = np.where(uncertainty > 0, uncertainty / rules.narrowing, np.inf)
    for k in np.argsort(scores)[::-1]:
        if all(np.linalg.norm((twists[k] - twists[other]) / scale) > 1.0 for other in kept):
            kept.append(int(k))
        if len(kept) == rules.kept:
            break
    return [poses[k] for k in kept]


def _twists(uncertainty: Floats, count: int, seed: int) -> Floats:
    """Random twists (n, 6), uniform within √3 standard deviations each way."""
    cube = np.random.default_rng(seed).random((count, 6))
    return np.asarray((2 * cube - 1) * np.sqrt(3) * uncertainty)
