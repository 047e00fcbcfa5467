"""`mixpose inspect`: pictures of one frame, and what to change in the session file."""

from __future__ import annotations

import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from checked import counted
from inspected import (
    SYNTHETIC,
    TWO_CAMERAS,
    command,
    copied,
)

import mixpose
from mixpose.cli.inspect import summary
from mixpose.frames import pair
from mixpose.pictures import Part
from mixpose.pictures.advice import describe
from mixpose.pictures.finding import Finding, find
from mixpose.pictures.signature import write_png
from mixpose.pictures.stages import ABOVE, _mark, threshold_picture
from mixpose.records import Estimate
from mixpose.rigid import transform
from mixpose.runner import begin, observe, open_sources


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """One frame of two cameras, free to be spoilt."""
    return copied(tmp_path / "recording")


def test_cameras_get_a_picture_per_stage_and_a_sheet(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "seen"
    folder.mkdir()
    write_png(folder / "left_pose.png", np.zeros((4, 4, 3), np.uint8))  # of an earlier time
    assert command("inspect", TWO_CAMERAS, "--frame", 5, "-o", folder) == 0
    stages = ("features", "threshold", "density", "pose")
    expected = {f"{side}_{stage}.png" for side in ("left", "right") for stage in stages}
    assert {path.name for path in folder.iterdir()} == expected | {"sheet.png", "objective.png"}
    for path in folder.iterdir():
        picture = cv2.imread(str(path))
        assert picture is not None
        assert picture.std() > 3, path.name  # something is on it
    out = capsys.readouterr().out
    assert "\nthe pose came from: predicted\n" in out
    # marker 1 is hidden in the left view of this frame, and a false spot is lit
    assert "left: 7 features found; the pose has 7 of 7 in view, 6 of them met" in out
    assert "not met and dark there: feature 2; hidden" in out
    assert "1 found belong to no feature" in out
    assert "right: 7 features found; the pose has 7 of 7 in view, 7 of them met" in out


@pytest.mark.usefixtures("without_plots")
def test_without_a_number_the_first_frame_is_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in TWO_CAMERAS.parent.glob("*000[45].png"):  # the recording begins with frame 4
        (tmp_path / path.name).write_bytes(path.read_bytes())
    session = tmp_path / "session.toml"
    session.write_bytes(TWO_CAMERAS.read_bytes())
    assert command("inspect", session, "-o", tmp_path / "seen") == 0
    assert "session.toml, frame 4: ok (estimated on its own)" in capsys.readouterr().out


@pytest.mark.usefixtures("without_plots")
def test_grey_values_have_pictures_too(tmp_path: Path) -> None:
    session = SYNTHETIC / "parallel_beams" / "session.toml"
    assert command("inspect", session, "--frame", 3, "-o", tmp_path) == 0
    shown = cv2.imread(str(tmp_path / "angle0_threshold.png"))
    assert shown is not None
    # in place of a mask, grey values: zero where no feature is, which is most of the frame
    assert 0.9 < (shown.max(axis=-1) == 0).mean() < 0.995


def test_ranges_have_plots_and_the_pose_may_come_from_a_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session, poses, folder = (
        SYNTHETIC / "range_profiles" / "session.toml",
        tmp_path / "poses.jsonl",
        tmp_path / "seen",
    )
    assert command("run", session, "-o", poses, "--stop", 2) == 0
    arguments = ("inspect", session, "-o", folder, "--poses", poses, "--frame")
    assert command(*arguments, 1) == 0
    assert f"ok (pose of {poses})" in capsys.readouterr().out
    names = {path.name for path in folder.iterdir()}
    assert names == {"sheet.png", "objective.png", "ranges.png"}
    assert command(*arguments, 9) == 2
    assert "has no pose of it, found frames 0 to 1" in capsys.readouterr().err


@pytest.mark.usefixtures("without_plots")
def test_the_frame_is_of_the_recording_that_the_poses_are_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses, gone = tmp_path / "poses.jsonl", tmp_path / "tuesday"
    header, *lines = TWO_CAMERAS.with_name("truth.jsonl").read_text().splitlines()
    told = json.dumps({**json.loads(header), "sources": {"left": str(gone)}})
    poses.write_text("\n".join([told, *lines, ""]))
    words = ("inspect", TWO_CAMERAS, "-o", tmp_path / "seen", "--poses", poses, "--frame", 1)
    assert command(*words) == 3
    assert f"{gone}: no such file" in capsys.readouterr().err
    left = TWO_CAMERAS.with_name("left*.png")
    assert command(*words, "--source", f"left={left}") == 0


def test_poses_of_another_object_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = SYNTHETIC / "one_camera_video" / "truth.jsonl"
    status = command("inspect", TWO_CAMERAS, "-o", tmp_path, "--frame", 1, "--poses", other)
    assert status == 2
    assert "found poses of wand, the session's object is tracker" in capsys.readouterr().err


@pytest.mark.parametrize("frame", [40, -1])
def test_a_frame_that_is_not_there_names_those_that_are(
    frame: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("inspect", TWO_CAMERAS, f"--frame={frame}", "-o", tmp_path / "seen") == 2
    error = capsys.readouterr().err
    assert f"--frame {frame}: the recording has no such frame" in error
    assert "frames 0-39" in error
    assert not (tmp_path / "seen").exists()


@pytest.mark.usefixtures("without_plots")
def test_frames_before_that_of_number_0_are_shown_as_they_are_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "session.toml").write_bytes(TWO_CAMERAS.read_bytes())
    session = tmp_path / "session.toml"
    text = session.read_text(encoding="utf-8")
    T = np.eye(4)
    T[:3, 3] = 12.0, -8.0, 5.0
    for setup in mixpose.load_session(TWO_CAMERAS).sensors:
        text = text.replace(f"{setup.name}*.png", f"{setup.name}.csv")
        y, _ = setup.sensor.project(transform(T, mixpose.load_session(TWO_CAMERAS).body.means))
        rows = "".join(f"-3,{u},{v}\n" for u, v in y)
        (tmp_path / f"{setup.name}.csv").write_text(f"frame,u,v\n{rows}", encoding="utf-8")
    session.write_text(text, encoding="utf-8")
    assert command("inspect", session, "--frame=-3", "-o", tmp_path / "seen") == 0
    assert "session.toml, frame -3: " in capsys.readouterr().out


@pytest.mark.parametrize("name", ["one_camera_video", "range_profiles", "parallel_beams"])
def test_a_number_before_the_first_frame_is_none_of_those_from_the_end(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = SYNTHETIC / name / "session.toml"
    assert command("inspect", session, "--frame=-1", "-o", tmp_path / "seen") == 2
    assert "--frame -1: the recording has no such frame; it has " in capsys.readouterr().err


def test_other_peoples_files_are_not_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "sheet.png").write_bytes(b"holiday")
    assert command("inspect", TWO_CAMERAS, "--frame", 5, "-o", tmp_path) == 2
    assert "sheet.png holds something that mixpose did not write" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["sheet.png"]
    assert (tmp_path / "sheet.png").read_bytes() == b"holiday"


@pytest.mark.usefixtures("without_plots")
@pytest.mark.parametrize(("source", "place"), [("left*.png", "."), ("left", "left")])
def test_pictures_do_not_go_among_the_frames_of_the_recording(
    source: str, place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / place
    folder.mkdir(exist_ok=True)
    for path in TWO_CAMERAS.parent.glob("*0005.png"):
        shutil.copy(path, folder if path.name.startswith("left") else tmp_path)
    text = TWO_CAMERAS.read_text(encoding="utf-8").replace("left*.png", source)
    (tmp_path / "session.toml").write_text(text, encoding="utf-8")
    assert command("inspect", tmp_path / "session.toml", "-o", folder) == 2
    told = ".png would be taken for a frame of the sensor 'left'; name another folder"
    assert told in capsys.readouterr().err
    assert not list(folder.glob("*_*.png"))
    assert command("inspect", tmp_path / "session.toml", "-o", folder / "seen") == 0


def test_without_matplotlib_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert command("inspect", TWO_CAMERAS, "--frame", 5, "-o", tmp_path / "seen") == 2
    assert "pip install 'mixpose[plots]'" in capsys.readouterr().err


def test_a_sensor_without_a_frame_is_said_to_have_none() -> None:
    session = mixpose.load_session(TWO_CAMERAS)
    finding = Finding(session.sensors[0], None, None, None, 0.0, None)
    assert describe(finding, session.body, session.unit) == ["left: no frame of this number"]


@pytest.mark.parametrize("name", ["two_cameras", "one_camera_video"])
def test_a_lost_frame_with_the_right_counts_is_for_check(name: str) -> None:
    session = mixpose.load_session(SYNTHETIC / name / "session.toml")
    lost = Estimate(6, None, session.labels[0], "lost", None, None, 0.0, {})
    *_, advice = summary(session, session.body, lost, [], None)
    assert f"lost: once the counts are right, mixpose check {session.path} tries" in advice
    assert "[start]" not in advice  # without which the body is searched for


@pytest.mark.parametrize(("count", "whose"), [(1, ""), (2, "a ")])
def test_of_several_bodies_it_is_told_whose_pose_is_shown(
    count: int, whose: str, tmp_path: Path
) -> None:
    session = counted(tmp_path, count)
    assert len(session.labels) == count
    lost = Estimate(6, None, "a", "lost", None, None, 0.0, {})
    first, *_ = summary(session, session.body, lost, [], None)
    assert first == f"{session.path}, frame 6: {whose}lost (estimated on its own)"


def test_a_small_spot_is_seen_between_the_arms_of_its_cross() -> None:
    session = mixpose.load_session(TWO_CAMERAS)
    frames = next(pair(open_sources(session, {}), 6, 7))
    nowhere = Estimate(6, None, "tracker", "lost", None, None, 0.0, {})
    (found, _) = find(
        session.sensors, frames.frames, observe(session, frames), session.body, nowhere
    )
    marked = threshold_picture(found, (1400, 1050))
    bare = threshold_picture(replace(found, points=np.zeros((0, 2))), (1400, 1050))
    spots = (bare == ABOVE).all(axis=-1)
    count, labels = cv2.connectedComponents(spots.astype(np.uint8))
    assert count == 1 + 7
    areas = np.bincount(labels.ravel())[1:]
    seen = np.bincount(labels[(marked == ABOVE).all(axis=-1)], minlength=count)[1:]
    assert areas.min() > 4 * 30  # px, of 40 in the image, at twice its size
    np.testing.assert_array_equal(seen, areas)  # though two are only 13 px apart
    assert (marked != bare).any(axis=-1).sum() > 7 * 4 * 4  # four arms, a few px long
    # nor does an arm, 7 px long where most spots are far apart, reach one 8 px away
    corners = np.array([[20, 20], [28, 20], [80, 20], [80, 80], [20, 80.0]])
    picture = np.zeros((100, 100, 3), np.uint8)
    _mark(picture, Part(), replace(found, points=corners, view=None))
    assert picture[20, 24].any()
    assert not picture[20, 27:30].any()


@pytest.mark.usefixtures("without_plots")
def test_real_frames_have_every_marker_met(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = recordings / "stereo_chessboard" / "session.toml"
    assert command("inspect", session, "--frame", 3, "-o", tmp_path) == 0
    assert capsys.readouterr().out.count("54 of 54 in view, 54 of them met") == 2
    tracker, _ = begin(mixpose.load_session(session))
    assert len(tracker.body) == 54


@pytest.mark.usefixtures("without_plots")
def test_each_of_several_bodies_is_shown_on_what_the_others_leave(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = SYNTHETIC / "several_bodies" / "session.toml"
    assert command("inspect", session, "--frame", 12, "-o", tmp_path / "seen") == 0
    said = capsys.readouterr().out
    for label in ("tool", "reference", "rod-0", "rod-1"):
        assert f"frame 12: {label} ok (estimated on its own)" in said
        assert (tmp_path / "seen" / f"{label}_sheet.png").is_file()
    assert (tmp_path / "seen" / "bodies.png").is_file()
    # of about 21 spots in the left image each body's own are left: 6, 5, 5 and 5 are in view
    assert re.findall(r"left: (\d+) features found", said) == ["6", "5", "5", "5"]
    assert "belong to no feature" not in said
