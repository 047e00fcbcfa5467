"""Pose lines as a poses file, over a connection (RFC 9293)."""

from __future__ import annotations

import socket

from mixpose.poses.header import Header
from mixpose.publishing.address import Address
from mixpose.publishing.message import Message, header_text
from mixpose.publishing.sockets import connected, force_down


class TcpSender:
    """Connects to ``tcp://host:port``, where a receiver listens; the header comes first."""

    def __init__(self, address: Address, header: Header) -> None:
        address.allow()
        self._place = address.place("tcp://127.0.0.1:9870")
        self._header = f"{header_text(header)}\n".encode()
        self._socket: socket.socket | None = None
        self.dropped = 0

    def connect(self) -> None:
        """Connect, and send the header."""
        self._socket = connected(self._place)
        self._socket.sendall(self._header)

    def send(self, message: Message) -> bool:
        """Send a line."""
        assert self._socket is not None
        self._socket.sendall(f"{message.text}\n".encode())
        return True

    def close(self) -> None:
        """Close the connection; what was sent still arrives."""
        if self._socket is not None:
            force_down(self._socket)
            self._socket.close()
