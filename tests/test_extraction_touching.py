"""Disks whose images run into each other, evenly lit: no grey value tells them apart."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from mixpose.extraction import ExtractOptions, extract
from mixpose.extraction.contours import Contour, lobes
from mixpose.records import PointPattern

Floats = NDArray[np.float64]

SIZE, FINE = 96, 8
SHAPE = 1.0, 16.0  # depth and least length, px


def seen(disks: Floats, seed: int = 0) -> NDArray[np.uint8]:
    """An image of disks (n, 3), u, v and radius, that hide each other."""
    at = (np.arange(SIZE * FINE) + 0.5) / FINE - 0.5
    covered = np.zeros((SIZE * FINE, SIZE * FINE), dtype=np.bool_)
    for u, v, radius in disks:
        covered |= (at - u) ** 2 + ((at - v) ** 2)[:, None] < radius**2
    light = covered.reshape(SIZE, FINE, SIZE, FINE).mean(axis=(1, 3))
    noise = np.random.default_rng(seed).normal(0.0, 2.0, light.shape)
    blurred: Floats = gaussian_filter(light, 0.7)
    return np.asarray(np.rint(20 + 150 * blurred + noise), dtype=np.uint8)


def farthest(disks: Floats, image: NDArray[np.uint8]) -> float:
    """How far the farthest of as many blobs is from its disk."""
    found = extract(image, ExtractOptions())
    assert isinstance(found, PointPattern)
    assert len(found.points) == len(disks)
    away = np.linalg.norm(found.points[:, None] - disks[:, :2], axis=2)
    return float(max(away.min(axis=0).max(), away.min(axis=1).max()))


@pytest.mark.parametrize("apart", [1.95, 1.8, 1.65, 1.5])
@pytest.mark.parametrize("radius", [5.0, 8.4, 14.0])
def test_two_disks_that_touch_or_overlap_are_two(radius: float, apart: float) -> None:
    step = apart * radius * np.array([np.cos(0.4), np.sin(0.4)])
    disks = np.array([[30.3, 40.7, radius], [30.3 + step[0], 40.7 + step[1], radius]])
    # blur fills the waist, by the more of a rim the smaller it is
    assert farthest(disks, seen(disks)) < 2 / radius


def test_three_in_a_row_and_of_other_sizes_are_three() -> None:
    disks = np.array([[20.4, 48.2, 9.0], [36.6, 46.1, 8.0], [47.2, 52.9, 6.0]])
    assert farthest(disks, seen(disks)) < 0.25


@pytest.mark.parametrize("seed", range(3))
def test_one_disk_by_itself_is_one(seed: int) -> None:
    disks = np.array([[40.3, 50.7, 10.0]])
    assert farthest(disks, seen(disks, seed)) < 0.05


def outline(mask: NDArray[np.uint8]) -> Contour:
    return cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0][0]


def test_an_outline_without_a_waist_stays_whole() -> None:
    mask = np.zeros((60, 60), np.uint8)
    mask[10:50, 20:30] = 1
    assert len(lobes(outline(mask), *SHAPE)) == 1
    # a notch from one side is no waist
    mask[28:32, 20:24] = 0
    assert len(lobes(outline(mask), *SHAPE)) == 1
    # from both sides it is
    mask[28:32, 26:30] = 0
    parts = lobes(outline(mask), *SHAPE)
    assert len(parts) == 2
    heights = sorted((int(part[:, 0, 1].min()), int(part[:, 0, 1].max())) for part in parts)
    assert heights[0][1] <= 32
    assert heights[1][0] >= 27
