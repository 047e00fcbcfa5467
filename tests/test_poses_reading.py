from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.header import Header
from mixpose.poses.jsonl import JsonlWriter, read_poses, read_unfinished_poses
from mixpose.records import Estimate, Hypothesis, SensorReport

EYE: list[list[float]] = np.eye(4).tolist()
MINIMAL: dict[str, Any] = {"frame": 3, "object": "bed", "T_world_object": EYE}
HEADER: dict[str, Any] = {"type": "header", "format": "mixpose-poses", "version": 1, "unit": "mm"}


def file_of(folder: Path, *lines: object) -> Path:
    path = folder / "poses.jsonl"
    texts = [line if isinstance(line, str) else json.dumps(line) for line in lines]
    path.write_text("".join(text + "\n" for text in texts), encoding="utf-8")
    return path


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    T = rigid.from_rotation_vector([0.3, -0.2, 0.1], [1.1, 2.2, 3.3])
    estimate = Estimate(
        frame=5,
        time_s=0.25,
        object="tracker",
        status="ambiguous",
        T_world_object=T,
        covariance=np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]),
        score=0.9,
        sensors={"left": SensorReport(True, 0.8, 0.2), "right": SensorReport(False)},
        hypotheses=(Hypothesis(T, 0.7),),
        latency_ms=2.0,
        proposer="searched",
    )
    path = tmp_path / "poses.jsonl"
    symmetries = {"tracker": np.stack([np.eye(4), T])}
    with path.open("w") as stream:
        JsonlWriter(stream, Header("cm", None, None, "0.1.0", 3, symmetries)).write(estimate)

    back = read_poses(path)
    assert back.unit == "cm"
    assert back.header["seed"] == 3
    assert np.array_equal(back.symmetries["tracker"], symmetries["tracker"])
    (line,) = back.poses
    assert line.line == 2
    apart = (
        "hypotheses",
        "proposer",
        "blurs",
        "doubt",
        "measured",
        "guesses",
        "delays",
        "tip_object",
    )
    for name, value in asdict(estimate).items():
        if name not in apart:
            assert np.array_equal(np.asarray(asdict(line)[name]), np.asarray(value)), name
    assert np.array_equal(line.hypotheses[0].T_world_object, T)
    assert line.hypotheses[0].weight == 0.7


def test_three_keys_and_no_header_are_enough(tmp_path: Path) -> None:
    (line,) = read_poses(file_of(tmp_path, MINIMAL)).poses
    assert (line.frame, line.object, line.status) == (3, "bed", "ok")
    assert line.covariance is None
    assert read_poses(file_of(tmp_path, MINIMAL)).unit is None


def test_unknown_keys_blank_lines_and_a_missing_last_newline_are_no_trouble(tmp_path: Path) -> None:
    path = file_of(tmp_path, HEADER, "", {**MINIMAL, "image": "a.png", "reference_rms_px": 0.1})
    path.write_text(path.read_text().rstrip("\n"))
    assert len(read_poses(path).poses) == 1


def test_a_lost_line_needs_no_matrix(tmp_path: Path) -> None:
    path = file_of(tmp_path, {"frame": 1, "object": "bed", "status": "lost"})
    assert read_poses(path).poses[0].T_world_object is None


