"""The examples of README.md and of pages of docs/, run as a reader would."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import mixpose
from mixpose.cli import main
from mixpose.cli.app import CheckRequest, app
from mixpose.cli.check import check_session
from mixpose.session.schema import SessionTable
from mixpose.simulation import SimulationOptions, simulate

ROOT = Path(__file__).parents[1]
FILE = re.compile(r"`([\w./]+)`:\s*$")
LINK = re.compile(r"\]\((?!https?:)([^)#]+)\)")
DECIMAL = re.compile(r"-?\d+\.\d*(?:e[-+]?\d+)?")
# Poses end within 1e-5 standard deviations of their maximum (`FitRules.sharp`), by a way that hangs
# on rounding, and the figures are errors of that size: with and without wide vector units 1e-7 is
# seen.  What is rounded to its last place may fall to either side.
RELATIVE, UNITS = 1e-4, 1.01
DELETE = re.compile(r"Delete the line `(.+?)` from\s+`(.+?)`")


def blocks(page: str) -> Iterator[tuple[str, str, str]]:
    """The text before each block of a page, its kind, and what is in it."""
    parts = (ROOT / page).read_text(encoding="utf-8").split("```")
    for before, block in zip(parts[::2], parts[1::2]):
        kind, _, text = block.partition("\n")
        yield before, kind, text


def parts(text: str) -> list[tuple[str, tuple[str, ...]]]:
    """Words of an output: each with # in place of its decimals, and the decimals."""
    return [(DECIMAL.sub("#", word), tuple(DECIMAL.findall(word))) for word in text.split()]


def near(shown: str, printed: str) -> bool:
    """Whether a decimal is the same but for what machines differ by."""
    places = len(shown.partition("e")[0].partition(".")[2])
    last = 10.0 ** (int(shown.partition("e")[2] or 0) - places)
    value = float(printed)
    return abs(float(shown) - value) <= RELATIVE * abs(value) + UNITS * last


def differing(shown: str, printed: str) -> list[str]:
    """Decimals of a text that are other in the output it is part of; fewest where it fits twice."""
    expected, found = parts(shown), parts(printed)
    form = [word for word, _ in expected]
    differences = []
    for k in range(len(found) - len(form) + 1):
        part = found[k : k + len(form)]
        if [word for word, _ in part] != form:
            continue
        pairs = [
            pair
            for (_, these), (_, those) in zip(expected, part, strict=True)
            for pair in zip(these, those, strict=True)
        ]
        differences.append([f"{a}: printed {b}" for a, b in pairs if not near(a, b)])
    assert differences, f"not in what was printed:\n{shown}\n--- printed:\n{printed}"
    return min(differences, key=len)


def assert_shown(shown: str, printed: str) -> None:
    """What a page shows is part of what was printed."""
    assert differing(shown, printed) == []


def output_of(line: str, capfd: pytest.CaptureFixture[str]) -> str:
    """What a line of shell prints."""
    program, *arguments = shlex.split(line)
    if program == "python":
        subprocess.run([sys.executable, *arguments], check=True)
    else:
        assert program == "mixpose", line
        with pytest.raises(SystemExit) as leaving:
            main(arguments)
        assert not leaving.value.code, line
    printed = capfd.readouterr()
    return printed.out + printed.err


def follow(page: str, capfd: pytest.CaptureFixture[str]) -> None:
    """Do what a page says, in the working folder."""
    printed = ""
    names: dict[str, Any] = {}
    for before, kind, text in blocks(page):
        for line, file in DELETE.findall(before):
            content = Path(file).read_text(encoding="utf-8")
            assert f"{line}\n" in content
            Path(file).write_text(content.replace(f"{line}\n", ""), encoding="utf-8")
        named = FILE.search(before)
        if named and kind in ("csv", "toml", "yaml", "python"):
            Path(named[1]).write_text(text, encoding="utf-8")
        elif kind == "sh":
            printed = "".join(output_of(line, capfd) for line in text.splitlines())
        elif kind == "python":
            exec(compile(text, page, "exec"), names)
            printed = capfd.readouterr().out
        elif kind == "text":
            assert_shown(text, printed)


def test_the_tutorial_can_be_followed_in_an_empty_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    follow("docs/tutorial.md", capfd)
    for written in ("overlay.mp4", "seen/sheet.png", "report.html", "poses.tum", "poses.yaml"):
        assert (tmp_path / written).stat().st_size > 0


def test_the_examples_of_the_python_page_run_and_print_what_it_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").symlink_to(ROOT / "data", target_is_directory=True)
    follow("docs/python.md", capfd)
    assert {"left_0.png", "right_0.png"} <= {path.name for path in tmp_path.iterdir()}


def test_the_page_about_markers_can_be_followed_from_a_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("ezc3d")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").symlink_to(ROOT / "data", target_is_directory=True)
    follow("docs/markers.md", capfd)
    assert (tmp_path / "markers.c3d").stat().st_size > 0


