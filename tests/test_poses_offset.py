"""Errors that one transform explains, files in another format, and files that were exchanged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.evaluate import Evaluation, evaluate
from mixpose.poses.jsonl import PoseFile, read_poses
from mixpose.poses.poseline import PoseLine
from mixpose.poses.report import as_dict, as_table
from mixpose.records import Floats

TRANSFORM = rigid.from_rotation_vector([0.0, 0.0, np.radians(12)], [50.0, -3.0, 7.0])
NOISE_MM = 0.01


def file_of(poses: list[Floats], covariance: Floats | None = None) -> PoseFile:
    lines = tuple(
        PoseLine(n, None, "tool", "ok", T, covariance, 1.0, {}, (), None, line=n + 2)
        for n, T in enumerate(poses)
    )
    return PoseFile(Path("some.jsonl"), {}, lines, "mm", {})


@pytest.fixture
def motion() -> list[Floats]:
    rng = np.random.default_rng(3)
    return [
        rigid.from_rotation_vector(0.5 * rng.normal(size=3), 100 * rng.normal(size=3))
        for _ in range(20)
    ]


def evaluated(poses: list[Floats], truth: list[Floats]) -> Evaluation:
    rng = np.random.default_rng(4)
    twists = NOISE_MM * rng.normal(size=(len(poses), 6)) * [1, 1, 1, 0.01, 0.01, 0.01]
    noisy = [rigid.perturb(T, twist) for T, twist in zip(poses, twists, strict=True)]
    return evaluate(file_of(noisy), file_of(truth))


def test_another_origin_of_the_object_is_told_with_what_is_left(motion: list[Floats]) -> None:
    found = evaluated(motion, [T @ TRANSFORM for T in motion])
    assert found.offset is not None
    assert found.offset.of == "object"
    np.testing.assert_allclose(found.offset.T, TRANSFORM, atol=3 * NOISE_MM)
    assert found.offset.translation_rms < 3 * NOISE_MM
    table = as_table(found)
    assert "in the axes of the object: turned by 12 deg, moved by (50" in table
    assert "has the truth another origin or other axes of the object?" in table
    assert as_dict(found)["constant_offset"]["of"] == "object"


def test_another_frame_of_the_world_is_told(motion: list[Floats]) -> None:
    found = evaluated(motion, [TRANSFORM @ T for T in motion])
    assert found.offset is not None
    assert found.offset.of == "world"
    assert "is the truth in another frame of the world?" in as_table(found)


def test_errors_of_no_one_transform_are_not_explained(motion: list[Floats]) -> None:
    rng = np.random.default_rng(5)
    wrong = [rigid.perturb(T, 5 * rng.normal(size=6) * [1, 1, 1, 0.01, 0.01, 0.01]) for T in motion]
    assert evaluated(motion, wrong).offset is None
    assert evaluated(motion, motion).offset is None
    assert "constant_offset" not in as_dict(evaluated(motion, motion))


def test_a_body_at_rest_tells_of_no_offset(motion: list[Floats]) -> None:
    rest = [motion[0]] * 20
    assert evaluated(rest, [T @ TRANSFORM for T in rest]).offset is None


def test_poses_and_truth_in_the_wrong_order_are_noticed(motion: list[Floats]) -> None:
    estimates, truth = file_of(motion, np.eye(6)), file_of(motion)
    assert not evaluate(estimates, truth).exchanged
    table = as_table(evaluate(truth, estimates))
    assert "were the two files exchanged? mixpose evaluate POSES.jsonl TRUTH.jsonl" in table
    assert not evaluate(estimates, replace(estimates)).exchanged


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("frame,time_s,object,status,unit\n0,0.0,tool,ok,mm\n", "found a .csv table of poses"),
        ("scene_id,im_id,obj_id,score,R,t,time\n", "found a .bop.csv table"),
        ("# time tx ty tz qx qy qz qw, in s and m, by mixpose\n", "found a .tum trajectory"),
        ("0.0 1 2 3 0 0 0 1\n0.1 1 2 3 0 0 0 1\n", "found a .tum trajectory"),
        ("hello\n1\n", "not JSON"),
    ],
)
def test_poses_of_another_format_are_called_what_they_are(
    text: str, said: str, tmp_path: Path
) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(RecordingError) as caught:
        read_poses(path)
    assert f":1: {said}" in str(caught.value)
    assert "a poses file holds one JSON object per line (.jsonl)" in str(caught.value)
