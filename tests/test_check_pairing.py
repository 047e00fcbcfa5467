"""`mixpose check`: frames of several sensors that are no frames of one moment."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from checked import copied, report_on


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return copied(tmp_path)


def test_frames_that_other_sensors_have_are_missing(
    recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (recording / "left0003.png").unlink()
    report = report_on(recording / "session.toml", capsys)
    assert "missing: 3 of the 8 frames of all sensors" in report
    assert "warnings  none" in report


@pytest.mark.parametrize(
    ("later", "said"),
    [
        (
            100,
            "sensor 'left': 0 of its 8 frames pair with those of other sensors: frames are paired",
        ),
        (1, "sensors 'left' and 'right' have 8 frames each, numbered from 1 and from 0"),
    ],
)
def test_sensors_whose_numbers_do_not_pair_are_told(
    recording: Path, capsys: pytest.CaptureFixture[str], later: int, said: str
) -> None:
    for path in sorted(recording.glob("left*.png"), reverse=True):
        path.rename(recording / f"left{int(path.stem[4:]) + later:04d}.png")
    assert said in report_on(recording / "session.toml", capsys)


@pytest.mark.parametrize("sides", [("left",), ("left", "right")])
def test_a_sensor_that_shows_the_same_again_is_told_where_others_do_not(
    recording: Path, capsys: pytest.CaptureFixture[str], sides: tuple[str, ...]
) -> None:
    for side in sides:
        for n in (4, 5):
            shutil.copy(recording / f"{side}0003.png", recording / f"{side}000{n}.png")
    report = report_on(recording / "session.toml", capsys)
    said = "sensor 'left' shows the same as the frame before in frames 4, 5, while others do not"
    assert (f"{said}: frozen, or frames doubled?" in report) == (sides == ("left",))


@pytest.mark.parametrize(
    ("times", "off"),
    # 8 frames a 0.04 s: median of n / 25 - n / 50; 2.5 frames later; half a frame, as of cameras
    # that nothing triggers together
    [("fps = 50", "0.07"), ('times = "later.csv"', "0.1"), ('times = "half.csv"', None)],
)
def test_frames_of_other_moments_by_their_times_are_told(
    recording: Path, capsys: pytest.CaptureFixture[str], times: str, off: str | None
) -> None:
    for name, delay in {"later": 0.1, "half": 0.02}.items():
        rows = [f"{n},{n / 25 + delay}" for n in range(8)]
        (recording / f"{name}.csv").write_text("\n".join(["frame,time_s", *rows, ""]))
    path = recording / "session.toml"
    first, second = path.read_text().split('name = "right"')
    path.write_text(f'{first}name = "right"{second.replace("fps = 25", times)}')
    report = report_on(path, capsys)
    said = f"'right': its frames are {off} s from those of 'left' with the same number, and 'left'"
    assert (f"{said} has one every 0.04 s: is fps" in report) == (off is not None)
    assert ("warnings  none" in report) == (off is None)
