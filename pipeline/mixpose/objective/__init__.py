"""Objectives of the pose: the matched one, the paper's, and the product of independent ones."""

from __future__ import annotations

from mixpose.objective.base import Objective, Quadratic, View, pose_jacobian
from mixpose.objective.build import OBJECTIVES, ObjectiveName, build_objective
from mixpose.objective.gaze import Gaze, Projected, gazes_of
from mixpose.objective.matched import MatchedObjective, matched_objective
from mixpose.objective.paper import IndependentObjective, PaperObjective, sampled_terms

__all__ = [
    "OBJECTIVES",
    "Gaze",
    "IndependentObjective",
    "MatchedObjective",
    "Objective",
    "ObjectiveName",
    "PaperObjective",
    "Projected",
    "Quadratic",
    "View",
    "build_objective",
    "gazes_of",
    "matched_objective",
    "pose_jacobian",
    "sampled_terms",
]
