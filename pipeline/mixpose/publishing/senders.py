"""The protocols that poses are published by, by the scheme of their addresses."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from mixpose.poses.header import Header
from mixpose.publishing.address import Address
from mixpose.publishing.lsl import LslSender
from mixpose.publishing.mqtt import MqttSender
from mixpose.publishing.osc import OscSender
from mixpose.publishing.ros2 import ros2_sender
from mixpose.publishing.sender import Sender
from mixpose.publishing.tcp import TcpSender
from mixpose.publishing.udp import UdpSender
from mixpose.publishing.ws import WebSocketSender

SENDERS: Mapping[str, Callable[[Address, Header], Sender]] = {
    "udp": UdpSender,
    "tcp": TcpSender,
    "ws": WebSocketSender,
    "osc": OscSender,
    "lsl": LslSender,
    "mqtt": MqttSender,
    "ros2": ros2_sender,
}
