from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from detections import view_of
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.errors import SessionError
from mixpose.objective import View
from mixpose.records import Floats, GridPattern, PointPattern
from mixpose.rigid import from_rotation_vector, rotation_angle_deg, transform
from mixpose.search import LIVE, THOROUGH, Candidate, SearchBudget, SearchState, search_frame
from mixpose.search.poses import distinct_poses
from mixpose.search.three_points import align_triples
from mixpose.sensors import ParallelBeam, PinholeCamera
from mixpose.tracking import estimate_pose

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from benchmarks.search_cases import Row, Trial, absent, crowded_absent, errors, is_right, trial

ALL = np.ones(6, dtype=np.bool_)


def search(
    views: Sequence[View], body: Body, *, free: NDArray[np.bool_], T_reference: Floats | None
) -> list[Candidate]:
    return search_frame(views, body, free=free, T_reference=T_reference).candidates


def found(frame: Trial) -> list[Candidate]:
    return search(frame.views, frame.body, free=ALL, T_reference=None)


@pytest.mark.parametrize(
    ("row", "trials"),
    [
        (Row("2 pinhole", 6, 0, 0, 0.99), 8),
        (Row("2 pinhole", 6, 1, 3, 0.99), 8),
        (Row("2 pinhole", 8, 2, 4, 0.99), 8),
        (Row("2 pinhole", 6, 2, 4, 0.95), 5),
        (Row("2 pinhole", 8, 4, 8, 0.95), 2),
        (Row("1 pinhole", 5, 0, 5, 0.99), 4),
        (Row("1 pinhole", 8, 2, 5, 0.99), 2),
        (Row("2 parallel", 6, 0, 0, 0.99), 8),
        (Row("2 parallel", 6, 1, 2, 0.99), 8),
        (Row("3 ranges", 6, 0, 0, 0.95), 3),
    ],
    ids=lambda value: value.name if isinstance(value, Row) else "",
)
def test_a_random_pose_of_a_random_body_is_found(row: Row, trials: int) -> None:
    for seed in range(trials):
        frame = trial(row, seed)
        assert is_right(found(frame)[0].T_world_object, frame), seed


def test_one_of_two_poses_that_fit_four_detections_alike_is_the_true_one() -> None:
    row = Row("1 pinhole", 5, 1, 5, 0.8)
    for seed in range(4):
        frame = trial(row, seed)
        candidates = found(frame)
        assert any(is_right(each.T_world_object, frame) for each in candidates), seed


def test_false_detections_alone_have_little_evidence() -> None:
    row = Row("2 pinhole", 6, 1, 3, 0.99)
    with_body = [found(trial(row, seed))[0].evidence for seed in range(4)]
    without = [found(absent(row, seed)) for seed in range(4)]
    most = max(each[0].evidence for each in without if each)
    # the odds that tell a body from none: at least e^15
    assert min(with_body) > most + 15


def test_candidates_are_the_same_for_the_same_seed() -> None:
    frame = trial(Row("1 pinhole", 5, 0, 5, 0.99), 0)
    first, second = found(frame), found(frame)
    assert len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.T_world_object, b.T_world_object)


def test_a_body_of_many_features_is_found_among_as_many_false_ones() -> None:
    frame = trial(Row("2 pinhole", 60, 20, 60, 0.99), 0)
    assert is_right(found(frame)[0].T_world_object, frame)


def test_a_body_is_found_where_a_third_camera_sees_nothing_but_clutter() -> None:
    frame = trial(Row("2 pinhole", 8, 1, 4, 0.99), 0)
    other = absent(Row("1 pinhole", 8, 0, 30, 0.99), 1).views[0]
    best = search([*frame.views, other], frame.body, free=ALL, T_reference=None)[0]
    assert is_right(best.T_world_object, frame)


def test_a_limited_search_goes_on_in_the_next_frame_where_it_stopped() -> None:
    row, budget = Row("1 pinhole", 8, 2, 5, 0.99), SearchBudget(max_guesses=5000)
    frame, state, made, states = trial(row, 0), SearchState(), [], []
    for _ in range(6):
        result = search_frame(
            frame.views, frame.body, free=ALL, T_reference=None, budget=budget, state=state
        )
        state = result.state
        made.append(result.report.made)
        states.append(state)
        if result.candidates and is_right(result.candidates[0].T_world_object, frame):
            break
    # 20 of 55,440 triples of rays and features are right, and a chunk makes some 4,000 guesses:
    # the chance to find none of the 20 in 6 frames is below 1e-3
    assert is_right(result.candidates[0].T_world_object, frame)
    # the last batch is finished, which makes up to 4 guesses of each of 4,096 problems
    assert max(made) < 5000 + 4 * 4096
    assert states[0].batch > 0


