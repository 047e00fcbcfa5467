"""One receiver, served in a thread of its own: whatever it does, the run goes on."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from mixpose.publishing.address import Address
from mixpose.publishing.backlog import Backlog, PublishingRules
from mixpose.publishing.message import Message
from mixpose.publishing.sender import Sender

_REMEMBERED = 10_000  # latencies: a live source may run for days


class Channel:
    """Sends messages to one receiver, and counts and tells what becomes of them."""

    def __init__(
        self,
        address: Address,
        sender: Sender,
        tell: Callable[[str], None],
        rules: PublishingRules = PublishingRules(),
    ) -> None:
        self._address, self._sender, self._tell, self._rules = address, sender, tell, rules
        self._backlog = Backlog(rules.waiting)
        self._latencies = deque[float](maxlen=_REMEMBERED)
        self._stamped_by: str | None = None
        self._sent = self._unheard = 0
        self._is_away = False
        self._began: float | None = None  # when the send began that goes on
        self._thread = threading.Thread(target=self._work, name="mixpose-publish", daemon=True)

    def start(self) -> None:
        """Begin to reach the receiver."""
        self._thread.start()

    def put(self, message: Message) -> None:
        """Send a message when its turn comes."""
        if message.estimate.status == "ok" or self._address.options.get("only") != "ok":
            self._backlog.put(message)

    def end(self) -> None:
        """Nothing more is put."""
        self._backlog.end()

    def close(self) -> None:
        """After the end: send what still waits, but not for long, and let go."""
        began, rules = self._began, self._rules
        is_stuck = began is not None and time.monotonic() - began > rules.stuck_s
        self._thread.join(0.0 if is_stuck else rules.farewell_s)
        self._sender.close()
        self._thread.join(rules.farewell_s)
        self._backlog.give_up()

    def text(self) -> str:
        """One line: how many poses were sent, dropped, and how late they were."""
        dropped = self._backlog.dropped + self._sender.dropped
        text = f"published to {self._address.text}: {self._sent} pose{'s' * (self._sent != 1)}"
        text += f", {self._unheard} more while nobody listened" if self._unheard else ""
        text += f", {dropped} dropped: the receiver was away or too slow" if dropped else ""
        if self._latencies:
            median, most = 1e3 * np.quantile(self._latencies, [0.5, 0.99])
            text += f"; {median:.1f} ms after {self._stamped_by}, 99 % within {most:.1f} ms"
        return text

    def _work(self) -> None:
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
                if not (is_connected and self._backlog.has_ended):
                    self._is_now_away(error)
                is_connected = False
                self._sender.close()
                if self._backlog.waits_for_end(self._rules.retry_s):
                    self._backlog.give_up()
                continue
            self._is_now_there()
            self._count(message, heard)

    def _count(self, message: Message, heard: bool) -> None:
        self._sent += heard
        self._unheard += not heard
        if message.moment is not None:
            self._latencies.append(message.late_s)
            self._stamped_by = message.moment.of

    def _is_now_away(self, error: OSError) -> None:
        if not self._is_away:
            self._is_away = True
            reason = error.strerror or str(error) or type(error).__name__
            self._tell(
                f"warning: --publish {self._address.text}: the receiver is away: {reason}; the run "
                "goes on, and tries to reach it"
            )

    def _is_now_there(self) -> None:
        if self._is_away:
            self._is_away = False
            self._tell(f"--publish {self._address.text}: the receiver is there")
