"""Where the branches of the track expect the body."""

from __future__ import annotations

from collections.abc import Iterable

from mixpose.judgement import Judged, convinces
from mixpose.tracking.likelihood import FrameData, Start


def predicted(data: FrameData, ranked: list[Judged]) -> Iterable[Start]:
    """The predictions, always."""
    return [Start(one.T_world_object, one.uncertainty, one) for one in data.predictions]


def is_doubtful(data: FrameData, ranked: list[Judged]) -> bool:
    """Whether no pose convinces yet, so that the body is to be looked for elsewhere."""
    return not ranked or not convinces(ranked[0], data.free, data.rules.acceptance)
