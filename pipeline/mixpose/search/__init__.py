"""Search: the first pose from nothing, over all orientations and positions.

Few features that are seen clearly name a pose: three points in space, a point and two rays, three
rays of one camera.  Where none are seen clearly, all orientations are scored on blurred densities.
Every guess is judged on all sensors, and the best descend through narrowing blurs.
"""

from __future__ import annotations

from mixpose.search.budget import LIVE, THOROUGH, SearchBudget
from mixpose.search.problem import Candidate, SearchReport, SearchResult, SearchState
from mixpose.search.refinement import Descent, Stage
from mixpose.search.search import search_frame

__all__ = [
    "LIVE",
    "THOROUGH",
    "Candidate",
    "Descent",
    "SearchBudget",
    "SearchReport",
    "SearchResult",
    "SearchState",
    "Stage",
    "search_frame",
]
