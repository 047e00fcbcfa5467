"""ROS 2: by rclpy if ROS is installed, else by a rosbridge.

rclpy comes with ROS only, and is in no package index.  A rosbridge takes JSON over a WebSocket, for
ROS on another machine or in a container:
https://github.com/RobotWebTools/rosbridge_suite/blob/ros2/ROSBRIDGE_PROTOCOL.md
"""

from __future__ import annotations

import array
import importlib
import json
from collections.abc import Mapping
from contextlib import suppress
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

from mixpose.poses.header import Header
from mixpose.poses.writers import pose_message
from mixpose.publishing.channel import PublishingRules
from mixpose.publishing.message import Address, Message, Sender, path_word, path_words
from mixpose.publishing.sockets import connected, force_down

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

DEFAULT_BRIDGE = "127.0.0.1:9090"
TRANSFORMS = "/tf"
_DEPTH = 10  # of the queues of publishers, as in ROS's examples


def ros2_sender(address: Address, header: Header) -> Sender:
    """Return the sender for ``ros2://topic``; by a bridge for ``?bridge=host:port``."""
    address.allow("bridge", "frame")
    if "bridge" in address.options or find_spec("rclpy") is None:
        return RosbridgeSender(address, header)
    return RosNodeSender(address, header)


class Topics(NamedTuple):
    """Topics of the poses of a run, and their reference frame."""

    poses: Mapping[str, str]  # by label of a body
    frames: Mapping[str, str]  # by label, the frames of bodies in transforms
    unit: str
    frame_id: str

    @property
    def kinds(self) -> dict[str, str]:
        """The kind of messages by topic, transforms last."""
        kinds = dict.fromkeys(self.poses.values(), "geometry_msgs/msg/PoseWithCovarianceStamped")
        return {**kinds, TRANSFORMS: "tf2_msgs/msg/TFMessage"}


def topics(address: Address, header: Header) -> Topics:
    """Return the topics by ``ros2://topic``, one per body below it if there are several."""
    names = address.name.split("/")
    if not all(part == path_word(part) and part for part in names):
        raise address.error(
            f"topic: found {address.name or 'none'}; allowed: words of letters, digits and _ with "
            "slashes between them, as in ros2://tracker"
        )
    base = f"/{address.name}"
    words = path_words(header.labels)
    poses = {label: f"{base}/{word}" for label, word in words.items()}
    if len(poses) == 1:
        poses = dict.fromkeys(poses, base)
    return Topics(poses, words, header.unit, address.options.get("frame", "world"))


def ros_messages(message: Message, targets: Topics) -> list[tuple[str, dict[str, Any]]]:
    """Return pose and transform of a message, in metres, as topics and fields; none if lost.

    The stamp is when the frame was taken: Unix time of a live source, the time of a recording's
    frame or, without times, its number.
    """
    estimate = message.estimate
    if estimate.T_world_object is None:
        return []
    recorded = estimate.frame if estimate.time_s is None else estimate.time_s
    seconds = float(recorded if message.unix_s is None else message.unix_s)
    fields = pose_message(estimate, targets.unit, seconds, targets.frame_id)
    pose = fields["pose"]["pose"]
    transform = {
        "header": fields["header"],
        "child_frame_id": targets.frames[estimate.label],
        "transform": {"translation": pose["position"], "rotation": pose["orientation"]},
    }
    return [
        (targets.poses[estimate.label], fields),
        (TRANSFORMS, {"transforms": [transform]}),
    ]


class RosNodeSender(Sender):
    """Publish to the topics of ``ros2://topic`` from a node ``mixpose``."""

    def __init__(self, address: Address, header: Header) -> None:
        self._topics = topics(address, header)
        rclpy = importlib.import_module("rclpy")
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("mixpose", context=self._context)
        self._kinds = {topic: _type(kind) for topic, kind in self._topics.kinds.items()}
        self._publishers = {
            topic: self._node.create_publisher(kind, topic, _DEPTH)
            for topic, kind in self._kinds.items()
        }

    def send(self, message: Message) -> bool:
        """Publish the pose of one body and its transform."""
        for topic, fields in ros_messages(message, self._topics):
            self._publishers[topic].publish(_filled(self._kinds[topic](), fields))
        return any(publisher.get_subscription_count() for publisher in self._publishers.values())

    def close(self) -> None:
        """End the node."""
        self._node.destroy_node()
        self._context.try_shutdown()


def _type(kind: str) -> Any:
    package, _, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def _filled(message: Any, fields: dict[str, Any]) -> Any:
    """Set the fields of a message and of its parts; return it."""
    for name, value in fields.items():
        if isinstance(value, dict):
            _filled(getattr(message, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            message_type = _type("geometry_msgs/msg/TransformStamped")
            setattr(message, name, [_filled(message_type(), entry) for entry in value])
        elif isinstance(value, list):
            setattr(message, name, array.array("d", value))
        else:
            setattr(message, name, value)
    return message


class RosbridgeSender(Sender):
    """Publish to the topics of ``ros2://topic?bridge=host:port``."""

    def __init__(self, address: Address, header: Header) -> None:
        address.needs("websockets", "ros2")
        self._bridge = address.options.get("bridge", DEFAULT_BRIDGE)
        host, _, port = self._bridge.rpartition(":")
        if not (host and port.isdigit() and 0 < int(port) < 2**16):
            raise address.error(f"bridge: found {self._bridge}; allowed: host:port")
        self._place = host.strip("[]"), int(port)
        address.require_host(self._place[0])
        self._topics = topics(address, header)
        self._connection: ClientConnection | None = None
        self._is_sending = False

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
        for topic, kind in self._topics.kinds.items():
            self._say({"op": "advertise", "topic": topic, "type": kind})

    def send(self, message: Message) -> bool:
        """Publish the pose of one body and its transform."""
        for topic, fields in ros_messages(message, self._topics):
            self._say({"op": "publish", "topic": topic, "msg": fields})
        from websockets.exceptions import ConnectionClosed  # noqa: PLC0415 - an extra

        assert self._connection is not None
        with suppress(TimeoutError, ConnectionClosed):
            # the bridge answers only to refuse
            answer = json.loads(self._connection.recv(timeout=0))
            if answer.get("op") == "status" and answer.get("level") == "error":
                raise ConnectionError(f"the rosbridge refuses: {answer.get('msg')}")
        return True

    def close(self) -> None:
        """Close the connection; by force if a send waits, which holds its lock."""
        if self._connection is None:
            return
        if self._is_sending:
            force_down(self._connection.socket)
        else:
            self._connection.close()

    def _say(self, operation: dict[str, Any]) -> None:
        from websockets.exceptions import ConnectionClosed  # noqa: PLC0415 - an extra

        assert self._connection is not None
        self._is_sending = True
        try:
            self._connection.send(json.dumps(operation, allow_nan=False))
        except ConnectionClosed as error:
            raise ConnectionError("the rosbridge has gone") from error
        finally:
            self._is_sending = False
