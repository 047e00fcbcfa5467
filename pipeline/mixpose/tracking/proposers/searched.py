"""Poses found without a prediction, everywhere."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from operator import add

from mixpose.judgement import ScoredPose
from mixpose.search import Candidate, SearchReport, SearchState, search_frame
from mixpose.tracking.likelihood import FrameData, Start
from mixpose.tracking.proposers.predicted import is_doubtful


def searched(data: FrameData, ranked: list[ScoredPose]) -> Iterable[Start]:
    """Candidates of the search where nothing convinces yet."""
    return starts_at(data, candidates_of(data)) if is_doubtful(data, ranked) else []


def candidates_of(data: FrameData) -> list[Candidate]:
    """What the search finds, the most evident first; with a budget, as far as that reaches.

    Detections that stayed where they are while the body was lost are left out at first, for half
    of the budget.
    """
    live = data.options.search == "live"
    budget = data.rules.live if live else data.rules.search
    state = data.track.search if live else SearchState()
    search = partial(
        search_frame,
        body=data.body,
        free=data.free,
        T_reference=data.T_reference,
        rules=data.rules.judgement,
        seed=data.options.seed,
    )
    among_moving: list[Candidate] = []
    data.log.report = SearchReport()
    moving = data.track.clutter.without(data.views, data.rules.static)
    if any(view is not whole for view, whole in zip(moving, data.views, strict=True)):
        budget = replace(budget, max_guesses=budget.max_guesses / 2)
        among_moving, data.log.report, _ = search(moving, budget=budget)
        if among_moving and among_moving[0].evidence > budget.beyond_doubt:
            return among_moving
    candidates, report, data.log.state = search(data.views, budget=budget, state=state)
    data.log.report = SearchReport(*map(add, data.log.report, report))
    return among_moving + candidates


def starts_at(data: FrameData, candidates: Sequence[Candidate]) -> Iterable[Start]:
    """Candidates as they are, and fitted: the wider blurs of a fit reach false detections."""
    for candidate in candidates:
        yield Start(candidate.T_world_object)
        yield Start(candidate.T_world_object, data.close)
