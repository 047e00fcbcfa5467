from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.consistency import normalised_error_squared
from mixpose.poses.estimates import in_unit
from mixpose.poses.evaluate import errors_to_truth, evaluate
from mixpose.poses.jsonl import PoseFile, read_poses
from mixpose.poses.poseline import PoseLine
from mixpose.poses.report import as_dict, as_table
from mixpose.poses.truth import renumbered
from mixpose.records import Floats, Hypothesis, Status

RNG_SEED = 20240611


def line(
    frame: int,
    T: Floats | None,
    *,
    status: Status = "ok",
    name: str = "board",
    covariance: Floats | None = None,
    rivals: tuple[Floats, ...] = (),
) -> PoseLine:
    hypotheses = tuple(Hypothesis(T_rival, 1.0 / len(rivals)) for T_rival in rivals)
    return PoseLine(
        *(frame, None, name, status, T, covariance, 1.0, {}, hypotheses, None), line=frame + 2
    )


def file_of(
    *lines: PoseLine, unit: str | None = "mm", symmetries: dict[str, Floats] | None = None
) -> PoseFile:
    return PoseFile(Path("some.jsonl"), {}, lines, unit, symmetries or {})


def a_pose(seed: int = RNG_SEED) -> Floats:
    rng = np.random.default_rng(seed)
    return rigid.from_rotation_vector(rng.normal(size=3), 100 * rng.normal(size=3))


def turned_about_z(T: Floats, deg: float) -> Floats:
    return T @ rigid.from_rotation_vector([0, 0, np.radians(deg)], [0, 0, 0])


def half_turn_about(centre: tuple[float, float, float]) -> Floats:
    R = np.diag([-1.0, -1.0, 1.0])
    return rigid.from_parts(R, np.array(centre) - R @ np.array(centre))


def test_known_errors_come_out_as_rms_median_and_maximum() -> None:
    T = a_pose()
    turns_deg = [1.0, 2.0, 6.0]
    shifts = [3.0, 0.0, 4.0]
    poses = [
        rigid.perturb(T, np.array([0, shift, 0, 0, 0, np.radians(turn)]))
        for turn, shift in zip(turns_deg, shifts)
    ]
    outcome = evaluate(
        file_of(*(line(n, pose) for n, pose in enumerate(poses))),
        file_of(*(line(n, T) for n in range(3))),
    )
    rotation, translation = outcome.rotation_deg, outcome.translation
    assert rotation is not None
    assert translation is not None
    assert rotation.rms == pytest.approx(np.sqrt((1 + 4 + 36) / 3))
    assert rotation.median == pytest.approx(2.0)
    assert rotation.p95 == pytest.approx(5.6)  # 90 % of the way from 2 to 6
    assert rotation.max == pytest.approx(6.0)
    assert rotation.worst_frame == 2
    assert translation.rms == pytest.approx(np.sqrt(25 / 3))
    assert translation.max == pytest.approx(4.0)
    # All the turning is about the world's z, all the shifting along its y.
    assert outcome.per_axis_rms is not None
    assert outcome.per_axis_rms["rz"] == pytest.approx(rotation.rms)
    assert outcome.per_axis_rms["y"] == pytest.approx(translation.rms)
    assert outcome.per_axis_rms["x"] == pytest.approx(0.0, abs=1e-9)
    assert outcome.per_axis_rms["rx"] == pytest.approx(0.0, abs=1e-9)


def test_frames_are_counted_once_each_and_strays_apart() -> None:
    T = a_pose()
    poses = file_of(
        line(0, T),
        line(1, T, status="ambiguous"),
        line(2, None, status="lost"),
        line(9, T),
        line(0, T, name="other"),
    )
    outcome = evaluate(poses, file_of(*(line(n, T) for n in range(5))))
    assert (outcome.frames, outcome.ok, outcome.ambiguous) == (5, 1, 1)
    assert (outcome.lost, outcome.missing, outcome.without_truth) == (1, 2, 2)


