"""Whether all of a spot is seen, by its grey values."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from mixpose.extraction.blobs import extract_blobs
from mixpose.extraction.conics import ellipses_of
from mixpose.extraction.options import ExtractOptions
from mixpose.extraction.shape import centre_errors, centroids
from mixpose.extraction.threshold import Foreground

Singles = NDArray[np.float32]
SCALE = 16
MIDDLE = np.array([333.5, 322.5]) / SCALE - 0.5  # of a pixel of what is drawn finer


def disk(
    axes: tuple[float, float], *, lost: float = 0.0, angle_deg: float = 0.0, blur: float = 0.8
) -> Singles:
    """A patch (40, 40) with a disk or an ellipse without a segment as deep as `lost` px."""
    big = np.zeros((40 * SCALE, 40 * SCALE), np.uint8)
    middle = ((MIDDLE + 0.5) * SCALE - 0.5).astype(int)
    size = round(axes[0] * SCALE), round(axes[1] * SCALE)
    cv2.ellipse(big, middle.tolist(), size, 0.0, 0.0, 360.0, 200, -1)
    v, u = np.indices(big.shape)
    along = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    place = (u - middle[0]) * along[0] + (v - middle[1]) * along[1]
    big[place > (axes[0] - lost) * SCALE] = 0
    image = cv2.resize(big.astype(np.float32), (40, 40), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), blur), dtype=np.float32)


@pytest.mark.parametrize("axes", [(3.0, 3.0), (6.0, 6.0), (9.0, 4.0)])
def test_what_is_like_itself_turned_by_half_a_turn_seems_nowhere_off(
    axes: tuple[float, float],
) -> None:
    (centre,), (off,) = centroids(disk(axes)[None])
    assert np.abs(centre - MIDDLE).max() < 0.01
    assert off < 0.01


@pytest.mark.parametrize("radius", [4.0, 7.0, 12.0])
@pytest.mark.parametrize("share", [0.15, 0.3, 0.5])
@pytest.mark.parametrize("angle_deg", [0.0, 100.0, 225.0])
def test_a_disk_without_a_segment_seems_about_as_far_off_as_its_centroid_is(
    radius: float, share: float, angle_deg: float
) -> None:
    patch = disk((radius, radius), lost=share * radius, angle_deg=angle_deg)
    (centre,), (off,) = centroids(patch[None])
    moved = float(np.linalg.norm(centre - MIDDLE))
    # as far to first order in what is lost at the rim; what reaches farther in has a smaller cube
    assert 0.4 * moved < off < moved + 0.03


def test_patches_side_by_side_are_as_each_by_itself_and_empty_ones_have_no_centre() -> None:
    patches = np.stack([disk((5.0, 5.0), lost=1.5), disk((8.0, 5.0)), np.zeros((40, 40))])
    centre, off = centroids(patches.astype(np.float32))
    for k in range(2):
        own, alone = centroids(patches[k : k + 1].astype(np.float32))
        np.testing.assert_allclose(centre[k], own[0], rtol=1e-12)
        assert off[k] == pytest.approx(alone[0])
    assert np.isnan(centre[2]).all()


def test_an_ellipse_beside_the_light_that_it_is_of_seems_off_by_as_much() -> None:
    image = np.full((40, 40), 20.0, np.float32) + disk((7.0, 7.0))
    top = image.max(axis=1)
    scene = Foreground(image, 20.0, 40.0, noise=1.0, least_peak=60.0, is_selective=True, tops=top)
    u, v = MIDDLE.tolist()
    right, beside = ((u + d, v, 7.0, 7.0, 0.0) for d in (0.0, 0.5))
    off = centre_errors([scene], np.zeros(2, np.intp), ellipses_of([right, beside]), 3, 0.1, 2.0)
    assert off[0] < 0.03
    assert off[1] == pytest.approx(0.5, rel=0.1)
    flat = replace(scene, grey=np.full((40, 40), 20.0, np.float32))
    none = centre_errors([flat], np.zeros(1, np.intp), ellipses_of([right]), 3, 0.1, 2.0)
    assert none.tolist() == [0.0]
    assert not centre_errors([scene], np.zeros(0, np.intp), ellipses_of([]), 3, 0.1, 2.0).size


@pytest.mark.parametrize("radius", [3.5, 4.3])
def test_a_notch_of_four_hundredths_of_a_spot_shows_and_whole_ones_beside_it_do_not(
    radius: float,
) -> None:
    """Before noise of 4 grey values of 200, as a thin thing in front does it."""
    rng = np.random.default_rng(7)
    centres = np.array([[30.2, 32.7], [90.4, 30.1], [150.8, 34.3], [60.5, 80.6], [120.1, 82.4]])
    big = np.full((110 * SCALE, 180 * SCALE), 20, np.uint8)
    places = np.round((centres + 0.5) * SCALE).astype(int)
    for place in places.tolist():
        cv2.circle(big, place, round(radius * SCALE), 200, -1)
    u, v = places[0].tolist()
    wide, deep = 0.18 * radius * SCALE, 0.45 * radius * SCALE
    first = round(v + radius * SCALE - deep)
    big[first : round(v + (radius + 1) * SCALE), round(u - wide) : round(u + wide)] = 20
    exact = cv2.resize(big.astype(np.float32), (180, 110), interpolation=cv2.INTER_AREA)
    exact = cv2.GaussianBlur(exact, (0, 0), 0.8)
    misses, alarms = 0, 0
    for _ in range(20):
        noisy = np.clip(exact + rng.normal(0, 4, exact.shape), 0, 255).astype(np.uint8)
        options = ExtractOptions(method="blobs", polarity="bright")
        pattern = extract_blobs(noisy, options, (0, 0, 180, 110))
        order = np.linalg.norm(pattern.points[:, None] - centres, axis=2).argmin(axis=0)
        is_shown = pattern.deviations[order] > 0.06  # off by 0.13
        misses += not is_shown[0]
        alarms += int(np.count_nonzero(is_shown[1:]))
    assert misses <= 1
    assert alarms <= 4  # of 80


def test_small_spots_and_disks_with_rims_are_equally_large_for_their_size() -> None:
    """Up to 100 px above the level grey values tell, above that the rim."""
    sizes = np.arange(2.5, 8.1, 0.25)
    image = np.full((120, 40 * len(sizes)), 20.0)
    rows, columns = np.indices(image.shape)
    for k, radius in enumerate(sizes):
        for row, bright in ((30, 200.0), (90, 80.0)):
            inside = np.hypot(columns - (40 * k + 20.3), rows - row - 0.2) < radius
            image[inside] = bright
    image = gaussian_filter(image, 0.8) + np.random.default_rng(0).normal(0, 1, image.shape)
    whole = 0, 0, image.shape[1], image.shape[0]
    found = extract_blobs(image.clip(0, 255).astype(np.uint8), ExtractOptions(), whole)
    assert found.size == 2 * len(sizes)
    true = sizes[(found.points[:, 0] // 40).astype(int)]
    # disks of so few pixels are drawn to 3 %; there was a jump by 17 % at about 5 px
    np.testing.assert_allclose(found.radii, true, rtol=0.06)
