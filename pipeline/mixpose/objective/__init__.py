"""Objectives of the pose: the matched one, the paper's, and the product of independent ones."""

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
    region_of_interest as region_of_interest,
    sampled_terms as sampled_terms,
)
from mixpose.objective.projection import (
    BodyProjection as BodyProjection,
    Match as Match,
    View as View,
    has_bare_points as has_bare_points,
    in_image as in_image,
    pose_jacobian as pose_jacobian,
    project_body as project_body,
)
from mixpose.objective.terms import (
    AmplitudesObjective as AmplitudesObjective,
    NormalPrior as NormalPrior,
    with_heights as with_heights,
)