BAD_MATRIX = [[2.0, 0, 0, 0], *EYE[1:]]
NEGATIVE = (-np.eye(6)).tolist()
TINY_NEGATIVE = np.diag([1.0, 1, 1, 1e-8, 1e-8, -1e-9]).tolist()
CORRELATED = np.eye(6)
CORRELATED[0, 1] = CORRELATED[1, 0] = 1.5


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", ":2: not JSON"),
        ("[1]", ":2: not a JSON object"),
        ({**MINIMAL, "type": "note"}, ":2: type is 'note'; allowed are 'header' and 'pose'"),
        ({"object": "bed", "T_world_object": EYE}, ":2: frame is missing"),
        ({**MINIMAL, "frame": 1.5}, ":2: frame is 1.5; "),
        ({**MINIMAL, "frame": True}, ":2: frame is True; "),
        ({**MINIMAL, "object": 3}, ":2: object is 3; "),
        ({**MINIMAL, "sensors": {"a\rb": None}}, r":2: sensors.a\\rb is None; "),
        ({**MINIMAL, "status": "fine"}, ":2: status is 'fine'; .*'ok', 'ambiguous' or 'lost'"),
        ({**MINIMAL, "T_world_object": None}, ":2: T_world_object is null or missing"),
        ({**MINIMAL, "status": "lost"}, ":2: T_world_object is given while status is 'lost'"),
        ({**MINIMAL, "T_world_object": EYE[:3]}, ":2: T_world_object is .*at least 4 items"),
        ({**MINIMAL, "T_world_object": BAD_MATRIX}, ":2: T_world_object is not a rotation"),
        ({**MINIMAL, "T_world_object": [[1e300] * 4] * 4}, ":2: T_world_object is not a rotation"),
        (
            {
                **MINIMAL,
                "T_world_object": [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
            },
            ":2: T_world_object holds 1e.300; allowed is at most 1e.100",
        ),
        ({**MINIMAL, "covariance": NEGATIVE}, ":2: covariance is not symmetric and positive"),
        ({**MINIMAL, "covariance": TINY_NEGATIVE}, ":2: covariance is not symmetric and positive"),
        ({**MINIMAL, "covariance": CORRELATED.tolist()}, ":2: covariance is not symmetric"),
        (
            {**MINIMAL, "time_s": float("nan")},
            ":2: NaN is not allowed; every number must be finite",
        ),
        ({**MINIMAL, "other": float("-inf")}, ":2: -Infinity is not allowed"),
        ('{"frame": 1, "object": "bed", "score": 1e999}', ":2: score is inf; .*finite"),
        ('{"frame": 1, "object": "bed", "score": 1' + 400 * "0" + "}", ":2: score is 1000"),
        (HEADER, ":2: a header after the first line"),
    ],
)
def test_a_wrong_line_is_named_with_what_is_allowed(
    line: object, message: str, tmp_path: Path
) -> None:
    path = file_of(tmp_path, HEADER, line, MINIMAL)
    with pytest.raises(RecordingError, match=message) as caught:
        read_poses(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"format": "mixpose-scores"},
            ":1: format is 'mixpose-scores'; allowed is 'mixpose-poses'",
        ),
        ({"version": 2}, ":1: version 2 of mixpose-poses; this mixpose reads version 1"),
        ({"unit": "inch"}, ":1: unit is 'inch'; allowed are 'm', 'cm', 'mm', 'um'"),
        ({"symmetries": {"bed": [BAD_MATRIX]}}, ":1: symmetries.bed is not a rotation"),
    ],
)
def test_a_wrong_header_is_named_with_what_is_allowed(
    change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(RecordingError, match=message):
        read_poses(file_of(tmp_path, {**HEADER, **change}, MINIMAL))


def test_a_line_cut_off_by_an_interruption_is_named_as_such(tmp_path: Path) -> None:
    path = file_of(tmp_path, HEADER, MINIMAL)
    path.write_text(path.read_text() + json.dumps(MINIMAL)[:30])
    with pytest.raises(RecordingError, match=r":3: the last line is cut off; .*--resume"):
        read_poses(path)


def test_files_that_are_no_poses_are_refused_in_one_line(tmp_path: Path) -> None:
    picture = tmp_path / "picture.png"
    picture.write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(RecordingError, match=":1: not UTF-8 text"):
        read_poses(picture)
    with pytest.raises(RecordingError, match="cannot be read: No such file"):
        read_poses(tmp_path / "absent.jsonl")
    with pytest.raises(RecordingError, match="cannot be read: Is a directory"):
        read_poses(tmp_path)


@pytest.mark.skipif("MIXPOSE_RECORDINGS" not in os.environ, reason="no recordings on this machine")
def test_truth_files_of_recordings_are_read() -> None:
    files = sorted(Path(os.environ["MIXPOSE_RECORDINGS"]).glob("*/truth*.jsonl"))
    assert files
    for path in files:
        truth = read_poses(path)
        assert truth.unit in ("m", "mm")
        assert truth.poses


def test_three_errors_cannot_each_go_against_the_other_two(tmp_path: Path) -> None:
    covariance = np.eye(6)
    for sign, refused in ((0.9, False), (-0.9, True)):
        # correlations below 1 all of them; with -0.9 the sum x + y + z has the variance -2.4
        covariance[:3, :3] = np.where(np.eye(3, dtype=bool), 1.0, sign)
        path = file_of(tmp_path, {**MINIMAL, "covariance": covariance.tolist()})
        if refused:
            with pytest.raises(
                RecordingError, match=":1: covariance is not symmetric and positive"
            ):
                read_poses(path)
        else:
            np.testing.assert_array_equal(read_poses(path).poses[0].covariance, covariance)


def test_a_file_that_a_run_still_writes_is_read_up_to_its_last_whole_line(tmp_path: Path) -> None:
    path = file_of(tmp_path, HEADER, MINIMAL, {**MINIMAL, "frame": 4})
    whole = path.read_bytes()
    for missing, frames, cut in ((0, [3, 4], False), (1, [3, 4], False), (5, [3], True)):
        path.write_bytes(whole[: len(whole) - missing])
        poses, was_cut = read_unfinished_poses(path)
        assert ([pose.frame for pose in poses.poses], was_cut) == (frames, cut)
