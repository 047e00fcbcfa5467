"""Objectives of the pose: the matched one, the paper's, and the product of independent ones."""

from mixpose.objective.amplitudes import AmplitudesObjective as AmplitudesObjective
from mixpose.objective.base import NormalPrior as NormalPrior, Objective as Objective, View as View
from mixpose.objective.matched import (
    MatchedObjective as MatchedObjective,
    SharedDensities as SharedDensities,
    matched_objective as matched_objective,
    together as together,
)
from mixpose.objective.paper import (
    OBJECTIVES as OBJECTIVES,
    IndependentObjective as IndependentObjective,
    ObjectiveName as ObjectiveName,
    PaperObjective as PaperObjective,
    build_objective as build_objective,
    sampled_terms as sampled_terms,
)
from mixpose.objective.projection import (
    BodyProjection as BodyProjection,
    Match as Match,
    can_be_together as can_be_together,
    in_image as in_image,
    pose_jacobian as pose_jacobian,
    project_body as project_body,
)
