"""Single ranges of which one sensor's are all too long, as behind a wall."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from detections import followed, view_of
from numpy.typing import NDArray
from scipy.special import chdtri

from mixpose.body import Body, PointFeature
from mixpose.objective import View
from mixpose.rigid import from_rotation_vector, perturb, transform
from mixpose.sensors import RangeSensor
from mixpose.tracking.ranges import sum_associations

Floats = NDArray[np.float64]
SIGMA, FRAMES, COVERED = 0.01, 16, range(5, 11)
TAGS = Body("tags", tuple(PointFeature(p) for p in np.random.default_rng(5).uniform(-1, 1, (4, 3))))


def views_of(T: Floats, rng: np.random.Generator, longer: float = 0.0) -> list[View]:
    """Four anchors around the tags, whose ranges are not labelled; the last's are `longer`."""
    angles, views = 1.6 + 1.3 * np.arange(4), list[View]()
    for k, (angle, height) in enumerate(zip(angles, [0.4, 1.5, 3.1, 0.1], strict=True)):
        anchor = RangeSensor(np.array([4 * np.cos(angle), 4 * np.sin(angle), height]))
        found = anchor.project(transform(T, TAGS.means))[0][:, 0] + rng.normal(0, SIGMA / 2, 4)
        shuffled = rng.permutation(found + longer * (k == 3))[:, None]
        views.append(view_of(f"anchor{k}", anchor, shuffled, SIGMA))
    return views


def walked(seed: int) -> Iterator[tuple[Body, Floats, list[View]]]:
    """Frames with one anchor covered for a while."""
    rng = np.random.default_rng(seed)
    T = from_rotation_vector(rng.uniform(-2, 2, 3), [0.2, -0.1, 1.2])
    step = rng.normal(size=6) * [0.03, 0.03, 0.02, 0.04, 0.04, 0.04]
    for k in range(FRAMES):
        T = perturb(T, step)
        yield TAGS, T, views_of(T, rng, 0.4 if k in COVERED else 0.0)


@pytest.mark.parametrize("seed", [1, 6, 7])
def test_poses_stay_right_and_ok_while_all_ranges_of_one_anchor_are_too_long(seed: int) -> None:
    told = followed(walked(seed))
    are_ok = [estimate.status == "ok" for estimate, _ in told]
    outside = [k for k, (_, off) in enumerate(told) if are_ok[k] and off > chdtri(6, 1e-4)]
    assert outside == []
    # one frame may show the change, and one its end
    assert sum(are_ok[COVERED.start : COVERED.stop]) >= len(COVERED) - 1
    assert sum(are_ok[COVERED.stop :]) >= FRAMES - COVERED.stop - 1


def test_a_sensor_that_fails_is_clutter_and_one_that_works_is_as_without_the_question() -> None:
    T, rng = from_rotation_vector([0.1, 0.2, 0.3], [0.3, -0.2, 1.0]), np.random.default_rng(1)
    views = views_of(T, rng)
    plain, unlikely = (
        sum_associations(views, TAGS, T[None], failing=np.full((4, 1), odds))
        for odds in (-np.inf, -40.0)
    )
    assert unlikely.log_odds == pytest.approx(plain.log_odds, abs=1e-9)
    assert plain.log_odds == pytest.approx(plain.by_sensor.sum(axis=0))
    failing = np.array([[-np.inf]] * 3 + [[60.0]])
    without = sum_associations(views, TAGS, T[None], failing=failing)
    three = sum_associations(views[:3], TAGS, T[None])
    assert without.log_odds == pytest.approx(three.log_odds, abs=1e-9)
    assert without.information == pytest.approx(three.information, rel=1e-9)
    assert without.most == pytest.approx(three.most, abs=1e-9)
    assert without.reached == pytest.approx(three.reached, abs=1e-9)
    assert without.met == pytest.approx(three.met, abs=1e-9)


def test_the_gradient_is_the_slope_where_it_is_open_whether_a_sensor_fails() -> None:
    T, rng = from_rotation_vector([0.1, 0.2, 0.3], [0.3, -0.2, 1.0]), np.random.default_rng(1)
    views, failing = views_of(T, rng, 0.02), np.array([[-8.5]] * 3 + [[15.0]])
    steps = 1e-6 * np.eye(6)
    ahead, behind = (
        sum_associations(views, TAGS, perturb(T, s), failing=failing).log_odds
        for s in (steps, -steps)
    )
    found = sum_associations(views, TAGS, T[None], failing=failing)
    assert found.by_sensor[3, 0] == pytest.approx(failing[3, 0], abs=2)  # both have a share
    slope = (ahead - behind) / 2e-6
    assert found.gradient[0] == pytest.approx(slope, rel=1e-4, abs=1e-4 * abs(slope).max())
