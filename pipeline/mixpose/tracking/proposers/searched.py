"""Poses found without a prediction, everywhere."""

from __future__ import annotations

from collections.abc import Iterable

from mixpose.judgement import Judged
from mixpose.search import search
from mixpose.tracking.likelihood import FrameData, Start
from mixpose.tracking.proposers.doubt import is_doubtful


def searched(data: FrameData, ranked: list[Judged]) -> Iterable[Start]:
    """Candidates of the search where nothing convinces yet, as they are and fitted."""
    if not is_doubtful(data, ranked):
        return
    close = data.start_uncertainty / data.rules.proposals.narrowing**2
    candidates = search(
        data.views,
        data.body,
        free=data.free,
        T_reference=data.T_reference,
        seed=data.options.seed,
    )
    for candidate in candidates:
        yield Start(candidate.T_world_object)
        # far worse ones are rivals in name only
        if candidate.evidence > candidates[0].evidence - data.rules.proposals.outdone:
            yield Start(candidate.T_world_object, close)
