"""A window or a polished floor shows the mirror image of the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detections import TRUTH, detect, view_of
from numpy.typing import NDArray

from mixpose.body import Body, PointFeature, thickness
from mixpose.fit import EstimatorOptions, Fit
from mixpose.judgement import Mistake
from mixpose.rigid import perturb, transform
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Tracker
from mixpose.tracking.doubt import reflection_mistake
from mixpose.tracking.frame import Start
from mixpose.tracking.likelihood import likelihood_of
from mixpose.tracking.mirrors import MIRRORED as MIRROR_IMAGE

Floats = NDArray[np.float64]

# four markers within 1 mm of a plane, one 60 mm before it
PLATE = np.array(
    [[-80.0, -50, 0.5], [70, -60, -0.5], [85, 55, 0.5], [-60, 75, -0.5], [10, -15, 60]]
)
BODY = Body("plate", tuple(PointFeature(point) for point in PLATE))
MIRRORED = Body("mirrored", tuple(PointFeature(point) for point in PLATE * [1, 1, -1]))


def status(
    cameras: list[PinholeCamera], shown: Body, *, given: Body = BODY, mirrors: bool = True
) -> str:
    views = detect(cameras, shown, TRUTH, noise=0.2)
    tracker = Tracker.create(given, EstimatorOptions())
    if not mirrors:  # no body is measured mirrored
        acceptance = replace(tracker.rules.acceptance, mistaken=1e-300)
        tracker = replace(tracker, rules=replace(tracker.rules, acceptance=acceptance))
    return tracker.advance(tracker.begin(), 0, None, views)[1].status


def test_the_mirror_image_of_a_nearly_flat_body_is_not_the_body(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # four of five markers are met to half a pixel
    assert status(pinhole_cameras, MIRRORED) == "ambiguous"


def test_so_many_markers_of_a_mirror_image_are_met_that_it_is_no_chance_and_yet_not_the_body(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    more = np.array([[0.0, 70, 0.5], [-20, -75, -0.5], [75, 0, 0.5], [-85, 10, -0.5]])
    points = np.concatenate([PLATE, more])
    given, shown = (
        Body("large plate", tuple(PointFeature(point) for point in points * [1, 1, side]))
        for side in (1, -1)
    )
    assert status(pinhole_cameras[:2], shown, given=given, mirrors=False) == "ok"
    assert status(pinhole_cameras[:2], shown, given=given) == "ambiguous"


def test_a_flat_body_whose_marker_before_the_plane_is_hidden_is_not_its_mirror_image(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    assert status(pinhole_cameras, BODY) == "ok"
    flat = Body("flat", BODY.features[:4])
    assert status(pinhole_cameras, flat) == "ok"


def test_a_false_point_beside_a_plane_is_no_mirror_image(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    flat = np.concatenate([PLATE[:4], [[40.0, 30.0, -60.0]]])
    views = []
    for k, camera in enumerate(pinhole_cameras):
        y, _ = camera.project(transform(TRUTH, flat))
        views.append(view_of(str(k), camera, y))
    tracker = Tracker.create(BODY, EstimatorOptions())
    assert tracker.advance(tracker.begin(), 0, None, views)[1].status == "ok"


@pytest.mark.parametrize("false", [0, 1])
@pytest.mark.parametrize("seed", [0, 1, 101])
@pytest.mark.parametrize("seen_by", [1, 2])
def test_a_body_given_mirrored_is_never_ok(
    pinhole_cameras: list[PinholeCamera], seed: int, seen_by: int, false: int
) -> None:
    points = np.random.default_rng(seed).uniform(-80, 80, (6, 3))
    given = Body("given", tuple(PointFeature(point) for point in points * [1, 1, -1]))
    shown = Body("shown", tuple(PointFeature(point) for point in points))
    tracker = Tracker.create(given, EstimatorOptions())
    track = tracker.begin()
    for frame in range(5):
        T = perturb(TRUTH, np.array([frame, 0, 0, 0, 0.02 * frame, 0]))
        views = detect(pinhole_cameras[:seen_by], shown, T, noise=0.2, false=false, seed=frame)
        track, estimate = tracker.advance(track, frame, None, views)
        assert estimate.status != "ok"


def test_a_body_once_seen_as_its_mirror_image_stays_in_doubt_where_both_are_alike(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # the mirror image of four markers in a plane, one before it, is these four as well
    points = PLATE * ([[1, 1, 0]] * 4 + [[1, 1, 1]])
    given, shown = (
        Body("plate", tuple(PointFeature(point) for point in points * [1, 1, side]))
        for side in (1, -1)
    )
    plane = Body("plane", given.features[:4])
    tracker = Tracker.create(given, EstimatorOptions())
    for first, expected in ((given, "ok"), (shown, "ambiguous")):
        track = tracker.begin()
        for frame, body in enumerate((first, plane, plane)):
            views = detect(pinhole_cameras, body, TRUTH, noise=0.2, seed=frame)
            track, estimate = tracker.advance(track, frame, None, views)
            assert estimate.status == expected
    # and frames that show the body itself end it
    for frame in (3, 4):
        views = detect(pinhole_cameras, given, TRUTH, noise=0.2, seed=frame)
        track, estimate = tracker.advance(track, frame, None, views)
    assert estimate.status == "ok"


def test_a_body_few_of_whose_markers_are_seen_beside_false_ones_is_not_its_mirror_image(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    views = detect(pinhole_cameras, BODY, TRUTH, noise=0.2, hidden=1, false=3)
    tracker = Tracker.create(BODY, EstimatorOptions())
    assert tracker.advance(tracker.begin(), 0, None, views)[1].status == "ok"


def test_a_body_in_a_plane_is_its_own_mirror_image() -> None:
    along = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    places = np.random.default_rng(1).uniform(-80, 80, (7, 2)) @ along[:2] + 20.0

    def body(points: Floats) -> Body:
        return Body("plane", tuple(PointFeature(point) for point in points))

    # what rounding leaves is 1e-15 of its size; a marker 10 um before it is worth a look
    assert thickness(body(places)) < 1e-6
    assert thickness(body(places + 0.01 * np.eye(7)[:, :1] * along[2])) > 1e-6
    assert thickness(body(places[:2])) < 1e-6


def test_what_frames_say_against_a_mirrored_body_holds_in_those_that_say_nothing(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    points = PLATE * ([[1, 1, 0]] * 4 + [[1, 1, 1]])
    given = Body("plate", tuple(PointFeature(point) for point in points))
    plane = Body("plane", given.features[:4])
    tracker = Tracker.create(given, EstimatorOptions())
    track, told = tracker.begin(), list[float]()
    for frame, body in enumerate((given, plane, plane, plane, plane)):
        views = detect(pinhole_cameras, body, TRUTH, noise=0.2, seed=frame)
        track, estimate = tracker.advance(track, frame, None, views)
        assert estimate.status == "ok"
        told.append(track.mistaken[MIRROR_IMAGE].log_odds)
    # as sure as one session in 2e-4² may be, at the most
    assert told == pytest.approx([2 * np.log(2e-4)] * 5)
    # and four markers in a plane, which are their own mirror image, are not asked any more
    views = detect(pinhole_cameras, plane, TRUTH, noise=0.2, seed=5)
    doubted = replace(track, mistaken={MIRROR_IMAGE: Mistake(MIRROR_IMAGE, MIRROR_IMAGE, 1.0, 0.0)})
    odds = 1.0 + np.log(2e-4)
    for known, share in ((track, 0.0), (doubted, 1 / (1 + np.exp(-odds)))):
        _, estimate = tracker.advance(known, 5, None, views)
        assert estimate.confidence == pytest.approx(1 - share, abs=2e-5)


def test_of_a_pose_that_meets_nothing_as_sensors_stand_no_odds_of_a_mirror_are_asked(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    """As where rows are read while a body moves fast: by itself, as if at rest, it meets none."""
    views = detect(pinhole_cameras[:1], BODY, TRUTH, noise=0.2, hidden=1)
    tracker = Tracker.create(BODY, EstimatorOptions())
    data = tracker.data(tracker.begin(), 0, None, views)
    best = tracker.explain(data)[0]
    away = replace(best, T_world_object=perturb(TRUTH, np.array([40.0, 0, 0, 0, 0, 0])))
    assert reflection_mistake(data, best).log_odds != -np.inf
    assert not np.isnan(reflection_mistake(data, away).log_odds)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_of_two_features_that_are_met_no_other_tilt_is_asked(
    pinhole_cameras: list[PinholeCamera], count: int
) -> None:
    few = Body("few", BODY.features[:count])
    views = detect(pinhole_cameras, few, TRUTH, noise=0.05)
    tracker = Tracker.create(BODY, EstimatorOptions())
    asked = {MIRROR_IMAGE: Mistake(MIRROR_IMAGE, MIRROR_IMAGE, 1.0, 0.0)}
    data = tracker.data(replace(tracker.begin(), mistaken=asked), 0, None, views)
    judged = likelihood_of(data).judge(Fit(TRUTH), Start(TRUTH))
    assert judged.features[0] == count
    assert np.isfinite(reflection_mistake(data, judged).log_odds)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("size", "count"), [(35.0, 8), (22.0, 6)])
@pytest.mark.parametrize("mirrors", [False, True])
def test_a_mirrored_body_that_one_camera_sees_from_afar_is_never_ok(
    pinhole_cameras: list[PinholeCamera], seed: int, size: float, count: int, mirrors: bool
) -> None:
    """Its depth reversed, the body looks as the mirror image does, but for some 0.3 px."""
    points = np.random.default_rng(seed).uniform(-size, size, (count, 3))
    given = Body("given", tuple(PointFeature(point) for point in points * [1, 1, -1]))
    shown = Body("shown", tuple(PointFeature(point) for point in points))
    tracker = Tracker.create(given, EstimatorOptions(mirrors=mirrors))
    for body in (shown, given):
        track, statuses = tracker.begin(), list[str]()
        for frame in range(8):
            T = perturb(TRUTH, np.array([3.0 * frame, 0, 0, 0, 0.05 * frame, 0.03 * frame]))
            views = detect(pinhole_cameras[:1], body, T, noise=0.05, seed=10 * seed + frame)
            track, estimate = tracker.advance(track, frame, None, views)
            statuses.append(estimate.status)
        assert statuses.count("ok") == (0 if body is shown else 8)
