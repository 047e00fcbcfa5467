"""The protocols that poses are published by, by the scheme of their addresses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Protocol

from mixpose.poses.header import Header
from mixpose.publishing.address import Address
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
