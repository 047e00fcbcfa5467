"""What is published, and the protocols by which it is, by the scheme of their addresses."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module

from mixpose.naming import distinct
from mixpose.poses.header import Header
from mixpose.poses.jsonl import header_line, pose_line
from mixpose.publishing.address import Address
from mixpose.records import Estimate, Moment


@dataclass(frozen=True)
class Message:
    """An estimate on its way."""

    estimate: Estimate
    # when its frame was taken, by `time.monotonic`; None of a recording
    moment: Moment | None = None
    ahead_s: float = 0.0  # how much later the pose is foretold for
    # the moment of the pose, s since 1970, the same for all receivers; None of a recording
    unix_s: float | None = field(init=False, default=None)  # the same for all receivers

    def __post_init__(self) -> None:
        if self.age_s is not None:
            object.__setattr__(self, "unix_s", time.time() - self.age_s)

    @property
    def age_s(self) -> float | None:
        """Seconds from the moment that the pose is of to now; negative if it is to come."""
        return None if self.moment is None else self.late_s - self.ahead_s

    @property
    def late_s(self) -> float:
        """Seconds from the moment of the frame to now; 0 of a recording."""
        return 0.0 if self.moment is None else time.monotonic() - self.moment.seconds

    @cached_property
    def text(self) -> str:
        """The pose line, and in it when the frame was taken, without an end of line."""
        line = pose_line(self.estimate)
        if self.moment is not None:
            line["stamp_s"], line["stamp_of"] = self.unix_s, self.moment.event
        if self.ahead_s:
            line["ahead_s"] = self.ahead_s
        return json.dumps(line, allow_nan=False)


def header_text(header: Header) -> str:
    """The header line, without an end of line."""
    return json.dumps(header_line(header), allow_nan=False)


def path_word(label: str) -> str:
    """What a body is called in topics and paths, which allow few characters."""
    word = re.sub(r"\W", "_", label, flags=re.ASCII)
    return f"_{word}" if word[:1].isdigit() else word


def path_words(labels: Sequence[str]) -> Mapping[str, str]:
    """What bodies are called in topics and paths, by label; no two are alike."""
    return dict(zip(labels, distinct(labels, path_word), strict=True))


class TooLargeError(Exception):
    """What a protocol cannot carry: how large it is and what to do, in words."""


class Sender:
    """Sends poses by one protocol.

    It is made with an `Address` and the `Header` of the run, and refuses with a `SessionError` what
    is wrong about them. All else is called in a thread of its own, so that it may wait; an
    `OSError` says that the receiver is not there, or has gone away, a `TooLargeError` that no
    receiver can get this pose.
    """

    dropped = 0  # of the poses that were handed to it those that no receiver got

    def connect(self) -> None:
        """Reach the receiver, where it does not come by itself; again after it was away."""

    def send(self, message: Message) -> bool:
        """Send a pose, and return whether anybody was there to hear it."""
        raise NotImplementedError

    def close(self) -> None:
        """Let go of the receiver.  Called from another thread, it ends a `send` that waits."""


# module and what makes a sender there: only what is asked for is loaded
SENDERS: Mapping[str, str] = {
    "udp": "sockets:UdpSender",
    "tcp": "sockets:TcpSender",
    "ws": "ws:WebSocketSender",
    "osc": "sockets:OscSender",
    "lsl": "lsl:LslSender",
    "mqtt": "mqtt:MqttSender",
    "ros2": "ros2:ros2_sender",
}


def sender_for(address: Address, header: Header) -> Sender:
    """What sends the poses of a run, or a `SessionError` that says why it cannot."""
    module, _, name = SENDERS[address.scheme].partition(":")
    make: Callable[[Address, Header], Sender] = getattr(
        import_module(f"mixpose.publishing.{module}"), name
    )
    return make(address, header)
