"""A WebSocket server (RFC 6455), for pages in a browser."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import TYPE_CHECKING

from mixpose.poses.header import Header
from mixpose.poses.jsonl import header_text
from mixpose.publishing.channel import PublishingRules
from mixpose.publishing.message import Address, Message, Sender
from mixpose.publishing.sockets import keep_little

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

_QUIET = logging.Logger("mixpose", logging.CRITICAL)  # failed connections are not reported


@dataclass(eq=False)
class _Line:
    """A pose line and its delivery."""

    text: str
    waiting: int  # clients that are still to get it
    has_arrived: bool = False  # at any client


@dataclass(eq=False)
class _Client:
    """The lines that wait for one browser."""

    connection: ServerConnection
    waiting: deque[_Line] = field(default_factory=deque)
    sending: _Line | None = None
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    has_gone: bool = False
    began: float = 0.0  # when the current send began

    def is_stuck(self) -> bool:
        """Test whether the browser does not read."""
        now = asyncio.get_running_loop().time()
        return self.sending is not None and now - self.began > PublishingRules.stuck_s


class WebSocketSender(Sender):
    """Listen at ``ws://host:port/path``; clients get the header and all further lines.

    A slow client misses lines.  Requests for other paths are refused, so that a path that nobody
    can guess keeps others out.
    """

    def __init__(self, address: Address, header: Header) -> None:
        address.allow()
        address.needs("websockets", "ws")
        host, port = address.place("ws://127.0.0.1:9871")
        self._path = f"/{address.path}"
        self._header = header_text(header)
        try:
            kind = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._socket = socket.create_server((host, port), family=kind)
            keep_little(self._socket)  # accepted connections inherit it
        except OSError as error:
            raise address.error(
                f"cannot be listened at: {error.strerror}; name a free port of this machine"
            ) from error
        self._clients = set[_Client]()
        self._loop = asyncio.new_event_loop()
        self._end = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="mixpose-ws", daemon=True)
        self._thread.start()

    def send(self, message: Message) -> bool:
        """Queue a line for all clients."""
        if not self._clients:
            return False
        self._loop.call_soon_threadsafe(self._hand_out, message.text)
        return True

    def close(self) -> None:
        """Send the waiting lines, and stop listening."""
        with suppress(RuntimeError):  # closed already
            self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(2 * PublishingRules.farewell_s)

    def _hand_out(self, text: str) -> None:
        line = _Line(text, len(self._clients))
        self.dropped += not line.waiting  # all clients have gone meanwhile
        for client in self._clients:
            if len(client.waiting) == PublishingRules.waiting:
                self._release(client.waiting.popleft())
            client.waiting.append(line)
            client.changed.set()

    def _release(self, line: _Line) -> None:
        """Count one client less for a line; it is dropped if it reached none."""
        line.waiting -= 1
        self.dropped += not (line.waiting or line.has_arrived)

    def _run(self) -> None:
        self._loop.run_until_complete(self._serve())
        self._loop.close()

    async def _serve(self) -> None:
        from websockets.asyncio.server import serve  # noqa: PLC0415 - an extra

        async with serve(
            self._serve_one,
            sock=self._socket,
            process_request=self._refuse_other_paths,
            compression=None,  # which takes longer than it saves
            close_timeout=PublishingRules.farewell_s,
            logger=_QUIET,
        ):
            await self._end.wait()
            deadline = self._loop.time() + PublishingRules.farewell_s
            # until all waiting lines are sent to clients that read
            while self._loop.time() < deadline and any(
                c.waiting or c.sending for c in self._clients if not c.is_stuck()
            ):
                await asyncio.sleep(0.01)
            for client in self._clients:
                if client.is_stuck():
                    client.connection.transport.abort()

    def _refuse_other_paths(
        self, connection: ServerConnection, request: Request
    ) -> Response | None:
        if request.path.rstrip("/") == self._path.rstrip("/"):
            return None
        return connection.respond(HTTPStatus.NOT_FOUND, "mixpose publishes at another path\n")

    async def _serve_one(self, connection: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed  # noqa: PLC0415 - an extra

        client = _Client(connection)
        reading = asyncio.create_task(_heed(connection, client))
        try:
            await connection.send(self._header)
            self._clients.add(client)
            while not client.has_gone:
                await client.changed.wait()
                client.changed.clear()
                while client.waiting:
                    client.began, client.sending = self._loop.time(), client.waiting.popleft()
                    await connection.send(client.sending.text)
                    client.sending.has_arrived = True
                    self._release(client.sending)
                    client.sending = None
        except ConnectionClosed:
            return
        finally:
            self._clients.discard(client)
            for line in (client.sending, *client.waiting):
                if line is not None:
                    self._release(line)
            reading.cancel()


async def _heed(connection: ServerConnection, client: _Client) -> None:
    """Read and drop what a client sends until it goes, so that pings are answered in time."""
    async for _ in connection:
        pass
    client.has_gone = True
    client.changed.set()
