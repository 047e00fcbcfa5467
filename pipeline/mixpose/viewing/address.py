"""Where the page of a run is, and who may open it.

Where only this machine can open it, a page of another site must not either: a browser lets any
site open connections to the loopback interface, and names whoever asks in ``Origin``; a name of
another site that is made to lead here (DNS rebinding) stands in ``Host``.  Where others can open
it, the address that the run told holds a token, which is kept in a cookie from then on.
"""

from __future__ import annotations

import ipaddress
import re
import secrets
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from urllib.parse import parse_qs, urlsplit

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
    except UnicodeError as error:  # of names that can be no host, as one with two dots in a row
        raise SessionError(f"--view {text}: found no host {host!r}; {_ALLOWED}") from error
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


@dataclass(frozen=True)
class Answer:
    """What a request gets in place of the page."""

    text: str
    status: HTTPStatus = HTTPStatus.FORBIDDEN
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Guard:
    """Tells requests that may pass from others."""

    port: int  # of the page; cookies do not tell ports apart
    token: str | None  # None: only this machine can open it

    def answer(self, target: str, headers: Mapping[str, str]) -> Answer | None:
        """What a request for a path and query gets in place of the page; None where it may pass."""
        host = headers.get("Host", "")
        if self.token is None and not _is_loopback(host):
            return Answer(f"Open http://127.0.0.1:{self.port}/ on the machine itself.\n")
        origin = headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc.casefold() != host.casefold():
            return Answer("This page answers no other site.\n")
        if self.token is None:
            return None
        name = f"mixpose-view-{self.port}"
        if self._is_token(parse_qs(urlsplit(target).query).get("token", [""])[0]):
            cookie = f"{name}={self.token}; HttpOnly; SameSite=Lax; Path=/"
            return Answer("", HTTPStatus.SEE_OTHER, {"Location": "/", "Set-Cookie": cookie})
        if self._is_token(_cookie(headers.get("Cookie", ""), name)):
            return None
        return Answer("Open the whole address that the run has told, with its token.\n")

    def _is_token(self, text: str) -> bool:
        # in a time that does not tell how much of it is right
        return secrets.compare_digest(text.encode(), (self.token or "").encode())


ASKED_FOR = ("Host", "Origin", "Cookie")


def _is_loopback(host: str) -> bool:
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


def _cookie(text: str, name: str) -> str:
    # `http.cookies` gives up all of them where one, of another service, is not as it should be
    pairs = (part.partition("=") for part in text.split(";"))
    return next((value.strip() for key, _, value in pairs if key.strip() == name), "")
