"""How many detections belong to nothing is known from the frames before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detections import EIGHT, TRUTH, view_of
from matches import Seen, matches_of
from numpy.typing import NDArray
from scipy.stats import nbinom, poisson

from mixpose.fit import EstimatorOptions
from mixpose.judgement import ClutterRates, DetectionModel
from mixpose.matching import Matches
from mixpose.records import Estimate
from mixpose.rigid import from_rotation_vector, transform
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Tracker

Floats = NDArray[np.float64]

LOG_NEW = DetectionModel().log_blind
MEMORY = 0.95
ONE = PinholeCamera(
    np.array([[1000, 0, 640], [0, 1000, 512], [0, 0, 1.0]]),
    np.zeros(5),
    (1280, 1024),
    from_rotation_vector([0, 0, 0], [0, 0, 1200]),
)


def of(met: int, count: int, name: str = "0") -> Matches:
    return matches_of(Seen(np.zeros((met, 2, 6)), name, count=float(count)))


def after(frames: int, left: int) -> ClutterRates:
    rates = ClutterRates()
    for _ in range(frames):
        rates = rates.followed(of(4, 4 + left), MEMORY)
    return rates


def test_where_nothing_else_was_seen_clutter_is_as_likely_as_something_new() -> None:
    # zero of a rate that is next to nothing, in place of the four that the frame shows: 4 nats
    assert after(40, 0).log_odds(of(4, 4), LOG_NEW) == pytest.approx(4 - LOG_NEW, abs=0.2)


def test_numbers_are_of_the_distribution_that_a_gamma_distributed_rate_gives_them() -> None:
    left, frames = after(5, 3).seen["0"]
    told = nbinom(left + 0.5, frames / (frames + 1))
    new = np.exp(LOG_NEW)
    with_body, alone = ((1 - new) * told.pmf(k) / poisson(9.0).pmf(k) + new for k in (3, 9))
    found = after(5, 3).log_odds(of(6, 9), LOG_NEW)
    assert found == pytest.approx(np.log(with_body / alone), rel=1e-9)


def test_where_all_is_new_a_frame_tells_by_itself() -> None:
    assert ClutterRates().log_odds(of(4, 4), LOG_NEW) == 0.0
    assert after(40, 0).log_odds(of(4, 60), LOG_NEW) == pytest.approx(0.0, abs=1e-6)
    assert after(40, 0).log_odds(of(4, 4, "other"), LOG_NEW) == 0.0


def test_the_images_of_a_cloud_count_as_one_sensor() -> None:
    three = matches_of(*(Seen(np.zeros((4, 2, 6)), name) for name in "012"))
    cloud = replace(three, owners=np.zeros(3, dtype=np.intp))
    rates, alone = ClutterRates(), ClutterRates()
    for _ in range(5):
        rates, alone = rates.followed(cloud, MEMORY), alone.followed(of(4, 4), MEMORY)
    odds = alone.log_odds(of(4, 4), LOG_NEW)
    assert rates.log_odds(cloud, LOG_NEW) == pytest.approx(odds, rel=1e-9)


def tracked(shown: list[list[int]], beside: Floats) -> list[Estimate]:
    """One camera that shows some features in each frame, and what is `beside` from the tenth on."""
    tracker, rng = Tracker.create(EIGHT, EstimatorOptions()), np.random.default_rng(0)
    track, found = tracker.begin(), list[Estimate]()
    for frame, chosen in enumerate(shown):
        y, _ = ONE.project(transform(TRUTH, EIGHT.means[chosen]))
        points = np.concatenate([y, beside]) if frame >= 10 else y
        views = [view_of("0", ONE, points + 0.2 * rng.standard_normal(points.shape))]
        track, estimate = tracker.advance(track, frame, None, views)
        found.append(estimate)
    return found


def test_four_of_eight_features_are_ok_where_nothing_else_was_seen_before() -> None:
    found = tracked([[*range(8)]] * 10 + [[0, 1, 6, 7]] * 5, np.zeros((0, 2)))
    assert [one.status for one in found] == ["ok"] * 15


@pytest.mark.parametrize("seed", range(6))
def test_as_many_other_spots_in_its_place_are_not_the_body(seed: int) -> None:
    spots = np.random.default_rng(seed).uniform([560, 440], [720, 600], (4, 2))
    found = tracked([[*range(8)]] * 10 + [[]] * 5, spots)
    assert {one.status for one in found[:10]} == {"ok"}
    assert "ok" not in {one.status for one in found[10:]}
