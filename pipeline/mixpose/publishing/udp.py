"""Pose lines as datagrams, one in each (RFC 768)."""

from __future__ import annotations

import socket
import time

from mixpose.poses.header import Header
from mixpose.publishing.address import Address
from mixpose.publishing.message import Message, header_text

HEADER_S = 1.0
"""The header, which says the unit, is repeated so often: nobody knows who listens since when."""


class UdpSender:
    """Sends to ``udp://host:port``, whether anybody listens there or not."""

    def __init__(self, address: Address, header: Header) -> None:
        address.allow()
        self._place = address.place("udp://127.0.0.1:9870")
        self._header = header_text(header).encode()
        self._socket: socket.socket | None = None
        self._to: tuple[object, ...] = self._place
        self._told = float("-inf")
        self.dropped = 0

    def connect(self) -> None:
        """Look up the host."""
        kind, _, _, _, to = socket.getaddrinfo(*self._place, type=socket.SOCK_DGRAM)[0]
        self._socket, self._to = socket.socket(kind, socket.SOCK_DGRAM), to

    def send(self, message: Message) -> bool:
        """Send a line, and from time to time the header before it."""
        now = time.monotonic()
        if now - self._told >= HEADER_S:
            self._told = now
            self._put(self._header)
        return self._put(message.text.encode())

    def _put(self, data: bytes) -> bool:
        assert self._socket is not None
        self._socket.sendto(data, self._to)
        return True

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
