"""Read ahead: an iterator that works in a thread while its consumer works on the last item."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Generator, Iterator
from queue import SimpleQueue
from typing import TypeVar

T = TypeVar("T")


def prefetch(
    items: Iterator[T], depth: int = 3, more: Callable[[T], int] | None = None
) -> Generator[T, None, None]:
    """Yield `items` in order while a worker thread fetches the next ones.

    The thread has ended when this generator is exhausted, closed or collected; `items` is advanced,
    and closed if it can be, in that thread only. An exception of theirs comes out in its place. At
    most `depth` items wait, one more may be on its way; `more`, told the first item, says how many
    more may wait.
    """
    # items, each by itself in a tuple, and in the end what was raised, or None
    waiting: SimpleQueue[tuple[T] | BaseException | None] = SimpleQueue()
    room: SimpleQueue[None] = SimpleQueue()
    for _ in range(max(depth, 1)):
        room.put(None)
    stop = threading.Event()
    worker = threading.Thread(
        target=_fetch, args=(items, waiting, room, stop, more), name="mixpose-prefetch", daemon=True
    )
    worker.start()
    try:
        while isinstance(entry := waiting.get(), tuple):
            room.put(None)
            yield entry[0]
        if entry is not None:
            raise entry
    finally:
        stop.set()
        room.put(None)  # a worker that waits for room goes on, and stops
        # The garbage collector may close this generator in the worker's own thread.
        if worker is not threading.current_thread():
            worker.join()


def _fetch(
    items: Iterator[T],
    waiting: SimpleQueue[tuple[T] | BaseException | None],
    room: SimpleQueue[None],
    stop: threading.Event,
    more: Callable[[T], int] | None,
) -> None:
    """Move items to the queue, one for each piece of room, until they end, fail or are stopped."""
    # two plain queues cost less than one that is bounded: their locks are not Python's
    error: BaseException | None = None
    try:
        with contextlib.ExitStack() as closing:
            closing.callback(getattr(items, "close", lambda: None))
            for item in items:
                for _ in range(more(item) if more else 0):
                    room.put(None)
                more = None
                room.get()
                if stop.is_set():
                    break
                waiting.put((item,))
    except BaseException as caught:  # whatever it is, it belongs to the consumer
        error = caught
    if not stop.is_set():
        waiting.put(error)
