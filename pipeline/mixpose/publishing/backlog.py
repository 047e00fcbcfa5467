"""What waits for a receiver: little, and of too much the newest."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

from mixpose.constants import constant
from mixpose.publishing.message import Message


@dataclass(frozen=True)
class PublishingRules:
    """How long receivers are waited for."""

    waiting: int = constant(
        100, "poses for one receiver: a second of a camera that gives 100 frames in it"
    )
    buffer: int = constant(2**16, "bytes that the system holds of a connection: some 20 poses")
    retry_s: float = constant(
        0.5, "between attempts to reach a receiver: 50 frames at 100 a second"
    )
    connect_s: float = constant(2.0, "to reach a receiver: a round trip by satellite takes 0.6 s")
    farewell_s: float = constant(2.0, "for what still waits at the end: as long as to connect")
    stuck_s: float = constant(
        0.25, "in one send: longer takes a receiver that does not read, which no end waits for"
    )


class Backlog:
    """Messages in their order; when there are too many, the oldest goes."""

    def __init__(self, most: int) -> None:
        self._messages = deque[Message]()
        self._most = most
        self._changed = threading.Condition()
        self.has_ended = False
        self.dropped = 0

    def put(self, message: Message) -> None:
        """Add the newest message, at once."""
        with self._changed:
            if len(self._messages) == self._most:
                self._messages.popleft()
                self.dropped += 1
            self._messages.append(message)
            self._changed.notify()

    def put_back(self, message: Message) -> None:
        """Add again the one that was taken last, if there is room for it."""
        with self._changed:
            if len(self._messages) == self._most:
                self.dropped += 1
            else:
                self._messages.appendleft(message)

    def take(self) -> Message | None:
        """The oldest message, as soon as there is one; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._messages or self.has_ended)
            return self._messages.popleft() if self._messages else None

    def end(self) -> None:
        """No further messages come."""
        with self._changed:
            self.has_ended = True
            self._changed.notify_all()

    def waits_for_end(self, seconds: float) -> bool:
        """Whether the end comes within some seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: self.has_ended, seconds)

    def give_up(self) -> None:
        """Drop all that is left."""
        with self._changed:
            self.dropped += len(self._messages)
            self._messages.clear()
