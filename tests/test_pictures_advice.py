"""What `mixpose inspect` advises holds for the image and the bodies that it looks at."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from inspected import (
    FRAME,
    SYNTHETIC,
    advice_for,
    command,
    copied,
    estimated_pose,
    left_image,
    with_options,
    write_left,
)
from numpy.typing import NDArray

import mixpose
from mixpose import runner
from mixpose.extraction import ExtractOptions, extract
from mixpose.rigid import transform


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """One frame of two cameras, free to be spoilt."""
    return copied(tmp_path / "recording")


@pytest.fixture(scope="module")
def pose() -> NDArray[np.float64]:
    return estimated_pose()


@pytest.mark.usefixtures("without_plots")
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


def test_without_a_pose_features_are_counted(recording: Path) -> None:
    session = with_options(recording, 'method = "log"\npolarity = "dark"')
    text = advice_for(session, FRAME, None)
    assert "left: 0 features found; without a pose up to 7 are expected" in text
    assert "fewer than the object has" in text


def test_where_much_of_an_image_counts_as_feature_a_stricter_threshold_is_advised(
    recording: Path,
) -> None:
    image = left_image(recording)
    for u, v in np.ndindex(
        14, 10
    ):  # 140 disks of some 80 of its 330 000 pixels, where 2 % are much
        cv2.circle(image, (40 + 40 * u, 40 + 45 * v), 5, 200, -1)
    write_left(recording, image)
    text = advice_for(with_options(recording, 'method = "blobs"\nthreshold = 100'), FRAME, None)
    assert "too much of the image counts as feature: raise threshold = 100, raise min_area" in text


def as_floats(recording: Path, image: NDArray[np.float64]) -> None:
    """Grey values of the left image, in parts of 255."""
    (recording / f"left{FRAME:04d}.png").unlink()
    cv2.imwrite(str(recording / f"left{FRAME:04d}.tif"), (image / 255).astype(np.float32))
    session = recording / "session.toml"
    session.write_text(session.read_text().replace("left*.png", "left*.tif"))


def with_clutter(image: NDArray[Any], grey: int) -> NDArray[np.float64]:
    """Things as large as markers along the upper edge."""
    spoilt = image.astype(np.float64)
    for u in range(200, 600, 100):
        cv2.circle(spoilt, (u, 20), 4, grey, -1)
    return spoilt


def beside_a_wall(image: NDArray[Any]) -> NDArray[np.uint8]:
    """With a wall at the left that is lit, smooth and as bright as clutter, but no feature."""
    u, rng = np.arange(image.shape[1]), np.random.default_rng(0)
    wall = 150 * np.exp(-(((u - 20) / 70.0) ** 2)) * np.ones(image.shape)
    lit = image + wall + rng.normal(0, 4, image.shape) * (wall > 2)
    return np.asarray(np.clip(lit, 0, 255), dtype=np.uint8)


def followed(session: Path, method: str, number: str) -> int:
    """How many points are found at a threshold that was told."""
    image = left_image(session.parent)
    options = ExtractOptions(method, threshold=float(number))
    return extract(image, options).size


@pytest.mark.parametrize("lit", [False, True])
def test_faint_clutter_is_left_out_by_a_threshold_only_where_the_light_is_even(
    lit: bool, recording: Path, pose: NDArray[np.float64]
) -> None:
    image = with_clutter(left_image(recording), 100)
    write_left(recording, beside_a_wall(image) if lit else image.astype(np.uint8))
    text = advice_for(recording / "session.toml", FRAME, pose)
    assert "4 found belong to no feature, all fainter than those that do; they do no harm" in text
    told = re.search(r"threshold = (\S+) would leave them out", text)
    assert (told is None) == lit
    if told is not None:
        assert followed(recording / "session.toml", "blobs", told[1]) == 7


@pytest.mark.parametrize("lit", [False, True])
def test_a_marker_before_something_bright_is_parted_by_a_threshold_only_in_even_light(
    lit: bool, recording: Path, pose: NDArray[np.float64]
) -> None:
    session = mixpose.load_session(recording / "session.toml")
    y, _ = session.sensors[0].sensor.project(transform(pose, session.body.means))
    image = left_image(recording)
    hand = np.zeros_like(image)
    cv2.circle(hand, np.rint(y[0]).astype(int).tolist(), 40, 90, -1)
    image = np.maximum(image, hand)
    write_left(recording, beside_a_wall(image) if lit else image)
    text = advice_for(recording / "session.toml", FRAME, pose)
    assert "not met though bright there: feature" in text
    assert ("no threshold parts them" in text) == lit
    assert (re.search(r"threshold = \d+ parts them", text) is None) == lit


def test_of_dark_markers_what_is_bright_is_their_ground(
    recording: Path, pose: NDArray[np.float64]
) -> None:
    session = mixpose.load_session(recording / "session.toml")
    y, _ = session.sensors[0].sensor.project(transform(pose, session.body.means))
    image = left_image(recording)
    cv2.circle(image, np.rint(y[0]).astype(int).tolist(), 20, int(np.median(image)), -1)
    write_left(recording, 255 - image)
    text = (recording / "session.toml").read_text(encoding="utf-8")
    dark = text.replace("[extract]", '[extract]\npolarity = "dark"', 1)
    (recording / "session.toml").write_text(dark, encoding="utf-8")
    told = advice_for(recording / "session.toml", FRAME, pose)
    assert "not met and bright there: features 1, 6;" in told  # 6 is hidden in the frame


def test_thresholds_of_images_of_parts_are_told_to_three_digits(
    recording: Path, pose: NDArray[np.float64]
) -> None:
    as_floats(recording, with_clutter(left_image(recording), 100))
    text = advice_for(recording / "session.toml", FRAME, pose)
    assert re.search(r"threshold = 0\.\d\d\d would leave them out", text)
    assert re.search(r": 0\.05\d+ grey levels above the background", text)


@pytest.mark.parametrize(
    ("lines", "known", "words"),
    [
        ("min_area = 60", True, r"a grey level below 0\.\d\d\d, that of"),
        ("threshold = 0.6", True, r"lower it: threshold = 0\.28\d"),
        ('threshold = "otsu"', False, r"threshold = 0\.\d\d finds 8 in this frame"),
    ],
)
def test_thresholds_that_find_more_in_images_of_parts_are_no_whole_numbers(
    lines: str, known: bool, words: str, recording: Path, pose: NDArray[np.float64]
) -> None:
    image = left_image(recording).astype(np.float64)
    if not known:  # a lamp, beside which markers are faint
        cv2.circle(image, (80, 40), 20, 2000, -1)
    as_floats(recording, image)
    session = with_options(recording, f'method = "blobs"\n{lines}')
    assert re.search(words, advice_for(session, FRAME, pose if known else None))


def test_light_of_lines_is_not_compared_with_their_number(
    recording: Path,
) -> None:
    session = with_options(recording, 'method = "intensity"')
    text = session.read_text(encoding="utf-8")
    points, rest = text.index("points = ["), text.index("# Near")
    lines = (
        "segments = [[[0, 0, 0], [90, 0, 0]], [[0, 0, 0], [0, 60, 0]], [[0, 0, 0], [0, 0, 40]]]\n\n"
    )
    session.write_text(text[:points] + lines + text[rest:], encoding="utf-8")
    image = np.zeros_like(left_image(recording))
    cv2.line(image, (200, 200), (400, 200), 200, 3)
    cv2.line(image, (200, 200), (200, 330), 200, 3)
    write_left(recording, image)
    said = advice_for(session, FRAME, None)
    assert re.search(r"left: light as of \d\d\.\d points; there is no pose", said)
    assert "too many" not in said


@pytest.mark.parametrize("own", [False, True])
def test_a_sigma_is_said_to_stand_where_it_does(
    own: bool, recording: Path, pose: NDArray[np.float64]
) -> None:
    session = recording / "session.toml"
    text = session.read_text(encoding="utf-8").replace("sigma = 1.5", "sigma = 0.03")
    if own:
        before, left, right = text.split("[[sensor]]")
        left += "\n[sensor.extract]\nsigma = 0.03\n\n"
        text = "[[sensor]]".join([before, left, right])
    session.write_text(text, encoding="utf-8")
    where = "its own [sensor.extract]" if own else "[extract]"
    off = pose.copy()
    off[0, 3] += 0.06  # mm, about as many px
    assert f"raise sigma in {where} to about 0.0" in advice_for(session, FRAME, off)