def test_a_symmetric_board_measured_from_its_corner_may_be_half_a_turn_off() -> None:
    # The axis stands 100 units beside the origin: the origins of the two right answers are far
    # apart, the error against the right one is not.
    T = a_pose()
    S = half_turn_about((96.0, 60.0, 0.0))
    slip = np.array([0.1, 0.2, -0.2, 0.0, 0.0, np.radians(0.5)])
    poses = file_of(line(0, rigid.perturb(T @ S, slip)), symmetries={"board": S[None]})
    (error,) = errors_to_truth(poses, file_of(line(0, T)))
    assert error.twist == pytest.approx(slip, abs=1e-9)
    (blind,) = errors_to_truth(replace(poses, symmetries={}), file_of(line(0, T)))
    assert blind.twist is not None
    assert np.linalg.norm(blind.twist[3:]) > 3.0


def test_the_truth_itself_is_right_where_a_file_names_the_half_turn_alone() -> None:
    T = a_pose()
    poses = file_of(line(0, T), symmetries={"board": half_turn_about((96.0, 60.0, 0.0))[None]})
    outcome = evaluate(poses, file_of(line(0, T)))
    assert outcome.rotation_deg is not None
    assert outcome.rotation_deg.max == pytest.approx(0.0, abs=1e-5)


def test_a_symmetry_axis_through_the_origin_is_told_by_rotation_alone() -> None:
    # Cube corners: all answers share one position, so only rotation tells them apart.
    turns = np.stack([turned_about_z(np.eye(4), deg) for deg in (0, 120, 240)])
    T = a_pose()
    poses = file_of(line(0, turned_about_z(T, 241.5)), symmetries={"board": turns})
    outcome = evaluate(poses, file_of(line(0, T)))
    assert outcome.rotation_deg is not None
    assert outcome.rotation_deg.max == pytest.approx(1.5)


@pytest.mark.parametrize(("deg", "distance"), [(0.4, 0.0), (0.6, 5.0)])
def test_answers_within_half_a_degree_are_told_apart_by_place(deg: float, distance: float) -> None:
    T = a_pose()
    pose = rigid.from_parts(T[:3, :3], T[:3, 3] + [3.0, 0.0, 4.0])
    # where the pose is, and turned by a little more than the answer that is 5 away
    S = rigid.inverse(T) @ turned_about_z(pose, deg)
    poses = file_of(line(0, pose), symmetries={"board": S[None]})
    (error,) = errors_to_truth(poses, file_of(line(0, T)))
    assert error.twist is not None
    assert np.linalg.norm(error.twist[:3]) == pytest.approx(distance, abs=1e-9)


def test_symmetries_named_by_the_truth_go_before_those_of_the_poses() -> None:
    T = a_pose()
    S = half_turn_about((0.0, 0.0, 0.0))
    poses = file_of(line(0, T @ S), symmetries={"board": S[None]})
    strict = file_of(line(0, T), symmetries={"board": np.eye(4)[None]})
    outcome = evaluate(poses, strict)
    assert outcome.rotation_deg is not None
    assert outcome.rotation_deg.max == pytest.approx(180.0)


def test_several_truth_lines_of_one_frame_are_equally_right() -> None:
    T = a_pose()
    flipped = T @ rigid.from_rotation_vector([np.radians(40), 0, 0], [5.0, 0, 0])
    truth = file_of(line(0, T), line(0, flipped), line(1, T))
    outcome = evaluate(file_of(line(0, flipped), line(1, T)), truth)
    assert outcome.frames == 2
    assert outcome.rotation_deg is not None
    assert outcome.rotation_deg.max == pytest.approx(0.0, abs=1e-5)


def test_right_answers_that_share_their_rotation_are_told_by_position() -> None:
    # A row of marks seen one mark further: same rotation but for the noise of the reference.
    T = a_pose()
    along = np.array([24.0, 0, 0, 0, 0, 0])
    further = rigid.perturb(turned_about_z(T, 0.1), along)
    pose = rigid.perturb(T, along)
    outcome = evaluate(file_of(line(0, pose)), file_of(line(0, T), line(0, further)))
    assert outcome.translation is not None
    assert outcome.translation.max == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("unit", "per_metre"), [("m", 1.0), ("cm", 1e2), ("mm", 1e3), ("um", 1e6)])
