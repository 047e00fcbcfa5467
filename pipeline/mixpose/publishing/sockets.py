"""Poses over plain sockets: a poses file by TCP, lines by UDP, and Open Sound Control 1.0."""

from __future__ import annotations

import errno
import re
import socket
import time
from contextlib import suppress
from typing import Any

from mixpose import rigid
from mixpose.poses.header import Header
from mixpose.poses.jsonl import header_text
from mixpose.publishing.channel import PublishingRules
from mixpose.publishing.message import Address, Message, Sender, TooLargeError, path_words

HEADER_S = 1.0
"""Seconds after which the header, with the unit, is repeated for new listeners."""

_NO_OSC = re.compile(r"[^!-~]|[#*,?\[\]{}]")
"""Characters that no address of Open Sound Control 1.0 may have."""

_BY_TCP = "publish to tcp:// or ws://, which carry any size"


def connected(place: tuple[str, int]) -> socket.socket:
    """Return a connection to a host and a port with a small buffer, which sends without delay."""
    connection = socket.create_connection(place, PublishingRules.connect_s)
    connection.settimeout(None)  # a timeout could cut a line
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    keep_little(connection)
    return connection


def keep_little(connection: socket.socket) -> None:
    """Limit the buffer of a connection; by default the system keeps seconds of poses, which age."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, PublishingRules.buffer)


def force_down(connection: socket.socket) -> None:
    """End a connection, also for a thread that waits for it; data already sent still arrives."""
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class Datagrams(Sender):
    """Send datagrams to a host and a port, with or without a listener (RFC 768)."""

    def __init__(self, place: tuple[str, int]) -> None:
        self._place = place
        self._socket: socket.socket | None = None
        self._to: tuple[Any, ...] = ()

    def connect(self) -> None:
        """Look up the host."""
        kind, _, _, _, self._to = socket.getaddrinfo(*self._place, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(kind, socket.SOCK_DGRAM)

    def put(self, data: bytes, name: str, advice: str) -> None:
        """Send a datagram called `name`; a `TooLargeError` says its size, and what to do."""
        assert self._socket is not None
        try:
            self._socket.sendto(data, self._to)
        except OSError as error:
            if error.errno != errno.EMSGSIZE:
                raise
            # the limit depends on systems and networks, 65,507 bytes at most
            size = f"{len(data):,} bytes, more than a datagram can be here"
            raise TooLargeError(f"{name} has {size}; {advice}") from error

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()


class TcpSender(Sender):
    """Send to a receiver that listens at ``tcp://host:port``; the header comes first."""

    def __init__(self, address: Address, header: Header) -> None:
        address.allow()
        self._place = address.place("tcp://127.0.0.1:9870", bare=True)
        self._header = f"{header_text(header)}\n".encode()
        self._socket: socket.socket | None = None

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
        """Close the connection; data already sent still arrives."""
        if self._socket is not None:
            force_down(self._socket)
            self._socket.close()


class UdpSender(Datagrams):
    """Send to ``udp://host:port``, with or without a listener."""

    def __init__(self, address: Address, header: Header) -> None:
        address.allow()
        super().__init__(address.place("udp://127.0.0.1:9870", bare=True))
        self._header = header_text(header).encode()
        self._header_sent_at = float("-inf")

    def send(self, message: Message) -> bool:
        """Send a line, and the header before it every `HEADER_S`."""
        now = time.monotonic()
        if now - self._header_sent_at >= HEADER_S:
            # if it is too large, it is not sent again
            self._header_sent_at = float("inf")
            self.put(self._header, "the header", _BY_TCP)
            self._header_sent_at = now
        estimate = message.estimate
        name = f"the pose of {estimate.label} in frame {estimate.frame}"
        is_labelled = any(report.labels for report in estimate.sensors.values())
        advice = f"leave out --labels, or {_BY_TCP}" if is_labelled else _BY_TCP
        self.put(message.text.encode(), name, advice)
        return True


class OscSender(Datagrams):
    """Send to ``osc://host:port/prefix``, with or without a listener.

    A message ``/prefix/<body>`` has the frame number (i; h beyond 32 bits), the time of the frame
    in seconds (d; of a live source those since 1970), the status (s) and, unless the frame is lost,
    x y z in the unit of the session and the quaternion x y z w (7 f).
    """

    def __init__(self, address: Address, header: Header) -> None:
        address.allow()
        address.needs("pythonosc", "osc")
        super().__init__(address.place("osc://127.0.0.1:9000"))
        prefix = f"/{address.path or 'mixpose'}"
        if invalid := _NO_OSC.search(prefix):
            raise address.error(
                f"found {invalid[0]!r} in the path; allowed: printable ASCII but for space # * , ? "
                "[ ] { }"
            )
        words = path_words(header.labels)
        self._paths = {label: f"{prefix}/{word}" for label, word in words.items()}

    def send(self, message: Message) -> bool:
        """Send the message of one body."""
        from pythonosc.osc_message_builder import OscMessageBuilder  # noqa: PLC0415 - an extra

        estimate = message.estimate
        builder = OscMessageBuilder(self._paths[estimate.label])
        frame = int(estimate.frame)
        builder.add_arg(frame, "i" if -(2**31) <= frame < 2**31 else "h")
        time_s = estimate.time_s if message.unix_s is None else message.unix_s
        builder.add_arg(float(estimate.frame if time_s is None else time_s), "d")
        builder.add_arg(estimate.status, "s")
        T = estimate.T_world_object
        if T is not None:
            for value in (*T[:3, 3].tolist(), *rigid.quaternion_xyzw(T).tolist()):
                builder.add_arg(value, "f")
        name = f"the message of {estimate.label}"
        advice = "shorten the name of the body, or the path of the address"
        self.put(builder.build().dgram, name, advice)
        return True
