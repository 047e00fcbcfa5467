"""A sensor that is a frame late is named."""

from __future__ import annotations

import re
import shutil
from itertools import pairwise
from pathlib import Path

import pytest

import mixpose
from mixpose.checking.trials import late_sensor
from mixpose.cli.app import CheckRequest
from mixpose.cli.check import check_session
from mixpose.frames import pair
from mixpose.objective import View
from mixpose.runner import observe, open_sources
from mixpose.simulation import SimulationOptions, simulate

SESSION = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras" / "session.toml"


def test_a_sensor_whose_frames_belong_to_those_before_is_named() -> None:
    session = mixpose.load_session(SESSION)
    frame_sets = pair(open_sources(session, {}), 4, 8)
    seen: list[list[View]] = [observe(session, one) for one in frame_sets]
    numbers = range(5, 8)
    in_step = list(zip(numbers, seen[1:], strict=True))
    # the left camera's frame beside that which the right one took before
    late = [[after[0], before[1]] for before, after in pairwise(seen)]
    assert [view.name for view in late[0]] == ["left", "right"]
    assert late_sensor(session, in_step) is None
    told = late_sensor(session, list(zip(numbers, late, strict=True)))
    assert told == "'right' is a frame late: with each of its frames given to the one before"
    # of a body at rest frames of other moments are as good, and no better
    assert late_sensor(session, [(number, seen[1]) for number in numbers]) is None
    # of frames with gaps nobody knows
    assert late_sensor(session, list(zip((5, 7, 8), late, strict=True))) is None
    assert late_sensor(session, list(zip(numbers, late, strict=True))[:2]) is None


def test_check_names_a_sensor_that_is_late_and_not_where_it_might_stand_instead(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copy(SESSION, tmp_path)
    for n in range(8):
        shutil.copy(SESSION.with_name(f"left{n + 1:04d}.png"), tmp_path / f"left{n:04d}.png")
        shutil.copy(SESSION.with_name(f"right{n:04d}.png"), tmp_path)
    check_session(CheckRequest(tmp_path / SESSION.name))
    (warning,) = re.findall(r"^warning +(.*)$", capsys.readouterr().out, re.MULTILINE)
    assert warning.startswith("'right' is a frame late: ")


def test_a_delay_that_the_session_tells_is_no_fault(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    late = SESSION.read_text().replace('name = "right"', 'name = "right"\ndelay = 0.03')
    (tmp_path / "late.toml").write_text(late)
    session = mixpose.load_session(tmp_path / "late.toml")
    motion = SimulationOptions(frames=8, amplitude_rotation_deg=40.0, amplitude_translation=80.0)
    simulate(session, tmp_path / "recording", motion)
    check_session(CheckRequest(tmp_path / "recording" / "session.toml"))
    assert "warnings  none" in capsys.readouterr().out
