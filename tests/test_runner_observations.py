"""What the frames of a recording become before a pose is estimated from them."""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mixpose
from mixpose import runner
from mixpose.errors import SessionError
from mixpose.records import FrameSet, GridPattern, PointPattern, RawFrame
from mixpose.rigid import from_parts, from_rotation_vector
from mixpose.selection import Selection
from mixpose.session import Session

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
NOTHING = PointPattern(np.empty((0, 2)), np.empty(0))


class EndError(Exception):
    """Ends a run."""


@pytest.fixture
def session() -> Session:
    return mixpose.load_session(SYNTHETIC / "two_cameras" / "session.toml")


@pytest.fixture
def ranges() -> Session:
    return mixpose.load_session(SYNTHETIC / "range_profiles" / "session.toml")


def delays(session: Session, left_s: float | None, right_s: float | None) -> list[float]:
    """Delays of two cameras in a set whose time is that of the left one."""
    frames = {"left": RawFrame(4, left_s, NOTHING), "right": RawFrame(4, right_s, NOTHING)}
    return [view.delay for view in runner.observe(session, FrameSet(4, left_s, frames))]


def test_a_sensor_that_is_later_than_the_set_has_a_positive_delay(session: Session) -> None:
    assert delays(session, 0.5, 0.53) == pytest.approx([0.0, 0.03])
    assert delays(session, 0.5, 0.48) == pytest.approx([0.0, -0.02])


def test_sensors_in_step_or_without_times_have_no_delay(session: Session) -> None:
    assert delays(session, 0.5, 0.5 + 1e-9) == [0.0, 0.0]
    assert delays(session, 0.5, None) == [0.0, 0.0]
    assert delays(session, None, None) == [0.0, 0.0]


def test_grey_values_are_as_wide_as_their_spots_and_sigma_together(ranges: Session) -> None:
    setup = ranges.sensors[0]
    extract = replace(setup.extract, sigma=3.0, spot_sigma=4.0)
    profile = GridPattern(np.ones((1, 50), np.float32), np.array([0.0]), 1.0)
    seen = runner.observation_of(
        ranges, replace(setup, extract=extract), RawFrame(0, None, profile)
    )
    assert seen.sigma == pytest.approx(5.0)  # hypot(3, 4): variances add
    assert seen.intrinsic == 4.0
    points = PointPattern(np.array([[10.0]]), np.ones(1))
    seen = runner.observation_of(ranges, replace(setup, extract=extract), RawFrame(0, None, points))
    assert seen.sigma == 3.0  # a detection has no spot any more


