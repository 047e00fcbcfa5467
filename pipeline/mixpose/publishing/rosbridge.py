"""ROS by a rosbridge: JSON over a WebSocket, where ROS is on another machine or in a container.

https://github.com/RobotWebTools/rosbridge_suite/blob/ros2/ROSBRIDGE_PROTOCOL.md
"""

from __future__ import annotations

import json
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from mixpose.poses.header import Header
from mixpose.publishing.address import Address
from mixpose.publishing.backlog import PublishingRules
from mixpose.publishing.message import Message
from mixpose.publishing.ros_messages import POSE, TRANSFORMS, ros_messages, topics
from mixpose.publishing.sockets import connected, force_down

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

DEFAULT_BRIDGE = "127.0.0.1:9090"


class RosbridgeSender:
    """Publishes to the topics of ``ros2://topic?bridge=host:port``."""

    def __init__(self, address: Address, header: Header) -> None:
        address.needs("websockets", "ros2")
        self._bridge = address.options.get("bridge", DEFAULT_BRIDGE)
        host, _, port = self._bridge.rpartition(":")
        if not (host and port.isdigit() and 0 < int(port) < 2**16):
            raise address.error(f"bridge: found {self._bridge}; allowed: host:port")
        self._place = host.strip("[]"), int(port)
        self._topics = topics(address, header)
        self._connection: ClientConnection | None = None
        self._is_sending = False
        self.dropped = 0

    def connect(self) -> None:
        """Connect, and advertise the topics."""
        from websockets.exceptions import WebSocketException  # noqa: PLC0415 - an extra
        from websockets.sync.client import connect  # noqa: PLC0415

        try:
            self._connection = connect(
                f"ws://{self._bridge}",
                sock=connected(self._place),
                open_timeout=PublishingRules.connect_s,
                close_timeout=PublishingRules.connect_s,
                compression=None,
            )
        except WebSocketException as error:
            raise ConnectionError(f"ws://{self._bridge}: {error}") from error
        for topic in self._topics.poses.values():
            self._say({"op": "advertise", "topic": topic, "type": POSE})
        self._say({"op": "advertise", "topic": self._topics.transforms, "type": TRANSFORMS})

    def send(self, message: Message) -> bool:
        """Publish the pose of one body and its transform."""
        for each in ros_messages(message, self._topics):
            self._say({"op": "publish", "topic": each.topic, "msg": each.fields})
        self._heed()
        return True

    def close(self) -> None:
        """Close the connection; where a send waits, for which its lock is held, by force."""
        if self._connection is None:
            return
        if self._is_sending:
            force_down(self._connection.socket)
        else:
            self._connection.close()

    def _say(self, what: dict[str, Any]) -> None:
        from websockets.exceptions import ConnectionClosed  # noqa: PLC0415 - an extra

        assert self._connection is not None
        self._is_sending = True
        try:
            self._connection.send(json.dumps(what, allow_nan=False))
        except ConnectionClosed as error:
            raise ConnectionError("the rosbridge has gone") from error
        finally:
            self._is_sending = False

    def _heed(self) -> None:
        """Read what the bridge says; it says something only where it refuses."""
        from websockets.exceptions import ConnectionClosed  # noqa: PLC0415 - an extra

        assert self._connection is not None
        with suppress(TimeoutError, ConnectionClosed):
            answer = json.loads(self._connection.recv(timeout=0))
            if answer.get("op") == "status" and answer.get("level") == "error":
                raise ConnectionError(f"the rosbridge refuses: {answer.get('msg')}")
