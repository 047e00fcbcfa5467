"""A body that is in the frame twice: in a mirror, or one more of which nobody told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from bodies_in_view import OTHER, TOOL, at, body, off, scene_of, views_of

from mixpose.body import Body
from mixpose.fit import EstimatorOptions
from mixpose.judgement import ScoredPose
from mixpose.records import Estimate, Floats
from mixpose.rigid import from_rotation_vector
from mixpose.tracking import TWICE, Scene, Tracker
from mixpose.tracking.doubt import decide_frame
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.likelihood import likelihood_of
from mixpose.tracking.mirrors import IN_A_MIRROR, mirror_odds

FLAT = body("flat", TOOL * [1.0, 1.0, 0.0])
SOLID = body("solid", TOOL)
OPTIONS = EstimatorOptions()
HERE, THERE = at(-120.0), at(130.0, 60.0, turn=0.4)


def estimates_of(
    tracked: Body,
    shown: list[list[np.ndarray]],
    options: EstimatorOptions = OPTIONS,
    **there: Body,
) -> list[Estimate]:
    """Of frames that show the body at some poses each, or what stands `there` instead."""
    scene = Scene((Tracker.create(tracked, options),))
    tracks, found = scene.begin(), list[Estimate]()
    for frame, poses in enumerate(shown):
        bodies = [there.get("there", tracked) if T is THERE else tracked for T in poses]
        views = views_of(bodies, poses, frame)
        tracks, estimates = scene.advance(tracks, frame, None, views)
        found += estimates
    return found


@pytest.mark.parametrize("tracked", [FLAT, SOLID], ids=["flat", "solid"])
def test_a_second_body_makes_every_frame_ambiguous_from_its_first_on(tracked: Body) -> None:
    found = estimates_of(tracked, [[HERE]] * 4 + [[HERE, THERE]] * 8)
    assert [one.status for one in found] == ["ok"] * 4 + ["ambiguous"] * 8
    assert {one.doubt for one in found[4:]} == {TWICE}
    for one in found[4:]:
        places = np.array([each.T_world_object[:3, 3] for each in one.hypotheses])
        for T in (HERE, THERE):  # both are told
            assert np.linalg.norm(places - T[:3, 3], axis=1).min() < 2.0


def test_a_second_body_that_passes_right_beside_the_first_is_not_forgotten() -> None:
    points = np.random.default_rng(0).uniform(-50, 50, (7, 3))
    seven, six, four = (body(str(count), points[:count]) for count in (7, 6, 4))
    scene = Scene((Tracker.create(seven, OPTIONS),))
    tracks = scene.begin()
    for frame, x in enumerate(np.linspace(190.0, -370.0, 29)):
        there = at(x, 25.0, turn=0.4)
        is_near = np.linalg.norm(there[:3, 3] - HERE[:3, 3]) < seven.radius
        # four before one camera are sure to be it only where it was
        shown = [seven, four if is_near else six][: 1 + (frame > 2)]
        views = views_of(shown, [HERE, there][: len(shown)], frame)[:1]
        tracks, (found,) = scene.advance(tracks, frame, None, views)
        assert found.status == ("ok" if frame < 3 else "ambiguous"), frame


def test_the_frame_is_ok_again_once_the_other_one_is_gone() -> None:
    found = estimates_of(SOLID, [[HERE]] * 3 + [[HERE, THERE]] * 3 + [[HERE]] * 4)
    assert found[-1].status == "ok"
    assert found[-1].T_world_object is not None
    assert np.linalg.norm(found[-1].T_world_object[:3, 3] - HERE[:3, 3]) < 2.0


def test_what_stood_beside_the_body_is_not_it_when_the_body_goes() -> None:
    moved = TOOL + 8.0 * np.eye(len(TOOL))[-1][:, None] * [1.0, 0.0, 0.0]
    shown = [[HERE]] * 3 + [[HERE, THERE]] * 3 + [[THERE]] * 5 + [[HERE, THERE]] * 4
    found = estimates_of(SOLID, shown, there=body("like it", moved))
    for one in found[6:11]:
        # what missed a marker before two cameras, each one time in ten
        assert (one.status, one.doubt) == ("ambiguous", TWICE)
        assert one.confidence is not None
        assert one.confidence < 0.15
    assert off(found[-1], HERE)[0] < 2.0


@pytest.mark.parametrize(("off_mm", "status"), [(0.0, "ambiguous"), (1.5, "ok")])
def test_what_looks_like_the_body_as_closely_as_it_errs_is_a_second_one(
    off_mm: float, status: str
) -> None:
    other = body("other", TOOL + off_mm * np.random.default_rng(1).standard_normal(TOOL.shape))
    found = estimates_of(SOLID, [[HERE]] * 4 + [[HERE, THERE]] * 4, there=other)
    assert {one.status for one in found[4:]} == {status}
    for one in found[4:]:
        assert status == "ambiguous" or off(one, HERE)[0] < 1.0


def test_what_differs_by_a_marker_is_told_from_the_body_though_others_are_hidden_later() -> None:
    points = np.random.default_rng(0).uniform(-50, 50, (7, 3))
    seven, part = body("seven", points), body("part", points[:5])
    moved = points.copy()
    moved[5, 0] += 4.0  # 3 px, which is near enough to be met
    other, scene = body("other", moved), Scene((Tracker.create(seven, OPTIONS),))
    tracks, told = scene.begin(), list[Estimate]()
    for frame, shown in enumerate([[seven]] * 2 + [[seven, other]] * 3 + [[part, other]] * 3):
        views = views_of(shown, [HERE, THERE][: len(shown)], frame)
        tracks, (found,) = scene.advance(tracks, frame, None, views)
        told.append(found)
    assert [one.status for one in told[:6]] == ["ok"] * 6
    # of all frames the one counts that tells most: the other one has seven, the body five then
    assert told[-1].status == "ok"
    assert all(off(one, HERE)[0] < 1.0 for one in told if one.status == "ok")


def test_as_many_other_spots_are_no_second_body() -> None:
    other = body("other", OTHER)
    scene = Scene((Tracker.create(SOLID, EstimatorOptions()),))
    tracks = scene.begin()
    for frame in range(12):
        poses = [HERE, at(130.0 + 3.0 * frame)]
        views = views_of([SOLID, other], poses, frame)
        tracks, (estimate,) = scene.advance(tracks, frame, None, views)
        assert estimate.status == "ok"


def test_identical_bodies_that_the_session_counts_are_no_surprise() -> None:
    scene = scene_of(SOLID, SOLID)
    tracks = scene.begin()
    for frame in range(4):
        views = views_of([SOLID, SOLID], [HERE, THERE], frame)
        tracks, estimates = scene.advance(tracks, frame, None, views)
        assert [one.status for one in estimates] == ["ok", "ok"]


def test_one_more_than_the_session_counts_makes_all_identical_bodies_ambiguous() -> None:
    scene = scene_of(SOLID, SOLID)
    tracks = scene.begin()
    for frame in range(10):
        shown = [HERE, THERE, at(10.0, -120.0, turn=-0.5)][: 2 + (frame >= 4)]
        views = views_of([SOLID] * len(shown), shown, frame)
        tracks, estimates = scene.advance(tracks, frame, None, views)
        told = [(one.status, one.doubt) for one in estimates]
        assert told == [("ok", "") if frame < 4 else ("ambiguous", TWICE)] * 2, frame


def test_an_identical_body_that_comes_back_leaves_the_other_ok() -> None:
    scene = scene_of(SOLID, SOLID)
    tracks = scene.begin()
    for frame in range(30):
        other = THERE if frame < 5 else at(10.0, -120.0, turn=-0.5)
        shown = [HERE, other][: 1 + (not 5 <= frame < 14)]
        views = views_of([SOLID] * len(shown), shown, frame)[:1]  # it is searched for in turn
        tracks, estimates = scene.advance(tracks, frame, None, views)
        here = [
            one for one in estimates if one.T_world_object is not None and off(one, HERE)[0] < 30
        ]
        assert [one.status for one in here] == ["ok"], frame


def test_where_there_are_mirrors_a_flat_body_by_itself_is_never_ok() -> None:
    options = replace(EstimatorOptions(), mirrors=True)
    found = estimates_of(FLAT, [[HERE]] * 6, options)
    assert {(one.status, one.doubt) for one in found} == {("ambiguous", IN_A_MIRROR)}
    assert all(one.status == "ok" for one in estimates_of(SOLID, [[HERE]] * 6, options))


def test_where_there_are_mirrors_a_flat_body_whose_markers_face_one_side_is_ok() -> None:
    options = replace(EstimatorOptions(), mirrors=True)
    one_side = replace(FLAT, normals=np.tile([0.0, 0.0, -1.0], (len(FLAT), 1)))
    assert all(one.status == "ok" for one in estimates_of(one_side, [[HERE]] * 6, options))
    # but a square turned over lies on itself: its image in a mirror has the same face
    corners = np.array([[-40.0, -40, 0], [40, -40, 0], [40, 40, 0], [-40, 40, 0]])
    square = replace(body("square", corners), normals=np.tile([0.0, 0.0, -1.0], (4, 1)))
    found = estimates_of(square, [[HERE]] * 6, options)
    assert {(one.status, one.doubt) for one in found} == {("ambiguous", IN_A_MIRROR)}


def in_mirror(T: Floats, own: Sequence[float] = (1.0, 1.0, -1.0)) -> Floats:
    """Where a body is seen in a mirror 150 mm behind the middle of the scene.

    A reflection, by the signs of its coordinates, maps it onto its `own` features.
    """
    M = np.diag([1.0, 1.0, -1.0, 1.0])
    M[2, 3] = 300.0
    return M @ T @ np.diag([*own, 1.0])


@pytest.mark.parametrize("mirrors", [False, True])
def test_of_a_flat_body_and_its_mirror_image_the_nearer_one_is_it(mirrors: bool) -> None:
    own = [at(-60.0 + 4.0 * frame, turn=0.02 * frame) for frame in range(10)]
    shown = [[in_mirror(T), T][: 1 + (k >= 4)] for k, T in enumerate(own)]
    found = estimates_of(FLAT, shown, replace(EstimatorOptions(), mirrors=mirrors))
    # what is seen in the mirror alone could be the body behind a window
    assert {one.status for one in found[:4]} == {"ambiguous" if mirrors else "ok"}
    assert [one.status for one in found[4:]] == ["ok"] * 6
    for one, T in zip(found[4:], own[4:], strict=True):
        assert off(one, T)[0] < 1.0  # 0.2 px are 0.24 mm across


def test_what_lies_between_a_body_and_its_mirror_image_is_no_motion() -> None:
    scene = Scene((Tracker.create(FLAT, OPTIONS),))
    tracks, T = scene.begin(), at(-60.0)
    for frame, poses in enumerate(([in_mirror(T)], [in_mirror(T)], [in_mirror(T), T])):
        tracks, (found,) = scene.advance(
            tracks, frame, None, views_of([FLAT] * len(poses), poses, frame)
        )
    assert off(found, T)[0] < 1.0
    body_s, image_s = tracks[0].branches
    assert body_s.velocity is None
    assert image_s.velocity is not None
    assert np.abs(image_s.velocity[:3]).max() < 2.0  # it rests, and is not where the body is


def test_a_body_that_is_seen_beside_its_mirror_image_is_known_when_that_is_hidden() -> None:
    own = [at(-60.0 + 4.0 * frame) for frame in range(8)]
    shown = [[T, in_mirror(T)][: 2 if k < 5 else 1] for k, T in enumerate(own)]
    found = estimates_of(FLAT, shown, replace(EstimatorOptions(), mirrors=True))
    assert [one.status for one in found] == ["ok"] * 8


def test_a_body_is_told_from_its_mirror_image_though_more_of_it_is_hidden() -> None:
    points = np.random.default_rng(3).uniform(-50, 50, (9, 3)) * [1.0, 1.0, 0.0]
    whole, part, T = body("whole", points), body("part", points[:5]), at(-60.0)
    scene = Scene((Tracker.create(whole, OPTIONS),))
    tracks = scene.begin()
    for frame in range(3):
        views = views_of([whole, part], [in_mirror(T), T], frame)
        tracks, (found,) = scene.advance(tracks, frame, None, views)
    # four markers more that both cameras miss are odds of 3^8 for the image, in any place
    assert found.status == "ok"
    assert off(found, T)[0] < 1.0


def frame_of(tracked: Body, T: Floats, T_other: Floats) -> tuple[Frame, ScoredPose, ScoredPose]:
    """A frame that shows a body twice, and the poses that were fitted there."""
    tracker = Tracker.create(tracked, OPTIONS)
    data = tracker.data(tracker.begin(), 0, None, views_of([tracked] * 2, [T, T_other], 0))
    likelihood = likelihood_of(data)
    starts = [Start(each, data.close_uncertainty) for each in (T, T_other)]
    one, other = (likelihood.judge(likelihood.fit(start), start) for start in starts)
    return data, one, other


def test_two_poses_are_mirrored_only_about_a_plane_between_them() -> None:
    T = at(-60.0)
    for there, is_mirrored in (
        (in_mirror(T), True),
        (in_mirror(T) @ from_rotation_vector([0.0, 0.0, 0.1], np.zeros(3)), False),  # 6 deg
        (in_mirror(T) + np.eye(4)[:, :1] * [0.0, 0.0, 0.0, 10.0], False),  # 10 mm along it
        (THERE, False),
    ):
        data, one, other = frame_of(FLAT, T, there)
        odds, is_first = mirror_odds(data, one, other)
        # a turn within 2π that is known to 3e-3, and two shifts within 300 mm to 0.5 mm
        assert (odds > 12.0) == is_mirrored
        assert (odds < 0.0) != is_mirrored
        back, is_other = mirror_odds(data, other, one)
        assert back == pytest.approx(odds, rel=1e-3)
        assert not is_mirrored or (is_first and not is_other)


def test_no_body_reaches_through_a_mirror() -> None:
    # its other tilt before one camera is nearly its image in a plane across the line of sight
    T, tilted = at(0.0), at(0.0)
    tilted[:3, :3] = np.diag([1.0, 1.0, -1.0]) @ T[:3, :3] @ np.diag([1.0, 1.0, -1.0])
    data, one, other = frame_of(FLAT, T, tilted)
    assert mirror_odds(data, one, other)[0] == -np.inf
    # and what is not flat has no mirror image that looks like it
    data, one, other = frame_of(SOLID, T, in_mirror(T))
    assert mirror_odds(data, one, other)[0] == -np.inf


def test_what_two_poses_explain_alike_is_in_no_mirror() -> None:
    """A mirror image is seen beside the body; of two tilts of a small body the one is no image."""
    T = at(-60.0)
    data, one, other = frame_of(FLAT, T, in_mirror(T))
    assert [each for each, _ in decide_frame(data, [one, other]).kept] == [one]
    # of the features in two cameras half are met by the same detections, then all
    for alike in (1, 2):
        by = other.matches.detections.copy()
        by[:alike] = one.matches.detections[:alike]
        same = replace(other, matches=replace(other.matches, detections=by))
        assert {id(each) for each, _ in decide_frame(data, [one, same]).kept} == {id(one), id(same)}


def test_a_solid_body_that_looks_the_same_in_a_mirror_is_told_from_its_image() -> None:
    roof = np.array([[50, 0, 0], [-50, 0, 0], [0, 40, 30], [0, -40, 30], [0, 70, -10.0]])
    T = at(-60.0, turn=0.3)
    data, one, other = frame_of(body("roof", roof), T, in_mirror(T, (-1.0, 1.0, 1.0)))
    odds, is_first = mirror_odds(data, one, other)
    assert odds > 12.0
    assert is_first


def test_where_nothing_is_left_beside_the_body_nothing_is_sought() -> None:
    """Three markers that were there twice, without the false spot."""
    few = body("few", TOOL[:3])
    scene = scene_of(few)
    tracks = scene.begin()
    for frame in range(6):
        views, poses = [], [HERE, THERE] if frame < 3 else [HERE]
        for view in views_of([few] * len(poses), poses, frame):
            assert view.observation.points is not None
            own = view.observation.points[:, 0] > 60.0
            views.append(replace(view, observation=view.observation.only(own)))
        tracks, (estimate,) = scene.advance(tracks, frame, None, views)
    assert off(estimate, HERE)[0] < 5.0


def test_a_second_body_before_a_late_camera_is_followed_where_it_is() -> None:
    """Both move by 10 px a frame; the right camera takes its frame half a frame later."""
    scene = Scene((Tracker.create(SOLID, EstimatorOptions()),))
    tracks, late = scene.begin(), 0.5 / 30
    for frame in range(12):
        now, then = (
            [at(-120.0, y), at(130.0, 60.0 - y, turn=0.4)][: 1 + (frame >= 4)]
            for y in (12.0 * frame - 60.0, 12.0 * (frame + 0.5) - 60.0)
        )
        left, _ = views_of([SOLID] * len(now), now, frame)
        _, right = views_of([SOLID] * len(now), then, frame)
        views = [left, replace(right, delay=late)]
        tracks, (estimate,) = scene.advance(tracks, frame, frame / 30, views)
        if frame < 4:
            assert estimate.status == "ok"
            assert off(estimate, now[0])[0] < 2.0
            continue
        assert (estimate.status, estimate.doubt) == ("ambiguous", TWICE)
        places = np.array([each.T_world_object[:3, 3] for each in estimate.hypotheses])
        # in its first frame its velocity is not known: 0.3 m/s for 17 ms
        for T, limit in zip(now, (2.0, 5.0 if frame == 4 else 2.0), strict=True):
            assert np.linalg.norm(places - T[:3, 3], axis=1).min() < limit
