"""The run's side of the page: hands moments over, newest first, and waits only where asked to."""

from __future__ import annotations

import multiprocessing
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from typing import TypeAlias

from mixpose.errors import SessionError, require_package
from mixpose.objective import View
from mixpose.pictures.scene import resized, room_for
from mixpose.records import Estimate, Floats, FrameSet, GridPattern, PointPattern, RawFrame, Status
from mixpose.session import Session
from mixpose.viewing.address import listen
from mixpose.viewing.moment import PACE, Moment, Row, Shown, Wish, row_of

_LOOK_S = 0.2
"""How often a wait looks whether it was interrupted; on some systems a wait on a lock is not."""

_LATELY_S = 2.0
"""Over which frames per second are counted."""


_Frame: TypeAlias = tuple[FrameSet, dict[str, Floats], tuple[Estimate, ...]]
"""A frame as the run has it, and what was found in it."""


class Viewer:
    """Shows a run on a page; a context for ``run(watch=...)``, announced once it is entered.

    The page is where a `text` says, as of `mixpose.viewing.address.listen`. A run `on_files` waits
    for a browser before its first frame goes by, no longer than `Pace.patience_s`, and pauses and
    steps as the page says; where nobody looks any more it goes on. One that begins `paused` waits
    for the page for as long as it takes.

    A `SessionError` if the package of the page is missing, or nothing can listen there.
    """

    def __init__(
        self,
        session: Session,
        text: str,
        say: Callable[[str], None],
        *,
        on_files: bool,
        paused: bool = False,
    ) -> None:
        require_package("--view", "viser", "view")
        if paused and not on_files:
            raise SessionError("--pause: a live source does not wait; leave it out")
        self._session = session
        self._say = say
        self._on_files = on_files
        self._state = threading.Condition()
        self._newest: _Frame | None = None
        self._rows: deque[Row] = deque(maxlen=PACE.history)
        self._counts: Counter[Status] = Counter()
        self._instants: deque[float] = deque(maxlen=PACE.history)
        self._estimates: list[Estimate] = []
        self._asked = False  # for another moment
        self._viewers = 0
        self._paused, self._steps = paused, 0
        self._waits_for_page = on_files
        self._patience = float("inf") if paused else PACE.patience_s
        self._ended = self._gone = False
        self._threads: list[threading.Thread] = []
        self._place = listen(text)
        self._address = self._place.address

    def __enter__(self) -> Viewer:
        with ExitStack() as opened:
            self._begin(opened)
            self._opened = opened.pop_all()
        return self

    def _begin(self, opened: ExitStack) -> None:
        """Start the page and what talks to it; an interrupt meanwhile ends both."""
        from mixpose.viewing.process import show  # noqa: PLC0415 - loads drawing

        place = self._place
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        opened.callback(self._close)
        self._process = context.Process(
            target=show,
            args=(place, theirs, self._session, self._on_files, self._paused),
            name="mixpose page",
            daemon=True,
        )
        with _interrupts_ignored():
            self._process.start()
        opened.callback(self._process.kill)
        opened.callback(self._end)
        theirs.close()
        place.socket.close()
        for each in (self._send, self._receive):
            name = f"mixpose page: {each.__name__}"
            thread = threading.Thread(target=each, name=name, daemon=True)
            thread.start()
            self._threads.append(thread)

    def announce(self) -> None:
        """Tell people where the page is, and whether the run waits for it."""
        begins = "; the run begins when it is open" if self._on_files else ""
        limit = f", in {PACE.patience_s:g} s at the latest" if begins and not self._paused else ""
        self._say(f"see {self._address}{begins}{limit}")

    def _close(self) -> None:
        for thread in self._threads:
            thread.join(_LOOK_S)
        self._connection.close()

    def _end(self) -> None:
        """Say that what comes from now on is nothing to warn of."""
        with self._state:
            self._ended = True
            self._state.notify_all()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._end()
        if kind is None:
            with suppress(KeyboardInterrupt):  # the recording is done
                self._stay()
        self._opened.close()

    def _stay(self) -> None:
        """Let those who look see the last frame, for a while."""
        deadline = time.monotonic() + PACE.parting_s
        with self._state:
            if self._viewers and not self._gone:
                self._say(
                    f"the page stays while somebody looks, for {PACE.parting_s:g} s at the most; "
                    "an interrupt (Ctrl-C) ends it"
                )
            while self._viewers and not self._gone and time.monotonic() < deadline:
                self._state.wait(_LOOK_S)

    def watch(self, frame_set: FrameSet, views: Sequence[View], estimate: Estimate) -> None:
        """Take one pose; with the last of a frame, show that if asked to, and wait if paused."""
        self._estimates.append(estimate)
        if len(self._estimates) < len(self._session.labels):
            return
        estimates, self._estimates = tuple(self._estimates), []
        found = {
            view.name: view.observation.pattern.points
            for view in views
            if isinstance(view.observation.pattern, PointPattern)
        }
        with self._state:
            self._newest = frame_set, found, estimates
            self._rows.append(row_of(estimates))
            self._counts.update(one.status for one in estimates)
            self._instants.append(time.monotonic())
            self._state.notify_all()
            if self._on_files:
                self._wait()

    def _wait(self) -> None:
        """Wait for the page to be open, and while the run is paused and somebody looks."""
        deadline = time.monotonic() + self._patience
        while self._waits_for_page and not (self._viewers or self._gone):
            if time.monotonic() > deadline:
                self._say("nobody has opened the page; the run goes on")
                break
            self._state.wait(_LOOK_S)
        self._waits_for_page = False
        while self._paused and not self._steps and self._viewers and not self._gone:
            self._state.wait(_LOOK_S)
        self._steps = max(self._steps - 1, 0)

    def _send(self) -> None:
        """Give the page the newest moment whenever it asks for one."""
        with suppress(OSError):  # it is gone, as `_receive` notices, too
            while (taken := self._next()) is not None:
                self._connection.send(self._moment(*taken))
            self._connection.send(None)  # and the page stays as it is

    def _next(self) -> tuple[_Frame, tuple[Row, ...]] | None:
        """The newest frame and all rows since the last, as soon as they are asked for."""
        with self._state:
            while not self._gone and not (self._asked and self._newest is not None):
                if self._ended and self._newest is None:
                    return None
                self._state.wait(_LOOK_S)
            if self._gone or self._newest is None:
                return None
            frame, rows = self._newest, tuple(self._rows)
            self._newest, self._asked = None, False
            self._rows.clear()
            return frame, rows

    def _moment(self, frame: _Frame, rows: tuple[Row, ...]) -> Moment:
        frame_set, found, estimates = frame
        room = room_for(max(sum(s.sensor.dimension == 2 for s in self._session.sensors), 1))
        sensors = {
            setup.name: _shown(frame_set.frames.get(setup.name), found.get(setup.name), room)
            for setup in self._session.sensors
        }
        # what works out offsets holds the whole frame
        estimates = tuple(replace(one, measured=dict) for one in estimates)
        with self._state:
            since = time.monotonic() - _LATELY_S
            lately = sum(instant > since for instant in self._instants)
            counts = dict(self._counts)
        return Moment(estimates, sensors, rows, counts, lately / _LATELY_S)

    def _receive(self) -> None:
        """Take what the page says until it is gone."""
        with suppress(EOFError, OSError):
            while True:
                message: Wish = self._connection.recv()
                with self._state:
                    if isinstance(message, int):
                        self._viewers = message
                    elif message == "next":
                        self._asked = True
                    elif message == "step":
                        self._paused, self._steps = True, self._steps + 1
                    else:
                        self._paused, self._steps = message == "pause", 0
                    self._state.notify_all()
        with self._state:
            if not self._ended:  # said before the run goes on, which may be at its end by then
                self._say("warning: the page of --view has ended; the run goes on without it")
            self._gone = True
            self._state.notify_all()


def _shown(frame: RawFrame | None, found: Floats | None, room: tuple[int, int]) -> Shown:
    """A frame no larger than the page has room for."""
    if frame is None or isinstance(frame.data, PointPattern | GridPattern):
        return Shown(frame, found=found)
    width, height = frame.data.shape[1], frame.data.shape[0]
    if width <= room[0] and height <= room[1]:
        return Shown(frame, found=found)
    image, zoom = resized(frame.data, room)
    return Shown(replace(frame, data=image), zoom, found)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Let a process that is started here ignore interrupts from the keyboard, as it inherits."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
