"""Several starts around a prediction, where the coarsest blurs of one descent may lead astray."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from mixpose.fit import blur_schedule
from mixpose.judgement import ScoredPose
from mixpose.objective import matched_objective
from mixpose.records import Floats
from mixpose.rigid import perturb
from mixpose.search import Descent, Stage
from mixpose.tracking.likelihood import FrameData, Start
from mixpose.tracking.proposers.predicted import is_doubtful


def multistart(data: FrameData, ranked: list[ScoredPose]) -> Iterable[Start]:
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
    descent = Descent(data.views, data.body, data.free, data.rules.search)
    poses = descent.refine(np.array(starts), stages)
    values = descent.objective().value(poses)
    order = np.argsort(-values, kind="stable")
    return poses[order[values[order] > data.rules.fit.near * len(data.views)]]


def starts_around(data: FrameData, T_guess: Floats, uncertainty: Floats) -> list[Floats]:
    """The most promising poses (4, 4) around a guess, best first, none close to another.

    Standard deviations (6,) of the guess are zero for directions that are not free.
    """
    rules = data.rules.proposals
    sigmas = blur_schedule(data.views, data.body, T_guess, uncertainty / rules.narrowing)[0]
    cube = np.random.default_rng(data.options.seed).random((rules.drawn, 6))
    # uniform within √3 standard deviations each way
    drawn = (2 * cube - 1) * np.sqrt(3) * uncertainty
    twists = np.concatenate([np.zeros((1, 6)), drawn])
    poses = perturb(T_guess, twists)
    scores = matched_objective(data.views, data.body, sigmas).value(poses)
    kept: list[int] = []
    scale = np.where(uncertainty > 0, uncertainty / rules.narrowing, np.inf)
    for k in np.argsort(scores)[::-1]:
        if all(np.linalg.norm((twists[k] - twists[other]) / scale) > 1.0 for other in kept):
            kept.append(int(k))
        if len(kept) == rules.kept:
            break
    return [poses[k] for k in kept]
