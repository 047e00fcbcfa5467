"""A session in the frame of the floor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import assert_one_line, command
from pose_lines import covariance_of, lines_of, write_poses

import mixpose as package
from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.records import Estimate, Floats
from mixpose.trajectories.floor import floor_of

FLOOR = rigid.from_rotation_vector([0.3, -2.0, 0.4], [120.0, -40.0, 1500.0])  # T_old_floor
ABOVE = rigid.transform(FLOOR, np.array([[500.0, 200, 900], [-300, 100, 1100]]))

SESSION = """\
unit = "mm"  # of all lengths

[object]
name = "tool"
points = [[0, 0, 0], [50, 0, 0], [0, 60, 0], [0, 0, 70]]
gravity = { direction = [0, 0, -1], sigma = 0.5 }

[start]
rotation_vector = [0.1, 0.2, 0.3]
translation = [1, 2, 3]

[[sensor]]
name = "camera"  # over the door
model = "pinhole"
source = "frames/*.png"
camera_matrix = [[800, 0, 320], [0, 800, 240], [0, 0, 1]]
rotation_vector = [0.5, -0.2, 0.1]
translation = [10, 20, 30]

[[sensor]]
name = "range"
model = "lateration"
source = "ranges.csv"
position = [100, -200, 50]
"""


def estimates_at(poses: Floats, names: list[str] | None = None) -> list[Estimate]:
    lines: list[Estimate] = [*lines_of(poses, covariance_of(0.01, 1e-4))]
    if names is None:
        return lines
    return [replace(one, object=name, frame=0) for one, name in zip(lines, names, strict=True)]


def on_floor(xy: list[list[float]]) -> Floats:
    places = rigid.transform(FLOOR, np.array([[*each, 0.0] for each in xy]))
    return rigid.from_parts(np.eye(3), places)


@pytest.mark.parametrize("frames", [2, 3, 5])
def test_a_body_that_rests_is_the_frame_of_the_world(frames: int) -> None:
    # its places differ by errors, 0.01 along each axis, in which three frames span a triangle
    errors = np.random.default_rng(frames).normal(size=(frames, 3)) * 0.01
    poses = rigid.from_parts(np.repeat(FLOOR[None, :3, :3], frames, 0), FLOOR[:3, 3] + errors)
    found = floor_of(estimates_at(poses), "z", ABOVE)
    np.testing.assert_allclose(found.T_old_new, FLOOR, atol=0.03)
    np.testing.assert_allclose(found.T_old_new[:3, :3], FLOOR[:3, :3], atol=1e-9)


@pytest.mark.parametrize("names", [None, ["a", "b", "c"]])
def test_three_points_are_origin_first_axis_and_plane(names: list[str] | None) -> None:
    # wherever the origin and the first axis lie on the floor
    T = FLOOR @ rigid.from_rotation_vector([0, 0, 0.7], [30.0, 50.0, 0])
    corners = rigid.transform(T, np.array([[0.0, 0, 0], [300, 0, 0], [-20, 200, 0]]))
    found = floor_of(estimates_at(rigid.from_parts(np.eye(3), corners), names), "z", ABOVE)
    np.testing.assert_allclose(found.T_old_new, T, atol=1e-9)


@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_a_plane_through_many_points_keeps_origin_and_heading(up: str) -> None:
    rng = np.random.default_rng(1)
    poses = on_floor(rng.uniform(-400, 400, size=(20, 2)).tolist())
    found = floor_of(estimates_at(poses), up, ABOVE)  # type: ignore[arg-type]
    T_new_old = rigid.inverse(found.T_old_new)
    k = "xyz".index(up)
    assert np.abs(rigid.transform(T_new_old, poses[:, :3, 3])[:, k]).max() < 1e-9
    assert (rigid.transform(T_new_old, ABOVE)[:, k] > 800).all()
    # the old origin is right above or below the new one
    assert np.abs(np.delete(T_new_old[:3, 3], k)).max() < 1e-9
    assert rigid.is_rigid(found.T_old_new, 1e-12)
    assert found.rms_distance is not None
    assert found.rms_distance < 1e-9


@pytest.mark.parametrize("count", [3, 20])
def test_the_floor_is_level_to_what_points_err_by(count: int) -> None:
    rng = np.random.default_rng(4)
    places = on_floor((rng.uniform(-400, 400, size=(count, 2)) * [1.0, 0.3]).tolist())
    told, tilts = [], []
    for _ in range(400):
        poses = rigid.from_parts(np.eye(3), places[:, :3, 3] + rng.normal(size=(count, 3)))
        lines: list[Estimate] = [*lines_of(poses, np.diag([1.0] * 3 + [1e-8] * 3))]
        found = floor_of(lines, "z", ABOVE)
        told.append(found.tilt_deg)
        # about the long axis of the floor, along which points spread most
        tilts.append(np.degrees(found.T_old_new[:3, 2] @ FLOOR[:3, 1]))
    # of 400 draws 3.5 %; the long axis of few points is not quite x
    assert np.sqrt(np.mean(np.square(tilts))) == pytest.approx(np.mean(told), rel=0.15)


def test_a_body_on_the_floor_is_level_as_its_turns_are_known() -> None:
    (line,) = lines_of(FLOOR[None], np.diag([1e-4] * 3 + [4e-6] * 3))
    assert floor_of([line], "z", ABOVE).tilt_deg == pytest.approx(np.degrees(2e-3))
    assert floor_of([replace(line, covariance=None)], "z", ABOVE).tilt_deg == 0.0


def test_the_tip_of_a_tool_touches_the_floor() -> None:
    tip = np.array([3.0, -8.0, -150.0])
    rng = np.random.default_rng(2)
    R = rigid.rotation_matrix(rng.normal(size=(9, 3)) * 0.5)
    places = on_floor(rng.uniform(-300, 300, size=(9, 2)).tolist())[:, :3, 3]
    poses = rigid.from_parts(R, places - R @ tip)
    touched = [replace(one, tip_object=tip) for one in estimates_at(poses)]
    found = floor_of(touched, "z", ABOVE)
    heights = rigid.transform(rigid.inverse(found.T_old_new), places)[:, 2]
    assert np.abs(heights).max() < 1e-9


def test_what_spans_no_floor_is_refused() -> None:
    with pytest.raises(RecordingError, match="on a line"):
        floor_of(estimates_at(on_floor([[0, 0], [100, 0], [250, 0]])), "z", ABOVE)
    with pytest.raises(RecordingError, match="found 2 points"):
        floor_of(estimates_at(on_floor([[0, 0], [100, 0]])), "z", ABOVE)
    # moved along a line, and 3 to and fro for errors along it that one camera leaves in its depth
    astray = rigid.from_rotation_vector(np.zeros(3), [0.0, 3.0, 0.0]) @ FLOOR
    lines = estimates_at(np.stack([FLOOR, astray, *on_floor([[100, 0], [250, 0]])]))
    unsure = np.diag([0.01, 3.0, 0.01, 1e-4, 1e-4, 1e-4]) ** 2
    for count in (3, 4):
        told = [replace(each, covariance=unsure) for each in lines[-count:]]
        with pytest.raises(RecordingError, match="may be errors"):
            floor_of(told, "z", ABOVE)
    # a tool that is turned about its tip
    tip, turns = np.array([3.0, -8.0, -150.0]), rigid.rotation_matrix(np.diag([0.1, 0.3, 0.5]))
    about = estimates_at(rigid.from_parts(turns, FLOOR[:3, 3] - turns @ tip))
    with pytest.raises(RecordingError, match=r"turns by .* deg about a point that rests"):
        floor_of([replace(each, tip_object=tip) for each in about], "z", ABOVE)
    anywhere = rigid.from_parts(np.eye(3), np.random.default_rng(0).normal(size=(9, 3)) * 100)
    with pytest.raises(RecordingError, match="no plane"):
        floor_of(estimates_at(anywhere), "z", ABOVE)


def test_the_aligned_session_sees_the_same_in_another_world(tmp_path: Path) -> None:
    (tmp_path / "session.toml").write_text(SESSION, encoding="utf-8")
    (tmp_path / "other").mkdir()
    write_poses(tmp_path / "poses.jsonl", estimates_at(FLOOR[None]))
    aligned = tmp_path / "other/aligned.toml"
    done = command("align", "session.toml", "--floor", "poses.jsonl", "-o", aligned, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    old, new = (package.load_session(p) for p in (tmp_path / "session.toml", aligned))
    places = np.array([[0.0, 0, 0], [50, 20, 10], [-30, 5, 400]])
    before = rigid.transform(FLOOR, places)
    for one, other in zip(old.sensors, new.sensors, strict=True):
        seen = [s.project(x)[0] for s, x in ((one.sensor, before), (other.sensor, places))]
        np.testing.assert_allclose(seen[1], seen[0], rtol=0, atol=1e-9)
    assert old.start is not None
    assert new.start is not None
    np.testing.assert_allclose(
        FLOOR @ new.start.T_world_object, old.start.T_world_object, atol=1e-9
    )
    assert new.body.gravity is not None
    np.testing.assert_allclose(FLOOR[:3, :3] @ new.body.gravity.direction, [0, 0, -1], atol=1e-9)
    text = aligned.read_text(encoding="utf-8")
    assert "# over the door" in text
    assert 'source = "../frames/*.png"' in text
    # what mixpose wrote may be written again, and what it did not may not
    again = ("align", "session.toml", "--floor", "poses.jsonl", "-o")
    assert command(*again, aligned, cwd=tmp_path).returncode == 0
    assert command(*again, "session.toml", cwd=tmp_path).returncode == 2


def test_a_session_with_held_directions_and_words_that_name_nothing_are_refused(
    tmp_path: Path,
) -> None:
    held = '[estimator]\nfree = ["x", "y", "rz"]\n\n[[sensor]]\nname = "camera"'
    (tmp_path / "held.toml").write_text(SESSION.replace('[[sensor]]\nname = "camera"', held, 1))
    (tmp_path / "session.toml").write_text(SESSION)
    done = command("align", "held.toml", "--floor", "tool@3", "-o", "a.toml", cwd=tmp_path)
    assert done.returncode == 2
    assert "estimator.free" in done.stderr
    done = command("align", "session.toml", "--floor", "board@3", "-o", "a.toml", cwd=tmp_path)
    assert done.returncode == 2
    assert "OBJECT@FRAME with one of tool" in done.stderr


def test_functions_of_the_session_are_run_where_allowed_and_found_from_where_it_is_written(
    tmp_path: Path,
) -> None:
    (tmp_path / "spots.py").write_text(
        "from dataclasses import replace\n\nfrom mixpose.extraction import extract\n\n\n"
        "def find(image, options):\n    return extract(image, replace(options, method='blobs'))\n"
    )
    (tmp_path / "other").mkdir()
    recording = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras"
    text = (recording / "session.toml").read_text().replace('"blobs"', '"spots:find"')
    for side in ("left", "right"):
        text = text.replace(f'"{side}*.png"', f"'{recording / side}*.png'")
    (tmp_path / "session.toml").write_text(text)
    words = ("align", "session.toml", "--floor", "tracker@0", "-o")
    assert_one_line(command(*words, "x.toml", cwd=tmp_path), 2, "add --allow-code")
    done = command(*words, "other/x.toml", "--allow-code", cwd=tmp_path)
    assert_one_line(done, 2, "other has no spots; allowed: -o in", "or spots copied there")
    assert command(*words, "x.toml", "--allow-code", cwd=tmp_path).returncode == 0
    (tmp_path / "other/spots.py").write_bytes((tmp_path / "spots.py").read_bytes())
    assert command(*words, "other/x.toml", "--allow-code", cwd=tmp_path).returncode == 0


@pytest.mark.parametrize("frames", [2, 3, 5, 10])
def test_true_poses_of_a_body_that_rests_are_all_one(frames: int) -> None:
    poses = np.repeat(FLOOR[None], frames, axis=0)
    lines: list[Estimate] = [replace(one, covariance=None) for one in estimates_at(poses)]
    found = floor_of(lines, "z", ABOVE)
    np.testing.assert_allclose(found.T_old_new, FLOOR, atol=1e-9)


def test_a_frame_that_is_not_there_is_said_to_be_so(tmp_path: Path) -> None:
    session = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras" / "session.toml"
    done = command("align", session, "--floor", "tracker@500", "-o", tmp_path / "a.toml")
    assert_one_line(done, 3, "--floor tracker@500: there is no frame 500; name another one")


@pytest.mark.parametrize("where", ["", "object."])
@pytest.mark.parametrize("more", ["", "distance = 3.0"])
def test_a_start_in_dotted_keys_is_moved(tmp_path: Path, where: str, more: str) -> None:
    body, cameras = SESSION.split("[start]", maxsplit=1)[0], SESSION.split("[[sensor]]", 1)[1]
    keys = "rotation_vector = [0.1, 0.2, 0.3]", "translation = [1, 2, 3]", more
    start = "".join(f"start.{key}\n" for key in keys if key)
    text = f"{start}{body}" if not where else f"{body}{start}"
    (tmp_path / "session.toml").write_text(f"{text}\n[[sensor]]{cameras}", encoding="utf-8")
    write_poses(tmp_path / "poses.jsonl", estimates_at(FLOOR[None]))
    words = ("align", "session.toml", "--floor", "poses.jsonl", "-o", "aligned.toml")
    done = command(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    old, new = (package.load_session(tmp_path / name) for name in ("session.toml", "aligned.toml"))
    assert old.start is not None
    assert new.start is not None
    moved = FLOOR @ new.start.T_world_object
    np.testing.assert_allclose(moved, old.start.T_world_object, atol=1e-9)
    assert new.start.distance == old.start.distance
