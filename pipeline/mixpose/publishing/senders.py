"""The protocols that poses are published by, by the scheme of their addresses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module

from mixpose.poses.header import Header
from mixpose.publishing.address import Address
from mixpose.publishing.sender import Sender

# module and what makes a sender there: only what is asked for is loaded
SENDERS: Mapping[str, str] = {
    "udp": "udp:UdpSender",
    "tcp": "tcp:TcpSender",
    "ws": "ws:WebSocketSender",
    "osc": "osc:OscSender",
    "lsl": "lsl:LslSender",
    "mqtt": "mqtt:MqttSender",
    "ros2": "ros2:ros2_sender",
}


def sender_for(address: Address, header: Header) -> Sender:
    """What sends the poses of a run to an address.

    A `SessionError` if that is not one of its protocol, or its package is not installed.
    """
    module, _, name = SENDERS[address.scheme].partition(":")
    make: Callable[[Address, Header], Sender] = getattr(
        import_module(f"mixpose.publishing.{module}"), name
    )
    return make(address, header)
