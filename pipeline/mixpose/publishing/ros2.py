"""ROS 2: by rclpy where ROS is installed, else by a rosbridge."""

from __future__ import annotations

from importlib.util import find_spec

from mixpose.poses.header import Header
from mixpose.publishing.address import Address
from mixpose.publishing.ros_node import RosNodeSender
from mixpose.publishing.rosbridge import RosbridgeSender
from mixpose.publishing.sender import Sender


def ros2_sender(address: Address, header: Header) -> Sender:
    """What publishes to ``ros2://topic``; by a bridge where that says ``?bridge=host:port``."""
    address.allow("bridge", "frame")
    if "bridge" in address.options or find_spec("rclpy") is None:
        return RosbridgeSender(address, header)
    return RosNodeSender(address, header)
