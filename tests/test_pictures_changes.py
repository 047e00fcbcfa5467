"""`mixpose inspect`: what to change in the session file, as the features of a frame tell it."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from inspected import (
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
from mixpose.records import Status
from mixpose.rigid import transform


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """One frame of two cameras, free to be spoilt."""
    return copied(tmp_path / "recording")


@pytest.fixture(scope="module")
def pose_of_frame_6() -> NDArray[np.float64]:
    return estimated_pose()


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ('method = "blobs"\nmin_area = 60', "not met, too small: features 1, 2, 3, 4, 5, 6 and 1"),
        ('method = "blobs"\nmin_area = 60', "lower min_area = 60 to 40"),
        ('method = "blobs"\nmax_area = 30', "raise max_area = 30 to"),
        ('method = "blobs"\nthreshold = 150', "lower it: threshold = 72"),
        ('method = "blobs"\npolarity = "dark"', "not met"),
    ],
)
def test_expected_features_that_are_not_found_name_the_key_and_the_direction(
    lines: str, words: str, recording: Path, pose_of_frame_6: NDArray[np.float64]
) -> None:
    assert words in advice_for(with_options(recording, lines), 6, pose_of_frame_6)


@pytest.mark.parametrize("rule", ["otsu", "auto"])
@pytest.mark.parametrize("polarity", ["bright", "dark"])
def test_a_grey_level_beside_that_of_a_rule_is_a_number_of_the_image(
    rule: str, polarity: str, recording: Path, pose_of_frame_6: NDArray[np.float64]
) -> None:
    for path in recording.glob("*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        cv2.imwrite(str(path), image if polarity == "bright" else 255 - image)
    lines = f'method = "blobs"\nthreshold = "{rule}"\npolarity = "{polarity}"\nmin_area = 60'
    session = with_options(recording, lines)
    text = advice_for(session, 6, pose_of_frame_6)
    side = "below" if polarity == "bright" else "above"
    told = re.search(rf'set threshold to a grey level {side} (\d+), that of "{rule}"', text)
    assert told is not None, text
    # as a level of its own, rounded, it parts what the rule parts: pieces keep their areas
    by_rule = re.search(r"lower min_area = 60 to (\d+)", text)
    session.write_text(session.read_text().replace(f'"{rule}"', told[1]))
    by_number = re.search(r"min_area = 60 to (\d+)", advice_for(session, 6, pose_of_frame_6))
    assert by_rule is not None
    assert by_number is not None
    assert abs(int(by_number[1]) - int(by_rule[1])) <= 2  # px, of a grey level less or more


def test_following_the_advice_finds_the_features(
    recording: Path, pose_of_frame_6: NDArray[np.float64]
) -> None:
    session = with_options(recording, 'method = "blobs"\nthreshold = 72')
    text = advice_for(session, 6, pose_of_frame_6)
    assert "7 of 7 in view, 7 of them met" in text
    assert "not met" not in text


@pytest.mark.parametrize("polarity", ["bright", "dark"])
def test_a_marker_before_something_bright_is_parted_from_it_by_a_threshold_that_is_named(
    polarity: str, recording: Path, pose_of_frame_6: NDArray[np.float64]
) -> None:
    """A hand of grey 90 about one marker: no level above the hand is named in vain."""
    session = mixpose.load_session(recording / "session.toml")
    y, _ = session.sensors[0].sensor.project(transform(pose_of_frame_6, session.body.means))
    for path in recording.glob("*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        hand = np.zeros_like(image)
        if path.name.startswith("left"):
            cv2.circle(hand, np.rint(y[0]).astype(int).tolist(), 40, 90, -1)
        image = np.maximum(image, hand)
        cv2.imwrite(str(path), image if polarity == "bright" else 255 - image)
    lines = f'method = "blobs"\npolarity = "{polarity}"'
    session_file = with_options(recording, lines)
    told = re.search(
        r"threshold = (\d+) parts them in this frame", advice_for(session_file, 6, pose_of_frame_6)
    )
    assert told is not None
    text = session_file.read_text().replace(lines, f"{lines}\nthreshold = {told[1]}")
    session_file.write_text(text)
    assert "7 of 7 in view, 7 of them met" in advice_for(session_file, 6, pose_of_frame_6)


def test_a_sensor_that_sees_the_body_elsewhere_is_said_to_take_no_part(
    recording: Path, pose_of_frame_6: NDArray[np.float64]
) -> None:
    away = pose_of_frame_6.copy()
    away[0, 3] += 60.0
    text = advice_for(recording / "session.toml", 6, away)
    assert "it takes no part in this pose" in text
    assert "not met" not in text


def test_for_dark_features_the_threshold_goes_the_other_way(
    recording: Path, pose_of_frame_6: NDArray[np.float64]
) -> None:
    for path in recording.glob("*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        cv2.imwrite(str(path), 255 - image)
    session = with_options(recording, 'method = "blobs"\npolarity = "dark"\nthreshold = 105')
    assert "raise it: threshold = 184" in advice_for(session, 6, pose_of_frame_6)


@pytest.mark.parametrize(
    ("threshold", "words"),
    [
        ('"auto"', "clear of the noise, and a fifth of the clearest spot"),
        ("1000.0", "hidden, or lower threshold = 1000"),
    ],
)
def test_unsharp_spots_are_told_by_their_height(
    threshold: str, words: str, recording: Path, pose_of_frame_6: NDArray[np.float64]
) -> None:
    lines = f'method = "log"\nspot_sigma = 1.5\nthreshold = {threshold}'
    assert words in advice_for(with_options(recording, lines), 6, pose_of_frame_6)


@pytest.mark.usefixtures("without_plots")
def test_unsharp_spots_have_a_picture_of_the_response(recording: Path, tmp_path: Path) -> None:
    session = with_options(recording, 'method = "log"\nspot_sigma = 1.5')
    assert command("inspect", session, "--frame", 6, "-o", tmp_path / "seen") == 0
    shown = cv2.imread(str(tmp_path / "seen" / "left_threshold.png"))
    assert shown is not None
    # black but for markers and the noise: half of the noise is below zero
    assert (shown.max(axis=-1) < 30).mean() > 0.9


def test_no_sigma_is_advised_where_a_told_delay_puts_features_off(
    recording: Path, pose_of_frame_6: NDArray[np.float64]
) -> None:
    session, pose = recording / "session.toml", pose_of_frame_6.copy()
    pose[:3, 3] += 2.0  # as far as the body goes in the time that the camera is late
    assert "raise sigma" in advice_for(session, 6, pose)
    text = session.read_text(encoding="utf-8").replace("fps = 25", "fps = 25\ndelay = 0.02")
    session.write_text(text, encoding="utf-8")
    told = advice_for(session, 6, pose)
    assert "raise sigma" not in told
    assert "the sensor is late or rolling, and the pose is of the frame's own moment" in told


def test_small_clutter_is_told_by_its_area(
    recording: Path, pose_of_frame_6: NDArray[np.float64]
) -> None:
    image = left_image(recording)
    for u in range(30, 600, 60):
        image[30:33, u : u + 3] = 150
    write_left(recording, image)
    text = advice_for(recording / "session.toml", 6, pose_of_frame_6)
    # specks of 9 px and markers of about 40: their geometric mean lies between
    assert "10 found belong to no feature, all smaller" in text
    assert re.search("raise min_area to 1[0-9]$", text, re.MULTILINE)


@pytest.mark.parametrize(("status", "hidden"), [("ambiguous", 0), ("ok", 2)])
def test_where_markers_are_not_told_for_sure_no_size_is_advised(
    status: Status, hidden: int, recording: Path, pose_of_frame_6: NDArray[np.float64]
) -> None:
    # a pose that may be wrong, or one that misses two of seven markers
    image = left_image(recording)
    session = mixpose.load_session(recording / "session.toml")
    y, _ = session.sensors[0].sensor.project(transform(pose_of_frame_6, session.body.means))
    for u, v in y[:hidden].round().astype(int).tolist():
        image[v - 8 : v + 9, u - 8 : u + 9] = 0
    for u in range(30, 600, 60):
        image[30:33, u : u + 3] = 150
    write_left(recording, image)
    text = advice_for(recording / "session.toml", 6, pose_of_frame_6, status)
    assert "10 found belong to no feature; which are markers cannot be told here" in text
    assert "min_area" not in text


def test_without_a_pose_too_many_features_are_not_told_apart(recording: Path) -> None:
    image = left_image(recording)
    for u in range(30, 600, 25):
        image[30:33, u : u + 3] = 150
    write_left(recording, image)
    text = advice_for(recording / "session.toml", 6, None)
    assert "too many: look which are markers" in text
    assert "raise min_area" not in text


def test_without_a_pose_the_number_of_features_tells(recording: Path) -> None:
    text = advice_for(with_options(recording, 'method = "blobs"\nmin_area = 60'), 6, None)
    assert "0 features found; without a pose up to 7 are expected" in text
    assert "7 pieces above the threshold are too small" in text


@pytest.mark.parametrize("polarity", ["bright", "dark"])
def test_where_most_of_the_image_counts_as_feature_the_threshold_goes_the_other_way(
    recording: Path, polarity: str
) -> None:
    # above 250 is nothing, and below it all of a dark frame: one piece, and no more farther up
    lines = f'method = "blobs"\npolarity = "{polarity}"\nthreshold = 250'
    assert "too few: lower threshold = 250" in advice_for(with_options(recording, lines), 6, None)
