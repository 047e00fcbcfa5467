"""Serve the receivers of a run, each in a separate thread, so that none can stop the run."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mixpose.constants import constant
from mixpose.poses.header import Header
from mixpose.poses.writing import require_finite
from mixpose.publishing.message import Address, Message, Sender, TooLargeError, parse, sender_for
from mixpose.records import Estimate, FrameSet

_REMEMBERED = 10_000  # latencies kept: a live source may run for days

Foresee = Callable[[Estimate], Estimate]
"""A function that returns the prediction after an estimate."""


@dataclass(frozen=True)
class PublishingRules:
    """Limits of what a run keeps and waits for receivers."""

    waiting: int = constant(
        100, "poses kept for one receiver: one second of a camera of 100 frames a second"
    )
    buffer: int = constant(2**16, "bytes that the system holds of a connection: some 20 poses")
    retry_s: float = constant(
        0.5, "between attempts to connect to a receiver: 50 frames at 100 a second"
    )
    connect_s: float = constant(2.0, "to connect: a round trip by satellite takes 0.6 s")
    farewell_s: float = constant(2.0, "for poses that still wait at the end: as long as to connect")
    stuck_s: float = constant(
        0.25, "for one send: a receiver that takes longer does not read, and is not waited for"
    )


class Backlog:
    """A queue of messages that drops the oldest when it is full."""

    def __init__(self, most: int) -> None:
        self._messages = deque[Message]()
        self._most = most
        self._changed = threading.Condition()
        self.has_ended = False
        self.dropped = 0

    def put(self, message: Message) -> None:
        """Add the newest message without waiting."""
        with self._changed:
            if len(self._messages) == self._most:
                self._messages.popleft()
                self.dropped += 1
            self._messages.append(message)
            self._changed.notify()

    def put_back(self, message: Message) -> None:
        """Put the message that was taken last back at the front, if there is room."""
        with self._changed:
            if len(self._messages) == self._most:
                self.dropped += 1
            else:
                self._messages.appendleft(message)

    def take(self) -> Message | None:
        """Wait for a message and return the oldest; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._messages or self.has_ended)
            return self._messages.popleft() if self._messages else None

    def end(self) -> None:
        """Announce that no further messages come."""
        with self._changed:
            self.has_ended = True
            self._changed.notify_all()

    def wait_for_end(self, seconds: float) -> bool:
        """Wait at most so many seconds; return whether the end has come."""
        with self._changed:
            return self._changed.wait_for(lambda: self.has_ended, seconds)

    def drop_all(self) -> None:
        """Drop all remaining messages."""
        with self._changed:
            self.dropped += len(self._messages)
            self._messages.clear()


