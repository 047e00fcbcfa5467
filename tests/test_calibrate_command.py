"""`mixpose calibrate`, as it is typed."""

from __future__ import annotations

import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
from command_line import assert_one_line, command

from mixpose.cli.notices import shown_progress
from mixpose.rigid import from_rotation_vector, inverse, rotation_angle_deg
from mixpose.session import load_session

RECORDING = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras"
FRAMES = 8


@pytest.fixture(scope="module")
def bumped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight frames of two cameras, the second turned by 2 degrees and moved by 20 mm."""
    folder = tmp_path_factory.mktemp("bumped")
    text = (RECORDING / "session.toml").read_text()
    for camera in ("left", "right"):
        names = sorted(path.as_posix() for path in RECORDING.glob(f"{camera}*.png"))[::5]
        text = text.replace(f'source = "{camera}*.png"', f"source = {names[:FRAMES]}")
    T = load_session(RECORDING / "session.toml").sensors[1].sensor.T_sensor_world  # type: ignore[attr-defined]
    T = from_rotation_vector(np.radians([1.2, -1.2, 1.06]), [12.0, -12.0, 10.6]) @ T
    old = "rotation_vector = [-0.04, 0.81, -0.03]\ntranslation = [-11.0, 6.0, 820.0]"
    assert old in text
    path = folder / "session.toml"
    path.write_text(text.replace(old, f"T_sensor_world = {T.tolist()}"))
    return path


def test_a_camera_that_was_bumped_is_put_back_where_it_stands(bumped: Path) -> None:
    output = bumped.with_name("calibrated.toml")
    done = command("calibrate", bumped, "-o", output)
    assert done.returncode == 0, done.stderr
    truth = load_session(RECORDING / "session.toml").sensors[1].sensor.T_sensor_world  # type: ignore[attr-defined]
    found = load_session(output).sensors[1].sensor.T_sensor_world  # type: ignore[attr-defined]
    # six frames with centres good to 0.01 px: standard deviations of 0.003 degrees and 0.05 mm
    assert rotation_angle_deg(truth, found) < 0.02
    assert np.linalg.norm(inverse(truth)[:3, 3] - inverse(found)[:3, 3]) < 0.15
    assert np.array_equal(
        load_session(output).sensors[0].sensor.T_sensor_world,  # type: ignore[attr-defined]
        load_session(bumped).sensors[0].sensor.T_sensor_world,  # type: ignore[attr-defined]
    )
    assert "turned by 2" in done.stdout
    assert "held back" in done.stdout
    text = output.read_text()
    assert text.startswith("# Calibrated by mixpose")
    assert "# Two cameras at about right angles" in text  # the user's comments stay
    assert tomllib.loads(text)["sensor"][0]["source"][0].endswith(".png")
    assert not output.with_name("calibrated.toml.partial").exists()


def test_a_wrong_word_for_what_is_free_is_one_line(bumped: Path) -> None:
    for word, said in (
        ("right:posse", "did you mean pose?"),
        ("middle:pose", "no such sensor; allowed: left, right"),
        ("left:range_bias", "it has pose, focal"),
    ):
        done = command("calibrate", bumped, "-o", bumped.with_name("x.toml"), "--free", word)
        assert done.returncode == 2
        assert said in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1


def test_of_several_bodies_the_one_that_is_looked_at_is_told(bumped: Path) -> None:
    other = '[[object]]\nname = "other"\npoints = [[0, 0, 0], [90, 0, 0], [0, 70, 0], [0, 0, 50]]\n'
    path = bumped.with_name("two.toml")
    text = bumped.read_text().replace("[object]", "[[object]]").replace("[start]", "[object.start]")
    path.write_text(text + other)
    done = command("calibrate", path, "--check")
    assert "mixpose: of 2 bodies 'tracker' is looked at\n" in done.stderr


def test_the_session_itself_is_not_overwritten(bumped: Path) -> None:
    done = command("calibrate", bumped, "-o", bumped)
    assert done.returncode == 2
    assert "is an input of this run" in done.stderr


def test_a_calibration_and_its_report_do_not_go_to_one_file(bumped: Path) -> None:
    for place in ("both.toml", "-"):
        words = ("-o", place, "--report", place)
        done = command("calibrate", bumped, *words, cwd=bumped.parent)
        assert_one_line(done, 2, f"--report {place}: -o goes there, too; name another file")
    assert not (bumped.parent / "both.toml").exists()


def test_a_world_that_there_is_not_is_told_before_anything_is_searched(bumped: Path) -> None:
    for word in ("bodi@0", "body@77", f"body@{'7' * 5000}", "middle"):
        done = command("calibrate", bumped, "-o", bumped.with_name("x.toml"), "--world", word)
        assert done.returncode == 2
        (line,) = done.stderr.strip().splitlines()  # no line about what is free and searched
        assert f"--world {word}: allowed: left, right, or the body in a frame" in line
        assert "body@0, body@5, body@10, ..." in line


def test_another_world_is_refused_where_directions_of_the_old_one_are_held(tmp_path: Path) -> None:
    text = (RECORDING / "session.toml").read_text()
    held = '[estimator]\nfree = ["x", "y", "rz"]\n\n[[sensor]]'
    (tmp_path / "session.toml").write_text(text.replace("[[sensor]]", held, 1))
    done = command("calibrate", "session.toml", "-o", "x.toml", "--world", "right", cwd=tmp_path)
    assert_one_line(done, 2, "estimator.free: found x, y, rz", "where the world becomes another")


def test_functions_of_the_session_are_run_where_allowed_and_found_from_where_it_is_written(
    bumped: Path, tmp_path: Path
) -> None:
    (tmp_path / "spots.py").write_text(
        "from dataclasses import replace\n\nfrom mixpose.extraction import extract\n\n\n"
        "def find(image, options):\n    return extract(image, replace(options, method='blobs'))\n"
    )
    (tmp_path / "other").mkdir()
    text = bumped.read_text().replace('method = "blobs"', 'method = "spots:find"')
    (tmp_path / "session.toml").write_text(text)
    words = ("calibrate", "session.toml", "--free", "right:pose", "-o")
    assert_one_line(command(*words, "x.toml", cwd=tmp_path), 2, "add --allow-code")
    done = command(*words, "other/x.toml", "--allow-code", cwd=tmp_path)
    assert_one_line(done, 2, "other has no spots; allowed: -o in", "or spots copied there")
    done = command(*words, "x.toml", "--allow-code", cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_the_sensor_that_is_held_is_called_so_in_a_check(bumped: Path) -> None:
    done = command("calibrate", bumped, "--check")
    assert done.returncode == 0, done.stderr
    left, right = done.stdout.splitlines()[1:3]
    assert "held, the others are told against it; residual" in left
    assert right.split()[:3] == ["right", "turned", "by"]
    assert "e-1" not in done.stdout  # no rounding error among the figures


def test_what_was_searched_before_does_not_count_in_the_time_to_expect(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    with shown_progress() as progress:
        for done in range(41):
            now[0] += 1e-4 if done <= 20 else 1.5
            progress("searching in left", done, 40)
    said = capsys.readouterr().err
    assert said == "mixpose: 16 frames of cameras left to search, about 24 s\n"


@pytest.mark.parametrize(("step_s", "text"), [(9.0, "90 s"), (9.9, "99 s"), (12.0, "2 min")])
def test_long_searches_are_told_in_minutes(
    step_s: float, text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    with shown_progress() as progress:
        for done in range(12):
            progress("searching in left", done, 14)  # too few to be worth a word
        for done in range(21):
            progress("searching in right", done + 10, 34)
            now[0] += 1e-4 if done < 10 else step_s
    assert (
        capsys.readouterr().err == f"mixpose: 10 frames of cameras left to search, about {text}\n"
    )
