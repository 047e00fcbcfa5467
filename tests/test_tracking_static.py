"""Lamps and screws that stay where they are while the body is lost are searched last."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from detections import EIGHT, TRUTH, detect, view_of
from numpy.typing import NDArray

from mixpose.density import Observation
from mixpose.fit import EstimatorOptions
from mixpose.objective import View
from mixpose.records import Estimate, PointPattern
from mixpose.rigid import transform
from mixpose.sensors import CloudSensor, PinholeCamera, from_planes
from mixpose.tracking import Track, Tracker
from mixpose.tracking.clouds import plane_views
from mixpose.tracking.rules import ProposalRules
from mixpose.tracking.static_clutter import StaticClutter

Floats = NDArray[np.float64]

FRAMES = ProposalRules().static


def tracker_of(static: int = FRAMES) -> Tracker:
    tracker = Tracker.create(EIGHT, EstimatorOptions(search="live"))
    proposals = replace(tracker.rules.proposals, static=static)
    return replace(tracker, rules=replace(tracker.rules, proposals=proposals))


def room(cameras: list[PinholeCamera], seed: int, seen: bool) -> list[View]:
    """Thirty lamps a camera, which flicker by 0.2 px, and the body where it is seen."""
    rng = np.random.default_rng(seed)
    views = []
    for k, camera in enumerate(cameras):
        lamps = np.random.default_rng(100 + k).uniform([0, 0], camera.upper, (30, 2))
        y, _ = camera.project(transform(TRUTH, EIGHT.means if seen else EIGHT.means[:0]))
        points = np.concatenate([lamps, y])
        views.append(view_of(str(k), camera, points + 0.2 * rng.standard_normal(points.shape)))
    return views


def entered(cameras: list[PinholeCamera], static: int) -> tuple[Track, Estimate]:
    """The frame in which the body comes into a room that was watched for a while."""
    tracker = tracker_of(static)
    track = tracker.begin()
    for frame in range(FRAMES):
        views = room(cameras, frame, seen=False)
        track = track.missed(track.search, track.clutter.learnt(views, static))
    return tracker.advance(track, FRAMES, None, room(cameras, 99, seen=True))


def test_a_body_that_comes_into_a_room_full_of_lamps_is_found_among_what_moves(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    one = pinhole_cameras[:1]
    _, known = entered(one, FRAMES)
    assert known.status == "ok"
    # 7,770 triples of 38 rays as 336 triples of features; 56 of the eight that move
    _, unknown = entered(one, 1000)
    assert unknown.status == "lost"


def test_a_body_that_stands_still_is_found_all_the_same(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    views = detect(pinhole_cameras[:2], EIGHT, TRUTH, noise=0.2)
    clutter = StaticClutter()
    for _ in range(FRAMES):
        clutter = clutter.learnt(views, FRAMES)
    assert all(one.observation.is_empty for one in clutter.without(views, FRAMES))
    tracker = tracker_of()
    track = tracker.begin().missed(tracker.begin().search, clutter)
    assert tracker.advance(track, 1, None, views)[1].status == "ok"


def test_a_place_counts_as_static_from_ten_frames_and_is_forgotten_as_slowly(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    lamp = [view_of("0", pinhole_cameras[0], np.array([[100.0, 200.0]]))]
    off = [view_of("0", pinhole_cameras[0], np.array([[900.0, 50.0]]))]
    clutter = StaticClutter()
    for frame in range(1, 12):
        clutter = clutter.learnt(lamp, FRAMES)
        pattern = clutter.without(lamp, FRAMES)[0].observation.pattern
        assert isinstance(pattern, PointPattern)
        assert len(pattern.points) == (1 if frame < 10 else 0)
    for frame in range(1, 12):
        clutter = clutter.learnt(off, FRAMES)
        pattern = clutter.without(lamp, FRAMES)[0].observation.pattern
        assert isinstance(pattern, PointPattern)
        # eleven times there, and not there since
        assert len(pattern.points) == (0 if frame < 2 else 1)


def test_a_point_of_a_cloud_stays_where_it_is_if_it_does_in_all_three_images() -> None:
    lamps = np.random.default_rng(3).uniform(-500, 500, (6, 3))
    # seen in the place of a lamp along one axis only: one image takes each for a lamp
    moved = lamps[:3] + 100 * np.eye(3)[[2, 0, 1]]
    before, after = (as_seen(points) for points in (lamps, np.concatenate([lamps[3:], moved])))
    clutter = StaticClutter()
    for _ in range(FRAMES):
        clutter = clutter.learnt(before, FRAMES)
    left = clutter.without(after, FRAMES)
    places = from_planes(np.array([view.observation.points for view in left]))
    np.testing.assert_allclose(places, moved, atol=1e-9)


def as_seen(points: Floats) -> list[View]:
    """A cloud of points in its three images."""
    cloud = CloudSensor()
    seen = PointPattern(points, np.ones(len(points)))
    return plane_views(View("cloud", cloud, Observation(seen, 1.0)))
