"""Rules for the threshold, each where another rule finds less: spots and disks of known places."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from numpy.typing import NDArray
from test_extraction_blobs import (
    Floats,
    blobs,
    disk,
    distances,
    dots_on_paper,
    photograph,
    spots,
)

from mixpose.extraction.threshold import RULES
from mixpose.session.values import THRESHOLDS

Bytes = NDArray[np.uint8]


def dim_spots_beside_a_lamp() -> tuple[Bytes, Floats]:
    """Spots 30 grey values high, 15 times the noise, and a lamp of 250: 12 % of its height."""
    truth = np.array(
        [(100.2, 90.6), (120.5, 240.1), (260.7, 100.3), (180.4, 180.8), (230.0, 260.0)]
    )
    image = photograph(spots((320, 400), truth, 1.5, 30), 5)
    image[100:220, 300:390] = 250
    return image, truth


def test_the_triangle_rule_finds_dim_spots_beside_a_lamp() -> None:
    image, truth = dim_spots_beside_a_lamp()
    # To "auto" a spot of less than a fifth of the lamp's height is a reflection.
    assert len(blobs(image)) == 1
    found = blobs(image, threshold="triangle")
    assert len(found) == 6
    # Limit for a peak of 30: noise / (peak √(π/2)) = 0.053 px per axis; measured at most 0.15 px.
    assert np.max(distances(found, truth)) < 0.2


@pytest.mark.parametrize("threshold", ["li", "triangle"])
def test_histograms_with_dim_and_bright_disks_keep_the_dim_ones(threshold: str) -> None:
    truth = np.array([(60.3, 55.2), (180.7, 61.4), (62.1, 178.8), (181.2, 180.3)])
    light = np.zeros((240, 240))
    for (u, v), brightness in zip(truth, (230, 120, 60, 45), strict=True):
        light += brightness * disk(240, u, v, 40, hole=24)
    image = photograph(light, 2)
    # Otsu's level is half way between the two brighter ones and the rest.
    assert len(blobs(image, threshold="otsu")) == 2
    found = blobs(image, threshold=threshold)
    assert len(found) == 4
    # Measured 0.03 px, "auto" 0.02.
    assert np.max(distances(found, truth)) < 0.1


@pytest.mark.parametrize("threshold", ["li", "triangle", "sauvola"])
def test_spots_on_unevenly_lit_ground_are_found_by_every_rule(threshold: str) -> None:
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    truth = np.array([(100.2, 90.6), (320.5, 240.1), (560.7, 400.3), (580.4, 80.8)])
    light = 90 * np.exp(-((u - 330) ** 2 + (v - 230) ** 2) / 2 / 120**2) + 0.08 * u
    found = blobs(photograph(light + spots((480, 640), truth, 1.5, 80), 6), threshold=threshold)
    # Rules for the whole histogram take one or two scraps of the ground for spots.
    assert 4 <= len(found) <= (4 if threshold == "sauvola" else 6)
    # As with "auto"; measured 0.08 px.
    assert np.max(distances(found, truth)) < 0.1


@pytest.mark.parametrize("threshold", ["li", "triangle", "sauvola"])
def test_dark_dots_on_paper_are_found_by_every_rule(threshold: str) -> None:
    light, truth = dots_on_paper()
    found = blobs(photograph(light, 7), polarity="dark", threshold=threshold)
    # "local" and "sauvola" find the darkest corner of the table, too.
    assert 9 <= len(found) <= 10
    # Measured 0.07 to 0.10 px, "auto" 0.08.
    assert np.max(distances(found, truth)) < 0.15


@pytest.mark.parametrize("threshold", ["li", "triangle", "sauvola"])
def test_noise_holds_no_blobs_by_rules_that_part_any_histogram(threshold: str) -> None:
    # The level is above five standard deviations of the noise, whatever the rule says; without
    # that Li's rule finds hundreds.
    for seed in range(2):
        assert len(blobs(photograph(np.zeros((256, 320)), seed), threshold=threshold)) == 0


@pytest.mark.parametrize("threshold", RULES)
def test_types_of_image_agree_by_every_rule(threshold: str) -> None:
    truth = np.array([(30.3, 40.6), (90.2, 70.1), (60.0, 95.5)])
    image = photograph(spots((120, 120), truth, 1.6, 150, 120, 100), 13)
    found = blobs(image, threshold=threshold)
    assert len(found) == 3
    # Sixteen bits of which twelve are used, and floats in steps of 1 / 65535 of their range.
    np.testing.assert_allclose(
        blobs(image.astype(np.uint16) * 16, threshold=threshold), found, atol=0.02
    )
    np.testing.assert_allclose(
        blobs(image.astype(np.float32) / 255, threshold=threshold), found, atol=0.02
    )
    turned = np.asarray(255 - image.astype(np.int64), dtype=np.uint8)
    np.testing.assert_allclose(
        blobs(turned, polarity="dark", threshold=threshold), found, atol=1e-4
    )


def test_session_files_may_name_every_rule() -> None:
    assert THRESHOLDS == RULES


def test_scikit_image_is_imported_by_the_rules_that_need_it_only() -> None:
    # 0.04 s for its filters, of the 0.15 s that `mixpose --help` takes.
    program = (
        "import sys, numpy as np\n"
        "from mixpose.extraction import ExtractOptions, extract\n"
        "image = np.zeros((40, 50), np.uint8); image[20:23, 20:23] = 200\n"
        "for threshold in ('auto', 'otsu', 'local', 100.0):\n"
        "    extract(image, ExtractOptions(threshold=threshold))\n"
        "extract(image, ExtractOptions(method='corners'))\n"
        "assert 'skimage' not in sys.modules\n"
        "extract(image, ExtractOptions(threshold='li'))\n"
        "assert 'skimage' in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
