"""Cameras that take their frames at different moments of a motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions
from mixpose.matching import LEAST_VARIANCE
from mixpose.objective import View
from mixpose.records import Floats, PointPattern
from mixpose.rigid import from_parts, perturb, rotation_angle_deg, transform
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Tracker
from mixpose.tracking.in_motion import delays_after, offsets_of

K = np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])
MARKERS = np.array(
    [[0, 0, 0], [60, 0, 5], [0, 70, -10], [40, 30, 50], [-50, 20, 30], [10, -60, 25.0]]
)
FRONT = from_parts(np.eye(3), [0, 0, 800.0])
SIDE = from_parts(np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]]), [0, 0, 800.0])
VELOCITY = np.array([300.0, -200.0, 250.0, 0.8, -0.5, 0.6])  # per second
INTERVAL = 1 / 30
LATE = 0.4 * INTERVAL  # what the second camera lags behind


def pose_at(time_s: float) -> Floats:
    return perturb(np.eye(4), VELOCITY * time_s)


def views_at(time_s: float, *, told: bool, late: float = LATE) -> list[View]:
    body_seen = []
    for name, T_sensor_world, delay in (("front", FRONT, 0.0), ("side", SIDE, late)):
        camera = PinholeCamera(K, np.zeros(0), (640, 480), T_sensor_world)
        y, seen = camera.project(transform(pose_at(time_s + delay), MARKERS))
        assert seen.all()
        observation = Observation(PointPattern(y, np.ones(len(y))), 1.5)
        body_seen.append(View(name, camera, observation, delay if told else 0.0))
    return body_seen


def last_error(*, told: bool, late: float = LATE) -> tuple[float, float]:
    body = Body("tracker", tuple(PointFeature(point) for point in MARKERS))
    tracker = Tracker.create(body, EstimatorOptions(), pose_at(0.0))
    track = tracker.begin()
    for number in range(16):
        time_s = number * INTERVAL
        track, estimate = tracker.advance(
            track, number, time_s, views_at(time_s, told=told, late=late)
        )
    assert estimate.T_world_object is not None
    T = pose_at(time_s)
    shift = np.linalg.norm(estimate.T_world_object[:3, 3] - T[:3, 3])
    return float(rotation_angle_deg(estimate.T_world_object, T)), float(shift)


def test_delays_that_are_known_cost_no_accuracy_at_constant_velocity() -> None:
    angle, shift = last_error(told=True)
    # in the 13 ms the body moves 6 mm and turns 0.9 degrees; what the velocity errs by after the
    # first frames, without one, fades by the share of the delay from frame to frame
    assert angle < 0.01
    assert shift < 0.02


@pytest.mark.parametrize("frames", [1.0, 1.5])
def test_delays_that_are_told_are_believed_though_frames_come_faster(frames: float) -> None:
    angle, shift = last_error(told=True, late=frames * INTERVAL)
    # what the velocity of the first frames errs by fades the slower; it moved 14 and 22 mm
    assert angle < 0.01
    assert shift < 0.1


def test_delays_that_are_not_known_pull_the_pose_aside() -> None:
    angle, shift = last_error(told=False)
    assert angle > 0.1 or shift > 1.0


def test_clocks_that_have_nothing_in_common_are_not_believed() -> None:
    body = Body("tracker", tuple(PointFeature(point) for point in MARKERS))
    tracker = Tracker.create(body, EstimatorOptions(), np.eye(4))
    track = tracker.begin()
    for number in range(3):
        # a body at rest would be moved nowhere, however late the clock
        views = views_at(number * INTERVAL, told=False)
        views[1] = replace(views[0], name="other clock", delay=1.6e9)
        track, estimate = tracker.advance(track, number, number * INTERVAL, views)
    assert estimate.status == "ok"
    # all that it detects, where its frame was taken at the common time after all
    assert (estimate.sensors["other clock"].explained or 0.0) > 0.9


def test_what_frames_tell_of_delays_leaves_out_what_pose_and_velocity_explain() -> None:
    """The information on a delay is what is left of it beside all other unknowns."""
    body = Body("tracker", tuple(PointFeature(point) for point in MARKERS))
    tracker, rng = Tracker.create(body, EstimatorOptions(), pose_at(0.0)), np.random.default_rng(0)

    def seen_at(time_s: float) -> list[View]:
        """With 0.3 px of noise, and half of the delay told."""
        views = []
        for k, view in enumerate(views_at(time_s, told=False)):
            y, _ = view.sensor.project(transform(pose_at(time_s + k * LATE), MARKERS))
            pattern = PointPattern(y + rng.normal(0, 0.3, y.shape), np.ones(len(y)))
            views.append(replace(view, observation=Observation(pattern, 1.5), delay=k * LATE / 2))
        return views

    track, last = tracker.begin(), 6
    for number in range(last):
        track, _ = tracker.advance(track, number, number * INTERVAL, seen_at(number * INTERVAL))
    frame = tracker.data(track, last, last * INTERVAL, seen_at(last * INTERVAL))
    best = tracker.explain(frame)[0]
    found, before = delays_after(frame, best), track.delays
    assert found.names == ("side",)
    met, expected = offsets_of(frame, best.used), frame.expected_velocity(best.T_world_object)
    # a feature that nothing meets says nothing, not even how many there are
    shares = best.used.shares.copy()
    shares[1, 0] = 0.0
    assert len(offsets_of(frame, replace(best.used, shares=shares)).rows) == len(met.rows) - 2
    variance = max(float(met.offsets @ met.offsets) / (len(met.offsets) - 6), LEAST_VARIANCE)
    late = np.where(met.sensor == 1, met.rows @ expected.velocity, 0.0)
    ways = met.rows * met.late[:, None] * expected.deviation
    known = np.hstack([np.zeros((6, 6)), np.eye(6), np.zeros((6, 1))])  # of the velocity
    seen = np.column_stack([met.rows, ways, late]) / np.sqrt(variance)
    all_rows = np.vstack([seen, known])
    sizes = np.maximum(np.linalg.norm(all_rows, axis=0), 1e-300)
    _, R = np.linalg.qr(all_rows / sizes)
    information = float(R[-1, -1] * sizes[-1]) ** 2  # R^T R are the normal equations
    told = float(found.information[0, 0] - before.information[0, 0])
    assert told == pytest.approx(information, rel=1e-6)
    assert 0 < information < 0.9 * float(late @ late) / variance
