"""Where the branches of the track expect the body."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mixpose.judgement import ScoredPose, convinces, is_sure
from mixpose.tracking.likelihood import FrameData, Start


def predicted(data: FrameData, ranked: list[ScoredPose]) -> Iterable[Start]:
    """The predictions, always."""
    beside = [] if data.beside is None else [data.beside]
    some = [*data.predictions, *beside]
    return [Start(one.T_world_object, one.uncertainty, one) for one in some]


def is_doubtful(data: FrameData, ranked: list[ScoredPose]) -> bool:
    """Whether no pose convinces yet, so that the body is to be looked for elsewhere."""
    if not ranked:
        return True
    given = ranked[0], data.free, data.rules.acceptance
    return not (convinces(*given) or (is_sure(*given) and _is_met_as_before(data, ranked[0])))


def _is_met_as_before(data: FrameData, best: ScoredPose) -> bool:
    """Whether of a body that was followed for some frames no more is missed all at once.

    However much of it is hidden: what slips by a step of its grid, or turns over, meets less.
    """
    track = data.track
    is_new = track.believed < data.rules.proposals.believed
    if is_new or track.misses or track.doubted or len(track.branches) != 1:
        return False
    before = sum(one.met for one in track.tallies.values())
    met = int(np.count_nonzero(best.used.shares))
    return met > data.rules.acceptance.convincing * before
