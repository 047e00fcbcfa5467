"""The registry of objectives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.objective.base import Objective, View
from mixpose.objective.gaze import Gaze
from mixpose.objective.matched import matched_objective
from mixpose.objective.paper import IndependentObjective, PaperObjective, sampled_terms

Floats: TypeAlias = NDArray[np.float64]
ObjectiveName: TypeAlias = Literal["matched", "paper", "independent"]
Builder: TypeAlias = Callable[
    [Sequence[View], Body, Floats, Sequence[float], Floats, bool, Sequence[Gaze]], Objective
]


def _matched(
    views: Sequence[View],
    body: Body,
    samples: Floats,
    sigmas: Sequence[float],
    near: Floats,
    fine: bool,
    gazes: Sequence[Gaze],
) -> Objective:
    return matched_objective(views, body, sigmas, near, fine=fine, gazes=gazes)


def _paper(
    views: Sequence[View],
    body: Body,
    samples: Floats,
    sigmas: Sequence[float],
    near: Floats,
    fine: bool,
    gazes: Sequence[Gaze],
) -> Objective:
    terms = sampled_terms(views, samples, sigmas, near)
    return PaperObjective(terms, samples, body.world_offsets(samples.shape[1]))


def _independent(
    views: Sequence[View],
    body: Body,
    samples: Floats,
    sigmas: Sequence[float],
    near: Floats,
    fine: bool,
    gazes: Sequence[Gaze],
) -> Objective:
    terms = sampled_terms(views, samples, sigmas, near)
    return IndependentObjective(terms, samples, body.world_offsets(samples.shape[1]))


OBJECTIVES: dict[ObjectiveName, Builder] = {
    "matched": _matched,
    "paper": _paper,
    "independent": _independent,
}


def build_objective(
    name: ObjectiveName,
    views: Sequence[View],
    body: Body,
    samples: Floats,
    sigmas: Sequence[float],
    near: Floats,
    fine: bool = False,
    gazes: Sequence[Gaze] = (),
) -> Objective:
    """Build an objective of the pose at one level of blur.

    Parameters
    ----------
    name : {"matched", "paper", "independent"}
    views : sequence of View
        Sensors whose observation is not empty.
    body : Body
    samples : (N, R, 3) array
        Samples of the body; the matched objective does not use them.
    sigmas : sequence of float
        Standard deviation of a feature at this level, per view, in sensor units.
    near : (4, 4) array
        Pose around whose projection densities are made.
    fine : bool
        Whether the matched objective makes its densities on fine tiles, for the last digits.
    gazes : sequence of Gaze
        Of the views' sensors at the body, where they are at hand.
    """
    return OBJECTIVES[name](views, body, samples, sigmas, near, fine, gazes)
