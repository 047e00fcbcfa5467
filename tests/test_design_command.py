"""`mixpose design`, as it is typed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import command

from mixpose.cli import main

TWO_CAMERAS = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras" / "session.toml"


def test_the_command_compares_two_systems_and_writes_what_it_found(tmp_path: Path) -> None:
    text = TWO_CAMERAS.read_text(encoding="utf-8")
    markers = text[text.index("points = [") : text.index("# Near")].replace("points = ", "")
    rows = [row.strip(" [],\n") for row in markers.strip().strip("[]").splitlines() if row.strip()]
    table = "name,x,y,z\n" + "".join(f"mark{k},{row}\n" for k, row in enumerate(rows))
    (tmp_path / "markers.csv").write_text(table, encoding="utf-8")
    named = text.replace(f"points = {markers}", 'file = "markers.csv"\n\n')
    (tmp_path / "two.toml").write_text(named, encoding="utf-8")
    one = text[: text.index('[[sensor]]\nname = "right"')].replace('"tracker"', '"other"')
    (tmp_path / "one.toml").write_text(one, encoding="utf-8")
    options = ("--count", "6", "--tip", "0,0,-100", "--json", "d.json", "--plot", "d.png")
    noise = ("--noise", "one:left=0.1", "--noise", "two:left=0.03", "--noise", "two:right=1.2")
    done = command("design", "two.toml", "one.toml", *options, *noise, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "two: features err by left 0.03 px, right 1.2 px" in done.stdout
    assert "one: features err by left 0.1 px" in done.stdout
    assert (
        "weights   sigma in proportion to what features err by (left 0.025, right 1)" in done.stdout
    )
    (tip,) = [row for row in done.stdout.splitlines() if row.startswith("tip, mm ")]
    assert len(tip.split()) == 4  # its name, the unit, and a number for each system
    assert "sigma     features err by much of sigma: right 0.8 of it" in done.stdout
    assert "moving mark" in done.stdout
    assert "7 markers of tracker (mark0, mark1" in done.stdout
    result: dict[str, Any] = json.loads((tmp_path / "d.json").read_text(encoding="utf-8"))
    assert [system["name"] for system in result["systems"]] == ["two", "one"]
    equal = result["systems"][1]["equals_first_with"]
    assert equal["noise"]["left"] == pytest.approx(0.1 * equal["factor"])
    assert len(result["systems"][0]["deviations"]) == 6
    # what is printed are root mean squares of what is written, in degrees, with three digits
    (turns,) = [row for row in done.stdout.splitlines() if row.startswith("rotation, deg ")]
    for printed, system in zip(turns.split()[2:], result["systems"], strict=True):
        squares = (np.array(system["deviations"])[:, 3:] ** 2).sum(axis=1)
        error = np.degrees(np.sqrt(squares.mean()))
        assert float(printed) == pytest.approx(error, rel=2e-3)
    assert (tmp_path / "d.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", ["study.png", "study.svg", "study.pdf", "study.json"])
def test_nothing_is_overwritten_but_what_mixpose_wrote(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    option = "--json" if path.suffix == ".json" else "--plot"
    arguments = ["design", str(TWO_CAMERAS), "--count", "2", option, str(path)]
    path.write_bytes(b"holiday")
    with pytest.raises(SystemExit) as leaving:
        main(arguments)
    assert leaving.value.code == 2
    assert "holds something that mixpose did not write" in capsys.readouterr().err
    assert path.read_bytes() == b"holiday"
    path.unlink()
    for _ in range(2):  # its own file, the second time
        with pytest.raises(SystemExit) as leaving:
            main(arguments)
        assert leaving.value.code == 0
    assert path.stat().st_size > 1000


def test_a_system_may_be_called_by_what_would_be_a_formula(tmp_path: Path) -> None:
    session, picture = tmp_path / r"$\q$.toml", tmp_path / "study.png"
    session.write_bytes(TWO_CAMERAS.read_bytes())
    flat = ["--volume", "100,0,0"]  # which is a volume, too
    with pytest.raises(SystemExit) as leaving:
        main(["design", str(session), "--count", "2", *flat, "--plot", str(picture)])
    assert leaving.value.code == 0
    assert picture.stat().st_size > 1000


def test_an_input_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = tmp_path / "session.toml"
    session.write_bytes(TWO_CAMERAS.read_bytes())
    with pytest.raises(SystemExit) as leaving:
        main(["design", str(session), "--count", "2", "--json", str(session)])
    assert leaving.value.code == 2
    assert "--json" in capsys.readouterr().err
    assert session.read_bytes() == TWO_CAMERAS.read_bytes()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--tip", "1,2"], "--tip: found '1,2'; allowed: three numbers"),
        (["--volume", "1,-2,3"], "--volume: found 1,-2,3; allowed"),
        (["--noise", "left"], "--noise: found 'left'; allowed: SENSOR=NUMBER"),
        (["--noise", "middle=1"], "--noise: found no sensor 'middle'; sensors: left, right"),
        (["--noise", "x:left=1"], "--noise: found no system 'x'"),
        (["--turn", "200"], "--turn: found 200"),
        (["--tolerance", "nan"], "--tolerance: found nan; allowed"),
        (["--tolerance", "-1"], "--tolerance: found -1"),
        (["--plot", "a.png", "--json", "a.png"], "--plot a.png: --json goes there, too"),
        (["--plot", "a.gif"], "--plot a.gif: found '.gif'"),
        (["--plot", "none/a.png"], "--plot none/a.png: there is no folder none"),
        (["--json", "none/a.json"], "--json none/a.json: there is no folder none"),
        (["--poses", "none.jsonl"], "none.jsonl"),
    ],
)
def test_wrong_options_are_told_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as leaving:
        main(["design", str(TWO_CAMERAS), *options])
    assert leaving.value.code in (2, 3)
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert words in said


def test_poses_of_another_unit_or_body_are_not_judged_at(tmp_path: Path) -> None:
    truth = TWO_CAMERAS.with_name("truth.jsonl").read_text(encoding="utf-8")
    header, first, *_ = truth.splitlines(keepends=True)
    assert '"mm"' in header
    assert '"tracker"' in first
    poses, session = tmp_path / "poses.jsonl", TWO_CAMERAS

    def told(text: str) -> str:
        poses.write_text(text, encoding="utf-8")
        done = command("design", session, "--poses", "poses.jsonl", cwd=tmp_path)
        return done.stderr if done.returncode else done.stdout

    other = first.replace('"tracker"', '"cup"')
    assert "found the unit m; allowed: that of the session, mm" in told(
        header.replace('"mm"', '"m"') + first
    )
    assert "holds no pose of 'tracker'" in told(header + other)
    assert told(header + first + other) == told(header + first)


def test_frames_are_simulated_where_a_system_determines_anything(tmp_path: Path) -> None:
    text = TWO_CAMERAS.read_text(encoding="utf-8")
    before, right = (
        text[: text.index("[[sensor]]")],
        text[text.index('[[sensor]]\nname = "right"') :],
    )
    sonar = '[[sensor]]\nname = "sonar"\nmodel = "lateration"\nposition = [0, 0, 0]\n'
    (tmp_path / "range.toml").write_text(before + sonar, encoding="utf-8")
    (tmp_path / "camera.toml").write_text(before + right, encoding="utf-8")
    done = command(
        "design", "range.toml", "camera.toml", "--count", "2", "--monte-carlo", "2", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    alone, beside = done.stdout.split("\ncamera: ")
    assert "simulated nothing: no pose is determined" in alone
    assert "simulated 2 frames at 1 pose" in beside


def test_what_is_said_of_one_sensor_counts_more_than_of_all(tmp_path: Path) -> None:
    # in whatever order it stands
    of_system = ("two_cameras:*=0.3", "left=0.1", "*=9")
    for said in (("left=0.1", "*=0.3"), ("*=0.3", "left=0.1"), of_system):
        noise = [word for text in said for word in ("--noise", text)]
        done = command("design", TWO_CAMERAS, *noise, "--count", "2", cwd=tmp_path)
        assert "features err by left 0.1 px, right 0.3 px" in done.stdout


def test_of_several_bodies_it_is_said_which_is_judged() -> None:
    several = TWO_CAMERAS.parents[1] / "several_bodies" / "session.toml"
    done = command("design", several, "--count", "2")
    assert "'tool' alone is judged, the first of tool, reference, rod" in done.stderr


def test_the_tip_of_the_session_is_judged_unless_another_is_given(tmp_path: Path) -> None:
    text = TWO_CAMERAS.read_text(encoding="utf-8")
    (tmp_path / "s.toml").write_text(
        text.replace("[object]\n", "[object]\ntip = [0, 0, -100]\n"), encoding="utf-8"
    )
    for more, tip in (((), "(0, 0, -100)"), (("--tip", "1,2,3"), "(1, 2, 3)")):
        done = command("design", "s.toml", "--count", "2", *more, cwd=tmp_path)
        assert f"errors of the tip {tip} mm" in done.stdout


def test_simulated_frames_are_told_with_their_poses_and_none_where_nothing_is_determined(
    tmp_path: Path,
) -> None:
    done = command("design", TWO_CAMERAS, "--count", "3", "--monte-carlo", "4")
    assert "simulated 4 frames at 1 pose (4 ok): errors" in done.stdout
    text = TWO_CAMERAS.read_text(encoding="utf-8")
    markers = text[text.index("points = [") : text.index("# Near")]
    line = text.replace(markers, "points = [[0, 0, 0], [50, 0, 0], [80, 0, 0]]\n\n")
    (tmp_path / "line.toml").write_text(line, encoding="utf-8")
    done = command("design", "line.toml", "--count", "1", "--monte-carlo", "4", cwd=tmp_path)
    assert "open      not determined at 1 pose: 0" in done.stdout
    assert "simulated nothing: no pose is determined" in done.stdout
