"""How unlikely it is that a pose explains its detections by chance."""

from __future__ import annotations

import numpy as np
import pytest
from detections import ALL_FREE, EIGHT, TRUTH, view_of
from numpy.typing import NDArray

from mixpose.body import Body, PointFeature
from mixpose.rigid import transform
from mixpose.search.budget import EvidenceOptions, PeakOptions
from mixpose.search.detections import sensor_detections
from mixpose.search.evidence import evidence
from mixpose.sensors import PinholeCamera

Floats = NDArray[np.float64]

OPTIONS = EvidenceOptions()


def seen(camera: PinholeCamera, count: int = 8) -> Floats:
    """Where the first features are seen."""
    return camera.project(transform(TRUTH, EIGHT.means[:count]))[0]


def evidence_of(camera: PinholeCamera, points: Floats, body: Body = EIGHT) -> float:
    detections = sensor_detections([view_of("0", camera, points)], body, PeakOptions())
    return float(evidence(detections, body, TRUTH[None], ALL_FREE, OPTIONS)[0])


def spread_out(camera: PinholeCamera, count: int, away_from: Floats) -> Floats:
    """Places all over the image, none near some others."""
    u, v = np.meshgrid(np.arange(40.0, 1280, 80), np.arange(40.0, 1024, 80))
    places = np.stack([u.ravel(), v.ravel()], axis=1)
    near = np.linalg.norm(places[:, None] - away_from, axis=2).min(axis=1)
    return np.asarray(places[near > 60][:count])


def test_clutter_makes_each_detection_that_is_met_less_telling(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    camera = pinhole_cameras[0]
    large = Body("large", tuple(PointFeature(3 * point) for point in EIGHT.means))
    y, visible = camera.project(transform(TRUTH, large.means))
    assert visible.all()
    clutter = spread_out(camera, 56, y)
    assert len(clutter) == 56
    alone = evidence_of(camera, y, large)
    lost = alone - evidence_of(camera, np.concatenate([y, clutter]), large)
    # eight times as many in the image: ln 8 for each of 8, 10 of whose 16 coordinates are spare;
    # less as far as the eight lay closer together than all over the image already
    most = 8 * 10 / 16 * np.log(8)
    assert 0.3 * most < lost <= most


def test_a_crowd_around_the_body_makes_chance_matches_likelier(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    camera = pinhole_cameras[0]
    y = seen(camera)
    ring = 25.0 * np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
    crowd = (y[:, None] + ring).reshape(-1, 2)
    scattered = spread_out(camera, len(crowd), y)
    crowded, sparse = (
        evidence_of(camera, np.concatenate([y, each])) for each in (crowd, scattered)
    )
    # three others within 25 px: 5 times as dense as 40 over the whole image
    assert crowded < sparse - 5.0


def test_a_feature_in_view_without_a_detection_costs_as_much_as_one_in_three(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    camera = pinhole_cameras[0]
    seven = Body("seven", EIGHT.features[:7])
    y = seen(camera, 7)
    lost = evidence_of(camera, y, seven) - evidence_of(camera, y, EIGHT)
    assert lost == pytest.approx(-np.log(0.3))


def test_detections_met_to_a_tenth_of_a_pixel_are_better_evidence_than_to_a_pixel(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    camera = pinhole_cameras[0]
    y = seen(camera)
    off = np.where(np.arange(16).reshape(8, 2) % 2, 1.5, -1.5) / np.sqrt(2)
    gained = evidence_of(camera, y + 0.1 * off) - evidence_of(camera, y + off)
    # errors of σ_ε and of a tenth of it, 10 of 16 coordinates being spare: their squares are
    # estimated as 8/10 and, as none below a tenth is believed, 1/100
    tight, loose = -5 * np.log(0.01) - 0.5 * 0.08 / 0.01, -5 * np.log(0.8) - 0.5 * 8 / 0.8
    # detections a pixel aside crowd a little differently
    assert gained == pytest.approx(tight - loose, abs=0.5)
