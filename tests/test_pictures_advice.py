"""What `mixpose inspect` advises holds for the image and the bodies that it looks at."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from inspected import (
    FRAME,
    SYNTHETIC,
    TWO_CAMERAS,
    advice_for,
    copied,
    left_image,
    with_options,
    write_left,
)
from numpy.typing import NDArray

import mixpose
from mixpose import runner
from mixpose.cli import main
from mixpose.selection import Selection


def command(*arguments: str | Path | float) -> int:
    with pytest.raises(SystemExit) as leaving:
        main([str(argument) for argument in arguments])
    return int(str(leaving.value.code))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """One frame of two cameras, free to be spoilt."""
    return copied(tmp_path / "recording")


@pytest.fixture(scope="module")
def pose() -> NDArray[np.float64]:
    (estimate,) = mixpose.run(
        mixpose.load_session(TWO_CAMERAS), selection=Selection(FRAME, FRAME + 1)
    )
    assert estimate.T_world_object is not None
    return estimate.T_world_object


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


@pytest.mark.parametrize("method", ["blobs", "log"])
def test_a_flood_of_features_of_which_none_is_used_is_too_many_and_not_too_few(
    method: str, recording: Path, pose: NDArray[np.float64], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "MOST_DETECTIONS", 40)
    image = left_image(recording)
    for u in range(20, 620, 10):
        image[10:13, u : u + 3] = 160
    write_left(recording, image)
    session = with_options(recording, f'method = "{method}"')
    for truth in (None, pose):
        text = advice_for(session, FRAME, truth)
        assert re.search(r"left: [67]\d features found, which are too many to use any", text)
        assert "far more than the object has" in text or "too many: look which" in text
        assert "too few" not in text
        assert "not met" not in text