def test_truth_in_another_unit_is_converted_with_its_symmetries(
    unit: str, per_metre: float
) -> None:
    T_mm = a_pose()
    S_mm = half_turn_about((96.0, 60.0, 0.0))

    def scaled(T: Floats) -> Floats:
        return rigid.from_parts(T[:3, :3], T[:3, 3] / 1000 * per_metre)

    poses = file_of(line(0, T_mm @ S_mm))
    truth = file_of(line(0, scaled(T_mm)), unit=unit, symmetries={"board": scaled(S_mm)[None]})
    outcome = evaluate(poses, truth)
    assert outcome.unit == "mm"
    assert outcome.translation is not None
    assert outcome.translation.max == pytest.approx(0.0, abs=1e-9)


def test_a_file_without_unit_is_in_the_unit_of_the_other() -> None:
    T = a_pose()
    assert evaluate(file_of(line(0, T), unit=None), file_of(line(0, T), unit="cm")).unit == "cm"
    assert evaluate(file_of(line(0, T), unit=None), file_of(line(0, T), unit=None)).unit is None


def test_the_best_hypothesis_of_an_ambiguous_frame_is_measured_apart() -> None:
    T = a_pose()
    wrong = turned_about_z(T, 60.0)
    near = turned_about_z(T, 1.0)
    poses = file_of(
        line(0, wrong, status="ambiguous", rivals=(wrong, near)), line(1, turned_about_z(T, 2.0))
    )
    outcome = evaluate(poses, file_of(line(0, T), line(1, T)))
    assert outcome.rotation_deg is not None
    assert outcome.rotation_deg.max == pytest.approx(60.0)
    assert outcome.best_rotation_deg is not None
    assert outcome.best_rotation_deg.max == pytest.approx(1.0)


def test_frames_that_are_ok_are_measured_alone_where_others_are_ambiguous() -> None:
    T = a_pose()
    wrong = turned_about_z(T, 60.0)
    poses = file_of(
        line(0, wrong, status="ambiguous", rivals=(wrong,)), line(1, turned_about_z(T, 2.0))
    )
    outcome = evaluate(poses, file_of(line(0, T), line(1, T)))
    assert outcome.ok_rotation_deg is not None
    assert outcome.ok_rotation_deg.max == pytest.approx(2.0)
    assert outcome.ok_rotation_deg.worst_frame == 1
    rows = [row for row in as_table(outcome).splitlines() if row.startswith("ok alone, deg")]
    assert [row.split()[3] for row in rows] == ["2"]
    only_ok = evaluate(file_of(line(1, T)), file_of(line(1, T)))
    assert "ok alone" not in as_table(only_ok)


def drawn_from(covariance: Floats, count: int) -> tuple[PoseFile, PoseFile]:
    rng = np.random.default_rng(RNG_SEED)
    T = a_pose()
    draws = rng.multivariate_normal(np.zeros(6), covariance, size=count, method="eigh")
    poses = file_of(
        *(line(n, rigid.perturb(T, draw), covariance=covariance) for n, draw in enumerate(draws))
    )
    return poses, file_of(*(line(n, T) for n in range(count)))


def mixed_covariance(free: list[int]) -> Floats:
    rng = np.random.default_rng(RNG_SEED)
    A = rng.normal(size=(6, 6)) * np.array([2.0, 2, 2, 1e-3, 1e-3, 1e-3])[:, None]
    held = np.setdiff1d(np.arange(6), free)
    A[held] = 0.0
    return np.asarray(A @ A.T)


@pytest.mark.parametrize("free", [[0, 1, 2, 3, 4, 5], [0, 1, 5]])
def test_right_covariances_have_a_squared_error_of_one_per_dimension(free: list[int]) -> None:
    # 1000 frames: the mean scatters by sqrt(2 / (1000 d)), 0.026 for 3 dimensions, the share by
    # 0.007; allowed are three of these.
    poses, truth = drawn_from(mixed_covariance(free), 1000)
    nees = evaluate(poses, truth).nees
    assert nees is not None
    assert nees.frames == 1000
    assert nees.mean_per_dimension == pytest.approx(1.0, abs=0.08)
    assert nees.inside_95 == pytest.approx(0.95, abs=0.021)


