"""Read ahead: run an iterator in a thread while its consumer works on the last item."""

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

    The thread ends when this generator is exhausted, closed or collected; only that thread advances
    `items`, and closes it if it can be closed. An exception of `items` is raised in its place. At
    most `depth` items wait, and another may be on its way; `more` is called with the first item and
    returns how many more may wait.
    """
    # items in tuples of one, and in the end the exception raised, or None
    waiting: SimpleQueue[tuple[T] | BaseException | None] = SimpleQueue()
    room: SimpleQueue[None] = SimpleQueue()
    for _ in range(max(depth, 1)):
        room.put(None)
    stop = threading.Event()

    def fetch() -> None:
        """Move items to the queue as there is room, until they end, fail or are stopped."""
        # two unbounded queues cost less than a bounded one, as their locks are not in Python
        error: BaseException | None = None
        try:
            with contextlib.ExitStack() as closing:
                closing.callback(getattr(items, "close", lambda: None))
                for k, item in enumerate(items):
                    for _ in range(more(item) if more and not k else 0):
                        room.put(None)
                    room.get()
                    if stop.is_set():
                        break
                    waiting.put((item,))
        except BaseException as caught:  # the consumer raises it
            error = caught
        if not stop.is_set():
            waiting.put(error)

    worker = threading.Thread(target=fetch, name="mixpose-prefetch", daemon=True)
    worker.start()
    try:
        while isinstance(entry := waiting.get(), tuple):
            room.put(None)
            yield entry[0]
        if entry is not None:
            raise entry
    finally:
        stop.set()
        room.put(None)  # wakes a worker that waits for room, so that it stops
        # the garbage collector may close this generator in the thread of the worker
        if worker is not threading.current_thread():
            worker.join()
