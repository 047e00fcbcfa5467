"""Messages that are published, addresses of receivers, and protocols by scheme."""

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
from mixpose.poses.jsonl import pose_line
from mixpose.records import Estimate, Moment


@dataclass(frozen=True)
class Address:
    """The parts of an address."""

    text: str  # for messages: without a password
    scheme: str
    host: str  # empty if there is none
    port: int | None
    path: str  # without slashes at its ends
    name: str  # host and path as they are written, for schemes with a name in place of a host
    user: str | None
    password: str | None
    options: Mapping[str, str]  # after the question mark

    def error(self, reason: str) -> SessionError:
        """Return an error about this address."""
        return SessionError(f"--publish {self.text}: {reason}")

    def place(
        self, example: str, port: int | None = None, *, bare: bool = False
    ) -> tuple[str, int]:
        """Return host and port, else `port`, `bare` without a path; or raise with an example."""
        written = self.port or port
        if bare and self.path:
            raise self.error(f"found {self.path!r} behind host and port; allowed: {example}")
        if not self.host or written is None:
            raise self.error(f"found no host and port; allowed: {example}")
        self.require_host(self.host)
        return self.host, written

    def require_host(self, host: str) -> None:
        """Raise an error for an invalid name of a host, like one with two dots in a row."""
        try:
            host.encode("idna")  # as in a look-up
        except UnicodeError:
            raise self.error(
                f"host: found {host!r}; allowed: a number, or words with a dot between them"
            ) from None

    def allow(self, *names: str) -> None:
        """Raise an error for options other than these and those of all addresses."""
        only = {self.options["only"]} if "only" in self.options else set()
        checks = ("option", set(self.options), {*names, "only"}), ("only", only, {"ok"})
        for kind, values, allowed in checks:
            for value in values - allowed:
                listed = ", ".join(sorted(allowed))
                raise self.error(f"{kind}: found {value}; allowed: {listed}")

    def needs(self, package: str, extra: str) -> None:
        """Raise an error that names the extra if a package is not installed."""
        require_package(f"--publish {self.text}", package, extra)


def parse(url: str) -> Address:
    """Split an address into its parts; SessionError if it is none, or has an unknown scheme."""
    allowed = ", ".join(f"{scheme}://" for scheme in SENDERS)
    # messages must not show the password
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
    """An estimate to be sent."""

    estimate: Estimate
    # when its frame was taken, by `time.monotonic`; None for a recording
    moment: Moment | None = None
    ahead_s: float = 0.0  # how much later than the frame the pose is predicted for
    # the time of the pose, s since 1970, the same for all receivers; None for a recording
    unix_s: float | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        if self.age_s is not None:
            object.__setattr__(self, "unix_s", time.time() - self.age_s)

    @property
    def age_s(self) -> float | None:
        """Seconds from the time of the pose to now; negative if it is in the future."""
        return None if self.moment is None else self.late_s - self.ahead_s

    @property
    def late_s(self) -> float:
        """Seconds from the time of the frame to now; 0 for a recording."""
        return 0.0 if self.moment is None else time.monotonic() - self.moment.seconds

    @cached_property
    def text(self) -> str:
        """The pose line with the time of its frame, without a line end."""
        line = pose_line(self.estimate)
        if self.moment is not None:
            line["stamp_s"], line["stamp_of"] = self.unix_s, self.moment.event
        if self.ahead_s:
            line["ahead_s"] = self.ahead_s
        return json.dumps(line, allow_nan=False)


def path_word(label: str) -> str:
    """Return the name of a body in topics and paths, which allow few characters."""
    word = re.sub(r"\W", "_", label, flags=re.ASCII)
    return f"_{word}" if word[:1].isdigit() else word


def path_words(labels: Sequence[str]) -> Mapping[str, str]:
    """Return distinct names of bodies in topics and paths, by label."""
    return dict(zip(labels, distinct(labels, path_word), strict=True))


class TooLargeError(Exception):
    """A message is too large for a protocol; the text says how large, and what to do."""


class Sender:
    """Send poses by one protocol.

    It is made from an `Address` and the `Header` of the run, and raises SessionError if they are
    wrong. Other methods run in a separate thread and may wait; an OSError says that the receiver is
    not there or has gone, a `TooLargeError` that no receiver can get this pose.
    """

    dropped = 0  # poses passed to `send` that reached no receiver

    def connect(self) -> None:
        """Connect to the receiver, if the protocol needs it; again after it was away."""

    def send(self, message: Message) -> bool:
        """Send a pose; return whether there was any receiver."""
        raise NotImplementedError

    def close(self) -> None:
        """Disconnect.  Called from another thread, it ends a `send` that waits."""


# module and class or function that makes a sender; only those in use are imported
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
    """Return the sender of a run's poses to an address; SessionError if it cannot be made."""
    module, _, name = SENDERS[address.scheme].partition(":")
    make: Callable[[Address, Header], Sender] = getattr(
        import_module(f"mixpose.publishing.{module}"), name
    )
    return make(address, header)
