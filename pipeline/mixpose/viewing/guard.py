"""Who may open the page: what a request has to bring, before anything answers it.

Where only this machine can open it, a page of another site must not either: a browser lets any
site open connections to the loopback interface, and names whoever asks in ``Origin``; a name of
another site that is made to lead here (DNS rebinding) stands in ``Host``.  Where others can open
it, the address that the run told holds a token, which is kept in a cookie from then on.
"""

from __future__ import annotations

import ipaddress
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit


@dataclass(frozen=True)
class Answer:
    """What a request gets in place of the page."""

    status: HTTPStatus
    text: str
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Guard:
    """Tells requests that may pass from others."""

    port: int  # of the page; cookies do not tell ports apart
    token: str | None  # None: only this machine can open it

    def answer(self, target: str, headers: Mapping[str, str]) -> Answer | None:
        """What a request gets in place of the page; None where it may pass.

        Its target is path and query, its headers those of `ASKED_FOR` that it has, each once.
        """
        host = headers.get("Host", "")
        if self.token is None and not _is_loopback(host):
            return Answer(
                HTTPStatus.FORBIDDEN, f"Open http://127.0.0.1:{self.port}/ on the machine itself.\n"
            )
        origin = headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc.casefold() != host.casefold():
            return Answer(HTTPStatus.FORBIDDEN, "This page answers no other site.\n")
        if self.token is None:
            return None
        name = f"mixpose-view-{self.port}"
        if self._is_token(parse_qs(urlsplit(target).query).get("token", [""])[0]):
            cookie = f"{name}={self.token}; HttpOnly; SameSite=Lax; Path=/"
            return Answer(HTTPStatus.SEE_OTHER, "", {"Location": "/", "Set-Cookie": cookie})
        if self._is_token(_cookie(headers.get("Cookie", ""), name)):
            return None
        return Answer(
            HTTPStatus.FORBIDDEN, "Open the whole address that the run has told, with its token.\n"
        )

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
    try:
        found = SimpleCookie(text).get(name)
    except CookieError:
        return ""
    return "" if found is None else found.value
