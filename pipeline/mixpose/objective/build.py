"""The registry of objectives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeAlias, get_args

from mixpose.body import Body
from mixpose.objective.base import Objective, View
from mixpose.objective.matched import matched_objective
from mixpose.objective.paper import IndependentObjective, PaperObjective, sampled_terms
from mixpose.records import Floats

ObjectiveName: TypeAlias = Literal["matched", "paper", "independent"]
OBJECTIVES: tuple[ObjectiveName, ...] = get_args(ObjectiveName)


def build_objective(
    name: ObjectiveName,
    views: Sequence[View],
    body: Body,
    samples: Floats,
    sigmas: Sequence[float],
    near: Floats,
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
        Pose around whose projection sampled densities are made.
    """
    if name == "matched":
        return matched_objective(views, body, sigmas)
    kind = PaperObjective if name == "paper" else IndependentObjective
    terms = sampled_terms(views, samples, sigmas, near)
    return kind(terms, samples, body.world_offsets(samples.shape[1]))
