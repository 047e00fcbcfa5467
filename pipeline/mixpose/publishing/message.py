"""What is published, the addresses it goes to, and the protocols, by the scheme of these."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from urllib.parse import parse_qsl, unquote, urlsplit

from mixpose.errors import SessionError, require_package
from mixpose.naming import distinct
from mixpose.poses.header import Header
from mixpose.poses.jsonl import header_line, pose_line
from mixpose.records import Estimate, Moment


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


def parse(url: str) -> Address:
    """Take an address apart; a `SessionError` if it is none, or of a scheme that is not allowed."""
    allowed = ", ".join(f"{each}://" for each in SENDERS)
    # a password is for the receiver, not for those who read what is said
    text = re.sub(r"//[^/]*@", "//", url)
    try:
        parts = urlsplit(url, allow_fragments=False)
        port = parts.port
    except ValueError as error:
        reason = str(error)
        if "@" in url:  # the error may quote a part of a password that is not quoted itself
            text = re.sub(r"//.*@", "//", url)
            reason = "of a user name or password / ? # @ are written %2F %3F %23 %40"
        raise SessionError(f"--publish {text}: is no address: {reason}") from None
    if parts.scheme not in SENDERS:
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


@dataclass(frozen=True)
class Message:
    """An estimate on its way."""

    estimate: Estimate
    # when its frame was taken, by `time.monotonic`; None of a recording
    moment: Moment | None = None
    ahead_s: float = 0.0  # how much later the pose is foretold for
    # the moment of the pose, s since 1970, the same for all receivers; None of a recording
    unix_s: float | None = field(init=False, default=None)  # the same for all receivers

    def __post_init__(self) -> None:
        if self.age_s is not None:
            object.__setattr__(self, "unix_s", time.time() - self.age_s)

    @property
    def age_s(self) -> float | None:
        """Seconds from the moment that the pose is of to now; negative if it is to come."""
        return None if self.moment is None else self.late_s - self.ahead_s

    @property
    def late_s(self) -> float:
        """Seconds from the moment of the frame to now; 0 of a recording."""
        return 0.0 if self.moment is None else time.monotonic() - self.moment.seconds

    @cached_property
    def text(self) -> str:
        """The pose line, and in it when the frame was taken, without an end of line."""
        line = pose_line(self.estimate)
        if self.moment is not None:
            line["stamp_s"], line["stamp_of"] = self.unix_s, self.moment.event
        if self.ahead_s:
            line["ahead_s"] = self.ahead_s
        return json.dumps(line, allow_nan=False)


def header_text(header: Header) -> str:
    """The header line, without an end of line."""
    return json.dumps(header_line(header), allow_nan=False)


def path_word(label: str) -> str:
    """What a body is called in topics and paths, which allow few characters."""
    word = re.sub(r"\W", "_", label, flags=re.ASCII)
    return f"_{word}" if word[:1].isdigit() else word


def path_words(labels: Sequence[str]) -> Mapping[str, str]:
    """What bodies are called in topics and paths, by label; no two are alike."""
    return dict(zip(labels, distinct(labels, path_word), strict=True))


class TooLargeError(Exception):
    """What a protocol cannot carry: how large it is and what to do, in words."""


class Sender:
    """Sends poses by one protocol.

    It is made with an `Address` and the `Header` of the run, and refuses with a `SessionError` what
    is wrong about them. All else is called in a thread of its own, so that it may wait; an
    `OSError` says that the receiver is not there, or has gone away, a `TooLargeError` that no
    receiver can get this pose.
    """

    dropped = 0  # of the poses that were handed to it those that no receiver got

    def connect(self) -> None:
        """Reach the receiver, where it does not come by itself; again after it was away."""

    def send(self, message: Message) -> bool:
        """Send a pose, and return whether anybody was there to hear it."""
        raise NotImplementedError

    def close(self) -> None:
        """Let go of the receiver.  Called from another thread, it ends a `send` that waits."""


# module and what makes a sender there: only what is asked for is loaded
SENDERS: Mapping[str, str] = {
    "udp": "sockets:UdpSender",
    "tcp": "sockets:TcpSender",
    "ws": "ws:WebSocketSender",
    "osc": "sockets:OscSender",
    "lsl": "lsl:LslSender",
    "mqtt": "mqtt:MqttSender",
    "ros2": "ros2:ros2_sender",
}


def sender_for(address: Address, header: Header) -> Sender:
    """What sends the poses of a run, or a `SessionError` that says why it cannot."""
    module, _, name = SENDERS[address.scheme].partition(":")
    make: Callable[[Address, Header], Sender] = getattr(
        import_module(f"mixpose.publishing.{module}"), name
    )
    return make(address, header)
