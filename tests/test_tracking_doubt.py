"""Other things that may have some of a body's markers alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detections import EIGHT, TRUTH, detect, view_of
from matches import Seen, scored

from mixpose.body import Body
from mixpose.fit import EstimatorOptions
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Tracker
from mixpose.tracking.doubt import FEW, decide_frame, log_odds_other


def odds(cameras: list[PinholeCamera], *met: int, known: bool = False, in_view: int = 8) -> float:
    """Of another thing, where each camera meets so many of the features, from the first on."""
    views = [view_of(str(k), cameras[k], np.ones((1, 2))) for k in range(len(met))]
    tracker = Tracker.create(EIGHT, EstimatorOptions(), TRUTH)
    track = replace(tracker.begin(), is_identified=known)
    numbers = np.arange(in_view)
    seen = [
        Seen(np.zeros((in_view, 2, 6)), str(k), shares=np.where(numbers < each, 1.0, 0.0))
        for k, each in enumerate(met)
    ]
    return log_odds_other(tracker.data(track, 0, None, views), scored(TRUTH, *seen))


@pytest.mark.parametrize(
    ("met", "in_view", "is_likely"),
    [
        (3, 3, False),
        (3, 4, True),
        (3, 8, True),
        (4, 8, True),
        (5, 8, False),
        (6, 12, False),
        (8, 40, True),
    ],
)
def test_three_markers_of_eight_may_be_another_thing(
    pinhole_cameras: list[PinholeCamera], met: int, in_view: int, *, is_likely: bool
) -> None:
    # three lengths alike to a twentieth each, and two cameras that miss each of the others
    expected = 3 * (met - 2) * np.log(1 / 20) + 2 * (in_view - met) * np.log(4)
    found = odds(pinhole_cameras, met, met, in_view=in_view)
    assert found == pytest.approx(expected)
    assert (found > np.log(1e-3)) == is_likely


def test_what_was_followed_is_where_it_is_expected(pinhole_cameras: list[PinholeCamera]) -> None:
    assert odds(pinhole_cameras, 3, 3, known=True) < np.log(1e-3) < odds(pinhole_cameras, 3, 3)


def test_of_four_cameras_two_have_to_meet_a_marker(pinhole_cameras: list[PinholeCamera]) -> None:
    cameras = [*pinhole_cameras, *pinhole_cameras][:4]
    # one camera meets it by chance, which is half as much as two that do
    alone = odds(cameras, 4, 3, 3, 3) - odds(cameras, 3, 3, 3, 3)
    both = odds(cameras, 4, 4, 3, 3) - odds(cameras, 3, 3, 3, 3)
    assert both - alone == pytest.approx(1.5 * np.log(1 / 20))


def test_a_frame_is_ok_from_the_confidence_that_the_session_asks_for(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    assert Tracker.create(EIGHT, EstimatorOptions()).rules.acceptance.confidence == 0.999
    asked = Tracker.create(EIGHT, EstimatorOptions(confidence=0.9), TRUTH)
    assert asked.rules.acceptance.log_doubt == pytest.approx(np.log(0.1 / 0.9))
    # a pose with odds of 100 against clutter, and nothing else against it
    seen = [Seen(np.zeros((8, 2, 6)), str(k)) for k in range(2)]
    views = [view_of(str(k), pinhole_cameras[k], np.ones((4, 2))) for k in range(2)]
    pose = replace(scored(TRUTH, *seen), log_evidence=np.log(100.0))
    for confidence, expected in ((0.9, "ok"), (0.99, "ok"), (0.991, "ambiguous")):
        tracker = Tracker.create(EIGHT, EstimatorOptions(confidence=confidence), TRUTH)
        verdict = decide_frame(tracker.data(tracker.begin(), 0, None, views), [pose])
        assert verdict.status == expected
        assert verdict.confidence == pytest.approx(100 / 101, abs=1e-5)


@pytest.mark.parametrize(("met", "expected"), [(3, FEW), (5, "")])
def test_a_pose_that_meets_few_markers_of_many_is_ambiguous(
    pinhole_cameras: list[PinholeCamera], met: int, expected: str
) -> None:
    shares = np.where(np.arange(8) < met, 1.0, 0.0)
    seen = [Seen(np.zeros((8, 2, 6)), str(k), shares=shares) for k in range(2)]
    tracker = Tracker.create(EIGHT, EstimatorOptions())
    views = [view_of(str(k), pinhole_cameras[k], np.ones((4, 2))) for k in range(2)]
    pose = replace(scored(TRUTH, *seen), log_evidence=30.0)
    verdict = decide_frame(tracker.data(tracker.begin(), 0, None, views), [pose])
    assert verdict.doubt == expected
    assert verdict.status == ("ambiguous" if expected else "ok")


def test_of_one_camera_or_two_one_that_meets_a_marker_is_enough(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # five of eight by one camera alone; each of the other three is missed as often as it is in view
    alike = 3 * (5 - 2) * np.log(1 / 20)
    assert odds(pinhole_cameras, 5) == pytest.approx(alike + 3 * np.log(4))
    assert odds(pinhole_cameras, 5, 0) == pytest.approx(alike + 2 * 3 * np.log(4))


@pytest.mark.parametrize(("missed", "expected"), [(12, "ambiguous"), (0, "ok")])
def test_what_is_followed_by_three_markers_after_it_was_lost_may_be_another_thing(
    pinhole_cameras: list[PinholeCamera], missed: int, expected: str
) -> None:
    tracker = Tracker.create(EIGHT, EstimatorOptions())
    track, part = tracker.begin(), Body("part", EIGHT.features[:3])
    for frame in range(4):
        views = detect(pinhole_cameras, EIGHT, TRUTH, noise=0.1, seed=frame)
        track, estimate = tracker.advance(track, frame, None, views)
    assert estimate.status == "ok"
    for frame in range(4, 4 + missed):
        track, estimate = tracker.advance(track, frame, None, [])
    statuses = list[str]()
    for frame in range(4 + missed, 12 + missed):
        views = detect(pinhole_cameras, part, TRUTH, noise=0.1, seed=frame)
        track, estimate = tracker.advance(track, frame, None, views)
        statuses.append(estimate.status)
    assert statuses[1:] == [expected] * 7
