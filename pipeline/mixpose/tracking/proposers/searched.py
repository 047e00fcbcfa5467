"""Poses found without a prediction, everywhere."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from mixpose.judgement import Judged
from mixpose.search import Candidate, search_frame
from mixpose.tracking.likelihood import FrameData, Start
from mixpose.tracking.proposers.doubt import is_doubtful


def searched(data: FrameData, ranked: list[Judged]) -> Iterable[Start]:
    """Candidates of the search where nothing convinces yet, as they are and fitted."""
    return starts_at(data, candidates_of(data)) if is_doubtful(data, ranked) else []


def candidates_of(data: FrameData) -> list[Candidate]:
    """What the search finds, the most evident first; with a budget, as far as that reaches."""
    live = data.options.search == "live"
    result = search_frame(
        data.views,
        data.body,
        free=data.free,
        T_reference=data.T_reference,
        seed=data.options.seed,
        budget=data.rules.live if live else data.rules.search,
        state=data.track.search if live else None,
    )
    data.log.state = result.state
    return result.candidates


def starts_at(data: FrameData, candidates: Sequence[Candidate]) -> Iterable[Start]:
    """Candidates as they are, and fitted."""
    close = data.start_uncertainty / data.rules.proposals.narrowing**2
    for candidate in candidates:
        yield Start(candidate.T_world_object)
        yield Start(candidate.T_world_object, close)
