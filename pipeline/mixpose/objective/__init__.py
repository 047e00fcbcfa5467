"""Objectives of the pose: the matched one, the paper's, and the product of independent ones."""

from __future__ import annotations

from mixpose.objective.amplitudes import AmplitudesObjective
from mixpose.objective.base import Objective, Quadratic, View
from mixpose.objective.build import OBJECTIVES, ObjectiveName, build_objective
from mixpose.objective.kernel import Match
from mixpose.objective.matched import MatchedObjective, SharedDensities, matched_objective
from mixpose.objective.paper import IndependentObjective, PaperObjective, sampled_terms
from mixpose.objective.projection import (
    BodyProjection,
    Projected,
    in_image,
    pose_jacobian,
    project_body,
)
from mixpose.objective.together import Together, can_be_together

__all__ = [
    "OBJECTIVES",
    "AmplitudesObjective",
    "BodyProjection",
    "IndependentObjective",
    "Match",
    "MatchedObjective",
    "Objective",
    "ObjectiveName",
    "PaperObjective",
    "Projected",
    "Quadratic",
    "SharedDensities",
    "Together",
    "View",
    "build_objective",
    "can_be_together",
    "in_image",
    "matched_objective",
    "pose_jacobian",
    "project_body",
    "sampled_terms",
]
