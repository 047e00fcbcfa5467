"""The run's side of the page: sends the newest moment on request, and waits if asked to."""

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
from mixpose.viewing.moment import PACE, Moment, PageMessage, Row, ShownFrame, row_of

_LOOK_S = 0.2
"""Longest wait in seconds, after which interrupts come; some systems delay them during waits."""

_LATELY_S = 2.0
"""Seconds over which frames per second are counted."""


_Frame: TypeAlias = tuple[FrameSet, dict[str, Floats], tuple[Estimate, ...]]
"""A frame set, its features by sensor, and the estimates of all bodies."""


class Viewer:
    """Show a run on a page; a context manager, whose `watch` goes to ``run(watch=...)``.

    `text` is the address for `mixpose.viewing.address.listen`. A run `on_files` waits for a browser
    after its first frame, for at most `Pace.patience_s`; the page can pause it and let it step, and
    it goes on when no browser is left. A run that begins `paused` waits for the page without limit.

    Raises SessionError if the package of the page is missing, or the address cannot be used.
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
        self._is_requested = False  # for another moment
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
        """Start the page and the threads that serve it; an interrupt meanwhile ends both."""
        from mixpose.viewing.process import show  # noqa: PLC0415 - loads drawing

        place = self._place
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        opened.callback(self._close)
        shown = place, theirs, self._session, self._on_files, self._paused
        self._process = context.Process(target=show, args=shown, name="mixpose page", daemon=True)
        with _interrupts_ignored():
            self._process.start()
        opened.callback(self._process.kill)
        opened.callback(self._end)
        theirs.close()
        place.socket.close()
        for target in (self._send, self._receive):
            name = f"mixpose page: {target.__name__}"
            thread = threading.Thread(target=target, name=name, daemon=True)
            thread.start()
            self._threads.append(thread)

    def announce(self) -> None:
        """Print the address of the page, and whether the run waits for it."""
        begins = "; the run begins when it is open" if self._on_files else ""
        limit = f", in {PACE.patience_s:g} s at the latest" if begins and not self._paused else ""
        self._say(f"see {self._address}{begins}{limit}")

    def _close(self) -> None:
        for thread in self._threads:
            thread.join(_LOOK_S)
        self._connection.close()

    def _end(self) -> None:
        """Note the end of the run, after which the end of the page needs no warning."""
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
        """Keep the page open for a while as long as browsers show it."""
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
        """Take a pose; with the last of a frame, offer it to the page, and wait if paused."""
        self._estimates.append(estimate)
        if len(self._estimates) < len(self._session.labels):
            return
        estimates, self._estimates = tuple(self._estimates), []
        patterns = {view.name: view.observation.pattern for view in views}
        features = {n: p.points for n, p in patterns.items() if isinstance(p, PointPattern)}
        with self._state:
            self._newest = frame_set, features, estimates
            self._rows.append(row_of(estimates))
            self._counts.update(estimate.status for estimate in estimates)
            self._instants.append(time.monotonic())
            self._state.notify_all()
            if self._on_files:
                self._wait()

    def _wait(self) -> None:
        """Wait until the page is open, and while the run is paused and a browser shows it."""
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
        """Send the newest moment to the page whenever it asks for one."""
        with suppress(OSError):  # the page has ended, which `_receive` reports
            while (update := self._next()) is not None:
                self._connection.send(self._moment(*update))
            self._connection.send(None)  # the end, after which the page stays as it is

    def _next(self) -> tuple[_Frame, tuple[Row, ...]] | None:
        """Wait for a request; return the newest frame and all rows since the last."""
        with self._state:
            while not self._gone and not (self._is_requested and self._newest is not None):
                if self._ended and self._newest is None:
                    return None
                self._state.wait(_LOOK_S)
            if self._gone or self._newest is None:
                return None
            frame, rows = self._newest, tuple(self._rows)
            self._newest, self._is_requested = None, False
            self._rows.clear()
            return frame, rows

    def _moment(self, frame: _Frame, rows: tuple[Row, ...]) -> Moment:
        frame_set, features, estimates = frame
        room = room_for(max(sum(s.sensor.dimension == 2 for s in self._session.sensors), 1))
        sensors = {
            setup.name: _resized(frame_set.frames.get(setup.name), features.get(setup.name), room)
            for setup in self._session.sensors
        }
        # without `measured`, which refers to all data of the frame
        estimates = tuple(replace(estimate, measured=dict) for estimate in estimates)
        with self._state:
            since = time.monotonic() - _LATELY_S
            lately = sum(instant > since for instant in self._instants)
            counts = dict(self._counts)
        return Moment(estimates, sensors, rows, counts, lately / _LATELY_S)

    def _receive(self) -> None:
        """Receive messages of the page until it ends."""
        with suppress(EOFError, OSError):
            while True:
                message: PageMessage = self._connection.recv()
                with self._state:
                    if isinstance(message, int):
                        self._viewers = message
                    elif message == "next":
                        self._is_requested = True
                    elif message == "step":
                        self._paused, self._steps = True, self._steps + 1
                    else:
                        self._paused, self._steps = message == "pause", 0
                    self._state.notify_all()
        with self._state:
            if not self._ended:  # printed before the run goes on, as that may be near its end
                self._say("warning: the page of --view has ended; the run goes on without it")
            self._gone = True
            self._state.notify_all()


def _resized(frame: RawFrame | None, features: Floats | None, room: tuple[int, int]) -> ShownFrame:
    """Return a frame for the page, its image no larger than the room for it."""
    if frame is None or isinstance(frame.data, PointPattern | GridPattern):
        return ShownFrame(frame, features=features)
    width, height = frame.data.shape[1], frame.data.shape[0]
    if width <= room[0] and height <= room[1]:
        return ShownFrame(frame, features=features)
    image, zoom = resized(frame.data, room)
    return ShownFrame(replace(frame, data=image), zoom, features)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Start processes in this context so that they ignore interrupts from the keyboard."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
