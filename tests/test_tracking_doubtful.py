"""Whether a pose convinces, or the body is to be looked for elsewhere."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from detections import EIGHT, TRUTH
from matches import of_eight, scored

from mixpose.density import Observation
from mixpose.fit import EstimatorOptions
from mixpose.objective import View
from mixpose.records import GridPattern
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Track, Tracker
from mixpose.tracking.proposers import is_doubtful


def test_a_pose_that_does_not_convince_is_in_doubt() -> None:
    tracker = Tracker.create(EIGHT, EstimatorOptions(), TRUTH)
    data = tracker.data(tracker.begin(), 1, None, [])
    assert is_doubtful(data, [])
    assert is_doubtful(data, [scored(TRUTH, of_eight("0", 5.0))])
    assert not is_doubtful(data, [scored(TRUTH, of_eight("0", 8.0))])


def test_a_body_of_which_as_much_is_met_as_before_is_not_looked_for_elsewhere() -> None:
    tracker = Tracker.create(EIGHT, EstimatorOptions(), TRUTH)
    track = replace(tracker.begin(), met_before={"0": 5}, ok_count=3, frame=0)

    def doubted(
        track: Track, met: int, log_evidence: float = 20.0, ratio: float = 0.5, count: int = 8
    ) -> bool:
        shares = np.where(np.arange(8) < met, 1.0, 0.0)
        seen = replace(of_eight("0", met), shares=shares, count=float(count))
        judged = replace(scored(TRUTH, seen), log_evidence=log_evidence, residual_ratio=ratio)
        return is_doubtful(tracker.data(track, 1, None, []), [judged])

    assert not doubted(track, 5)
    # as much of it, farther off than chance makes it: it may have turned away all at once
    assert doubted(track, 5, ratio=1.1)
    # as much of it, and yet not sure: a thing that shines alike came near
    assert doubted(track, 5, log_evidence=5.0)
    assert not doubted(track, 4)
    # a quarter is gone all at once, as where a grid slips by a step; or little was believed before
    assert doubted(replace(track, met_before={"0": 8}), 5)
    # but not where all that there is is met: nowhere else is more; of grey values nobody counts it
    assert not doubted(replace(track, met_before={"0": 8}), 5, count=5)
    grey = GridPattern(np.ones((4, 4), np.float32), np.zeros(2), 1.0)
    seen = replace(of_eight("0", 5.0), shares=np.where(np.arange(8) < 5, 1.0, 0.0), count=5.0)
    judged = replace(scored(TRUTH, seen), log_evidence=20.0, residual_ratio=0.5)
    camera = PinholeCamera(np.diag([800.0, 800.0, 1.0]))
    data = tracker.data(
        replace(track, met_before={"0": 8}), 1, None, [View("0", camera, Observation(grey, 1.5))]
    )
    assert is_doubtful(data, [judged])
    for other in (
        replace(track, ok_count=2),
        replace(track, misses=1),
        replace(track, doubted=True),
        replace(track, branches=2 * track.branches),
    ):
        assert doubted(other, 5)


def test_in_the_first_frames_what_is_met_farther_off_than_chance_makes_it_is_looked_for() -> None:
    """It may be its double image in a pane, which meets all of it about as well."""
    tracker = Tracker.create(EIGHT, EstimatorOptions(), TRUTH)
    convincing = scored(TRUTH, of_eight("0", 8.0))

    def doubted(believed: int, ratio: float, **other: Any) -> bool:
        track = replace(tracker.begin(), ok_count=believed)
        judged = replace(convincing, residual_ratio=ratio, **other)
        return is_doubtful(tracker.data(track, 1, None, []), [judged])

    assert doubted(1, 1.1)
    assert not doubted(1, 0.9)
    # recordings that err by fits and starts, and what is explained by a sensor that is left out
    assert not doubted(3, 6.0)
    assert not doubted(1, 6.0, left_out={"1": "out of step"})