def test_covariances_that_promise_too_much_are_found_out() -> None:
    poses, truth = drawn_from(mixed_covariance([0, 1, 2, 3, 4, 5]), 200)
    boasting = replace(
        poses,
        poses=tuple(
            replace(pose, covariance=pose.covariance / 4)
            for pose in poses.poses
            if pose.covariance is not None
        ),
    )
    honest, boasted = evaluate(poses, truth).nees, evaluate(boasting, truth).nees
    assert honest is not None
    assert boasted is not None
    assert boasted.mean_per_dimension == pytest.approx(4 * honest.mean_per_dimension)
    assert boasted.inside_95 < 0.5


def test_the_squared_error_does_not_depend_on_the_unit() -> None:
    covariance = mixed_covariance([0, 1, 2, 3, 4, 5])
    twist = np.array([1.0, -2.0, 0.5, 1e-3, 2e-3, -1e-3])
    to_um = np.array([1000.0] * 3 + [1.0] * 3)
    in_mm, _ = normalised_error_squared(twist, covariance)
    in_um, rank = normalised_error_squared(twist * to_um, covariance * to_um[:, None] * to_um)
    assert rank == 6
    assert in_um == pytest.approx(in_mm)


def test_a_held_direction_does_not_count_though_it_is_wrong() -> None:
    covariance = np.diag([4.0, 4.0, 0.0, 0.0, 0.0, 0.01])
    twist = np.array([2.0, 0.0, 55.0, 0.3, 0.0, 0.1])
    nees, dimensions = normalised_error_squared(twist, covariance)
    assert nees == pytest.approx(1.0 + 0.0 + 1.0)
    assert dimensions == 3
    assert normalised_error_squared(twist, np.zeros((6, 6))) == (None, 0)


def test_an_ambiguous_frame_says_nothing_about_covariances() -> None:
    T = a_pose()
    pose = line(0, turned_about_z(T, 60), status="ambiguous", covariance=np.eye(6) * 1e-9)
    assert evaluate(file_of(pose), file_of(line(0, T))).nees is None


def test_poses_that_cannot_be_compared_are_refused() -> None:
    T = a_pose()
    truth = file_of(line(0, T))
    with pytest.raises(RecordingError, match=r"poses of 'tee', but some\.jsonl of 'board'"):
        evaluate(file_of(line(0, T, name="tee")), truth)
    with pytest.raises(RecordingError, match=r":2: frame 0 of 'board' stands in line 2 already"):
        evaluate(file_of(line(0, T), line(0, T)), truth)
    with pytest.raises(RecordingError, match="holds no pose"):
        evaluate(truth, file_of())


def test_a_file_without_a_single_pose_is_all_lost_or_missing() -> None:
    truth = file_of(line(0, a_pose()), line(1, a_pose()))
    outcome = evaluate(file_of(line(0, None, status="lost")), truth)
    assert (outcome.lost, outcome.missing, outcome.rotation_deg) == (1, 1, None)
    assert as_dict(outcome)["rotation_deg"] is None
    assert "no frame has a pose to compare" in as_table(outcome)
    assert evaluate(file_of(), truth).missing == 2


def test_a_truth_line_without_a_pose_says_nothing() -> None:
    T = a_pose()
    truth = file_of(line(0, T), line(1, None, status="lost"))
    outcome = evaluate(file_of(line(0, T), line(1, T)), truth)
    assert (outcome.frames, outcome.without_truth, outcome.ok_without_truth) == (1, 1, 1)
    told = "1 pose line has no truth and does not count; 1 of them ok: wrong, if the body was away"
    assert told in as_table(outcome).splitlines()
    away = evaluate(file_of(line(0, T), line(1, None, status="lost")), truth)
    assert away.ok_without_truth == 0
    assert "1 pose line has no truth and does not count" in as_table(away).splitlines()


