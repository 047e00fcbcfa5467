"""What is said of a body that was learnt: its table, and what the recording does not tell."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import null_space

from mixpose.calibration import SeenFrame
from mixpose.learning import in_axes_of
from mixpose.learning.adjusting import LearntBody, _spread
from mixpose.learning.copies import _are_foreign, is_chance
from mixpose.learning.points import Cloud, _supported
from mixpose.learning.rules import RULES
from mixpose.learning.shapes import PlacedBody, Placement, Shape, least_met
from mixpose.learning.telling import _digits_of, doubts_of, lines_of, look_alikes
from mixpose.records import Floats
from mixpose.rigid import from_rotation_vector
from mixpose.sensors import PinholeCamera

POINTS = np.array([[0, 0, 0], [60, 5, 0], [-15, 70, 10], [20, -30, 45], [-40, 10, 80.0]])


def learnt(
    turns_deg: Floats, points: Floats = POINTS, *, deviation: float = 0.01, spread: float = 0.0
) -> LearntBody:
    poses = [from_rotation_vector(np.radians(turn), [0.0, 0.0, 0.0]) for turn in turns_deg]
    return LearntBody(
        tuple(f"m{k}" for k in range(len(points))),
        points,
        np.tile(deviation**2 * np.eye(3), (len(points), 1, 1)),
        np.full(len(points), 12),
        np.array(poses),
        np.arange(len(poses)),
        1,
        0.3,
        spread,
    )


def turning(along: float, across: float) -> Floats:
    """Turns by up to so many degrees about z, and about x, independent of each other."""
    phase = np.arange(24) * 2 * np.pi / 24
    return np.stack([across * np.sin(2 * phase), 0 * phase, along * np.sin(phase)], axis=1)


@pytest.mark.parametrize(
    ("along", "across", "missing"),
    [
        (12.0, 12.0, "turned by 14.7 deg at most; missing: turns of 30 deg or more"),
        (40.0, 6.0, "turned about one axis only, (0.00, 0.00, 1.00) of the world"),
        (40.0, 12.0, None),  # 0.3 of the turn about the main axis, and 0.2 are asked for
        (150.0, 12.0, None),  # 8.5 deg RMS, and 5 are enough whatever the main axis turns by
        (150.0, 6.0, "turned about one axis only"),
    ],
)
def test_turns_that_are_missing_are_named(along: float, across: float, missing: str | None) -> None:
    told = doubts_of(learnt(turning(along, across)), "body", "mm")
    if missing is None:
        assert told == []
    else:
        (doubt,) = told
        assert missing in doubt.replace("-0.00", "0.00").replace("-1.00", "1.00")


def test_markers_that_move_on_the_body_are_told_with_the_key_to_write() -> None:
    told = doubts_of(learnt(turning(40.0, 20.0), spread=0.456), "body", "mm")
    assert told == ["body: its markers move on it by 0.46 mm: write sigma = 0.46 into its [object]"]


def test_the_spread_of_markers_is_what_poses_leave_and_triangulation_does_not_explain() -> None:
    shifts, turns = np.tile(np.eye(3), 5), np.cross(np.eye(3)[:, None], POINTS).reshape(3, 15)
    left = null_space(np.vstack([shifts, turns]))  # nine of 15 coordinates
    seen = POINTS + 0.5 * left.sum(axis=1).reshape(5, 3)
    numbers = np.arange(5)
    cloud = Cloud(seen, np.full(5, 0.4), numbers[:, None], numbers, SeenFrame(0, None, {}, {}))
    places = ((0, Placement(np.eye(4), numbers, 0.5)),)
    loose = PlacedBody(Shape(POINTS, np.full(5, 0.1)), places, looseness=4.0)
    assert _spread(loose, [cloud]) == pytest.approx(np.sqrt(0.5**2 - 5 * 0.4**2 / 9), rel=1e-9)


@pytest.mark.parametrize(("corners", "ways"), [(3, "2 other ways"), (2, "1 other way:")])
def test_markers_that_map_onto_themselves_are_counted(corners: int, ways: str) -> None:
    angles = 2 * np.pi * np.arange(corners) / corners
    ring = np.stack([30 * np.cos(angles), 30 * np.sin(angles), 0 * angles], axis=1)
    axis = np.array([[0, 0, 20.0], [0, 0, -55.0]])
    told = doubts_of(learnt(turning(40.0, 20.0), np.concatenate([ring, axis])), "body", "mm")
    assert len(told) == 1
    assert f"onto themselves in {ways}" in told[0]


@pytest.mark.parametrize(("deviation", "digits"), [(0.01, 3), (0.1, 2), (2.0, 1), (20.0, 0)])
def test_coordinates_have_a_digit_more_than_is_known(deviation: float, digits: int) -> None:
    # of three axes together it is 1.7 times as large, a tenth of which is the last digit
    assert _digits_of(learnt(turning(40.0, 20.0), deviation=deviation)) == digits


def test_the_table_has_a_line_for_each_marker_and_the_largest_turn() -> None:
    head, titles, first, *others = lines_of(learnt(turning(40.0, 20.0)), "body", "mm")
    assert head == ("body: 5 markers, adjusted in 24 frames, turned by up to 40 deg; lengths in mm")
    assert titles.split() == ["marker", "x", "y", "z", "deviation", "frames"]
    assert first.split() == ["m0", "0.000", "0.000", "0.000", "0.010", "12"]
    assert others[0].split()[:4] == ["m1", "60.000", "5.000", "0.000"]
    assert len(others) == 4


def test_bodies_that_share_three_markers_are_named_with_them() -> None:
    turned = from_rotation_vector([0.3, -0.7, 1.1], [100.0, 20.0, 5.0])
    shared = POINTS[[3, 0, 2]] @ turned[:3, :3].T + turned[:3, 3]
    fourth = shared.mean(axis=0) + np.array([90.0, 10.0, 33.0])
    other = np.vstack([shared, fourth])
    bodies = [learnt(turning(40.0, 20.0)), learnt(turning(40.0, 20.0), other)]
    (told,) = look_alikes(bodies, ["first", "second"])
    _, names = told.split("markers ", 1)
    these, those = names.split(": where")[0].split(" of second lie like ")
    pairs = dict(zip(these.split(", "), those.removesuffix(" of first").split(", "), strict=True))
    assert pairs == {"m0": "m3", "m1": "m0", "m2": "m2"}


def test_bodies_alike_that_are_never_seen_at_a_time_may_be_one() -> None:
    one, other = learnt(turning(40.0, 20.0)), learnt(turning(40.0, 20.0), POINTS[:4])
    (told,) = look_alikes([one, other], ["first", "second"])
    assert told.endswith("the two cannot be told apart")
    later = replace(other, numbers=other.numbers + 1000)
    (told,) = look_alikes([one, later], ["first", "second"])
    assert told.endswith("hardly ever seen at a time, and may be one: leave one out")


def test_markers_that_an_older_body_has_not_get_numbers_that_are_no_names_of_it() -> None:
    older = POINTS + np.array([5.0, 6.0, 7.0])
    found = in_axes_of(learnt(turning(40.0, 20.0)), older[:4], ("1", "2", "3", "5"))
    assert found is not None
    assert (found.body.names, found.shared) == (("1", "2", "3", "5", "6"), 4)
    np.testing.assert_allclose(found.body.points, older, atol=1e-9)


def test_three_of_four_points_and_four_of_more_tell_a_shape_from_chance() -> None:
    assert [least_met(points) for points in (3, 4, 5, 9)] == [3, 3, 4, 4]


@pytest.mark.parametrize(("more", "expected"), [(-1, True), (0, False)])
def test_four_points_that_no_other_size_has_are_a_body_from_twice_the_least_frames(
    more: int, expected: bool
) -> None:
    points = np.vstack([np.zeros(3), 50 * np.eye(3)])
    one = Placement(np.eye(4), np.arange(4), 0.5)
    places = [(k, one) for k in range(2 * RULES.least_frames + more)]
    body = PlacedBody(Shape(points, np.full(4, 0.1)), tuple(places))
    assert is_chance(body, []) == expected


def test_of_points_that_are_hardly_ever_seen_together_the_one_seen_less_goes() -> None:
    shape, places = Shape(POINTS[:4], np.full(4, 0.1)), []
    for k in range(100):  # one of two points each, by accident once both
        seen = np.array([True, True, k % 2 == 0, k == 0 or (k % 2 == 1 and k > 3)])
        places.append((k, Placement(np.eye(4), np.where(seen, np.arange(4), -1), 0.5)))
    strange = np.array([False, False, True, True])
    assert _are_foreign(shape, places, strange).tolist() == [False, False, False, True]
    assert not _are_foreign(shape, places[:1], strange).any()


def test_points_of_two_sensors_that_share_a_detection_are_both_kept() -> None:
    """One is a ghost, but which is not known; only a point of three takes its detections."""
    sensors = [PinholeCamera(np.eye(3) * [[900], [900], [1]], np.zeros(0), None, np.eye(4))] * 3
    points = np.array([[0.0, 0, 900], [9.0, 0, 900]])
    frame = SeenFrame(0, None, {k: np.full((2, 2), 1e6) for k in range(3)}, {})
    gates = np.full(3, 1.0)

    def kept(*detections: list[int]) -> Any:
        both, gaps = np.array(detections), np.array([0.1, 0.2])
        found = _supported(points, both, gaps, frame, sensors, gates)
        return (found >= 0).any(axis=1).tolist()

    assert kept([0, 0, -1], [0, 1, -1]) == [True, True]
    assert kept([0, 0, 0], [0, 1, -1]) == [True, False]


def test_a_sensor_that_meets_hardly_any_markers_is_named() -> None:
    body = replace(learnt(turning(30.0, 30.0)), met={"a": 4.0, "b": 5.0, "c": 0.2})
    (told,) = doubts_of(body, "body.csv", "mm")
    assert told == (
        "body.csv: 'c' meets 0.2 of its markers in a frame, and others 4.5: does it look "
        "elsewhere, or stand elsewhere than the session says?"
    )
    assert doubts_of(replace(body, met={"a": 4.0, "b": 1.0}), "body.csv", "mm") == []


def test_columns_of_a_table_stay_apart_however_many_decimals_deviations_ask_for() -> None:
    # a tenth of 1e-9 is told by ten decimals, behind hundreds
    *_, row = lines_of(learnt(turning(40, 12), -300 + POINTS, deviation=1e-9), "body", "mm")
    name, x, *others = row.split()
    assert (name, x, len(others)) == ("m4", "-340.0000000000", 4)
