"""What a run says in the end: a body seen twice, and sensors that are flooded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mixpose.body import ASIDE, TURNED
from mixpose.cli.findings import Findings
from mixpose.cli.marker_offsets import Marker
from mixpose.cli.notices import Summary
from mixpose.density import Observation
from mixpose.judgement import APART
from mixpose.objective import View
from mixpose.records import (
    DelayEstimate,
    Estimate,
    FrameSet,
    Offsets,
    PointPattern,
    RawFrame,
    SensorReport,
    Status,
)
from mixpose.runner import observation_of
from mixpose.session import load_session
from mixpose.tracking import OUT_OF_STEP, TWICE

SESSION = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras" / "session.toml"


@pytest.mark.parametrize("before", [0, 8])
def test_poses_before_the_body_is_seen_twice_may_be_of_its_mirror_image(before: int) -> None:
    session = load_session(SESSION)
    findings = Findings(session)
    for frame in range(20):
        status: Status = "ok" if frame < before else "ambiguous"
        doubt = "" if frame < before else TWICE
        pose, label = np.eye(4), session.labels[0]
        findings.add(Estimate(frame, None, label, status, pose, np.eye(6), 1.0, {}, doubt=doubt))
    (line,) = findings.causes()
    assert line.startswith(f"{TWICE} in {20 - before} of 20 frames")
    assert line.endswith("is there a mirror?") == (before > 0)


@pytest.mark.parametrize(("seconds", "is_late"), [(0.01, True), (4e-4, False)])
def test_a_delay_that_is_told_is_the_cause_and_no_other_is_sought(
    seconds: float, is_late: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = load_session(SESSION)
    summary, label = Summary(session), session.labels[0]
    monkeypatch.setattr("mixpose.cli.findings.explanation", lambda *_: "T_sensor_world is off")
    monkeypatch.setattr("mixpose.cli.findings.late_sensor", lambda *_: None)
    delays = {"right": DelayEstimate(seconds, 5e-5)}
    estimate = Estimate(0, None, label, "ambiguous", np.eye(4), np.eye(6), 1.0, {}, doubt=APART)
    for frame in range(12):
        summary.add(replace(estimate, frame=frame, delays=delays))
    (line,) = summary.warnings()
    assert ("as told below" in line) == is_late
    assert ("T_sensor_world is off" in line) != is_late
    assert len(summary.delay_remarks()) == is_late


@pytest.mark.parametrize(
    ("doubt", "count", "asked"),
    [
        (ASIDE, 20, "does it have more rows or fewer than told?"),
        (f"{TURNED} 180 deg", 20, "is a feature of [object] missing, or one too many?"),
        (f"{TURNED} 180 deg", 8, ""),  # of 20: what tells may be hidden now and then
    ],
)
def test_look_alikes_all_along_ask_whether_the_session_has_all_features(
    doubt: str, count: int, asked: str
) -> None:
    session = load_session(SESSION)
    findings, label = Findings(session), session.labels[0]
    for frame in range(20):
        status: Status = "ambiguous" if frame < count else "ok"
        why = doubt if frame < count else ""
        pose = np.eye(4)
        findings.add(Estimate(frame, None, label, status, pose, np.eye(6), 1.0, {}, doubt=why))
    (line,) = findings.causes()
    assert line.startswith(f"{doubt} in {count} of 20 frames")
    assert line.endswith(asked)
    assert ("?" in line) == bool(asked)


@pytest.mark.parametrize(("status", "warned"), [("lost", True), ("ok", False)])
def test_features_by_the_hundred_are_told_where_frames_are_not_ok(
    status: Status, warned: bool
) -> None:
    session = load_session(SESSION)
    findings = Findings(session)
    (left, right), label = session.sensors, session.labels[0]
    spots = np.random.default_rng(0).uniform(0, 400, (700, 2))
    for frame in range(5):
        crowd = PointPattern(spots, np.ones(700))
        few = PointPattern(spots[:7], np.ones(7))
        views = [
            View("left", left.sensor, Observation(few, 1.0)),
            View("right", right.sensor, Observation(crowd, 1.0)),
        ]
        estimate = Estimate(frame, None, label, status, None, None, 0.0, {})
        pictures = {name: RawFrame(frame, None, few) for name in ("left", "right")}
        findings.watch(FrameSet(frame, None, pictures), views, estimate)
        if status == "lost":
            findings.add(estimate)
    warnings = findings.sensor_lines()
    assert len(warnings) == warned
    for line in warnings:
        assert line.startswith("sensor 'right' found up to 700 features, where 7 are expected, in")
        assert "[extract]" in line


@pytest.mark.parametrize("why", [OUT_OF_STEP, None])
def test_a_table_that_repeats_itself_is_told_where_it_is_out_of_step(why: str | None) -> None:
    session = load_session(SESSION)
    findings, label = Findings(session), session.labels[0]
    rng = np.random.default_rng(0)
    frozen = PointPattern(rng.uniform(0, 400, (7, 2)), np.ones(7))
    for frame in range(6):
        moving = PointPattern(rng.uniform(0, 400, (7, 2)), np.ones(7))
        seen = {"left": moving, "right": frozen if frame > 1 else moving}
        views = [
            View(one.name, one.sensor, Observation(seen[one.name], 1.0)) for one in session.sensors
        ]
        reports = {"left": SensorReport(True), "right": SensorReport(why is None, why=why)}
        pose = np.eye(4)
        estimate = Estimate(frame, None, label, "ok", pose, np.eye(6), 1.0, reports)
        pictures = {name: RawFrame(frame, None, data) for name, data in seen.items()}
        findings.watch(FrameSet(frame, None, pictures), views, estimate)
        findings.add(estimate)
    told = [line for line in findings.sensor_lines() if "frame before" in line]
    # a body that rests shows the same to all
    assert len(told) == (why is not None)
    for line in told:
        assert line.startswith("sensor 'right' shows the same as the frame before in frames 3 to 5")


def test_a_flooded_image_is_told_as_such_though_nothing_of_it_is_used() -> None:
    session = load_session(SESSION)
    findings = Findings(session)
    setup, label = session.sensors[0], session.labels[0]
    image = np.zeros((480, 640), np.uint8)
    image[6::6, 6::6] = 200  # 79 x 106 spots: more than are kept of a frame
    options = replace(setup.extract, threshold=100.0, min_area=1.0)
    setup = replace(setup, extract=options)
    for frame in range(3):
        raw = RawFrame(frame, None, image)
        observation = observation_of(session, setup, raw)
        assert observation.is_empty
        estimate = Estimate(frame, None, label, "lost", None, None, 0.0, {})
        view = View(setup.name, setup.sensor, observation)
        findings.watch(FrameSet(frame, None, {setup.name: raw}), [view], estimate)
        findings.add(estimate)
    flooded = [
        line
        for line in [*findings.sensor_lines(), *findings.causes()]
        if line.startswith(f"sensor {setup.name!r}")
    ]
    assert len(flooded) == 1
    assert flooded[0].startswith(f"sensor {setup.name!r} found up to 8374 features")


@pytest.mark.parametrize(
    ("since", "said"),
    [(0, "met in none of 20 frames"), (5, "not met from frame 5 on, in 15 frames: gone?")],
)
def test_markers_that_are_not_met_any_more_are_told_in_one_line(since: int, said: str) -> None:
    session = load_session(SESSION)
    findings, features = Findings(session), np.arange(7)
    nothing, views = np.zeros((7, 2)), (np.zeros((7, 2, 3)), np.zeros((7, 2)))
    sensors = {name: SensorReport(True, 0.9, 0.1) for name in ("left", "right")}
    for frame in range(20):
        label, T = session.labels[0], np.eye(4)
        is_met = np.isin(features, [0, 1, 5]) | (frame < since)
        seen = Offsets(features, is_met, nothing, *views, np.zeros(7, np.bool_), np.ones(7))
        measured = Estimate(
            *(frame, None, label, "ok", T, np.eye(6), 1.0, sensors),
            measured=lambda seen=seen: {"left": seen},  # type: ignore[misc]
        )
        findings.add(measured)
    names = [session.body.labels[i] for i in (2, 3, 4, 6)]
    (line,) = findings.causes()
    assert line.startswith(f"markers {', '.join(names)} are each {said}")


@pytest.mark.parametrize(
    ("frames", "noise", "weight", "is_told"),
    [
        (20, 0.1, 1.0, True),
        (20, 0.8, 1.0, False),  # 20 (1 / 0.8)^2 = 31 is under 100: that may be chance
        (80, 0.8, 1.0, True),  # 125
        (9, 0.1, 1.0, False),  # too few frames to speak of any marker
        (20, 0.1, 1e-3, False),  # its spots are known to be cut
    ],
)
def test_a_marker_is_measured_wrong_where_its_offsets_are_no_chance(
    frames: int, noise: float, weight: float, is_told: bool
) -> None:
    session = load_session(SESSION)
    findings, features = Findings(session), np.arange(7)
    is_met, residuals = np.ones(7, np.bool_), np.full((7, 2), 0.01)
    jacobians = np.tile(np.eye(2, 3), (7, 1, 1))
    sensors = {name: SensorReport(True, 0.9, 0.1) for name in ("left", "right")}
    for frame in range(frames):
        # marker 3 is 1 off along x, and by chance once above and once below
        residuals = residuals.copy()
        residuals[3] = [1.0, noise * (-1) ** frame]
        each = np.zeros(7, np.bool_), np.where(features == 3, weight, 1.0)
        seen = Offsets(features, is_met, residuals, jacobians, residuals, *each)
        measured = Estimate(
            frame,
            None,
            session.labels[0],
            "ok",
            np.eye(4),
            np.eye(6),
            1.0,
            sensors,
            measured=lambda seen=seen: {"left": seen},  # type: ignore[misc]
        )
        findings.add(measured)
    told = [line for line in findings.causes() if "measured wrong" in line]
    assert bool(told) == is_told, findings.causes()
    if is_told:
        name = session.body.labels[3]
        assert told[0].startswith(
            f"marker {name} is met 1 mm off in {frames} of {frames} frames: measured wrong?"
        )


@pytest.mark.parametrize(
    ("frames", "since", "said"),
    [
        (40, 0, "met 1 mm off in 40 of 40 frames: measured wrong?"),
        (40, 20, "met 1 mm off from frame 20 on, in 20 frames: moved?"),
        (40, 5, "met 0.88 mm off in 40 of 40 frames: measured wrong?"),  # 5 frames tell nothing
        (40, 35, ""),  # 5 frames may be chance
        # stretches are of four frames by then
        (120, 64, "met 1 mm off from frame 64 on, in 56 frames: moved?"),
        (120, 67, "met 1 mm off from frame 68 on, in 52 frames: moved?"),
    ],
)
def test_a_marker_that_moves_on_the_body_is_told_with_the_frame(
    frames: int, since: int, said: str
) -> None:
    marker, rng, J = Marker(), np.random.default_rng(0), np.eye(2, 3)
    for frame in range(frames):
        off = np.array([float(frame >= since), 0.0]) + rng.normal(0, 0.01, 2)
        marker.add(frame, [(1.0, off, J), (1.0, off, np.eye(3)[[0, 2]])])
    assert (marker.oddness(1e-3, "mm") or "") == said


def test_what_is_kept_of_a_marker_does_not_grow_and_sums_up_to_all_frames() -> None:
    marker, J = Marker(), np.eye(2, 3)
    for frame in range(5000):
        marker.add(frame, [(0.5, np.array([0.0, 2.0]), J)])
        assert len(marker.stretches) <= 32
    whole = marker.whole
    assert (whole.first, whole.met, whole.squares, whole.views) == (0, 5000, 1e4, 2500.0)
    np.testing.assert_allclose(whole.shift(), [0, 2, 0], atol=1e-6)
