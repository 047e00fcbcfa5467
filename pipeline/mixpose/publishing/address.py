"""Where poses are published to, as people write it."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from urllib.parse import parse_qsl, unquote, urlsplit

from mixpose.errors import SessionError, require_package


@dataclass(frozen=True)
class Address:
    """An address, taken apart."""

    text: str  # for messages: without a password
    scheme: str
    host: str  # empty where there is none
    port: int | None
    path: str  # without a slash before it or behind it
    name: str  # host and path as they are written, where they are no host but a name
    user: str | None
    password: str | None
    options: Mapping[str, str]  # what stands behind a question mark

    def error(self, reason: str) -> SessionError:
        """An error about this address."""
        return SessionError(f"--publish {self.text}: {reason}")

    def place(
        self, example: str, port: int | None = None, *, bare: bool = False
    ) -> tuple[str, int]:
        """Host and port, this port where none is written, or an error that shows an example.

        `bare` allows nothing behind them.
        """
        found = self.port or port
        if bare and self.path:
            raise self.error(f"found {self.path!r} behind host and port; allowed: {example}")
        if not self.host or found is None:
            raise self.error(f"found no host and port; allowed: {example}")
        self.require_host(self.host)
        return self.host, found

    def require_host(self, host: str) -> None:
        """Raise an error for what can be no name of a host, as one with two dots in a row."""
        try:
            host.encode("idna")  # as systems look it up
        except UnicodeError:
            raise self.error(
                f"host: found {host!r}; allowed: a number, or words with a dot between them"
            ) from None

    def allow(self, *names: str) -> None:
        """Raise an error for options other than these, and those that all addresses have."""
        values = {self.options["only"]} if "only" in self.options else set()
        checks = ("option", set(self.options), {*names, "only"}), ("only", values, {"ok"})
        for what, found, allowed in checks:
            for each in found - allowed:
                listed = ", ".join(sorted(allowed))
                raise self.error(f"{what}: found {each}; allowed: {listed}")

    def needs(self, package: str, extra: str) -> None:
        """Raise an error that names the extra where a package is not installed."""
        require_package(f"--publish {self.text}", package, extra)


def parse(url: str, schemes: Collection[str]) -> Address:
    """Take an address apart; a `SessionError` if it is none, or of a scheme that is not allowed."""
    allowed = ", ".join(f"{each}://" for each in schemes)
    # a password is for the receiver, not for those who read what is said
    text = re.sub(r"//[^/]*@", "//", url)
    try:
        parts = urlsplit(url, allow_fragments=False)
        port = parts.port
    except ValueError as error:
        raise SessionError(f"--publish {text}: is no address: {error}") from error
    if parts.scheme not in schemes:
        raise SessionError(f"--publish {text}: no address of a receiver; allowed: {allowed}")
    place = parts.netloc.rpartition("@")[2]
    return Address(
        text=text,
        scheme=parts.scheme,
        host=parts.hostname or "",
        port=port,
        path=parts.path.strip("/"),
        name=unquote(f"{place}{parts.path}").strip("/"),
        user=None if parts.username is None else unquote(parts.username),
        password=None if parts.password is None else unquote(parts.password),
        options=dict(parse_qsl(parts.query, keep_blank_values=True)),
    )
