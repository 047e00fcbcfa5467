"""What `mixpose inspect` advises holds for the image and the bodies that it looks at."""

from __future__ import annotations

from pathlib import Path

import pytest

from mixpose.cli import main

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"


def command(*arguments: str | Path | int) -> int:
    with pytest.raises(SystemExit) as leaving:
        main([str(argument) for argument in arguments])
    return int(str(leaving.value.code))


def test_clutter_beside_several_bodies_is_told_of_what_the_others_leave(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session, made = SYNTHETIC / "several_bodies" / "session.toml", tmp_path / "made"
    words = ("--frames", 1, "--clutter", 4, "--hidden", 0.1, "--seed", 3)
    assert command("simulate", session, "-o", made, *words) == 0
    assert command("inspect", made / "session.toml", "-o", tmp_path / "seen") == 0
    said = capsys.readouterr().out
    assert "4 found belong to no feature" in said
    assert (tmp_path / "seen" / "tool_sheet.png").is_file()
