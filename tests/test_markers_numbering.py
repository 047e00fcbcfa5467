"""Trajectories of markers where frames or markers are called as no file can call them."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from mixpose.cli.session_formats import trajectories_of
from mixpose.errors import RecordingError, SessionError
from mixpose.poses.jsonl import PoseFile
from mixpose.poses.poseline import PoseLine
from mixpose.poses.trajectories import Trajectories, numbers_of, rate_of, write_trc
from mixpose.session import Session, load_session

FOLDER = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras"
EPOCH_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def session() -> Session:
    return load_session(FOLDER / "session.toml")


def line(frame: int, time_s: float | None = None) -> PoseLine:
    return PoseLine(
        line=1, frame=frame, time_s=time_s, object="tracker", status="ok", T_world_object=np.eye(4),
        covariance=None, score=1.0, sensors={}, hypotheses=(), latency_ms=None,
    )  # fmt: skip


def collected(session: Session, lines: list[PoseLine]) -> Trajectories:
    return trajectories_of(PoseFile(Path("p"), {}, tuple(lines)), lines, session, measured=False)


@pytest.mark.parametrize("has_times", [True, False])
@pytest.mark.parametrize("first", [0, EPOCH_NS])
def test_frames_that_are_numbered_by_stamps_count_from_0_and_gaps_stay(
    first: int, has_times: bool, session: Session, capfd: pytest.CaptureFixture[str]
) -> None:
    places = [0, 1, 2, 3, 7, 8]
    jitter = [0, 14_024, -20_000, 9_000, 20_000, -3_000]
    stamps = [first + 40_000_000 * k + off for k, off in zip(places, jitter, strict=True)]
    lines = [line(n, (n - first) * 1e-9 if has_times else None) for n in stamps]
    found = collected(session, lines)
    assert found.first == 0
    assert np.flatnonzero(found.is_known.all(axis=1)).tolist() == places
    assert found.rate == pytest.approx(25 if has_times else 1, rel=1e-3)
    assert "frames are numbered by stamps; in the file they count from 0" in capfd.readouterr().err


def test_frames_of_very_large_numbers_have_a_rate(session: Session) -> None:
    lines = [line(10**30 + k, 0.1 * k) for k in range(5)]
    found = rate_of(lines, numbers_of(lines))
    assert found is not None
    assert found[0] == pytest.approx(10)
    assert collected(session, lines).first == 10**30


def test_a_gap_of_more_frames_than_there_is_room_for_is_refused(session: Session) -> None:
    for times in ([None] * 4, [0.0, 1e-300, 2e-300, 1e300]):
        numbers = (0, 10**6, 2 * 10**6, 10**400)
        lines = [line(n, t) for n, t in zip(numbers, times, strict=True)]
        with pytest.raises(SessionError, match="allowed are 50000000 places"):
            collected(session, lines)


def test_times_that_do_not_ascend_are_told_by_the_number_of_the_frame() -> None:
    lines = [line(EPOCH_NS, 1.0), line(EPOCH_NS + 1, 0.5)]
    with pytest.raises(RecordingError, match=r"frame 1700000000000000001 is at 0\.5 s"):
        rate_of(lines, numbers_of(lines))


def test_names_of_markers_stay_different_where_blanks_cannot_be_written() -> None:
    names = ("a b", "a_b", "a\tb", "c d")
    none = np.full((1, 4), np.nan)
    stream = io.StringIO()
    places = np.zeros((1, 4, 3))
    by_sensor = np.zeros((1, 4, 1), dtype=np.bool_)
    write_trc(stream, Trajectories(names, places, none, by_sensor, 0, 25.0, "mm"), "a.trc")
    header = stream.getvalue().splitlines()[3].split("\t")
    assert header[2::3] == ["a_b_2", "a_b", "a_b_3", "c_d"]
