"""Whether the prediction is enough, or the body is to be looked for elsewhere."""

from __future__ import annotations

from mixpose.judgement import Judged, convinces
from mixpose.tracking.likelihood import FrameData


def is_doubtful(data: FrameData, ranked: list[Judged]) -> bool:
    """Whether no pose convinces yet."""
    return not ranked or not convinces(ranked[0], data.free, data.rules.acceptance)
