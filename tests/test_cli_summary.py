"""What `mixpose run` says at its end about sensors that do not fit together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mixpose
from mixpose.body import Body, PointFeature
from mixpose.cli.notices import Summary
from mixpose.cli.request import RunRequest
from mixpose.cli.run import run_session
from mixpose.density import Observation
from mixpose.judgement import APART, MEETS_NOTHING
from mixpose.objective import View
from mixpose.records import (
    Estimate,
    FrameSet,
    PointPattern,
    RawFrame,
    SensorReport,
    Status,
)
from mixpose.selection import Selection
from mixpose.session import Session, load_session

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
UNUSED = SensorReport(False)
FEW = PointPattern(np.full((7, 2), 200.0), np.ones(7))


@pytest.fixture
def session() -> Session:
    return load_session(SYNTHETIC / "two_cameras" / "session.toml")  # sigma is 1.5 px


def met(explained: float, rms: float | None = 0.1) -> SensorReport:
    return SensorReport(True, explained, rms)


def summary(session: Session, *frames: list[SensorReport], status: Status = "ok") -> Summary:
    counted = Summary(session)
    names = [setup.name for setup in session.sensors]
    for number, reports in enumerate(frames):
        sensors = dict(zip(names, reports, strict=True))
        T = None if status == "lost" else np.eye(4)
        counted.add(Estimate(number, None, "body", status, T, None, 0.5, sensors))
    return counted


def test_features_met_far_off_in_half_of_the_frames_are_told_once(session: Session) -> None:
    close, far = [met(0.9), met(0.9)], [met(0.7, 1.3), met(0.7, 1.4)]
    (warning,) = summary(session, far, far, close).warnings()
    assert "1.3 px in 'left' (median; sigma is 1.5) and by 1.4 px in 'right'" in warning
    assert "[object]" in warning
    assert summary(session, far, close, close).warnings() == []
    assert summary(session, far, far, status="ambiguous").warnings() == []


def test_a_camera_that_is_met_within_half_of_sigma_is_silent(session: Session) -> None:
    assert summary(session, [met(0.9, 0.74), met(0.9, 0.74)]).warnings() == []
    (warning,) = summary(session, [met(0.9, 0.74), met(0.9, 0.76)]).warnings()
    assert "'right'" in warning
    assert "'left'" not in warning


def test_ranges_and_soft_bodies_may_be_far_off(session: Session) -> None:
    ranges = load_session(SYNTHETIC / "range_profiles" / "session.toml")
    assert summary(ranges, [met(0.9, 1.4)] * 3).warnings() == []
    soft = Body("soft", tuple(PointFeature(x, np.eye(3)) for x in session.body.means))
    assert summary(replace(session, body=soft), [met(0.9, 1.4)] * 2).warnings() == []


def test_a_change_is_told_from_its_first_frame_on_whatever_some_frames_are_doubted_for(
    session: Session,
) -> None:
    """Of some frames after a bump other poses explain as much, and no doubt has a name."""
    counted, label = Summary(session), session.labels[0]
    names = [setup.name for setup in session.sensors]
    sensors = dict(zip(names, [met(0.9)] * 2, strict=True))
    ok = Estimate(0, None, label, "ok", np.eye(4), None, 0.5, sensors)
    for frame in range(30):
        status: Status = "ok" if frame < 10 else "ambiguous"
        doubt = "" if frame < 10 or frame % 4 == 3 else APART
        counted.add(replace(ok, frame=frame, status=status, doubt=doubt))
    told = f"{APART} from frame 10 on: was one of them bumped?"
    assert told in counted.warnings()


def test_sensors_that_take_turns_are_told(session: Session) -> None:
    both, left, right = [met(0.9)] * 2, [met(0.9), met(0.0)], [met(0.005), met(0.9)]
    (warning,) = summary(session, left, right, left, both).warnings()
    assert warning.startswith("in 3 of 4 frames with a pose only one of 2 sensors is explained")
    assert summary(session, left, *[both] * 5).warnings() == []
    assert len(summary(session, left, *[both] * 4).warnings()) == 1


def test_a_sensor_that_meets_nothing_is_named_whatever_else_is_odd_about_it(
    session: Session,
) -> None:
    nothing = SensorReport(False, 0.0, None, MEETS_NOTHING)
    found = summary(session, *[[met(0.9), nothing]] * 20)
    (warning,) = found.warnings()
    assert warning.startswith("sensor 'right' explained less than 1 % in 20 of 20 frames")
    for frame in range(7):
        seen = View("left", session.sensors[0].sensor, Observation(FEW, 1.0))
        pictures = {name: RawFrame(frame, None, FEW) for name in ("left", "right")}
        estimate = Estimate(frame, None, session.labels[0], "ok", np.eye(4), None, 0.5, {})
        found.findings.watch(FrameSet(frame, None, pictures), [seen], estimate)
    assert [line for line in found.warnings() if "no feature" in line]
    assert warning in found.warnings()


def test_doubts_about_frames_do_not_hide_a_sensor_that_explains_nothing(session: Session) -> None:
    nothing = SensorReport(False, 0.0, None, MEETS_NOTHING)
    found = summary(session, *[[met(0.9), nothing]] * 20)
    T = np.eye(4)
    for frame in range(20, 30):
        doubted = Estimate(frame, None, session.labels[0], "ambiguous", T, None, 0.5, {})
        found.findings.add(replace(doubted, doubt="features that would fix it are hidden or cut"))
    first, second = found.warnings()
    assert first.startswith("sensor 'right' explained less than 1 % in 20 of 20 frames")
    assert second.startswith("features that would fix it are hidden or cut in 10 of")
    # sensors that contradict each other are said to do so, once
    for frame in range(30, 45):
        doubted = Estimate(frame, None, session.labels[0], "ambiguous", T, None, 0.5, {})
        found.findings.add(replace(doubted, doubt="sensors contradict each other"))
    assert not any("explained less" in line for line in found.warnings())


def test_of_more_sensors_those_not_explained_are_named() -> None:
    session = load_session(SYNTHETIC / "range_profiles" / "session.toml")
    (warning,) = summary(
        session, [met(0.9), met(0.0), met(0.9)], [met(0.9), met(0.9), met(0.0)]
    ).warnings()
    assert "in 2 of 2 frames with a pose not all of 3 sensors" in warning
    assert "('side' in 1, 'top' in 1 not)" in warning


def test_a_sensor_that_never_takes_part_is_told_once(session: Session) -> None:
    (warning,) = summary(session, *[[met(0.9), met(0.005, 2.1)]] * 4).warnings()
    assert warning.startswith("sensor 'right' explained less than 1 % in 4 of 4")


def test_a_sensor_without_features_or_beside_a_flood_is_no_mistake(session: Session) -> None:
    assert summary(session, *[[met(0.9), UNUSED]] * 4).warnings() == []
    assert summary(session, *[[met(0.08), met(0.05)]] * 4).warnings() == []


def test_that_no_frame_is_ok_is_said_long_before_the_end(
    session: Session, capsys: pytest.CaptureFixture[str]
) -> None:
    said = "no pose in the first 10 frames is ok, 10 of 10 are lost; the run goes on, mixpose check"
    summary(session, *[[UNUSED, UNUSED]] * 9, status="lost")
    assert said not in capsys.readouterr().err
    summary(session, *[[UNUSED, UNUSED]] * 12, status="lost")
    assert capsys.readouterr().err.count(said) == 1
    summary(session, *[[met(0.9), met(0.9)]] * 12)
    assert said not in capsys.readouterr().err


def test_a_run_names_all_that_it_wrote(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses, pictures = tmp_path / "poses.jsonl", tmp_path / "seen"
    session = SYNTHETIC / "two_cameras" / "session.toml"
    run_session(RunRequest([str(session)], poses, start=0, stop=1, overlay=pictures))
    assert capsys.readouterr().err == f"mixpose: 1 frame: 1 ok -> {poses}, {pictures}\n"


def test_squares_of_a_chessboard_that_are_a_millimetre_too_large(
    recordings: Path,
) -> None:
    session = load_session(recordings / "stereo_chessboard" / "session.toml")
    larger = Body("chessboard", tuple(PointFeature(x * 25 / 24) for x in session.body.means))
    for body, is_silent in ((session.body, True), (larger, False)):
        counted = Summary(session)
        for estimate in mixpose.run(replace(session, body=body), selection=Selection(1, 2)):
            counted.add(estimate)
        assert (counted.warnings() == []) is is_silent


def test_poses_of_several_bodies_are_not_called_frames() -> None:
    session = load_session(SYNTHETIC / "several_bodies" / "session.toml")
    out = [replace(met(0.9), used=False, why="it contradicts the others")]
    found = summary(session, *[[*out, met(0.9)]] * 8)
    assert any("was left out of 8 of 8 poses: it contradicts" in one for one in found.warnings())
