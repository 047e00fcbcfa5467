"""Reading ahead: order, errors, bounds, and threads that end."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Generator, Iterator

import pytest
from command_line import wait_until

from mixpose.frames import prefetch


def workers() -> int:
    return sum(thread.name == "mixpose-prefetch" for thread in threading.enumerate())


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    before = workers()
    yield
    assert workers() == before


def counting(limit: int, log: list[str]) -> Generator[int, None, None]:
    try:
        for number in range(limit):
            log.append(f"made {number}")
            yield number
    finally:
        log.append(f"closed in {threading.current_thread().name}")


def test_items_come_in_order() -> None:
    assert list(prefetch(iter(range(100)), depth=3)) == list(range(100))
    assert list(prefetch(iter(()))) == []


def test_error_comes_after_the_items_before_it() -> None:
    def failing() -> Iterator[int]:
        yield 1
        yield 2
        raise ValueError("broken")

    stream = prefetch(failing())
    assert [next(stream), next(stream)] == [1, 2]
    with pytest.raises(ValueError, match="broken"):
        next(stream)


def test_no_more_than_the_depth_is_read_ahead() -> None:
    log: list[str] = []
    stream = prefetch(counting(50, log), depth=3)
    assert next(stream) == 0
    # One is taken, three wait, one is on its way into the queue.
    wait_until(lambda: len(log) == 5)
    time.sleep(0.02)
    assert len(log) == 5
    stream.close()


def test_the_first_item_tells_how_many_more_are_read_ahead() -> None:
    log: list[str] = []
    stream = prefetch(counting(50, log), depth=3, more=lambda first: 4 + first)
    assert next(stream) == 0
    # one is taken, three and four more wait, one is on its way; later items tell nothing
    wait_until(lambda: len(log) == 9)
    time.sleep(0.02)
    assert len(log) == 9
    assert next(stream) == 1
    wait_until(lambda: len(log) == 10)
    stream.close()


def test_error_in_what_the_first_item_tells_belongs_to_the_consumer() -> None:
    stream = prefetch(iter([0]), more=lambda first: 1 // first)
    with pytest.raises(ZeroDivisionError):
        next(stream)


def test_consumer_that_stops_early_ends_the_thread_and_closes_the_source() -> None:
    log: list[str] = []
    stream = prefetch(counting(10**9, log), depth=2)
    assert next(stream) == 0
    assert workers() == 1
    stream.close()
    assert workers() == 0
    assert log[-1] == "closed in mixpose-prefetch"


def test_consumer_that_forgets_the_stream_ends_the_thread() -> None:
    stream = prefetch(counting(10**9, []))
    next(stream)
    del stream
    gc.collect()
    assert workers() == 0


def test_stream_that_is_never_started_has_no_thread() -> None:
    stream = prefetch(counting(5, []))
    assert workers() == 0
    stream.close()


def test_stream_can_be_closed_at_any_moment() -> None:
    for pause in (0.0, 0.0005, 0.001, 0.002):
        for taken in range(4):
            stream = prefetch(counting(5, []), depth=1)
            for _ in range(taken):
                next(stream)
            time.sleep(pause)
            stream.close()
            assert workers() == 0


def test_source_works_while_the_consumer_does() -> None:
    log: list[str] = []
    stream = prefetch(counting(10, log))
    assert next(stream) == 0
    wait_until(lambda: "made 1" in log)
    stream.close()
