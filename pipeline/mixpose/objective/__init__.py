"""Objectives of the pose: the matched one, the paper's, and the product of independent ones."""

from __future__ import annotations

from mixpose.objective.amplitudes import AmplitudesObjective
from mixpose.objective.base import Objective, View
from mixpose.objective.build import OBJECTIVES, ObjectiveName, build_objective
from mixpose.objective.kernel import Match
from mixpose.objective.matched import MatchedObjective, SharedDensities, matched_objective
from mixpose.objective.normal_prior import NormalPrior
from mixpose.objective.paper import IndependentObjective, PaperObjective, sampled_terms
from mixpose.objective.projection import (
    BodyProjection,
    Projected,
    in_image,
    pose_jacobian,
    project_body,
)
from mixpose.objective.together import BodiesObjective, can_be_together, together

__all__ = [
    "OBJECTIVES",
    "AmplitudesObjective",
    "BodiesObjective",
    "BodyProjection",
    "IndependentObjective",
    "Match",
    "MatchedObjective",
    "NormalPrior",
    "Objective",
    "ObjectiveName",
    "PaperObjective",
    "Projected",
    "SharedDensities",
    "View",
    "build_objective",
    "can_be_together",
    "in_image",
    "matched_objective",
    "pose_jacobian",
    "project_body",
    "sampled_terms",
    "together",
]
