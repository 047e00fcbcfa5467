"""The address of the page of a run, and access to it.

If only this machine can open the page, scripts of other sites must not: a browser lets any site
connect to the loopback interface, but names that site in ``Origin``; a name of another site that
is made to lead here (DNS rebinding) is in ``Host``.  If other machines can open it, the printed
address has a token, which a cookie keeps from then on.
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
    """A listening socket, and the token that a browser needs."""

    socket: socket.socket  # bound and listening: an early browser waits
    token: str | None  # part of the address; None if only this machine can open it

    @property
    def port(self) -> int:
        """The port that is bound."""
        return int(self.socket.getsockname()[1])

    @property
    def address(self) -> str:
        """The address to open in a browser."""
        host = str(self.socket.getsockname()[0])
        if ipaddress.ip_address(host).is_unspecified:  # all networks: name this machine instead
            host = socket.gethostname()
        host = f"[{host}]" if ":" in host else host
        query = "" if self.token is None else f"?token={self.token}"
        return f"http://{host}:{self.port}/{query}"


def listen(text: str) -> Place:
    """Listen at the ``PORT`` or ``HOST:PORT`` of ``--view``.

    An empty text is `USUAL_PORT` of the loopback interface or, if that is taken, any free port.
    Raises SessionError if the text has another form, or the port cannot be used.
    """
    if not text:
        try:
            return _listen(LOOPBACK, USUAL_PORT)
        except OSError:
            text = "0"
    match = _TEXT.fullmatch(text)
    if match is None or int(match["port"]) > _LAST_PORT:
        raise SessionError(f"--view {text}: found no port; {_ALLOWED}")
    host, port = (match["host"] or LOOPBACK).strip("[]"), int(match["port"])
    try:
        return _listen(host, port)
    except UnicodeError as error:  # of invalid names, like those with two dots in a row
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
    """A reply to a request in place of the page."""

    text: str
    status: HTTPStatus = HTTPStatus.FORBIDDEN
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Guard:
    """Decide which requests may reach the page."""

    port: int  # of the page; part of the cookie's name, as cookies are shared by all ports
    token: str | None  # None if only this machine can open it

    def answer(self, target: str, headers: Mapping[str, str]) -> Answer | None:
        """Return the reply to a request in place of the page; None if it may pass."""
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
        # in constant time, which does not show how many characters are right
        return secrets.compare_digest(text.encode(), (self.token or "").encode())


ASKED_FOR = ("Host", "Origin", "Cookie")


def _is_loopback(host: str) -> bool:
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


def _cookie(text: str, name: str) -> str:
    # `http.cookies` rejects all cookies if one, of another service, is malformed
    pairs = (part.partition("=") for part in text.split(";"))
    return next((value.strip() for key, _, value in pairs if key.strip() == name), "")
