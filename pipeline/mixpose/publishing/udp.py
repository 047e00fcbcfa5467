"""Pose lines as datagrams, one in each."""

from __future__ import annotations

import time

from mixpose.poses.header import Header
from mixpose.publishing.address import Address
from mixpose.publishing.message import Message, header_text
from mixpose.publishing.sockets import Datagrams

HEADER_S = 1.0
"""The header, which says the unit, is repeated so often: nobody knows who listens since when."""


class UdpSender(Datagrams):
    """Sends to ``udp://host:port``, whether anybody listens there or not."""

    def __init__(self, address: Address, header: Header) -> None:
        address.allow()
        super().__init__(address.place("udp://127.0.0.1:9870"))
        self._header = header_text(header).encode()
        self._told = float("-inf")
        self.dropped = 0

    def send(self, message: Message) -> bool:
        """Send a line, and from time to time the header before it."""
        now = time.monotonic()
        if now - self._told >= HEADER_S:
            self._told = now
            self.put(self._header)
        self.put(message.text.encode())
        return True
