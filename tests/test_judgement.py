"""What a pose is worth: features met, covariance, evidence, and what is believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detections import ALL_FREE, EIGHT, TRUTH, detect
from rounding import rounding

from mixpose.body import Body, Gravity, PointFeature
from mixpose.judgement import Case, expected_covariance, judge, judge_together
from mixpose.objective import matched_objective
from mixpose.sensors import PinholeCamera


def test_expected_covariance_is_infinite_where_the_data_leave_a_direction_open(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    camera = replace(pinhole_cameras[0], T_sensor_world=np.eye(4))
    one_point = Body(
        "far", tuple(PointFeature(np.array([0.0, 0.0, z])) for z in (900.0, 1000.0, 1200.0))
    )
    covariance, counts = expected_covariance([camera], [1.0], one_point, np.eye(4), ALL_FREE)
    assert counts == [3]
    # points on the optical axis: no motion along it and no turn about it can be seen
    assert np.isinf(covariance[2, 2])
    assert np.isinf(covariance[5, 5])
    full, _ = expected_covariance(pinhole_cameras, [1.0, 1.0], EIGHT, TRUTH, ALL_FREE)
    assert np.isfinite(full).all()


def test_judgement_tells_hidden_from_met(pinhole_cameras: list[PinholeCamera]) -> None:
    views = detect(pinhole_cameras, EIGHT, TRUTH, hidden=2, false=2)
    judged = judge(matched_objective(views, EIGHT, [1.5, 1.5]), TRUTH, ALL_FREE)
    assert judged.measurements == pytest.approx(24, abs=0.4)
    assert judged.coverage == pytest.approx(6 / 8, abs=0.02)
    for report in judged.reports({}).values():
        # six of eight features met, six of eight detections explained: (6/8)²
        assert report.explained == pytest.approx((6 / 8) ** 2, abs=0.02)
        assert report.rms == pytest.approx(0.0, abs=0.05)


def test_bodies_judged_at_once_are_worth_what_each_is_alone(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # one of eight features, one of five; some hidden from all cameras, some from one
    five = Body("five", EIGHT.features[:5])
    cases = [
        Case(matched_objective(views, body, [1.5, 1.5]), TRUTH)
        for body, views in (
            (EIGHT, detect(pinhole_cameras, EIGHT, TRUTH, hidden=2, noise=0.3, seed=1)),
            (five, detect(pinhole_cameras, five, TRUTH, hidden=1, noise=0.2, seed=2)),
        )
    ]
    # residuals of 0.2 px and more are differences of places up to 1280 px, and enter squared
    relative = 2 * rounding(1280) / 0.2
    for together, case in zip(judge_together(cases, ALL_FREE), cases, strict=True):
        alone = judge(case.objective, case.T_world_object, ALL_FREE)
        assert together.log_evidence == pytest.approx(alone.log_evidence, rel=1e-9)
        np.testing.assert_allclose(together.covariance, alone.covariance, rtol=1e-6, atol=1e-12)
        assert together.noise.names == alone.noise.names
        np.testing.assert_allclose(together.noise.sums, alone.noise.sums, rtol=relative)
        assert list(together.noise.biases) == list(alone.noise.biases)
        for names, sums in together.noise.biases.items():
            shown = alone.noise.biases[names][:, :-1]
            np.testing.assert_allclose(sums[:, :-1], shown, rtol=1e-6, atol=1e-9)


def test_a_body_that_gives_way_is_as_evident_bent_as_its_spread_lets_it_be(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    def giving_way(sigma: float, off: float = 0.0) -> Body:
        moves = np.random.default_rng(3).normal(0, 1, (8, 3)) * off
        positions = EIGHT.means + moves
        features = (PointFeature(p, sigma**2 * np.eye(3)) for p in positions)
        return Body("soft", tuple(features))

    def evidence(body: Body, seen: Body) -> float:
        views = detect(pinhole_cameras, seen, TRUTH, noise=0.2, seed=4)
        return judge(matched_objective(views, body, [1.5, 1.5]), TRUTH, ALL_FREE).log_evidence

    # rigid or bent, the one as likely as the other
    lost = evidence(giving_way(0.0), EIGHT) - evidence(giving_way(2.0), EIGHT)
    assert 0 < lost <= np.log(2) + 1e-9
    # what both cameras see alike is no noise of either
    bent = giving_way(0.0, off=1.0)
    assert evidence(giving_way(1.0), bent) > evidence(giving_way(0.0), bent) + 1


def test_a_body_that_sags_is_evident_where_it_hangs_and_not_where_it_would_lean(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # each feature hangs as far below its place in the world as chance has it, up to 2 mm or so
    down, across = np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0])
    sags = 1.5 * np.random.default_rng(3).normal(0, 1, (8, 1)) * down @ TRUTH[:3, :3]
    sagging = Body("sags", tuple(PointFeature(p) for p in EIGHT.means + sags))

    def evidence(gravity: Gravity | None) -> float:
        body = replace(EIGHT, gravity=gravity)
        views = detect(pinhole_cameras, sagging, TRUTH, noise=0.2, seed=4)
        return judge(matched_objective(views, body, [1.5, 1.5]), TRUTH, ALL_FREE).log_evidence

    rigid, hanging = evidence(None), evidence(Gravity(down, 1.5))
    assert hanging > rigid + 1
    assert hanging > evidence(Gravity(across, 1.5)) + 1


def test_a_sensor_that_is_left_out_may_see_what_no_other_sees(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    # the last feature of a body that gives way, far to the left of the first camera's view
    far = (np.array([-750.0, 40.0, 0.0]) - TRUTH[:3, 3]) @ TRUTH[:3, :3]
    features = (PointFeature(p, np.eye(3)) for p in [*EIGHT.means, far])
    body = Body("long", tuple(features))
    views = detect(pinhole_cameras, body, TRUTH, noise=0.2)
    both = matched_objective(views, body, [1.5, 1.5])
    judged = judge(both, TRUTH, ALL_FREE, left_out={"1": "bumped"})
    assert [np.flatnonzero(one).max() for one in judged.matches.weights] == [7, 8]
    alone = judge(matched_objective(views[:1], body, [1.5]), TRUTH, ALL_FREE)
    # what one sensor misses counts as 5 nats at most, and its detections are more to choose from
    assert 5.0 - 1e-9 <= alone.log_evidence - judged.log_evidence < 10.0
    np.testing.assert_allclose(judged.covariance, alone.covariance, rtol=1e-9)
