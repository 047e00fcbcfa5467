"""Bodies that give way, as markers on skin do: how far off their poses are is what they say."""

from __future__ import annotations

import numpy as np
import pytest
from detections import EIGHT, TRUTH, detect
from scipy.stats import chi2

from mixpose.body import Body, Gravity, PointFeature
from mixpose.fit import EstimatorOptions
from mixpose.judgement import RememberedNoise
from mixpose.records import Floats
from mixpose.rigid import twist_between
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Tracker

FRAMES = 100


def squared_errors(
    body: Body, cameras: list[PinholeCamera], moves: Floats, hidden: int = 0
) -> Floats:
    """Of poses that are ok, per dimension, of a body whose features are off by moves (F, N, 3)."""
    tracker = Tracker.create(body, EstimatorOptions())
    track, squared = tracker.begin(), []
    for frame, off in enumerate(moves):
        seen = Body("seen", tuple(PointFeature(p) for p in body.means + off))
        views = detect(cameras, seen, TRUTH, noise=0.1, hidden=hidden, seed=frame)
        track, found = tracker.advance(track, frame, frame / 50, views)
        if found.status != "ok":
            continue
        assert found.T_world_object is not None
        assert found.covariance is not None
        error = twist_between(TRUTH, found.T_world_object)
        squared.append(error @ np.linalg.solve(found.covariance, error) / 6)
    return np.array(squared)


@pytest.mark.parametrize(("markers", "hidden", "sigma"), [(4, 1, 0.5), (5, 0, 1.0), (8, 1, 1.0)])
def test_poses_of_a_body_that_gives_way_are_as_far_off_as_they_say(
    markers: int, hidden: int, sigma: float, pinhole_cameras: list[PinholeCamera]
) -> None:
    # of few markers as many as fix a pose are met closely, as if they were rigid
    features = tuple(PointFeature(one, sigma**2 * np.eye(3)) for one in EIGHT.means[:markers])
    moves = np.random.default_rng(markers).normal(0, sigma, (FRAMES, markers, 3))
    squared = squared_errors(Body("soft", features), pinhole_cameras, moves, hidden)
    assert len(squared) > 0.9 * FRAMES
    assert (squared * 6 < chi2.isf(1e-4, 6)).all()
    assert 0.4 < squared[10:].mean() < 1.3


def test_poses_of_a_body_that_sags_are_as_far_off_as_they_say(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    down = np.array([0.0, 0.0, -1.0])
    body = Body("sags", EIGHT.features, gravity=Gravity(down, 2.0))
    sags = np.random.default_rng(2).normal(0, 2.0, (FRAMES, 8, 1)) * (TRUTH[:3, :3].T @ down)
    squared = squared_errors(body, pinhole_cameras, sags)
    assert len(squared) > 0.9 * FRAMES
    assert (squared * 6 < chi2.isf(1e-4, 6)).all()


def test_a_body_that_was_rigid_so_far_is_more_likely_to_be_so_again() -> None:
    rigid = RememberedNoise()
    assert rigid.log_bent == pytest.approx((np.log(0.5), np.log(0.5)))
    for _ in range(20):
        rigid = rigid.bent_once(0.0, 0.99)
    # Jeffreys' prior, and Σ 0.99^k of twenty frames
    count = (1 - 0.99**20) / 0.01
    assert np.exp(rigid.log_bent[1]) == pytest.approx(0.5 / (count + 1))
    bent = RememberedNoise().bent_once(0.8, 0.99).bent_once(1.0, 0.99)
    assert np.exp(bent.log_bent[1]) == pytest.approx((0.99 * 0.8 + 1.0 + 0.5) / (1.99 + 1))
