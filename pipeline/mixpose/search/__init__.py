"""Search: the first pose from nothing, over all orientations and positions."""

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
