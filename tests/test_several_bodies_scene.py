"""Several bodies in one scene: each detection is one body's, and identical ones keep their numbers.

Scenes are drawn here from the cameras' geometry alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bodies_in_view import CAMERAS, OTHER, TOOL, at, body, off, scene_of, views_of

import mixpose
from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.objective import SharedDensities, View, matched_objective, together
from mixpose.poses.evaluate import evaluate
from mixpose.poses.jsonl import PoseFile, read_poses
from mixpose.poses.poseline import PoseLine
from mixpose.records import Estimate, Floats, PointPattern
from mixpose.search import SearchResult, search_frame
from mixpose.tracking import Scene, Track
from mixpose.tracking.claims import Claims, places_of
from mixpose.tracking.rules import SceneRules
from mixpose.tracking.sharing import Sharing

RECORDING = Path(__file__).parents[1] / "data" / "synthetic" / "several_bodies"


def test_a_recording_of_two_different_and_two_identical_bodies() -> None:
    session = mixpose.load_session(RECORDING / "session.toml")
    lines = [PoseLine(**vars(one)) for one in mixpose.run(session)]
    found = evaluate(
        PoseFile(Path("poses"), {}, tuple(lines), "mm"), read_poses(RECORDING / "truth.jsonl")
    )
    assert len(lines) == 4 * 30
    assert found.ok == 120
    assert found.swaps is not None
    assert found.swaps.count == 0
    # one body alone before such cameras has 0.03 degrees at worst over 16 recordings; a rod is
    # hidden by others for a third of the frames
    for each in found.bodies.values():
        assert each.rotation_deg is not None
        assert each.translation is not None
        assert each.rotation_deg.median < 0.03
        assert each.rotation_deg.rms < 0.15
        assert each.translation.rms < 0.06
    assert found.nees is not None
    assert found.nees.mean_per_dimension < 1.5


def test_bodies_found_from_nothing_are_those_that_are_there() -> None:
    bodies = [body("tool", TOOL), body("other", OTHER)]
    poses = [at(-100, turn=0.4), at(110, 30, turn=-0.8)]
    scene = scene_of(*bodies)
    _, estimates = scene.advance(scene.begin(), 0, None, views_of(bodies, poses, 1))
    for estimate, T in zip(estimates, poses, strict=True):
        assert estimate.status == "ok"
        away, angle = off(estimate, T)
        assert away < 1.0  # 0.2 px are 0.24 mm at this distance
        assert angle < 1.0


def test_a_body_that_is_not_there_is_not_found_on_its_twin() -> None:
    bodies = [body("rod", TOOL)]
    one = bodies[0]
    scene = scene_of(one, one)
    _, estimates = scene.advance(scene.begin(), 0, None, views_of(bodies, [at(20)], 2))
    assert [estimate.status for estimate in estimates] == ["ok", "lost"]


def test_bodies_are_lost_where_no_sensor_sees_anything() -> None:
    bodies = [body("tool", TOOL), body("other", OTHER)]
    scene, views = scene_of(*bodies), views_of(bodies, [at(-100), at(110, 30)], 1)
    tracks, _ = scene.advance(scene.begin(), 0, None, views)
    nothing = Observation(PointPattern(np.zeros((0, 2)), np.zeros(0)), 1.5)
    dark = [replace(view, observation=nothing) for view in views]
    tracks, estimates = scene.advance(tracks, 1, None, dark)
    assert [estimate.status for estimate in estimates] == ["lost", "lost"]
    assert [list(estimate.sensors) for estimate in estimates] == [["left", "right"]] * 2
    _, estimates = scene.advance(tracks, 2, None, views)
    assert [estimate.status for estimate in estimates] == ["ok", "ok"]


def test_a_body_that_is_hidden_takes_nothing_from_one_that_explains_more() -> None:
    # three markers of four are where three of five are; without them nothing speaks for the small
    small, large = body("small", np.vstack([OTHER[:3], [[-90.0, -80.0, 70.0]]])), body("l", OTHER)
    scene, views = scene_of(small, large), views_of([large], [at(20.0)], 0)
    sharing = Sharing(scene.bodies, scene.begin(), 0, None, views, scene.rules)
    found = sharing.explain_all()
    hidden = found[0].ranked[:1]
    assert found[1].verdict.status == "ok"
    assert not hidden or hidden[0].log_evidence < 0.0


def test_identical_bodies_found_from_nothing_are_numbered_along_x() -> None:
    one = body("rod", TOOL)
    poses = [at(150, turn=1.0), at(-140, 10), at(5, 40, turn=-0.7)]
    scene = scene_of(one, one, one)
    views = views_of([one] * 3, poses, 3)
    _, estimates = scene.advance(scene.begin(), 0, None, views)
    x = [estimate.T_world_object[0, 3] for estimate in estimates]  # type: ignore[index]
    assert x == pytest.approx([-140, 5, 150], abs=2)
    assert [estimate.instance for estimate in estimates] == [0, 1, 2]


def test_identical_bodies_that_are_looked_for_again_are_where_they_were_nearest() -> None:
    one = body("rod", TOOL)
    scene, poses = scene_of(one, one), [at(-120, 10), at(120, -20)]
    tracks, _ = scene.advance(scene.begin(), 0, None, views_of([one] * 2, poses, 4))
    views = views_of([one] * 2, poses, 5)
    found = Sharing(scene.bodies, tracks, 1, None, views, scene.rules)._triangulated_starts()
    # 0.2 px are 0.24 mm at this distance, 240 mm from each other
    for k, T in enumerate(poses):
        assert np.linalg.norm(found[k][0].T_world_object[:3, 3] - T[:3, 3]) < 2.0


def followed(scene: Scene, one: Body, path: Sequence[Sequence[Floats]]) -> list[list[Estimate]]:
    tracks: Sequence[Track] = scene.begin()
    found = []
    for frame, poses in enumerate(path):
        views = views_of([one] * len(poses), poses, frame)
        tracks, estimates = scene.advance(tracks, frame, None, views)
        found.append(estimates)
    return found


def test_identical_bodies_keep_their_numbers_where_their_paths_cross() -> None:
    one = body("rod", TOOL)
    path = [[at(-90 + 12 * f, 70), at(90 - 12 * f, -70, 60, 1.0)] for f in range(16)]
    found = followed(scene_of(one, one), one, path)
    for estimates, poses in zip(found, path, strict=True):
        assert [estimate.status for estimate in estimates] == ["ok", "ok"]
        for estimate, T in zip(estimates, poses, strict=True):
            assert off(estimate, T)[0] < 2.0


def test_identical_bodies_lost_together_come_back_in_doubt_for_one_frame() -> None:
    one = body("rod", TOOL)
    here, there = at(-90, 70), at(90, -70, 60, 1.0)
    gone: list[Floats] = []
    path = [[here, there]] * 3 + [gone] * 8 + [[here, there]] * 2
    found = followed(scene_of(one, one), one, path)
    statuses = [[estimate.status for estimate in estimates] for estimates in found]
    assert statuses[:3] == [["ok", "ok"]] * 3
    assert statuses[3:11] == [["lost", "lost"]] * 8
    assert statuses[11:] == [["ambiguous", "ambiguous"], ["ok", "ok"]]
    told = found[11][0]
    places = sorted(rival.T_world_object[0, 3] for rival in told.hypotheses)
    assert places == pytest.approx([-90, 90], abs=2)
    assert sum(rival.weight for rival in told.hypotheses) <= 1.0 + 1e-9
    assert told.T_world_object is not None
    np.testing.assert_array_equal(told.hypotheses[0].T_world_object, told.T_world_object)


@pytest.mark.parametrize("count", [3, 4])
def test_a_body_met_by_markers_that_another_has_too_is_in_doubt_while_that_is_not_seen(
    count: int,
) -> None:
    shared = TOOL[:count]
    one = body("one", np.concatenate([shared, [[70.0, 60.0, -50.0]], [[-60.0, -40.0, 30.0]]]))
    other = body("other", np.concatenate([shared, [[-50.0, 20.0, 70.0]], [[30.0, 80.0, 40.0]]]))
    part = body("part", shared)
    T, elsewhere = at(-60, turn=0.3), at(170, -60, 40, 1.2)
    scene = scene_of(one, other)
    _, alone = scene.advance(scene.begin(), 0, None, views_of([part], [T], 5))
    assert "ok" not in [estimate.status for estimate in alone]
    _, both = scene.advance(scene.begin(), 0, None, views_of([one, other], [T, elsewhere], 6))
    assert [estimate.status for estimate in both] == ["ok", "ok"]


def test_three_markers_of_a_body_that_gives_way_may_be_three_of_its_others() -> None:
    four, other = TOOL[:4], body("other", OTHER)
    soft = Body("soft", tuple(PointFeature(point, 4.0 * np.eye(3)) for point in four))
    seen, part = body("soft", four), body("part", four[:3])
    scene = scene_of(soft, other)
    tracks, there = scene.begin(), at(150.0, 60.0)
    told = []
    # three of its markers, then all of them, then three again while it is followed
    for frame, shown in enumerate((part, seen, seen, part)):
        views = views_of([shown, other], [at(2.0 * frame), there], frame)
        tracks, estimates = scene.advance(tracks, frame, None, views)
        told.append(estimates[0].status)
        assert estimates[1].status == "ok"
    assert told[0] != "ok"
    assert told[1:] == ["ok"] * 3


def test_a_body_that_nobody_saw_yet_is_searched_for_the_seldomer_the_longer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[float] = []
    frames: list[int] = []

    def search(views: Sequence[View], body: Body, **options: Any) -> SearchResult:
        if body.name == "other":
            asked.append(options["budget"].max_guesses)
            frames.append(frame)
        return search_frame(views, body, **options)

    # the module: its package has a function of the same name
    searched = import_module("mixpose.tracking.proposers")
    monkeypatch.setattr(searched, "search_frame", search)
    tool, other = body("tool", TOOL), body("other", OTHER)
    scene = scene_of(tool, other)
    tracks = scene.begin()
    for frame in range(24):
        views = views_of([tool], [at(2.0 * frame)], frame)
        tracks, estimates = scene.advance(tracks, frame, None, views)
        assert estimates[1].status == "lost"
    # points that both cameras see are looked at in each frame, all else in the first five, then in
    # one of two, of three and so on, and the tool that is there is not held up
    assert sorted(set(frames)) == [0, 1, 2, 3, 4, 5, 7, 9, 11, 14, 15, 19]
    assert max(asked) < np.inf
    views = views_of([tool, other], [at(48.0), at(150.0, 60.0)], 24)
    tracks, estimates = scene.advance(tracks, 24, None, views)
    assert [one.status for one in estimates] == ["ok", "ok"]
    frames.clear()
    for frame in range(25, 49):
        views = views_of([tool], [at(2.0 * frame)], frame)
        tracks, _ = scene.advance(tracks, frame, None, views)
    # what was seen is expected where it was, and searched for in one of ten
    assert sorted(set(frames)) == [34, 44]


def test_a_body_of_which_one_camera_sees_two_markers_is_found_in_the_frame_it_enters() -> None:
    tool, other = body("tool", TOOL), body("other", OTHER[:4])
    scene = scene_of(tool, other)
    tracks = scene.begin()
    for frame in range(3):
        tracks, _ = scene.advance(tracks, frame, None, views_of([tool], [at(2.0 * frame)], frame))
    there, half = at(6.0), body("half", OTHER[:2])
    whole, hidden = (views_of([tool, one], [there, at(150.0, 60.0)], 3) for one in (other, half))
    _, estimates = scene.advance(tracks, 3, None, [whole[0], hidden[1]])
    away, turn = off(estimates[1], at(150.0, 60.0))
    # 0.2 px are 0.24 mm across; along the line of sight of one camera four times as much
    assert away < 1.5
    assert turn < 1.0


def test_a_body_that_nobody_looked_at_for_seconds_is_found_in_the_frame_after() -> None:
    tool, other = body("tool", TOOL), body("other", OTHER[:4])
    scene = scene_of(tool, other)
    tracks = scene.begin()
    for frame, time_s in enumerate((0.0, 0.03, 0.06, 5.0)):
        there = at(-150.0 if time_s > 1 else 150.0, 60.0)
        views = views_of([tool, other], [at(2.0 * frame), there], frame)
        if time_s > 1:  # what two cameras see of it are no three points in space
            views[1] = views_of([tool, body("part", OTHER[:2])], [at(2.0 * frame), there], frame)[1]
        tracks, estimates = scene.advance(tracks, frame, time_s, views)
        assert [one.status for one in estimates] == ["ok", "ok"]
    assert off(estimates[1], there)[0] < 2.0


def test_a_body_alone_in_its_session_is_in_doubt_on_three_markers_of_another() -> None:
    # a body of which three markers lie as three of the tool, and two that do not
    twin = body("twin", np.concatenate([TOOL[:3], [[15.0, -60.0, 10.0], [-50.0, -20.0, 30.0]]]))
    tool, scene = body("tool", TOOL), scene_of(twin)
    tracks = scene.begin()
    for frame in range(4):
        # the tool is there, and the twin is not
        views = views_of([tool], [at(2.0 * frame)], frame)
        tracks, (estimate,) = scene.advance(tracks, frame, None, views)
        assert estimate.status != "ok"
    for frame in range(4, 8):
        views = views_of([twin], [at(2.0 * frame)], frame)
        tracks, (estimate,) = scene.advance(tracks, frame, None, views)
        assert estimate.status == "ok"
    # once it was known it stays so while it is followed, also by three
    three = body("twin", twin.means[:3])
    views = views_of([three], [at(16.0)], 8)
    (track,), _ = scene.advance(tracks, 8, None, views)
    assert track.is_identified


def test_a_body_met_by_markers_that_repeat_themselves_is_in_doubt() -> None:
    isosceles = np.array([[0, 45, 0], [-30, 0, 0], [30, 0, 0.0]])
    whole = np.concatenate([isosceles, [[10, 15, 60.0]], [[-20, -40, 35.0]], [[45, 30, -50.0]]])
    one, other, part = body("one", whole), body("other", OTHER), body("part", isosceles)
    T, elsewhere = at(-60, turn=0.3), at(170, -60, 40, 1.2)
    scene = scene_of(one, other)
    views = views_of([part, other], [T, elsewhere], 5)
    _, estimates = scene.advance(scene.begin(), 0, None, views)
    assert estimates[0].status != "ok"
    assert estimates[1].status == "ok"


def spots(*points: list[float]) -> Claims:
    pattern = PointPattern(np.array(points), np.ones(len(points)))
    return Claims.none([View("left", CAMERAS["left"], Observation(pattern, 1.0))])


def test_a_detection_belongs_to_the_body_that_it_lies_nearer_to() -> None:
    claims = spots([0.0, 0.0], [50.0, 0.0])
    first, second = (np.array([0, 1]), np.array([0.16, 0.0])), (np.array([0]), np.array([0.01]))
    assert claims.claimed_by({0: first, 1: second}).owners.tolist() == [1, 0]
    assert claims.claimed_by({1: second, 0: first}).owners.tolist() == [1, 0]


def test_a_spot_between_two_bodies_is_neither_ones_and_one_that_is_met_closely_is() -> None:
    claims, rules = spots([0.0, 0.0], [50.0, 0.0], [99.0, 0.0]), SceneRules()
    loosely, closely = (np.array([0, 2]), np.array([2.25, 2.25])), (np.array([1]), np.array([0.01]))
    places = {0: np.array([[-1.5, 0.0, 0.0], [97.5, 0.0, 0.0]]), 1: np.array([[1.5, 0.0, 0.0]])}
    taken = claims.claimed_by({0: loosely, 1: closely})
    left = taken.without_merged({0: loosely, 1: closely}, places, rules)
    # what lies beside no other body's feature is off for another reason
    assert left.owners.tolist() == [-2, 1, 0]
    assert left.available(0).tolist() == [False, False, True]


def test_a_spot_that_two_bodies_share_pulls_neither_of_them() -> None:
    bodies, left = [body("tool", TOOL), body("other", OTHER)], CAMERAS["left"]
    # their origins 4 px apart in the left image, 200 mm apart in depth
    T_tool = at(0.0)
    ray = left.towards(T_tool[None, :3, 3])[0] / np.linalg.norm(left.towards(T_tool[None, :3, 3]))
    x, y, z = (T_tool[:3, 3] - 200 * ray + 4.8 * np.cross(ray, [0.0, 1.0, 0.0])).tolist()
    T_other = at(x, y, z, turn=0.5)
    poses, scene = [T_tool, T_other], scene_of(*bodies)
    places = [left.project(T[None, :3, 3])[0][0] for T in poses]
    moved = []
    for seed in range(8):
        apart = views_of(bodies, poses, seed)
        tracks, _ = scene.advance(scene.begin(), 0, None, apart)
        points = apart[0].observation.points
        assert points is not None
        nearest = [int(np.linalg.norm(points - y, axis=1).argmin()) for y in places]
        rest = np.delete(points, nearest, axis=0)
        found = []
        for spots in (rest, np.vstack([rest, points[nearest].mean(axis=0)])):
            seen = Observation(PointPattern(spots, np.ones(len(spots))), 1.5)
            views = [replace(apart[0], observation=seen), apart[1]]
            found.append(scene.advance(tracks, 1, None, views)[1])
        for without, shared in zip(*found, strict=True):
            assert without.T_world_object is not None
            moved.append(off(shared, without.T_world_object)[0])
    # fits end within 1e-4 mm of each other; the spot pulled some of these poses by 0.03 to 0.4 mm
    assert max(moved) < 1e-3


def test_detections_are_expected_to_be_of_the_nearest_feature_of_all() -> None:
    claims = spots([0.0, 0.0], [3.0, 0.0], [100.0, 0.0])
    places = {0: places_of(0, np.array([[0.5, 0.0]])), 1: places_of(0, np.array([[2.0, 0.0]]))}
    assert claims.expected(places, 6.0).owners.tolist() == [0, 1, -1]


def test_bodies_evaluated_at_once_are_what_each_is_alone() -> None:
    bodies = [body("tool", TOOL), body("other", OTHER[:4])]  # of unlike numbers of markers
    poses = [at(-80.0), at(90.0, 30.0)]
    views = views_of(bodies, poses, 3)
    shared = SharedDensities(views)
    each = [matched_objective(views, one, [1.5, 1.5], shared=shared) for one in bodies]
    near = [T @ at(0.4, -0.3) for T in poses]
    joint = together(each)
    models = joint.linearise(np.array(near))
    for k, (one, T) in enumerate(zip(each, near, strict=True)):
        found, alone = models.of(k), one.linearise(T[None]).of(0)
        # looked up on other tiles of an array in which places are rounded to 2e-5 cells
        assert found.value == pytest.approx(alone.value, rel=1e-5)
        for a, b in ((found.gradient, alone.gradient), (found.curvature, alone.curvature)):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5 * np.abs(b).max())
    # what they see at other poses is at hand afterwards, as each would see it
    fresh = [matched_objective(views, one, [1.5, 1.5], shared=shared) for one in bodies]
    for one, other, T in zip(joint.split(each, np.array(poses)), fresh, poses, strict=True):
        assert one.known is not None
        np.testing.assert_array_equal(one.known[0], T)
        at_hand = one.match(T[None])
        seen = other.match(T[None])
        np.testing.assert_allclose(at_hand.y, seen.y)
        np.testing.assert_array_equal(at_hand.weights, seen.weights)
        largest = seen.sampled[..., 0].max() / np.array([1.0, 1.5, 1.5])  # gradients of 1.5 px
        assert (np.abs(at_hand.sampled - seen.sampled) < 1e-5 * largest).all()
        np.testing.assert_allclose(at_hand.norm, seen.norm)
        np.testing.assert_array_equal(at_hand.pairs, seen.pairs)


def test_an_estimate_is_the_same_line_by_line() -> None:
    line = PoseLine(0, None, "rod", "ok", np.eye(4), None, 1.0, {}, (), None, 2, line=1)
    assert line.label == "rod-2"