@pytest.mark.parametrize(
    ("given", "error", "said"),
    [
        ({"selection": Selection(start=0.5)}, SessionError, "start: found 0.5, allowed is a whole"),  # type: ignore[arg-type]
        ({"T_start": np.eye(3)}, ValueError, "start: not a rotation and a translation"),
        ({"T_start": {"tool": np.eye(4)}}, SessionError, "no body 'tool'; allowed: tracker"),
    ],
    ids=["half a frame", "3x3", "another body"],
)
def test_a_run_refuses_frames_and_starts_that_cannot_be_meant(
    session: Session, given: dict[str, Any], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        mixpose.run(session, **given)


def test_a_source_of_the_session_is_beside_it_and_one_given_instead_is_not(
    session: Session, ranges: Session
) -> None:
    own = runner.source_spec(session, session.sensors[0], None)
    given = runner.source_spec(session, session.sensors[0], "other/left*.png")
    assert (own.base, own.source) == (session.folder, session.sensors[0].source)
    assert (given.base, given.source) == (Path(), "other/left*.png")
    kinds = [runner.source_spec(ranges, setup, None).kind for setup in ranges.sensors]
    assert (own.kind, kinds) == ("camera", ["lateration"] * 3)


def test_a_sensor_without_a_source_needs_one_instead(session: Session) -> None:
    planned = replace(session.sensors[0], source="")
    with pytest.raises(SessionError, match=r"'left': source: found none, name the recording here"):
        runner.source_spec(session, planned, None)
    assert runner.source_spec(session, planned, "left*.png").source == "left*.png"
    with pytest.raises(SessionError, match=r"--source top=.*no such sensor, allowed: left, right"):
        runner.open_sources(session, {"top": "top*.png"})


def test_a_run_that_goes_on_begins_at_its_own_pose_and_not_at_start(session: Session) -> None:
    assert session.start is not None
    T = from_rotation_vector([0.1, 0.2, 0.3], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(runner.begin(session, T)[0].T_start, T)
    np.testing.assert_array_equal(runner.begin(session)[0].T_start, session.start.T_world_object)


def test_the_start_of_identical_bodies_is_that_of_the_first(session: Session) -> None:
    assert session.start is not None
    T = session.start.T_world_object
    middle = from_parts(np.eye(3), session.body.means.mean(axis=0))
    (alone,) = runner.scene_of(session).bodies
    np.testing.assert_array_equal(alone.T_start, T @ middle)
    pair = replace(session, count=2)
    first, second = runner.scene_of(pair).bodies
    np.testing.assert_array_equal(first.T_start, T @ middle)
    assert second.T_start is None  # two bodies are not at one place
    T_second = from_rotation_vector([0.1, 0.2, 0.3], [1.0, 2.0, 3.0])
    first, second = runner.scene_of(pair, {pair.labels[1]: T_second}).bodies
    np.testing.assert_array_equal(first.T_start, T @ middle)
    np.testing.assert_array_equal(second.T_start, T_second @ middle)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[Any]]:
    """Session and poses to begin at by which a run makes its scene."""

    def of_run(session: Session, **options: Any) -> list[Any]:
        found: list[Any] = []

        def scene_of(*those: Any) -> None:
            found.extend(those)
            raise EndError

        monkeypatch.setattr(runner, "scene_of", scene_of)
        with pytest.raises(EndError):
            runner.run(session, **options)
        return found

    return of_run


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [(("camera",) * 2, "thorough"), (("live", "camera"), "thorough"), (("live",) * 2, "live")],
)
def test_the_search_is_in_haste_only_where_all_sources_are_live(
    session: Session, asked: Callable[..., list[Any]], kinds: tuple[str, ...], expected: str
) -> None:
    opened = {setup.name: Namespace(kind=k) for setup, k in zip(session.sensors, kinds)}
    assert asked(session, opened=opened)[0].estimator.search == expected


def test_one_pose_to_begin_at_is_that_of_the_first_body(
    session: Session, asked: Callable[..., list[Any]]
) -> None:
    first, second = replace(session, count=2).labels
    for given, expected in ((np.eye(4), [first]), ({second: np.eye(4)}, [second]), (None, [])):
        assert list(asked(replace(session, count=2), T_start=given)[1]) == expected


def test_cameras_have_windows_where_thresholds_are_those_of_the_whole_frame(
    session: Session, ranges: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    def windowed(session: Session) -> set[str]:
        seen: list[set[str]] = []

        def windowed_scene(_: object, sensors: dict[str, object]) -> None:
            seen.append(set(sensors))
            raise EndError

        monkeypatch.setattr(runner, "WindowedScene", windowed_scene)
        with pytest.raises(EndError):
            next(runner.run(session))
        return seen[0]

    def changed(**changes: object) -> Session:
        extract = replace(session.sensors[0].extract, **changes)  # type: ignore[arg-type]
        return replace(session, sensors=(replace(session.sensors[0], extract=extract),))

    assert windowed(changed(threshold="auto")) == windowed(changed(threshold=128.0)) == {"left"}
    assert windowed(changed(threshold="local")) == windowed(changed(threshold="otsu")) == set()
    assert windowed(changed(method="corners")) == set()
    assert windowed(ranges) == set()


def test_a_sensor_without_frames_is_reported_as_unused_in_the_sessions_order(
    session: Session, tmp_path: Path
) -> None:
    path = tmp_path / "left.csv"
    path.write_text("frame,u,v\n99,0,0\n", encoding="ascii")
    began = time.perf_counter()
    found = list(mixpose.run(session, sources={"left": str(path)}, selection=Selection(0, 2)))
    assert 0.0 < sum(one.latency_ms or 0.0 for one in found) < 1e3 * (time.perf_counter() - began)
    for estimate in found:
        assert list(estimate.sensors) == ["left", "right"]
        assert [report.used for report in estimate.sensors.values()] == [False, True]
