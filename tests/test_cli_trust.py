"""What a session file may do, and what a file's name says about its format."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from mixpose.cli import main
from mixpose.errors import SessionError
from mixpose.runner import run
from mixpose.session import load_session

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
RANGES = SYNTHETIC / "range_profiles" / "session.toml"


def command(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


@pytest.fixture
def with_code(tmp_path: Path) -> Path:
    """A session whose extraction is a function beside it, which leaves a trace."""
    recording = SYNTHETIC / "two_cameras"
    for path in [*recording.glob("*000[01].png"), recording / "session.toml"]:
        shutil.copy(path, tmp_path)
    session = tmp_path / "session.toml"
    text = session.read_text(encoding="utf-8").replace('"blobs"', '"own:find"')
    session.write_text(text, encoding="utf-8")
    (tmp_path / "own.py").write_text(
        "from pathlib import Path\n"
        "Path(__file__).with_name('trace').touch()\n"
        "from mixpose.extraction import ExtractOptions, extract\n"
        "def find(image, options):\n"
        "    return extract(image, ExtractOptions())\n",
        encoding="utf-8",
    )
    return session


@pytest.mark.parametrize("what", ["run", "check", "inspect"])
@pytest.mark.usefixtures("without_plots")
def test_a_session_runs_no_code_unless_that_is_allowed(
    what: str, with_code: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    more = ["-o", str(tmp_path / "out")] if what != "check" else ["--quick"]
    assert command(what, with_code, *more) == 2
    said = capsys.readouterr().err
    assert said.startswith(
        f'mixpose: {with_code}: extract.method: "own:find" runs code of a module'
    )
    assert "--allow-code" in said
    assert len(said.splitlines()) == 1
    assert not (tmp_path / "trace").exists()
    assert command(what, with_code, *more, "--allow-code") == 0
    assert (tmp_path / "trace").exists()


def test_python_runs_code_of_a_session_only_where_that_is_allowed(with_code: Path) -> None:
    with pytest.raises(SessionError, match="allow_code=True"):
        next(run(load_session(with_code)))
    assert next(run(load_session(with_code, allow_code=True))).status == "ok"


@pytest.mark.usefixtures("without_plots")
def test_a_report_on_poses_runs_no_code_of_their_session(with_code: Path, tmp_path: Path) -> None:
    pytest.importorskip("jinja2")
    poses = tmp_path / "poses.jsonl"
    assert command("run", with_code, "-o", poses, "--allow-code") == 0
    (tmp_path / "trace").unlink()
    assert command("report", poses, "-o", tmp_path / "report.html") == 0
    assert not (tmp_path / "trace").exists()


@pytest.mark.parametrize(
    ("name", "beginning"),
    [
        ("poses.tum", "# time tx ty tz"),
        ("poses.csv", "frame,time_s,object"),
        ("poses.BOP.csv", "scene_id,im_id"),
        ("poses.yaml", "# frame 0"),
        ("poses.jsonl", '{"type": "header"'),
        ("poses", '{"type": "header"'),
    ],
)
def test_the_suffix_of_the_output_decides_the_format(
    name: str, beginning: str, tmp_path: Path
) -> None:
    assert command("run", RANGES, "--stop", "1", "-o", tmp_path / name) == 0
    assert (tmp_path / name).read_text(encoding="utf-8").startswith(beginning)


def test_a_format_that_is_named_is_taken_whatever_the_suffix(tmp_path: Path) -> None:
    poses = tmp_path / "poses.tum"
    assert command("run", RANGES, "--stop", "1", "-o", poses, "--format", "csv") == 0
    assert poses.read_text(encoding="utf-8").startswith("frame,time_s,object")


def test_a_format_that_cannot_be_written_along_the_way_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("run", RANGES, "-o", tmp_path / "poses.rrd") == 2
    assert "mixpose convert POSES.jsonl" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_suffix_that_is_no_format_is_refused_and_those_allowed_are_listed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("run", RANGES, "-o", tmp_path / "poses.json") == 2
    said = capsys.readouterr().err
    assert "found the suffix .json, which is no format of poses" in said
    assert ".jsonl, .bop.csv, .csv, .tum, .yaml, .yml; or name one with --format" in said
    assert list(tmp_path.iterdir()) == []
    named = ("--format", "jsonl", "--stop", "1")
    assert command("run", RANGES, "-o", tmp_path / "poses.json", *named) == 0


def test_the_name_of_a_file_makes_no_folder_for_several_sessions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    beams = SYNTHETIC / "parallel_beams" / "session.toml"
    assert command("run", RANGES, beams, "-o", tmp_path / "poses.jsonl") == 2
    said = capsys.readouterr().err
    assert "found the name of a file; allowed for 2 sessions: a folder" in said
    assert len(said.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
