"""Where the page of a run is: the text of ``--view``, the socket, and the address to open."""

from __future__ import annotations

import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass

from mixpose.errors import SessionError

LOOPBACK = "127.0.0.1"
USUAL_PORT = 8080
_LAST_PORT = 65535
_ALLOWED = (
    "allowed are a port (8080; 0 for any that is free), which this machine alone can open, or "
    "HOST:PORT (0.0.0.0:8080) to open it to others"
)
_TEXT = re.compile(r"(?:(?P<host>[^:\[\]\s]+|\[[0-9A-Fa-f:.]+\]):)?(?P<port>[0-9]+)")


@dataclass(frozen=True)
class Place:
    """A listening socket, and who may open what it serves."""

    socket: socket.socket  # bound and listening: a browser that is early waits
    token: str | None  # what the address has to hold; None where only this machine can open it

    @property
    def port(self) -> int:
        """The port that is bound."""
        return int(self.socket.getsockname()[1])

    @property
    def address(self) -> str:
        """What to open in a browser."""
        host = str(self.socket.getsockname()[0])
        if ipaddress.ip_address(host).is_unspecified:  # every network: a name that others know
            host = socket.gethostname()
        host = f"[{host}]" if ":" in host else host
        query = "" if self.token is None else f"?token={self.token}"
        return f"http://{host}:{self.port}/{query}"


def listen(text: str) -> Place:
    """Listen where ``--view`` says: at ``PORT`` or ``HOST:PORT``.

    Empty, that is `USUAL_PORT` of the loopback interface, or any that is free where that one is
    taken. A `SessionError` if it is neither, or nothing can listen there.
    """
    if not text:
        try:
            return _listen(LOOPBACK, USUAL_PORT)
        except OSError:
            text = "0"
    found = _TEXT.fullmatch(text)
    if found is None or int(found["port"]) > _LAST_PORT:
        raise SessionError(f"--view {text}: found no port; {_ALLOWED}")
    host, port = (found["host"] or LOOPBACK).strip("[]"), int(found["port"])
    try:
        return _listen(host, port)
    except OSError as error:
        reason = error.strerror or str(error)
        raise SessionError(
            f"--view {text}: cannot listen there: {reason}; name another port, or 0 for any that "
            "is free"
        ) from error


def _listen(host: str, port: int) -> Place:
    family, _, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    bound = socket.create_server(place[:2], family=family)
    local = ipaddress.ip_address(bound.getsockname()[0]).is_loopback
    return Place(bound, None if local else secrets.token_urlsafe(16))