@pytest.mark.parametrize(
    ("page", "written"),
    [
        ("importing", "poses.jsonl"),
        ("design", "design.png"),
        ("clouds", "markers.trc"),
        ("smoothing", "smooth.jsonl"),
        ("tips-and-floors", "aligned.toml"),
        ("learn", "poses.jsonl"),
    ],
)
def test_pages_that_need_no_data_can_be_followed_in_an_empty_folder(
    page: str,
    written: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    follow(f"docs/{page}.md", capfd)
    assert (tmp_path / written).stat().st_size > 0


def test_the_first_two_minutes_print_what_the_readme_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").symlink_to(ROOT / "data", target_is_directory=True)
    shown = list(blocks("README.md"))[:4]
    assert [kind for _, kind, _ in shown] == ["sh", "text", "sh", "text"]
    for (_, _, commands), (_, _, text) in zip(shown[::2], shown[1::2]):
        lines = commands.replace(" && ", "\n").splitlines()
        # the tutorial has overlays and reports
        beyond = re.compile("pip install|--overlay| report ")
        printed = [output_of(line, capfd) for line in lines if not beyond.search(line)]
        assert_shown(text, "\n".join(printed))
    assert (tmp_path / "seen" / "sheet.png").stat().st_size > 0


@pytest.mark.parametrize(
    ("shown", "printed", "differ"),
    [
        ("20 ok, 0.14 mm RMS", "20 ok, 0.04 mm RMS", ["0.14: printed 0.04"]),
        ("rms 0.0056 mm", "first\nrms  0.0057 mm\nlast", []),
        ("rms 0.0056 mm", "rms 0.0058 mm", ["0.0056: printed 0.0058"]),
        ("at (0.5, -1.068)", "at (0.5, 1.068)", ["-1.068: printed 1.068"]),
        ("0.8749161240833643", "0.8749161240839999", []),
        ("0.87491612", "0.87691612", ["0.87491612: printed 0.87691612"]),
        ("1.5e-05", "1.7e-05", ["1.5e-05: printed 1.7e-05"]),
    ],
)
def test_a_number_that_a_page_shows_is_told_from_another_one(
    shown: str, printed: str, differ: list[str]
) -> None:
    assert differing(shown, printed) == differ


@pytest.mark.parametrize("printed", ["20 frames: 19 ok", "20 frames: 20", ""])
def test_what_was_not_printed_is_not_shown(printed: str) -> None:
    with pytest.raises(AssertionError, match="not in what was printed"):
        differing("20 frames: 20 ok", printed)


CAMERA_YML = """%YAML:1.0
camera_matrix: !!opencv-matrix
   {rows: 3, cols: 3, dt: d, data: [800., 0., 320., 0., 800., 240., 0., 0., 1.]}
distortion_coefficients: !!opencv-matrix
   {rows: 1, cols: 5, dt: d, data: [0., 0., 0., 0., 0.]}
image_width: 640
image_height: 480
"""


def test_the_session_of_the_readme_gives_poses_that_are_ok(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (text,) = (text for _, kind, text in blocks("README.md") if kind == "toml")
    (tmp_path / "camera.yml").write_text(CAMERA_YML, encoding="utf-8")

    def simulated(name: str, text: str) -> Path:
        (tmp_path / f"{name}.toml").write_text(text, encoding="utf-8")
        session = mixpose.load_session(tmp_path / f"{name}.toml")
        simulate(session, tmp_path / name, SimulationOptions(frames=4, seed=1))
        return next((tmp_path / name).glob("*.toml"))

    found = mixpose.run(mixpose.load_session(simulated("six", text)))
    assert [estimate.status for estimate in found] == ["ok"] * 4
    # by four markers one camera finds the pose, too, and chance explains each frame nearly as well
    four = text.replace("[100, 111.6, -6.7], [-48, 20, 12], [35, -60, 30],", "[100, 111.6, -6.7],")
    assert four != text
    check_session(CheckRequest(simulated("four", four), quick=True))
    assert "the body is found, but not surely (confidence 0.99" in capsys.readouterr().out


def test_the_session_in_the_readme_is_one() -> None:
    (text,) = (text for _, kind, text in blocks("README.md") if kind == "toml")
    assert SessionTable.model_validate(tomllib.loads(text)).unit == "mm"


def test_every_command_is_in_the_table_of_the_readme() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    table = readme.partition("| `mixpose ...` |")[2].partition("\n\n")[0]
    for command in app.registered_commands:
        assert command.callback is not None
        assert f"| `{command.name or command.callback.__name__}" in table


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))], ids=lambda page: page.name
)
def test_links_lead_to_files(page: Path) -> None:
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        target = (page.parent / link).resolve()
        assert target.exists(), link
