"""ROS 2 by rclpy, which comes with ROS and with no package index."""

from __future__ import annotations

import array
import importlib
from typing import Any

from mixpose.poses.header import Header
from mixpose.publishing.address import Address
from mixpose.publishing.message import Message
from mixpose.publishing.ros_messages import POSE, TRANSFORMS, ros_messages, topics

_DEPTH = 10  # of the queues of publishers, as in ROS's examples


class RosNodeSender:
    """A node ``mixpose`` that publishes to the topics of ``ros2://topic``."""

    def __init__(self, address: Address, header: Header) -> None:
        self._topics = topics(address, header)
        rclpy = importlib.import_module("rclpy")
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("mixpose", context=self._context)
        kinds = dict.fromkeys(self._topics.poses.values(), POSE)
        kinds[self._topics.transforms] = TRANSFORMS
        self._publishers = {
            topic: self._node.create_publisher(_type(kind), topic, _DEPTH)
            for topic, kind in kinds.items()
        }
        self.dropped = 0

    def connect(self) -> None:
        """Nothing to do: ROS finds its receivers."""

    def send(self, message: Message) -> bool:
        """Publish the pose of one body and its transform."""
        for each in ros_messages(message, self._topics):
            self._publishers[each.topic].publish(_filled(_type(each.kind)(), each.fields))
        return any(one.get_subscription_count() for one in self._publishers.values())

    def close(self) -> None:
        """End the node."""
        self._node.destroy_node()
        self._context.try_shutdown()


def _type(kind: str) -> Any:
    """The class of a message, ``package/msg/Name``."""
    package, _, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def _filled(message: Any, fields: dict[str, Any]) -> Any:
    """A message with its fields set, those of its parts too."""
    for name, value in fields.items():
        if isinstance(value, dict):
            _filled(getattr(message, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            made = _type("geometry_msgs/msg/TransformStamped")
            setattr(message, name, [_filled(made(), each) for each in value])
        elif isinstance(value, list):
            setattr(message, name, array.array("d", value))
        else:
            setattr(message, name, value)
    return message