def test_poses_that_the_best_leaves_no_chance_are_no_candidates() -> None:
    frame = trial(Row("2 pinhole", 8, 2, 4, 0.99), 0)
    evidence = [one.evidence for one in found(frame)]
    assert min(evidence) > evidence[0] - THOROUGH.outdone
    everyone = replace(THOROUGH, outdone=np.inf)
    result = search_frame(frame.views, frame.body, free=ALL, T_reference=None, budget=everyone)
    assert len(result.candidates) > len(evidence)
    assert result.candidates[0].evidence == evidence[0]


def test_poses_that_no_fit_can_save_are_no_candidates() -> None:
    # 20 markers among 40 false detections a view: the best by chance has some -27 nats
    frame = crowded_absent(20, 40, 0)
    result = search_frame(frame.views, frame.body, free=ALL, T_reference=None, budget=LIVE)
    first, *others = [one.evidence for one in result.candidates]
    assert first < THOROUGH.hopeless
    assert others == []


def test_a_false_detection_beside_a_hidden_feature_does_not_draw_what_was_found() -> None:
    # it is 3 σ_ε from where a camera would see the feature: a fit that begins at σ_ε ends 1.8° off
    frame = trial(Row("2 pinhole", 6, 2, 4, 0.95), 21)
    estimate = estimate_pose(frame.views, frame.body)
    assert estimate.status == "ok"
    assert estimate.T_world_object is not None
    assert is_right(estimate.T_world_object, frame)


def test_what_a_search_cost_is_counted() -> None:
    frame = trial(Row("2 pinhole", 8, 2, 4, 0.99), 0)
    report = search_frame(frame.views, frame.body, free=ALL, T_reference=None).report
    assert report.made >= report.tested >= report.refined > 0


def test_candidates_differ_by_more_than_the_bodys_symmetries(
    paper_body: Body, parallel_cameras: list[ParallelBeam]
) -> None:
    T = from_rotation_vector([0.5, 1.0, -0.7], [20.0, -10.0, 5.0])
    views = [
        View(str(k), camera, Observation(PointPattern(y, np.ones(len(y))), 1.0))
        for k, camera in enumerate(parallel_cameras)
        for y in (camera.project(transform(T, paper_body.means))[0],)
    ]
    candidates = search(views, paper_body, free=ALL, T_reference=None)
    images = transform(T @ paper_body.symmetries, paper_body.means)
    assert len(paper_body.symmetries) == 6
    off = [
        np.abs(images - transform(each.T_world_object, paper_body.means)).max(axis=(1, 2)).min()
        for each in candidates
    ]
    assert off[0] < 0.01
    # densities are looked up on a grid of three cells per σ: 1 % of a value
    # six features of two cameras, far from clutter: no other pose is a thousandth as likely
    assert candidates[0].evidence > candidates[1].evidence + 7 if len(candidates) > 1 else True
    assert all(each > 1.0 for each in off[1:])


def test_directions_that_are_not_free_stay_where_the_reference_has_them() -> None:
    frame = trial(Row("1 pinhole", 5, 0, 5, 0.99), 3)
    turn = from_rotation_vector([0, 0, 2.0], np.zeros(3))
    reference = frame.T_world_object.copy()
    reference[:3, :3] = turn[:3, :3] @ reference[:3, :3]
    reference[:2, 3] += [40.0, -30.0]
    free = np.array([True, True, False, False, False, True])
    best = search(frame.views, frame.body, free=free, T_reference=reference)[0].T_world_object
    assert is_right(best, frame)
    assert best[2, 3] == pytest.approx(reference[2, 3], abs=1e-9)
    np.testing.assert_allclose(best[2, :3], reference[2, :3], atol=1e-9)


def test_held_directions_without_a_reference_are_refused() -> None:
    frame = trial(Row("1 pinhole", 5, 0, 5, 0.99), 0)
    with pytest.raises(SessionError, match="start"):
        search(frame.views, frame.body, free=np.eye(6, dtype=np.bool_)[0], T_reference=None)


def test_spots_in_grey_images_are_found_as_well(
    paper_body: Body, parallel_cameras: list[ParallelBeam]
) -> None:
    T = from_rotation_vector([0.2, -0.4, 0.3], [-40.0, -30.0, 10.0])
    v, u = np.mgrid[:401, :401]
    views = []
    for k, camera in enumerate(parallel_cameras):
        y, seen = camera.project(transform(T, paper_body.means))
        assert seen.all()
        image = sum(np.exp(-0.5 * ((u - a) ** 2 + (v - b) ** 2) / 2.0**2) for a, b in y)
        pattern = GridPattern(np.asarray(image, dtype=np.float32), np.zeros(2), 1.0)
        views.append(View(str(k), camera, Observation(pattern, 2.5, intrinsic=2.0)))
    best = search(views, paper_body, free=ALL, T_reference=None)[0].T_world_object
    frame = Trial(views, paper_body, T, 1000.0)
    angle, shift = errors(best, frame)
    # overlapping spots of a symmetric body move each other's peaks by a px at most
    assert angle < 1.0
    assert shift < 1.0


