"""Spots that have not the size of a marker are known to be cut, and tell less of a pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from detections import TRUTH
from numpy.typing import NDArray

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions
from mixpose.objective import View, project_body
from mixpose.records import PointPattern
from mixpose.rigid import rotation_angle_deg, transform
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Tracker
from mixpose.tracking.rules import Rules
from mixpose.tracking.sizes import SizeRules, Sizes, _scales, sizes_after, weighed_by_size

Floats = NDArray[np.float64]

RULES = SizeRules()
RADIUS, NOISE = 5.0, 0.03  # of markers, mm; of centres, px
PLACES = np.array([[0, 0, 0], [60, 5, 0], [-50, 20, 15], [20, -40, 30], [-30, -25, 60.0]])
BODY = Body("pointer", tuple(PointFeature(place) for place in PLACES))


def seen(
    cameras: Sequence[PinholeCamera],
    rng: np.random.Generator,
    lost: dict[tuple[int, int], float] | None = None,
    T: Floats = TRUTH,
) -> list[View]:
    """Disks before cameras; of some, by camera and marker, a share of the area is hidden."""
    at = project_body(tuple(cameras), BODY).project(T[None])
    views = []
    for k, camera in enumerate(cameras):
        scales = np.sqrt(np.square(at.J[k, 0, :, :, :3]).sum(axis=(1, 2)) / 2)
        radii = RADIUS * scales
        points = at.y[k, 0] + rng.normal(0, NOISE, (len(PLACES), 2))
        for (camera_cut, marker), share in (lost or {}).items():
            if camera_cut == k:
                # what is lost lies at the rim: the centroid of the rest moves away from it
                points[marker, 0] += radii[marker] * share / (1 - share)
                radii[marker] *= np.sqrt(1 - share)
        pattern = PointPattern(points, np.ones(len(points)), np.zeros(len(points)), radii)
        views.append(View(str(k), camera, Observation(pattern, 1.5)))
    return views


def test_whole_spots_teach_the_size_and_how_exact_it_is() -> None:
    rng, sizes = np.random.default_rng(0), Sizes()
    for _ in range(40):
        logs = np.log(RADIUS) + rng.normal(0, 0.02, 8)
        logs[0] -= 0.7  # one in eight is cut to half its radius
        sizes = sizes.followed({"0": logs}, RULES)
    assert np.exp(sizes.mean) == pytest.approx(RADIUS, rel=0.01)
    assert 0.02 < sizes.scatter(RULES) < 0.035  # 0.02, drawn to what is believed before
    whole, cut = sizes.cut(np.array([0.02, -0.7]), RULES)
    assert whole < 0.05
    assert cut > 0.999


def test_what_glows_has_a_size_of_its_own_in_each_sensor_and_disks_have_one() -> None:
    rng = np.random.default_rng(0)
    glowing, disks = Sizes(), Sizes()
    for _ in range(10):
        left, right = np.log(RADIUS) + rng.normal(0, 0.02, (2, 7))
        glowing = glowing.followed({"left": left, "right": right + 0.7}, RULES)
        disks = disks.followed({"left": left, "right": right}, RULES)
    for sizes, off in ((glowing, 0.7), (disks, 0.0)):
        left, right = sizes.centres(["left", "right"], RULES)
        assert left == pytest.approx(np.log(RADIUS), abs=0.03)
        assert right == pytest.approx(np.log(RADIUS) + off, abs=0.03)
        assert sizes.scatter(RULES) < 0.04  # of either by itself
    # a sensor that shows one spot, cut, for the first time: of disks the others tell it
    cut = {"new": np.log(RADIUS) + np.array([-0.5])}
    assert disks.followed(cut, RULES).centres(["new"], RULES)[0] > np.log(RADIUS) - 0.25


def test_markers_told_to_be_of_several_sizes_are_whole_at_their_own(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    ratios = np.array([0.5, 1.0, 1.5, 0.7, 1.2])
    body = replace(BODY, radii=RADIUS * ratios)
    views = []
    for view in seen(pinhole_cameras, np.random.default_rng(0)):
        pattern = view.observation.pattern
        assert isinstance(pattern, PointPattern)
        radii = PointPattern(
            pattern.points, pattern.weights, np.zeros(len(ratios)), ratios * pattern.radii
        )
        views.append(replace(view, observation=Observation(radii, 1.5)))
    tracker = Tracker.create(body, EstimatorOptions(), TRUTH)
    track, told = tracker.advance(tracker.begin(), 0, 0.0, views)
    assert told.status == "ok"
    assert track.sizes.scatter(RULES) < RULES.scatter
    for view in weighed_by_size(views, body, TRUTH, track.sizes, RULES):
        pattern = view.observation.pattern
        assert isinstance(pattern, PointPattern)
        assert pattern.deviations.max() == 0.0
    # told to be alike, the small ones seem cut
    (alike, _) = weighed_by_size(views, BODY, TRUTH, Sizes(200.0, np.log(RADIUS), 0.02), RULES)
    assert isinstance(alike.observation.pattern, PointPattern)
    assert alike.observation.pattern.deviations.max() > 1.0


@pytest.mark.parametrize("tilt_deg", [0.0, 50.0, 75.0])
def test_disks_are_as_large_as_they_are_turned(
    pinhole_cameras: list[PinholeCamera], tilt_deg: float
) -> None:
    points, turn = np.array([one.mean for one in BODY.features]), np.radians(tilt_deg)
    eye = pinhole_cameras[0]
    towards = eye.T_sensor_world[2, :3] @ TRUTH[:3, :3]
    across = np.cross(towards, [1.0, 0.0, 0.0])
    normal = -np.cos(turn) * towards + np.sin(turn) * across / np.linalg.norm(across)
    normals = np.tile(normal, (len(points), 1))
    radii = np.full(len(points), RADIUS)
    body = replace(BODY, shape="disk", radii=radii, normals=normals)
    at = project_body((eye,), body).project(TRUTH[None])
    scale = _scales(at.J[0, 0], TRUTH, body)
    # against the areas of polygons on the rims
    u, v = np.linalg.svd(normal[None])[2][1:]
    angles = np.linspace(0, 2 * np.pi, 100, endpoint=False)[:, None]
    rim = points[:, None] + RADIUS * (np.cos(angles) * u + np.sin(angles) * v)
    y, _ = eye.project(transform(TRUTH, rim.reshape(-1, 3)))
    areas = [cv2.contourArea(one.astype(np.float32)) for one in y.reshape(len(points), -1, 2)]
    np.testing.assert_allclose(np.pi * (RADIUS * scale) ** 2, areas, rtol=0.01)


def test_sizes_that_scatter_tell_nothing() -> None:
    rng, sizes = np.random.default_rng(0), Sizes()
    for _ in range(20):
        sizes = sizes.followed({"0": np.log(RADIUS) + rng.normal(0, 0.3, 8)}, RULES)
    assert sizes.cut(np.array([-0.4]), RULES)[0] < 0.5


def test_a_spot_is_taken_to_be_off_by_as_much_as_its_area_says(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    rng, share = np.random.default_rng(1), 0.3
    views = seen(pinhole_cameras, rng, {(0, 2): share})
    known = Sizes(200.0, float(np.log(RADIUS)), 200 * 0.01**2)
    found = weighed_by_size(views, BODY, TRUTH, known, RULES)
    pattern = found[0].observation.pattern
    assert isinstance(pattern, PointPattern)
    assert pattern.cut is not None
    whole = np.delete(pattern.deviations, 2)
    assert whole.max() < NOISE
    before = views[0].observation.pattern
    assert isinstance(before, PointPattern)
    # of each of two coordinates; it was moved by R s / (1 − s)
    radius = before.radii[2] / np.sqrt(1 - share)
    assert pattern.deviations[2] == pytest.approx(radius * share / np.sqrt(2), rel=0.02)


def test_before_any_size_is_known_and_without_radii_views_stay_as_they_are(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    views = seen(pinhole_cameras, np.random.default_rng(2))
    assert weighed_by_size(views, BODY, TRUTH, Sizes(), RULES) == views
    known = Sizes(50.0, float(np.log(RADIUS)), 0.005)
    plain = []
    for view in views:
        pattern = view.observation.pattern
        assert isinstance(pattern, PointPattern)
        points = PointPattern(pattern.points, pattern.weights)
        plain.append(replace(view, observation=Observation(points, 1.5)))
    assert weighed_by_size(plain, BODY, TRUTH, known, RULES) == plain


def test_slivers_do_not_turn_a_pose_and_are_no_reason_to_be_sure(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    """From the second frame on two of five markers are cut to a third in each camera."""
    rng, errors = np.random.default_rng(3), []
    tracker = Tracker.create(BODY, EstimatorOptions(), TRUTH)
    track, first = tracker.advance(tracker.begin(), 0, 0.0, seen(pinhole_cameras, rng))
    assert first.status == "ok"
    assert np.exp(track.sizes.mean) == pytest.approx(RADIUS, rel=0.02)
    for frame in range(1, 6):
        cut = {(camera, marker): 0.6 for camera in range(2) for marker in (1, 2)}
        views = seen(pinhole_cameras, rng, cut)
        track, told = tracker.advance(track, frame, frame / 30, views)
        assert told.T_world_object is not None
        errors.append(rotation_angle_deg(told.T_world_object, TRUTH))
    # three whole markers before two cameras tell the turn to 0.03 px of 60 px
    assert max(errors) < 0.15


def test_a_frame_by_itself_learns_the_size_from_its_pose(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    views = seen(pinhole_cameras, np.random.default_rng(4), {(0, 1): 0.35})
    exact = Rules(sizes=SizeRules(scatter=0.03))  # disks
    tracker = Tracker.create(BODY, EstimatorOptions(), TRUTH, rules=exact)
    data = tracker.data(tracker.begin(), 0, None, views)
    best = tracker.explain(data)[0]
    assert np.isfinite(best.used.cut).all()
    deviation = np.sqrt(best.used.extra[0, 1]) * best.used.sigmas[0]
    known = sizes_after(Sizes(), best, BODY, RULES)
    assert np.exp(known.mean) == pytest.approx(RADIUS, rel=0.05)
    # off by half a radius
    assert deviation > 10 * NOISE


def test_a_body_that_is_far_from_where_it_was_expected_is_weighed_where_it_is(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    """Twice as near its spots are twice as large; there they are whole, and not merged."""
    rng = np.random.default_rng(3)
    tracker = Tracker.create(BODY, EstimatorOptions(), TRUTH)
    track = tracker.begin()
    centres = [np.linalg.inv(one.T_sensor_world)[:3, 3] for one in pinhole_cameras]
    near = TRUTH.copy()
    near[:3, 3] = (TRUTH[:3, 3] + np.mean(centres, axis=0)) / 2
    for frame, T in enumerate([TRUTH] * 5 + [near, TRUTH, near]):
        views = seen(pinhole_cameras, rng, T=T)
        _, alone = tracker.advance(tracker.begin(), frame, None, views)
        track, estimate = tracker.advance(track, frame, None, views)
        assert estimate.status == "ok", frame
        assert estimate.covariance is not None
        assert alone.covariance is not None
        # frames before tell how exact spots are, which makes it narrower
        assert np.trace(estimate.covariance[:3, :3]) < 2 * np.trace(alone.covariance[:3, :3])


def test_spots_that_all_change_alike_are_whole_and_those_that_are_cut_are_not() -> None:
    rng, sizes = np.random.default_rng(0), Sizes()
    for _ in range(20):
        sizes = sizes.followed({"0": np.log(RADIUS) + rng.normal(0, 0.02, 6)}, RULES)
    (centre,) = sizes.centres(["0"], RULES)
    brighter = centre + 0.3 + rng.normal(0, 0.02, 6)
    assert sizes.centre_now(brighter, centre, RULES) == pytest.approx(centre + 0.3, abs=0.03)
    # whole ones beside cut ones, cut ones alone, and one that may be anything
    for others in ([0.0, 0.01, -0.3, -0.31, 0.02], [-0.2, -0.5, -0.9, -0.33, -0.7], [-0.3]):
        assert sizes.centre_now(centre + np.array(others), centre, RULES) == centre


@pytest.mark.parametrize("changed", [(0,), (0, 1)])
def test_where_light_or_exposure_changes_frames_stay_ok(
    pinhole_cameras: list[PinholeCamera], changed: tuple[int, ...]
) -> None:
    rng, tracker = np.random.default_rng(0), Tracker.create(BODY, EstimatorOptions())
    track = tracker.begin()
    for frame in range(16):
        views = seen(pinhole_cameras, rng)
        for k in changed if frame >= 8 else ():
            pattern = views[k].observation.pattern
            assert isinstance(pattern, PointPattern)
            assert pattern.radii is not None
            larger = replace(pattern, radii=1.3 * pattern.radii)
            views[k] = replace(views[k], observation=Observation(larger, 1.5))
        track, estimate = tracker.advance(track, frame, None, views)
        assert estimate.status == "ok"
