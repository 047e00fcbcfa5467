"""What every protocol must do."""

from __future__ import annotations

from typing import Protocol

from mixpose.publishing.message import Message


class Sender(Protocol):
    """Sends poses by one protocol.

    It is made with an `Address` and the `Header` of the run, and refuses with a `SessionError` what
    is wrong about them. All else is called in a thread of its own, so that it may wait; an
    `OSError` says that the receiver is not there, or has gone away.
    """

    @property
    def dropped(self) -> int:
        """Poses that some receiver did not get because it is slower than others."""

    def connect(self) -> None:
        """Reach the receiver; called again after it was away."""

    def send(self, message: Message) -> bool:
        """Send a pose, and return whether anybody was there to hear it."""

    def close(self) -> None:
        """Let go of the receiver.  Called from another thread, it ends a `send` that waits."""