class Channel(threading.Thread):
    """A thread that sends messages to one receiver; it counts and reports what becomes of them."""

    def __init__(
        self,
        address: Address,
        sender: Sender,
        tell: Callable[[str], None],
        rules: PublishingRules,
    ) -> None:
        super().__init__(name="mixpose-publish", daemon=True)
        self._address, self._sender, self._tell, self._rules = address, sender, tell, rules
        self._backlog = Backlog(rules.waiting)
        self._latencies = deque[float](maxlen=_REMEMBERED)
        self._stamped_by: str | None = None
        self._sent = self._unheard = self._too_large = self._failed = 0
        self._is_away = False
        self._began: float | None = None  # when the current send began

    def put(self, message: Message) -> None:
        """Queue a message, unless it is not ok and only ok poses are to be published."""
        if message.estimate.status == "ok" or self._address.options.get("only") != "ok":
            self._backlog.put(message)

    def close(self) -> None:
        """Take no further messages, send the remaining ones for a limited time, and disconnect."""
        self._backlog.end()
        began, rules = self._began, self._rules
        is_stuck = began is not None and time.monotonic() - began > rules.stuck_s
        self.join(0.0 if is_stuck else rules.farewell_s)
        self._sender.close()
        self.join(rules.farewell_s)
        self._backlog.drop_all()

    def text(self) -> str:
        """Return a line: how many poses were sent and dropped, and their latency."""
        lost = self._sender.dropped
        dropped, sent = self._backlog.dropped + lost, self._sent - lost
        text = f"published to {self._address.text}: {sent} pose{'s' * (sent != 1)}"
        text += f", {self._unheard} more while nobody listened" if self._unheard else ""
        text += f", {dropped} dropped: the receiver was away or too slow" if dropped else ""
        text += f", {self._too_large} dropped: too large" if self._too_large else ""
        text += f", {self._failed} dropped: they could not be sent" if self._failed else ""
        if self._latencies:
            median, most = 1e3 * np.quantile(self._latencies, [0.5, 0.99])
            text += f"; {median:.1f} ms after {self._stamped_by}, 99 % within {most:.1f} ms"
        return text

    def run(self) -> None:
        """Connect to the receiver and send, until the end."""
        is_connected = False
        while (message := self._backlog.take()) is not None:
            try:
                if not is_connected:
                    self._sender.connect()
                    is_connected = True
                self._began = time.monotonic()
                heard = self._sender.send(message)
                self._began = None
            except OSError as error:
                self._began = None
                self._backlog.put_back(message)
                if not (self._is_away or (is_connected and self._backlog.has_ended)):
                    self._is_away = True
                    reason = error.strerror or str(error) or type(error).__name__
                    self._tell(
                        f"warning: --publish {self._address.text}: the receiver is away: {reason}; "
                        "the run goes on, and tries to reach it"
                    )
                is_connected = False
                self._sender.close()
                if self._backlog.wait_for_end(self._rules.retry_s):
                    self._backlog.drop_all()
                continue
            except Exception as error:  # of this message alone: the next may succeed
                self._began = None
                self._count_unsent(message, error)
                continue
            if self._is_away:
                self._is_away = False
                self._tell(f"--publish {self._address.text}: the receiver is there")
            self._sent += heard
            self._unheard += not heard
            if message.moment is not None:
                self._latencies.append(message.late_s)
                self._stamped_by = message.moment.event

    def _count_unsent(self, message: Message, error: Exception) -> None:
        """Count a message that cannot be sent; warn of the first of its kind."""
        is_large = isinstance(error, TooLargeError)
        self._too_large += is_large
        self._failed += not is_large
        if is_large and self._too_large == 1:
            self._tell(f"warning: --publish {self._address.text}: {error}; not sent")
        elif not is_large and self._failed == 1:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            self._tell(
                f"warning: --publish {self._address.text}: frame {message.estimate.frame} cannot "
                f"be sent: {reason}; the run goes on"
            )


class Publishing:
    """Publish estimates to receivers, which neither slow nor stop the run.

    `tell` prints messages. For labels in `foresee` the prediction `ahead_s` after an estimate is
    published in its place. Raises SessionError if an address is wrong, its package is not
    installed, or a server cannot listen at it.
    """

    def __init__(
        self,
        urls: Sequence[str],
        header: Header,
        tell: Callable[[str], None],
        foresee: Mapping[str, Foresee] | None = None,
        ahead_s: float = 0.0,
        rules: PublishingRules = PublishingRules(),
    ) -> None:
        self._foresee, self._ahead_s, self._tell = foresee or {}, ahead_s, tell
        addresses = [parse(url) for url in urls]
        self._channels = [Channel(a, sender_for(a, header), tell, rules) for a in addresses]

    def __enter__(self) -> Publishing:
        for channel in self._channels:
            channel.start()
        return self

    def __exit__(self, *_: object) -> None:
        closing = [threading.Thread(target=channel.close) for channel in self._channels]
        for thread in closing:
            thread.start()
        for thread in closing:
            thread.join()
        for channel in self._channels:
            self._tell(channel.text())

    def watch(self, frame_set: FrameSet, _: object, estimate: Estimate) -> None:
        """Publish an estimate; SessionError if it is to be predicted and has no time."""
        require_finite(estimate)
        # without `measured`, which refers to all data of the frame
        estimate = replace(estimate, measured=dict)
        foresee = self._foresee.get(estimate.label)
        if foresee is not None:
            estimate = foresee(estimate)
        message = Message(estimate, frame_set.moment, self._ahead_s if foresee else 0.0)
        for channel in self._channels:
            channel.put(message)
