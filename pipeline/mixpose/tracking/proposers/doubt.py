"""Whether the prediction is enough, or the body is to be looked for elsewhere."""

from __future__ import annotations

from mixpose.judgement import Judged, convinces
from mixpose.tracking.likelihood import FrameData


def is_doubtful(data: FrameData, ranked: list[Judged]) -> bool:
    """Whether no pose convinces, or the best may have slipped by a step of its grid."""
    if not ranked or not convinces(ranked[0], data.free, data.rules.acceptance):
        return True
    return data.body.recurrence >= data.rules.proposals.recurrent and _has_slipped(ranked[0], data)


def _has_slipped(judged: Judged, data: FrameData) -> bool:
    """Whether a sensor misses more than in the frame before while more is seen beside the body.

    So it is where a body that looks like itself a step aside was followed to there.
    """
    for one in judged.associations:
        before = data.track.tallies.get(one.name)
        if before is None:
            continue
        least = data.rules.proposals.slipped
        if one.missed > before.missed + least and one.surplus > before.surplus + least:
            return True
    return False
