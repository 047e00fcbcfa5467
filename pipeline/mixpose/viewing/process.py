"""The process of the page: asks for moments as fast as browsers show them, and draws them."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING

from mixpose.session import Session
from mixpose.viewing.address import Place
from mixpose.viewing.moment import PACE, Moment, PageMessage

if TYPE_CHECKING:  # an extra
    from mixpose.viewing.page import Page

_LOOK_S = 0.05
_NICENESS = 5  # the run has priority if there are few processors


def show(
    place: Place, connection: Connection, session: Session, on_files: bool, paused: bool
) -> None:
    """Show the moments that come through a pipe until it ends.

    Runs `on_files` can be paused, and may begin `paused`.
    """
    _be_quiet()
    from mixpose.viewing.page import Page  # noqa: PLC0415 - an extra
    from mixpose.viewing.server import started  # noqa: PLC0415

    messages = RunMessages(connection)
    with started(place, on_viewers=messages.send_viewers) as server:
        page = Page(server, session, messages.send if on_files else None, paused=paused)
        with suppress(EOFError, OSError):  # the run has ended
            _play(connection, messages, page)


def _play(connection: Connection, messages: RunMessages, page: Page) -> None:
    is_requested, ready_at = False, 0.0
    while True:
        if not is_requested and messages.viewers and time.monotonic() >= ready_at:
            messages.send("next")
            is_requested = True
        if not connection.poll(_LOOK_S if is_requested or not messages.viewers else 1e-3):
            continue
        moment: Moment | None = connection.recv()
        if moment is None:
            page.end()
            continue
        began = time.monotonic()
        page.show(moment)
        took = time.monotonic() - began
        ready_at = began + max(1.0 / PACE.most_per_second, took / PACE.share)
        is_requested = False


class RunMessages:
    """Messages of the page to the run, from any thread."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._lock = threading.Lock()
        self.viewers = 0

    def send(self, message: PageMessage) -> None:
        """Send a message to the run."""
        with self._lock:
            self._connection.send(message)

    def send_viewers(self, count: int) -> None:
        """Send the number of browsers that show the page."""
        self.viewers = count
        self.send(count)


def _be_quiet() -> None:
    """Leave interrupts and standard output, which may take poses, to the run."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)
    sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115, PTH123
    if hasattr(os, "nice"):
        os.nice(_NICENESS)
    import cv2  # noqa: PLC0415

    cv2.setNumThreads(1)
