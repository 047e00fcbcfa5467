"""Connections whose receivers may be slow, and datagrams that nobody may get."""

from __future__ import annotations

import socket
from contextlib import suppress
from typing import Any

from mixpose.publishing.backlog import PublishingRules


def connected(place: tuple[str, int]) -> socket.socket:
    """A connection to a host and a port, on which little waits and nothing is held back."""
    connection = socket.create_connection(place, PublishingRules.connect_s)
    connection.settimeout(None)  # whoever is slow is waited for: half a line helps nobody
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    keep_little(connection)
    return connection


def keep_little(connection: socket.socket) -> None:
    """Let the system hold few poses: left to itself it takes in seconds of them, and they age."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, PublishingRules.buffer)


def force_down(connection: socket.socket) -> None:
    """End a connection, and what waits for it in another thread; what was sent still arrives."""
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class Datagrams:
    """Datagrams to a host and a port, whether anybody listens there or not (RFC 768)."""

    def __init__(self, place: tuple[str, int]) -> None:
        self._place = place
        self._socket: socket.socket | None = None
        self._to: tuple[Any, ...] = ()

    def connect(self) -> None:
        """Look up the host."""
        kind, _, _, _, self._to = socket.getaddrinfo(*self._place, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(kind, socket.SOCK_DGRAM)

    def put(self, data: bytes) -> None:
        """Send one datagram."""
        assert self._socket is not None
        self._socket.sendto(data, self._to)

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
