"""``-`` is standard output wherever text is written, and nothing else is printed there then."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import calibration_texts as texts
import numpy as np
import pytest
from command_line import assert_one_line, command
from moving_bodies import Scene, body, camera, detections, motion, write_recording
from report_runs import write_run

from mixpose.session import load_session

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
SESSION = SYNTHETIC / "two_cameras" / "session.toml"
TRUTH = SESSION.with_name("truth.jsonl")


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    return write_run(tmp_path / "poses.jsonl", {})


def printed(folder: Path, *arguments: str | Path) -> str:
    """What a command prints that writes nothing into the folder where it is begun."""
    before = {path.name for path in folder.iterdir()}
    done = command(*arguments, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in folder.iterdir()} == before
    return done.stdout


def test_smoothed_poses_are_those_of_the_file(poses: Path, tmp_path: Path) -> None:
    told = printed(tmp_path, "smooth", poses, "-o", "-")
    assert command("smooth", poses, "-o", tmp_path / "smooth.jsonl").returncode == 0
    assert told == (tmp_path / "smooth.jsonl").read_text(encoding="utf-8")


@pytest.mark.usefixtures("without_plots")
def test_a_report_is_a_page(poses: Path, tmp_path: Path) -> None:
    pytest.importorskip("jinja2")
    told = printed(tmp_path, "report", poses, TRUTH, "-o", "-")
    assert told.startswith("<!DOCTYPE html>")
    assert told.rstrip().endswith("</html>")


def test_an_aligned_session_has_its_paths_from_where_it_is_printed(tmp_path: Path) -> None:
    told = printed(tmp_path, "align", SESSION, "--floor", TRUTH, "-o", "-")
    assert told.startswith("# Aligned by mixpose")
    (tmp_path / "aligned.toml").write_text(told, encoding="utf-8")
    source = load_session(tmp_path / "aligned.toml").sensors[0].source
    assert (tmp_path / str(source)).resolve() == SESSION.with_name("left*.png")


def test_a_calibrated_session_is_printed_and_its_changes_are_told_aside(tmp_path: Path) -> None:
    text = SESSION.read_text(encoding="utf-8")
    for name in ("left", "right"):
        names = sorted(path.as_posix() for path in SESSION.parent.glob(f"{name}*.png"))[::8]
        text = text.replace(f'source = "{name}*.png"', f"source = {names}")
    (tmp_path / "session.toml").write_text(text, encoding="utf-8")
    words = ("calibrate", "session.toml", "--poses", TRUTH, "-o")
    told = printed(tmp_path, *words, "-")
    assert told.startswith("# Calibrated by mixpose")
    assert len(tomllib.loads(told)["sensor"]) == 2
    assert_one_line(
        command(*words, "-", "--report", "-", cwd=tmp_path), 2, "--report -: -o goes there, too"
    )


def test_a_study_in_numbers_is_printed_without_its_table(tmp_path: Path) -> None:
    told = printed(tmp_path, "design", SESSION, "--count", "2", "--json", "-")
    assert [system["name"] for system in json.loads(told)["systems"]] == ["two_cameras"]


def test_an_imported_session_is_printed_and_was_read_before(tmp_path: Path) -> None:
    (tmp_path / "calibration.toml").write_text(texts.toml("cam_", names=True), encoding="utf-8")
    (tmp_path / "marks.csv").write_text("name,x,y,z\na,0,0,0\nb,5,0,0\nc,0,9,0\n", encoding="utf-8")
    told = printed(tmp_path, "import", "calibration.toml", "marks.csv", "-o", "-")
    assert tomllib.loads(told)["object"]["file"] == "marks.csv"


def test_a_table_of_markers_is_printed_and_several_need_names(tmp_path: Path) -> None:
    scene, cameras = Scene(frames=16), [camera(20.0), camera(85.0)]
    bodies = []
    for markers in (5, 4):
        rng = np.random.default_rng(markers)
        bodies.append((body(markers, rng), motion(scene, rng)))
        write_recording(tmp_path, detections(bodies, cameras, scene, 1), cameras)
        words = ("learn", "session.toml", "-o", "-")
        if len(bodies) == 1:
            told = printed(tmp_path, *words)
            assert told.startswith("name,x,y,z,")
            assert len(told.splitlines()) == 1 + markers
    done = command(*words, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert "-o -: found 2 bodies, each of which gets a table of its own" in done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("inspect", SESSION, "-o", "-"), "-o -: pictures cannot go to standard output; name a"),
        (("simulate", SESSION, "--frames", "2", "-o", "-"), "-o -: a recording cannot go to"),
        (("run", SESSION, "--overlay", "-"), "--overlay -: pictures cannot go to standard output"),
        (("design", SESSION, "--plot", "-"), "--plot -: a picture cannot go to standard output"),
        (("run", SESSION, SESSION.parent / "*.toml", "-o", "-"), "-o DIR: missing"),
    ],
)
def test_what_is_no_text_needs_a_name(
    words: tuple[str | Path, ...], message: str, tmp_path: Path
) -> None:
    done = command(*words, cwd=tmp_path)
    assert_one_line(done, 2, message)
    assert not done.stdout
    assert not list(tmp_path.iterdir())