def test_the_report_holds_the_figures_as_json_and_as_an_aligned_table() -> None:
    T = a_pose()
    poses = file_of(
        line(0, turned_about_z(T, 1.5), covariance=np.eye(6)),
        line(1, turned_about_z(T, 30.0), status="ambiguous", rivals=(T,)),
    )
    outcome = evaluate(poses, file_of(line(0, T), line(1, T)))
    values = json.loads(json.dumps(as_dict(outcome), allow_nan=False))
    assert (values["frames"], values["ok"], values["missing"]) == (2, 1, 0)
    assert set(values["rotation_deg"]) >= {"rms", "median", "p95", "max"}
    assert values["translation"]["unit"] == "mm"
    assert set(values["per_axis"]) == {"x", "y", "z", "rx", "ry", "rz"}
    assert values["nees"]["frames"] == 1
    assert values["best_hypothesis"]["rotation_deg"]["max"] < 1e-5
    table = as_table(outcome).splitlines()
    assert table[0] == "2 frames: 1 ok, 1 ambiguous, 0 lost, 0 missing"
    header = next(text for text in table if text.startswith("error"))
    rotation = next(text for text in table if text.startswith("rotation"))
    assert len(header) == len(rotation) < 80  # as wide as a terminal is
    assert rotation.split()[-1] == "1"  # the worst frame
    said = next(text for text in table if text.startswith("rotation and position count"))
    assert "the ambiguous frame, too" in said


def test_one_is_told_as_one() -> None:
    T = a_pose()
    pose = line(0, turned_about_z(T, 1.5), covariance=np.eye(6))
    table = as_table(evaluate(file_of(pose, line(7, T)), file_of(line(0, T))))
    assert table.startswith("1 frame: 1 ok,")
    assert "1 pose line has no truth and does not count" in table
    assert "covariance, 1 frame that is ok: " in table


@pytest.mark.skipif("MIXPOSE_RECORDINGS" not in os.environ, reason="no recordings on this machine")
def test_a_chessboard_half_a_turn_off_is_right_and_a_tee_has_two_right_answers() -> None:
    recordings = Path(os.environ["MIXPOSE_RECORDINGS"])
    truth = read_poses(recordings / "stereo_chessboard" / "truth.jsonl")
    S = half_turn_about((96.0, 60.0, 0.0))
    turned = tuple(
        replace(pose, T_world_object=pose.T_world_object @ S)
        for pose in truth.poses
        if pose.T_world_object is not None
    )
    poses = replace(truth, poses=turned, symmetries={"chessboard": S[None]})
    outcome = evaluate(poses, truth)
    assert outcome.ok == outcome.frames == len(truth.poses)
    assert outcome.translation is not None
    assert outcome.translation.max < 1e-6

    truth = read_poses(recordings / "led_tee" / "truth.jsonl")
    for pose in truth.poses:
        outcome = evaluate(replace(truth, poses=(pose,)), truth)
        assert outcome.frames == 1
        assert outcome.rotation_deg is not None
        assert outcome.rotation_deg.max < 1e-5


def test_covariances_go_into_another_unit_with_their_poses() -> None:
    covariance = np.diag([4.0, 9.0, 16.0, 1e-4, 2e-4, 3e-4])
    covariance[0, 5] = covariance[5, 0] = 0.01
    told = in_unit(file_of(line(0, a_pose(), covariance=covariance)), "m").poses[0].covariance
    assert told is not None
    np.testing.assert_allclose(np.diag(told), [4e-6, 9e-6, 16e-6, 1e-4, 2e-4, 3e-4])
    assert told[0, 5] == pytest.approx(1e-5)


def test_of_identical_bodies_that_is_which_stands_there_however_it_is_turned() -> None:
    # a millimetre from each other; turned by three radians each, they would be nearer to the other
    here = a_pose()
    there = turned_about_z(here, 170.0)
    there[0, 3] += 1.0
    truth = [replace(line(0, T), instance=k) for k, T in enumerate((here, there))]
    turned = turned_about_z(there, -170.0), turned_about_z(here, 170.0)
    poses = [replace(line(0, T), instance=1 - k) for k, T in enumerate(turned)]
    told, _ = renumbered(poses, truth, {})
    assert [one.instance for one in told] == [1, 0]
