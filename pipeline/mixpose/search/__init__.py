"""Search of a pose without a start, over all orientations and positions."""

from mixpose.search.copies import (
    Copy as Copy,
    SeenTogether as SeenTogether,
    search_copies as search_copies,
)
from mixpose.search.from_points import triangulate as triangulate
from mixpose.search.poses import (
    Descent as Descent,
    spread_rotations as spread_rotations,
    distinct_poses as distinct_poses,
)
from mixpose.search.problem import (
    LIVE as LIVE,
    THOROUGH as THOROUGH,
    SearchBudget as SearchBudget,
    is_pointlike as is_pointlike,
    peaks as peaks,
)
from mixpose.search.search import (
    Candidate as Candidate,
    SearchReport as SearchReport,
    SearchResult as SearchResult,
    SearchState as SearchState,
    search_frame as search_frame,
)
from mixpose.search.three_points import (
    SIDES as SIDES,
    align_triples as align_triples,
    depths as depths,
)
from mixpose.search.triples import far_apart as far_apart, thinned as thinned