def test_views_without_detections_give_no_candidates(paper_body: Body) -> None:
    camera = ParallelBeam(1.0, np.zeros(2))
    empty = Observation(PointPattern(np.zeros((0, 2)), np.zeros(0)), 1.0)
    assert search([View("a", camera, empty)], paper_body, free=ALL, T_reference=None) == []
    assert search([], paper_body, free=ALL, T_reference=None) == []


@pytest.mark.parametrize("count", [1, 2, 3])
def test_too_few_detections_are_no_error(count: int) -> None:
    frame = trial(Row("2 pinhole", 6, 6 - count, 0, 0.0), 0)
    for views in (frame.views, frame.views[:1]):
        candidates = search(views, frame.body, free=ALL, T_reference=None)
        assert all(np.isfinite(each.T_world_object).all() for each in candidates)


def test_a_chessboard_is_not_found_a_square_off(recordings: Path) -> None:
    import json

    from mixpose.frames import pair
    from mixpose.runner import observe, open_sources
    from mixpose.session import load_session

    folder = recordings / "stereo_chessboard"
    session = load_session(folder / "session.toml")
    lines = [
        json.loads(line)
        for line in (folder / "truth.jsonl").read_text(encoding="utf-8").splitlines()
    ]
    truth = {line["frame"]: line["T_world_object"] for line in lines if "frame" in line}
    for frame_set in pair(open_sources(session, {}), 8, 11, 1):
        views = observe(session, frame_set)
        best = search(views, session.body, free=ALL, T_reference=None)[0].T_world_object
        images = transform(
            np.array(truth[frame_set.number]) @ session.body.symmetries, session.body.means
        )
        off = np.abs(images - transform(best, session.body.means)).max(axis=(1, 2)).min()
        # squares are 24 mm wide; the reference itself is good to about a millimetre
        assert off < 3.0


def test_three_places_in_a_row_still_give_a_rotation() -> None:
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0.3, 0.8, 0]])
    in_a_row = np.array([[0.0, 0, 5], [1, 0, 5], [0.4, 0, 5]])
    (T,) = align_triples(triangle[..., None], in_a_row[..., None])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert T[:3, :3] @ T[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)


def corners_of_a_box(rng: np.random.Generator) -> Body:
    """Four squares on each of six faces, of three sizes, as tags have them."""
    points, normals = [], []
    for k, face in enumerate(
        Rotation.from_euler(
            "xyz",
            [[0, 0, 0], [90, 0, 0], [180, 0, 0], [270, 0, 0], [0, 90, 0], [0, -90, 0]],
            degrees=True,
        ).as_matrix()
    ):
        size = (50.0, 35.0, 25.0)[k % 3]
        for middle in 30.0 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]):
            square = size / 2 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
            flat = square + middle + rng.normal(0, 5.0, 2)
            points.append(np.column_stack([flat, np.full(4, 60.0)]) @ face.T)
            normals.append(np.tile(face[:, 2], (4, 1)))
    means, outward = np.concatenate(points), np.concatenate(normals)
    return Body("box", tuple(PointFeature(point) for point in means), outward)


def test_one_face_of_a_large_body_is_found_among_all_its_faces() -> None:
    """Of 96 corners 16 are seen: of those that stand for all, most are on the other sides."""
    camera = PinholeCamera(
        np.array([[3200.0, 0, 640], [0, 3200.0, 512], [0, 0, 1]]), resolution=(1280, 1024)
    )
    for seed in (0, 5, 8):
        rng = np.random.default_rng(seed)
        body = corners_of_a_box(rng)
        T = from_rotation_vector([np.pi + rng.normal(0, 0.1), 0.1, 0], [10.0, -20.0, 1600.0])
        assert body.normals is not None
        facing = body.normals @ T[:3, :3].T @ T[:3, 3] < -800
        y, _ = camera.project(transform(T, body.means[facing]))
        view = view_of("camera", camera, rng.permutation(y + rng.normal(0, 0.5, y.shape)))
        best = search([view], body, free=ALL, T_reference=None)[0].T_world_object
        assert len(y) == 16
        # 0.5 px of 240 px turn what is flat by 2 to 6°
        assert rotation_angle_deg(best, T) < 10


def test_poses_that_are_nowhere_are_told_apart_without_a_warning() -> None:
    body = Body("three", tuple(PointFeature(p) for p in 10 * np.eye(3)))
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[1, 0, 3], poses[2, 0, 3], poses[3, 0, 3] = 1e300, np.inf, 5.0
    with np.errstate(all="raise", invalid="raise"), warnings.catch_warnings():
        warnings.simplefilter("error")
        assert {0, 3} <= {*distinct_poses(body, poses, 0.1).tolist()}
