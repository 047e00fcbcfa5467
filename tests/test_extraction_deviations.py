"""By how much the centres of blobs may err: those of disks that are cut, or merged."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.extraction.blob import Blob, deviations_of
from mixpose.extraction.blobs import extract_blobs
from mixpose.extraction.options import ExtractOptions
from mixpose.records import PointPattern

Floats = NDArray[np.float64]

CENTRES = np.array([[40.3, 50.6], [120.8, 44.2], [200.5, 60.9], [60.1, 140.7], [150.4, 150.2]])


def drawn(axes: tuple[float, float], *, cut: float | None = None) -> NDArray[np.uint8]:
    """Bright ellipses with soft edges; of the first, what is right of `cut` radii is hidden."""
    scale = 16
    big = np.full((200 * scale, 260 * scale), 20, np.uint8)
    for u, v in CENTRES:
        middle = round((u + 0.5) * scale), round((v + 0.5) * scale)
        size = round(axes[0] * scale), round(axes[1] * scale)
        cv2.ellipse(big, middle, size, 30.0, 0.0, 360.0, 220, -1)
    if cut is not None:
        edge = round((CENTRES[0, 0] + 0.5 + cut * axes[0]) * scale)
        big[: 90 * scale, edge : edge + 40 * scale] = 20
    image = cv2.resize(big, (260, 200), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.7), dtype=np.uint8)


def found(image: NDArray[np.uint8]) -> tuple[Floats, Floats]:
    """Errors (5,) of the centres, and deviations of the blobs, in px."""
    options = ExtractOptions(method="blobs", polarity="bright")
    pattern = extract_blobs(image, options, (0, 0, 260, 200))
    away = np.linalg.norm(pattern.points[:, None] - CENTRES, axis=2)
    assert sorted(away.argmin(axis=0)) == list(range(len(CENTRES)))
    order = away.argmin(axis=0)
    return away[order, np.arange(5)], pattern.deviations[order]


@pytest.mark.parametrize("radius", [3.5, 5.0, 7.0, 12.0])
def test_whole_disks_err_by_no_more_than_others(radius: float) -> None:
    errors, deviations = found(drawn((radius, radius)))
    assert errors.max() < 0.1
    assert not deviations.any()


@pytest.mark.parametrize("axes", [(4.5, 2.8), (9.0, 5.5)])
def test_oblique_disks_that_are_all_alike_are_whole(axes: tuple[float, float]) -> None:
    _, deviations = found(drawn(axes))
    assert not deviations.any()


def test_of_three_the_roundest_is_whole() -> None:
    blobs = [Blob(0.0, 0.0, math.pi, length) for length in (1.5, 1.5, 3.0)]
    # of a radius of 1 px, 0.9 of the length may be for pixels; 1.5 radii for each of the rest
    assert deviations_of(blobs, 1.0) == pytest.approx([0.0, 0.0, 0.15])


@pytest.mark.parametrize("like", [1, 2, 4])
def test_streaks_beside_round_things_are_whole_where_several_are_alike(like: int) -> None:
    big = np.full((200 * 8, 260 * 8), 20, dtype=np.uint8)
    streaks = np.array([(40.0, 40.0), (110.0, 60.0), (180.0, 50.0), (60.0, 150.0)])[:like]
    for u, v in streaks:
        first, last = ((round((u + k * 7) * 8), round((v + k * 3) * 8)) for k in (-1, 1))
        cv2.line(big, first, last, 220, 9 * 8)
    for u, v in [(120, 150), (150, 110), (200, 160), (230, 100), (30, 100)]:
        cv2.circle(big, (u * 8, v * 8), 6 * 8, 220, -1)
    image = np.asarray(cv2.resize(big, (260, 200), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    options = ExtractOptions(method="blobs", polarity="bright")
    pattern = extract_blobs(image, options, (0, 0, 260, 200))
    away = np.linalg.norm(pattern.points[:, None] - (streaks - 0.4375), axis=2)
    assert away.min(axis=0).max() < 0.3
    own = pattern.deviations[away.argmin(axis=0)]
    assert own.max() < 0.3 if like == 4 else own.min() > 5.0
    assert not np.delete(pattern.deviations, away.argmin(axis=0)).any()


@pytest.mark.parametrize("radius", [3.5, 5.0, 7.0])
@pytest.mark.parametrize("cut", [0.4, 0.0, -0.4])
def test_a_disk_that_is_cut_may_err_by_about_as_much_as_it_does(radius: float, cut: float) -> None:
    errors, deviations = found(drawn((radius, radius), cut=cut))
    assert not deviations[1:].any()
    # from a segment missing to a sliver left: 0.3 to 4.5 px
    assert 0.3 < errors[0] / deviations[0] < 4.0 or errors[0] < 0.3 < deviations[0]


@pytest.mark.parametrize("radius", [7.0, 12.0])
@pytest.mark.parametrize("cut", [0.3, 0.5, 0.7])
def test_a_disk_whose_rim_is_not_seen_all_around_may_err(radius: float, cut: float) -> None:
    # an ellipse goes through what is seen of the rim of a large one, and through its chord
    errors, deviations = found(drawn((radius, radius), cut=cut))
    # errs by 0.3 to 1.3 px: by about half a deviation, neither far more nor far less
    assert 0.3 < errors[0] / deviations[0] < 0.8
    assert not deviations[1:].any()


def test_what_errs_by_more_weighs_less_by_its_variance() -> None:
    pattern = PointPattern(CENTRES, np.ones(5), np.array([0.0, 0.0, 1.0, 2.0, 0.0]))
    np.testing.assert_allclose(pattern.effective_weights(0.5), [1.0, 1.0, 0.2, 1 / 17, 1.0])
    assert not pattern.is_uniform
    assert pattern.only(np.array([True, True, False, False, True])).is_uniform
