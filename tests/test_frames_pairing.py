"""Joining the frames of several sensors by number."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import wait_until

from mixpose.errors import RecordingError, SessionError
from mixpose.frames import Source, SourceSpec, open_source, pair
from mixpose.frames.source import SourceKind, selection
from mixpose.records import Image, PointPattern, RawFrame

NOTHING = PointPattern(np.zeros((0, 2)), np.zeros(0))


class Recorded(Source):
    """A source with the given frame numbers; it fails in place of frame `fails`."""

    kind: SourceKind = "detections"
    ahead: int = 0

    def __init__(
        self,
        *numbers: int,
        fails: int | None = None,
        rate: float | None = None,
        ahead: int = 0,
        data: PointPattern | Image = NOTHING,
    ) -> None:
        self.numbers, self.fails, self.rate, self.ahead = numbers, fails, rate, ahead
        self.data = data
        self.read: list[int] = []

    @property
    def length(self) -> int:
        return len(self.numbers)

    @property
    def first(self) -> int | None:
        return self.numbers[0] if self.numbers else None

    def describe(self) -> str:
        return "recorded"

    def caution(self) -> str | None:
        return None

    def check_times(self, wanted: range) -> None:
        pass

    def frames(
        self, start: int | None = None, stop: int | None = None, step: int = 1
    ) -> Generator[RawFrame, None, None]:
        wanted = selection(start, stop, step, self.first)
        for number in self.numbers:
            if number in wanted:
                if number == self.fails:
                    raise RecordingError(f"frame {number} is broken")
                self.read.append(number)
                yield RawFrame(number, number / self.rate if self.rate else None, self.data)


def joined(
    sources: dict[str, Source], *selected: int | None
) -> list[tuple[int, float | None, list[str]]]:
    sets = pair(sources, *selected)  # type: ignore[arg-type]
    return [(found.number, found.time_s, list(found.frames)) for found in sets]


def test_number_missing_from_one_sensor_gives_a_set_without_it() -> None:
    sources: dict[str, Source] = {"a": Recorded(1, 2, 4), "b": Recorded(2, 3, 4, 5)}
    assert joined(sources) == [
        (1, None, ["a"]),
        (2, None, ["a", "b"]),
        (3, None, ["b"]),
        (4, None, ["a", "b"]),
        (5, None, ["b"]),
    ]


def test_time_is_that_of_the_first_sensor_that_has_one() -> None:
    sources: dict[str, Source] = {
        "a": Recorded(0, 10),
        "b": Recorded(10, rate=100.0),
        "c": Recorded(0, 10, rate=50.0),
    }
    assert [time_s for _, time_s, _ in joined(sources)] == [0.0, 0.1]


def test_times_of_a_sensor_that_go_back_are_refused_and_those_of_two_may_differ() -> None:
    # where `a` has no frame the time is that of the other clock
    both: dict[str, Source] = {"a": Recorded(10, 30, rate=5.0), "b": Recorded(10, 20, rate=10.0)}
    assert [time_s for _, time_s, _ in joined(both)] == [2.0, 2.0, 6.0]
    back = Recorded(10, 20, rate=-10.0)
    with pytest.raises(RecordingError, match=r"'b': frame 20 is at -2 s and .* before it at -1 s"):
        joined({"a": Recorded(10, 20), "b": back})


def test_step_counts_from_the_first_number_of_all_sensors() -> None:
    sources: dict[str, Source] = {"a": Recorded(4, 5, 6, 7, 8), "b": Recorded(*range(3, 9))}
    assert joined(sources, None, None, 2) == [
        (3, None, ["b"]),
        (5, None, ["a", "b"]),
        (7, None, ["a", "b"]),
    ]


def test_start_and_stop_are_frame_numbers_like_in_range() -> None:
    sources: dict[str, Source] = {"a": Recorded(*range(10)), "b": Recorded(*range(10))}
    assert [number for number, _, _ in joined(sources, 2, 9, 3)] == [2, 5, 8]


def test_step_below_one_is_told_at_once() -> None:
    with pytest.raises(SessionError, match="step: found 0"):
        pair({"a": Recorded(1)}, step=0)


def test_no_sources_and_empty_sources_give_no_sets() -> None:
    assert joined({}) == []
    assert joined({"a": Recorded()}) == []


@pytest.mark.parametrize("ahead", [0, 3])
def test_error_of_one_source_comes_after_the_complete_sets(ahead: int) -> None:
    sources = {
        "a": Recorded(*range(9), ahead=ahead),
        "b": Recorded(*range(9), fails=4, ahead=ahead),
    }
    threads = threading.active_count()
    sets = pair(sources)
    for number in range(4):
        found = next(sets)
        assert (found.number, list(found.frames)) == (number, ["a", "b"])
    with pytest.raises(RecordingError, match="frame 4 is broken"):
        next(sets)
    assert threading.active_count() == threads


def test_frames_are_read_as_they_are_wanted() -> None:
    source = Recorded(*range(1000))
    sets = pair({"a": source})
    next(sets)
    next(sets)
    assert source.read == [0, 1]
    sets.close()


@pytest.mark.parametrize(
    ("pixels", "read"),
    [
        (
            64 * 64,
            1 + 3 + 13 + 1,
        ),  # taken, waiting as always, waiting as they are small, on its way
        (2**22, 1 + 3 + 4 + 1),  # 4 MiB: four more in 16 MiB
        (2**25, 1 + 3 + 0 + 1),
    ],
)
def test_small_frames_are_read_further_ahead_in_bounded_memory(pixels: int, read: int) -> None:
    source = Recorded(*range(50), ahead=3, data=np.zeros((1, pixels), np.uint8))
    sets = pair({"a": source})
    next(sets)
    wait_until(lambda: len(source.read) == read)
    time.sleep(0.02)
    assert len(source.read) == read
    sets.close()


def test_threads_end_with_a_consumer_that_stops_early(tmp_path: Path) -> None:
    for number in range(20):
        cv2.imwrite(str(tmp_path / f"f{number}.png"), np.full((8, 8), number, np.uint8))
    before = threading.active_count()
    spec = SourceSpec("left", "f*.png", tmp_path, "camera")
    sets = pair({"left": open_source(spec), "right": open_source(spec)})
    first = next(sets)
    assert set(first.frames) == {"left", "right"}
    assert threading.active_count() == before + 2
    sets.close()
    assert threading.active_count() == before


def test_images_of_two_cameras_meet_by_number(tmp_path: Path) -> None:
    for number in (7, 8, 9):
        cv2.imwrite(str(tmp_path / f"left{number}.png"), np.full((8, 8), number, np.uint8))
    for number in (8, 9, 10):
        cv2.imwrite(str(tmp_path / f"right_{number}.png"), np.full((8, 8), number, np.uint8))
    sources = {
        name: open_source(SourceSpec(name, f"{name}*.png", tmp_path, "camera"))
        for name in ("left", "right")
    }
    seen = {
        found.number: {name: int(np.max(frame.data)) for name, frame in found.frames.items()}  # type: ignore[arg-type]
        for found in pair(sources)
    }
    assert seen == {
        7: {"left": 7},
        8: {"left": 8, "right": 8},
        9: {"left": 9, "right": 9},
        10: {"right": 10},
    }
