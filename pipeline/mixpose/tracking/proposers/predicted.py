"""Where the branches of the track expect the body."""

from __future__ import annotations

from collections.abc import Iterable

from mixpose.judgement import Judged
from mixpose.tracking.likelihood import FrameData, Start


def predicted(data: FrameData, ranked: list[Judged]) -> Iterable[Start]:
    """The predictions, always."""
    return [Start(one.T_world_object, one.uncertainty, one) for one in data.predictions]
