"""What may be asked of a simulation, and what a session has nothing of."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest
from command_line import command

from mixpose.cli.app import SimulateRequest
from mixpose.errors import SessionError
from mixpose.simulation import SimulationOptions

OBJECT = """
unit = "mm"
[object]
name = "body"
points = [[0, 0, 0], [90, 10, 0], [-40, 70, 20], [10, -60, 55]]
[start]
T_world_object = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 900], [0, 0, 0, 1]]
"""
CAMERA = """
[[sensor]]
name = "cam"
model = "pinhole"
source = "{source}"
resolution = [320, 240]
camera_matrix = [[350, 0, 160], [0, 350, 120], [0, 0, 1]]
"""
RANGE = """
[[sensor]]
name = "near"
model = "lateration"
source = "near.{ending}"
position = [0, 0, 0]
"""
BINS = """range_min = 500.0
bin_size = 2.0
"""
IMAGES = ("noise", "brightness", "jpeg", "bayer", "background", "shot_noise", "spot_sigma")


@pytest.mark.parametrize(
    ("given", "unused"),
    [
        (("images",), {"pixel_noise", "range_noise", "range_snr", "range_width"}),
        (("profiles",), {*IMAGES, "pixel_noise", "range_noise", "readout", "exposure", "lamps"}),
        (("pixels",), {*IMAGES, "brightness_spread", "range_noise", "range_snr", "range_width"}),
        (("lengths",), {*IMAGES, "brightness_spread", "pixel_noise", "readout", "occluder"}),
        (("pixels", "lengths"), {*IMAGES, "brightness_spread", "range_snr"}),
        (("images", "profiles", "pixels", "lengths"), set()),
    ],
)
def test_options_are_of_what_sensors_give(given: tuple[str, ...], unused: set[str]) -> None:
    asked = {
        "noise": 3.0,
        "brightness": 99.0,
        "jpeg": 80,
        "bayer": True,
        "background": 5.0,
        "shot_noise": 0.1,
        "spot_sigma": 2.0,
        "brightness_spread": 0.2,
        "pixel_noise": 0.2,
        "range_noise": 1.0,
        "range_snr": 9.0,
        "range_width": 4.0,
        "readout": 0.01,
        "exposure": 0.01,
        "lamps": 1,
        "occluder": 1,
        "clutter": 1.0,
        "hidden": 0.1,
    }
    options = SimulationOptions(3, **asked)  # type: ignore[arg-type]
    found = options.unused(given, is_exact=True)  # type: ignore[arg-type]
    assert unused <= set(found)
    assert not {"clutter", "hidden", "frames", "delay"} & set(found)
    if len(given) == 4:
        assert not found
    assert not SimulationOptions(3).unused(given, is_exact=True)  # type: ignore[arg-type]


def test_features_that_are_exact_cannot_be_displaced() -> None:
    options = SimulationOptions(3, deform=True)
    assert options.unused({"images"}, is_exact=True) == ("deform",)
    assert not options.unused({"images"}, is_exact=False)


@pytest.mark.parametrize(
    ("sensors", "told"),
    [
        (CAMERA.format(source="cam*.png"), "--pixel-noise, --range-snr, --deform"),
        (CAMERA.format(source="cam.csv"), "--jpeg, --range-snr, --deform"),
        (RANGE.format(ending="csv"), "--pixel-noise, --turned-camera, --jpeg, --range-snr"),
        (RANGE.format(ending="npy") + BINS, "--pixel-noise, --turned-camera, --jpeg, --deform"),
        (CAMERA.format(source="cam.csv") + RANGE.format(ending="npy") + BINS, "--jpeg, --deform"),
    ],
)
def test_options_that_say_nothing_of_a_session_are_told(
    tmp_path: Path, sensors: str, told: str
) -> None:
    (tmp_path / "session.toml").write_text(OBJECT + sensors, encoding="utf-8")
    done = command(
        *("simulate", "session.toml", "-o", "out", "--frames", "1", "--pixel-noise", "0.2"),
        *("--jpeg", "90", "--range-snr", "20", "--deform", "--turned-camera", "1"),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "of this session has" in line]
    names, _, said = line.removeprefix("mixpose: warning: ").partition(":")
    assert set(told.split(", ")) <= set(names.split(", "))
    assert said == " no sensor or body of this session has what that is about"
    plain = command("simulate", "session.toml", "-o", "plain", "--frames", "1", cwd=tmp_path)
    assert "of this session has" not in plain.stderr


def test_every_option_of_the_command_is_one_of_the_simulation() -> None:
    asked = {one.name for one in fields(SimulateRequest)} - {"session", "output", "overwrite"}
    assert asked <= {one.name for one in fields(SimulationOptions)}


@pytest.mark.parametrize(
    ("option", "value"),
    [("readout", 5.0), ("exposure", 1.5), ("occluder", 101), ("lamps", 101), ("hidden", 1.1)],
)
def test_what_would_be_no_recording_is_refused(option: str, value: float) -> None:
    with pytest.raises(SessionError, match=f"simulate: {option}: found {value}; allowed: "):
        SimulationOptions(3, **{option: value})  # type: ignore[arg-type]
