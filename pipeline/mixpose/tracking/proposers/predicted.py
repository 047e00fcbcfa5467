"""Where the branches of the track expect the body, and a step of its grid aside.

A grid of features explains most of the detections a step off, too, and is followed there.  Where a
sensor misses more features than in the frame before, and more detections around the body belong to
none of them, the poses a step of the grid away are rivals.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mixpose.judgement import Judged, convinces
from mixpose.tracking.likelihood import FrameData, Start


def predicted(data: FrameData, ranked: list[Judged]) -> Iterable[Start]:
    """The predictions, always."""
    return [Start(one.T_world_object, one.uncertainty, one) for one in data.predictions]


def is_doubtful(data: FrameData, ranked: list[Judged]) -> bool:
    """Whether no pose convinces yet, so that the body is to be looked for elsewhere."""
    return not ranked or not convinces(ranked[0], data.free, data.rules.acceptance)


def stepped_aside(data: FrameData, ranked: list[Judged]) -> Iterable[Start]:
    """The best pose shifted by each step of the body's grid, where it may have slipped."""
    steps = data.body.grid_steps
    if not ranked or not len(steps) or not _may_have_slipped(ranked[0], data):
        return
    T = ranked[0].T_world_object
    close = data.start_uncertainty / data.rules.proposals.narrowing**2
    for step in steps:
        shifted = np.eye(4)
        shifted[:3, 3] = step
        yield Start(T @ shifted, close)


def _may_have_slipped(judged: Judged, data: FrameData) -> bool:
    """Whether a sensor misses more than in the frame before while more is seen beside the body."""
    least = data.rules.proposals.slipped
    for one in judged.associations:
        before = data.track.tallies.get(one.name)
        if before is None:
            continue
        if one.missed > before.missed + least and one.surplus > before.surplus + least:
            return True
    return False
