"""Runs with a page, and a viewer without a browser: what a page tells, and clicks on it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import viser
import zstandard
from command_line import started
from websockets.sync.client import ClientConnection, connect

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 0.0),
    "fov": 1.0,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 480,
    "image_width": 640,
    "look_at": (0.0, 0.0, 1.0),
    "up_direction": (0.0, 1.0, 0.0),
}
"""With it a browser says that it shows the scene; from then on it counts as open."""


class PageClient:
    """A viewer of a page."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self.elements: dict[str, dict[str, Any]] = {}
        """Elements of the page by what names them, with all that was told of each."""
        self.pictures = 0
        self.statuses: list[str] = []
        self.send(CAMERA)

    def send(self, message: dict[str, Any]) -> None:
        """Say something to the page."""
        self._connection.send(msgspec.msgpack.encode(message))

    def click(self, label: str) -> None:
        """Press a button."""
        button = next(uuid for uuid, one in self.elements.items() if one.get("label") == label)
        self.send({"type": "GuiUpdateMessage", "uuid": button, "updates": {"value": True}})

    def listen(self, timeout: float) -> None:
        """Take what the page tells within some time, or one message of many parts."""
        try:
            data = self._connection.recv(timeout)
        except TimeoutError:
            return
        assert isinstance(data, bytes)
        for message in messages_of(data):
            self._take(message)

    def _take(self, message: dict[str, Any]) -> None:
        name = message.get("uuid") or message.get("name") or message["type"]
        told = {**message.get("props", {}), **message.get("updates", {})}
        self.elements.setdefault(str(name), {"type": message["type"]}).update(told)
        self.pictures += told.get("_data") is not None
        content = told.get("content")
        if isinstance(content, str) and "frame" in content:
            self.statuses.append(content)


@contextmanager
def viewed(
    session: Path, *options: str | Path, place: str = "0"
) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A run with a page, and the address that it told."""
    command = [sys.executable, "-m", "mixpose", "run", str(session), *map(str, options)]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with started([*command, "--view", place], **streams) as process:
        assert process.stderr is not None
        said = process.stderr.readline()
        assert said.startswith("mixpose: see http://"), said + process.stderr.read()
        yield process, said.split()[2].rstrip(";")


def messages_of(data: bytes) -> Iterator[dict[str, Any]]:
    """Messages of one transmission; their arrays are left out."""
    size = int.from_bytes(data[8:16], "little")
    inner = zstandard.ZstdDecompressor().decompress(data[16 : 16 + size])
    yield from msgspec.msgpack.decode(inner)["messages"]


def open_page(address: str, **options: Any) -> ClientConnection:
    """A connection as a browser makes one."""
    return connect(
        address.replace("http://", "ws://"),
        subprotocols=[f"viser-v{viser.__version__}"],
        max_size=None,
        compression=None,
        **options,
    )
