"""The server of the page: viser on an existing socket, behind a `Guard`."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import viser
import websockets.asyncio.server
from websockets.datastructures import Headers, MultipleValuesError
from websockets.http11 import Request, Response

from mixpose.viewing.address import ASKED_FOR, LOOPBACK, Guard, Place

_MADE_S = 0.01  # between two tests whether the server is made


class _Server(viser.ViserServer):  # type: ignore[misc]
    """A server that ignores requests of a browser to open itself to the outside."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


@contextmanager
def started(place: Place, on_viewers: Callable[[int], None]) -> Iterator[viser.ViserServer]:
    """Run a server on a socket; it reports the number of browsers whenever that changes."""
    # browsers that disconnect or are refused are not reported
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    ready = threading.Event()
    with _behind(place, ready):
        server = _Server(host=LOOPBACK, port=0, verbose=False)

    def count(_: viser.ClientHandle) -> None:
        on_viewers(len(server.get_clients()))

    server.on_client_connect(count)
    server.on_client_disconnect(count)
    ready.set()
    try:
        yield server
    finally:
        server.stop()


@contextmanager
def _behind(place: Place, ready: threading.Event) -> Iterator[None]:
    """Let a server that starts in this context use the socket of a place, and ask its guard first.

    viser offers neither, so the function that it serves with is replaced while it starts. The
    socket accepts browsers from the start; they wait until viser is `ready`. Raises RuntimeError if
    viser started in another way, without the guard.
    """
    original_serve = websockets.asyncio.server.serve
    guard = Guard(place.port, place.token)
    guarded = []

    def serve(handler: Any, *_: Any, process_request: Any, **options: Any) -> Any:
        def process(connection: Any, request: Request) -> Response | None:
            try:
                values = {name: request.headers.get(name) for name in ASKED_FOR}
            except MultipleValuesError:
                values = {}
            present = {name: value for name, value in values.items() if value is not None}
            answer = guard.answer(request.path, present)
            if answer is not None:
                text = answer.text.encode()
                headers = Headers(**answer.headers)
                headers["Content-Type"] = "text/plain; charset=utf-8"
                headers["Content-Length"] = str(len(text))
                return Response(answer.status, answer.status.phrase, headers, text)
            response: Response | None = process_request(connection, request)
            return response

        async def handle(connection: Any) -> None:
            while not ready.is_set():
                await asyncio.sleep(_MADE_S)
            await handler(connection)

        guarded.append(True)
        return original_serve(handle, sock=place.socket, process_request=process, **options)

    websockets.asyncio.server.serve = serve
    try:
        yield
    finally:
        websockets.asyncio.server.serve = original_serve
    if not guarded:
        raise RuntimeError(f"viser {viser.__version__} does not serve as expected")
