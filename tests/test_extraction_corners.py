"""Corners of chessboards drawn here by supersampling a plane seen in perspective."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.errors import SessionError
from mixpose.extraction import ExtractOptions, extract
from mixpose.records import PointPattern

Floats = NDArray[np.float64]
FINE = 6
SIZE = 160


def chessboard(
    seed: int,
    *,
    side: float = 18,
    noise: float = 2,
    bright: float = 180,
    shade: float = 0.4,
) -> tuple[NDArray[np.uint8], Floats]:
    """A turned board of 6 x 6 fields, `side` px wide, with light falling off; 25 corners."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi)
    c, s = side * np.cos(angle), side * np.sin(angle)
    middle = SIZE / 2 + rng.uniform(-1, 1, 2)
    tilt = 0.001 * side * rng.normal(size=2)
    H = np.array([[c, -s, middle[0]], [0.8 * s, 0.8 * c, middle[1]], [*tilt, 1]])
    axis = (np.arange(SIZE * FINE) + 0.5) / FINE - 0.5
    u, v = np.meshgrid(axis, axis)
    a, b, w = np.einsum("ij,jvu->ivu", np.linalg.inv(H), np.stack([u, v, np.ones_like(u)]))
    a, b = a / w, b / w
    dark = (np.floor(a) + np.floor(b)) % 2 == 0
    light = np.where(dark & (np.maximum(np.abs(a), np.abs(b)) < 3), 40.0, bright)
    light *= 1 + shade * (u / SIZE - 0.5)
    image = light.reshape(SIZE, FINE, SIZE, FINE).mean(axis=(1, 3))
    # Optics: about 0.7 px of blur.
    for _ in range(2):
        image = (np.roll(image, 1, 0) + 2 * image + np.roll(image, -1, 0)) / 4
        image = image.T
    image = np.clip(np.rint(image + rng.normal(0, noise, image.shape)), 0, 255)
    inner = np.arange(-2.0, 3.0)
    plane = np.stack([*np.meshgrid(inner, inner), np.ones((5, 5))]).reshape(3, -1)
    corners = H @ plane
    return image.astype(np.uint8), (corners[:2] / corners[2]).T


def corners_in(image: NDArray[np.generic], **options: object) -> Floats:
    pattern = extract(image, ExtractOptions(method="corners", **options))  # type: ignore[arg-type]
    assert isinstance(pattern, PointPattern)
    assert np.all(pattern.weights == 1)
    return pattern.points


def distances(points: Floats, truth: Floats) -> Floats:
    return np.asarray(np.linalg.norm(points[None] - truth[:, None], axis=-1).min(axis=1))


@pytest.mark.parametrize(
    ("side", "noise", "limit"),
    # Measured RMS distances: 0.04, 0.05 and 0.06 px.
    [(18, 2, 0.06), (9, 2, 0.07), (18, 6, 0.09)],
)
def test_all_corners_are_found_and_nothing_else(side: float, noise: float, limit: float) -> None:
    errors = []
    for seed in range(3):
        image, truth = chessboard(seed, side=side, noise=noise)
        found = corners_in(image)
        assert len(found) == 25
        errors.append(distances(found, truth))
    assert np.max(errors) < 0.5
    assert np.sqrt(np.mean(np.square(errors))) < limit


def test_polarity_does_not_matter() -> None:
    image, _ = chessboard(4)
    turned = corners_in(np.asarray(255 - image, dtype=np.uint8), polarity="dark")
    np.testing.assert_allclose(turned, corners_in(image), atol=1e-3)


def test_types_of_image_agree() -> None:
    image, _ = chessboard(5)
    found = corners_in(image)
    np.testing.assert_allclose(corners_in(image.astype(np.uint16) * 100), found, atol=1e-3)
    np.testing.assert_allclose(corners_in(image.astype(np.float32) / 255), found, atol=1e-3)


def test_threshold_is_the_least_step_between_fields() -> None:
    image, _ = chessboard(6, bright=100, shade=0)
    # Fields of 100 and 40: a step of 60.
    assert len(corners_in(image, threshold=40.0)) == 25
    assert len(corners_in(image, threshold=80.0)) == 0


def test_edges_spots_and_ends_of_bars_are_no_corners() -> None:
    image = np.full((120, 160), 40, np.uint8)
    image[20:60, 30:80] = 200
    image[80:84, 20:140] = 180
    image[30:33, 120:123] = 255
    image[95:, 100:] = 120
    assert len(corners_in(image)) == 0


@pytest.mark.parametrize("shape", [(1, 1), (5, 200), (12, 12), (40, 50)])
def test_even_and_tiny_images_hold_no_corners(shape: tuple[int, int]) -> None:
    assert corners_in(np.full(shape, 90, np.uint8)).shape == (0, 2)


def test_noise_alone_holds_no_corners() -> None:
    noise = np.random.default_rng(0).normal(90, 3, (512, 640))
    assert len(corners_in(noise.astype(np.float32))) == 0


def test_corners_in_a_window_are_in_pixels_of_the_image() -> None:
    image, truth = chessboard(7)
    options = ExtractOptions(method="corners")
    window = (50, 60, 120, 110)
    pattern = extract(image, options, window=window)
    assert isinstance(pattern, PointPattern)
    deep = np.all((truth > [57, 67]) & (truth < [112, 102]), axis=1)
    assert deep.sum() >= 4
    assert np.max(distances(pattern.points, truth[deep])) < 0.3
    assert np.all((pattern.points >= window[:2]) & (pattern.points < window[2:]))


@pytest.mark.parametrize("threshold", ["otsu", "local", "li", "triangle", "sauvola"])
def test_rules_for_grey_levels_do_not_go_with_corners(threshold: str) -> None:
    image, _ = chessboard(8)
    with pytest.raises(SessionError, match=r"extract\.threshold.*corners.*auto"):
        corners_in(image, threshold=threshold)


@pytest.mark.parametrize(("second", "count"), [(190, 1), (130, 0)])
def test_fields_that_touch_at_a_corner_must_be_about_as_bright(second: int, count: int) -> None:
    image = np.full((80, 80), 40, np.uint8)
    image[10:40, 10:40] = 200
    image[40:70, 40:70] = second
    # after half a turn 0.996 of the pattern is the same with fields of 200 and 190, 0.86 with 130
    found = corners_in(image)
    assert len(found) == count
    if count:
        # the brighter field draws the saddle by an eighth of a px
        assert distances(found, np.array([(39.5, 39.5)]))[0] < 0.2
