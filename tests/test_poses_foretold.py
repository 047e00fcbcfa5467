"""Poses that were foretold are held against where the body was then."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import command
from pose_lines import covariance_of, pose_line, swinging, write_poses

from mixpose.errors import RecordingError
from mixpose.poses.evaluate import errors_to_truth, evaluate
from mixpose.poses.jsonl import PoseFile, read_poses
from mixpose.poses.poseline import PoseLine
from mixpose.poses.truth import truth_ahead
from mixpose.records import Floats

INTERVAL_S, PARTS = 0.04, 8
AHEAD = 5 * INTERVAL_S / PARTS


def moving(frames: int) -> tuple[Floats, Floats]:
    """Poses of a body at its frames, and at a moment after each of them."""
    fine = swinging(PARTS * frames, interval_s=INTERVAL_S / PARTS)
    return fine[::PARTS], fine[5::PARTS]


def file_of(lines: list[PoseLine], name: str = "some.jsonl") -> PoseFile:
    return PoseFile(Path(name), {}, tuple(lines), "mm", {})


def truth_file(poses: Floats, left_out: set[int] | None = None) -> PoseFile:
    lines = [pose_line(k, T, None) for k, T in enumerate(poses) if k not in (left_out or set())]
    return file_of(lines, "truth.jsonl")


def foretold_file(poses: Floats, **other: object) -> PoseFile:
    covariance = covariance_of(0.1, 0.001)
    return file_of(
        [pose_line(k, T, covariance, ahead_s=AHEAD, **other) for k, T in enumerate(poses)]
    )


def test_poses_foretold_rightly_have_no_error() -> None:
    now, then = moving(100)
    found = evaluate(foretold_file(then), truth_file(now))
    # the last frame's moment is after all of the truth
    assert (found.frames, found.without_truth) == (99, 1)
    assert found.translation is not None
    assert found.rotation_deg is not None
    # a cubic spline through a swing of 3 s sampled at 25 Hz errs by millionths of its height, at
    # its ends by thousandths
    assert found.translation.median < 1e-4 * 30
    assert found.translation.max < 2e-3 * 30
    assert found.rotation_deg.max < 2e-3 * 25


def test_poses_of_their_frames_that_say_to_be_of_later_are_found_wrong() -> None:
    now, then = moving(100)
    moved = np.linalg.norm(then[:-1, :3, 3] - now[:-1, :3, 3], axis=1)
    found = evaluate(foretold_file(now), truth_file(now))
    assert found.translation is not None
    assert found.translation.median == pytest.approx(np.median(moved), rel=0.01)
    assert found.nees is not None
    assert found.nees.mean_per_dimension > 10


def test_each_frame_is_held_against_its_own_moment() -> None:
    now, then = moving(40)
    poses = [
        pose_line(k, then[k] if k % 2 else now[k], None, ahead_s=AHEAD if k % 2 else 0.0)
        for k in range(39)
    ]
    twists = [error.twist for error in errors_to_truth(file_of(poses), truth_file(now))]
    assert max(float(np.linalg.norm(twist[:3])) for twist in twists[:39] if twist is not None) < 0.1


def test_identical_bodies_have_the_numbers_of_then() -> None:
    """Two that pass one another are where the other one was a moment before."""

    def place(number: int, time_s: float) -> Floats:
        T = np.eye(4)
        T[0, 3] = (1 - 2 * number) * (400.0 * (time_s - 0.41))  # they meet in frame 10
        return T

    truth, poses = [], []
    for k in range(20):
        for number in (0, 1):
            now, then = (place(number, 0.04 * k + later) for later in (0.0, AHEAD))
            truth.append(pose_line(k, now, None, instance=number))
            poses.append(pose_line(k, then, None, instance=1 - number, ahead_s=AHEAD))
    found = evaluate(file_of(poses), file_of(truth, "truth.jsonl"))
    assert found.translation is not None
    assert found.translation.max < 1e-6
    assert found.swaps is not None
    assert found.swaps.count == 0


def test_nothing_is_known_within_a_gap_of_the_truth() -> None:
    now, _ = moving(30)
    poses = foretold_file(now)
    one = truth_ahead(truth_file(now, {10}), poses).poses
    assert [line.frame for line in one if line.T_world_object is None] == [29]
    three = truth_ahead(truth_file(now, {10, 11, 12}), poses).poses
    assert [line.frame for line in three if line.T_world_object is None] == [9, 29]


def test_truth_of_poses_that_were_not_foretold_stays_as_it_is() -> None:
    now, _ = moving(5)
    truth = truth_file(now)
    poses = file_of([pose_line(k, T, None) for k, T in enumerate(now)])
    assert truth_ahead(truth, poses) is truth


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([(0, None), (1, None)], "time_s is missing"),
        ([(0, 0.0), (0, 0.0), (1, 0.04)], "frame 0 of 'tool' is not later than line 1"),
        ([(0, 0.04), (1, 0.0)], "frame 1 of 'tool' is not later than line 1"),
    ],
)
def test_a_truth_that_does_not_say_where_the_body_was_then_is_refused(
    lines: list[tuple[int, float | None]], said: str
) -> None:
    now, _ = moving(2)
    truth = file_of(
        [
            pose_line(frame, now[frame], None, time_s=time_s, line=k + 1)
            for k, (frame, time_s) in enumerate(lines)
        ],
        "truth.jsonl",
    )
    with pytest.raises(RecordingError, match=said):
        truth_ahead(truth, foretold_file(now))


def test_evaluate_reads_what_a_receiver_wrote(tmp_path: Path) -> None:
    now, then = moving(60)
    write_poses(tmp_path / "truth.jsonl", truth_file(now).poses)
    write_poses(tmp_path / "poses.jsonl", foretold_file(then).poses)
    lines = (tmp_path / "poses.jsonl").read_text(encoding="ascii").splitlines()
    told = [json.dumps({**json.loads(text), "ahead_s": AHEAD}) for text in lines[1:]]
    (tmp_path / "poses.jsonl").write_text("\n".join([lines[0], *told]) + "\n", encoding="ascii")
    assert read_poses(tmp_path / "poses.jsonl").poses[0].ahead_s == AHEAD
    result = command("evaluate", tmp_path / "poses.jsonl", tmp_path / "truth.jsonl", "--json")
    assert json.loads(result.stdout)["translation"]["max"] < 0.1


def test_poses_that_were_foretold_stay_so_and_are_not_smoothed(tmp_path: Path) -> None:
    covariance = covariance_of(0.1, 0.001)
    lines = [pose_line(k, T, covariance, ahead_s=AHEAD) for k, T in enumerate(moving(20)[1])]
    path, again = tmp_path / "foretold.jsonl", tmp_path / "again.jsonl"
    write_poses(path, lines)
    assert command("convert", path, "-o", again).returncode == 0
    assert {line.ahead_s for line in read_poses(again).poses} == {AHEAD}
    ended = command("smooth", again, "-o", tmp_path / "smooth.jsonl")
    assert ended.returncode == 3
    assert "holds poses that were foretold" in ended.stderr
