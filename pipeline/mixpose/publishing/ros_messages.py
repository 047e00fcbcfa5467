"""What ROS 2 is told of a pose: PoseWithCovarianceStamped and a transform."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from mixpose.poses.header import Header
from mixpose.poses.ros import pose_message
from mixpose.publishing.address import Address
from mixpose.publishing.message import Message, path_word

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"


class Topics(NamedTuple):
    """Topics of the poses of a run, and the frame that they are in."""

    poses: Mapping[str, str]  # by label of a body
    unit: str
    frame_id: str
    transforms: str = "/tf"


class RosMessage(NamedTuple):
    """A message with its fields by name, and where it goes."""

    topic: str
    kind: str
    fields: dict[str, Any]


def topics(address: Address, header: Header) -> Topics:
    """``ros2://topic`` is the topic of a body; of several, each has its own below that.

    A `SessionError` if the address names no topic.
    """
    names = address.name.split("/")
    if not all(part == path_word(part) and part for part in names):
        raise address.error(
            f"topic: found {address.name or 'none'}; allowed: words of letters, digits and _ with "
            "slashes between them, as in ros2://tracker"
        )
    base = f"/{address.name}"
    poses = {label: f"{base}/{path_word(label)}" for label in header.labels}
    if len(poses) == 1:
        poses = dict.fromkeys(poses, base)
    return Topics(poses, header.unit, address.options.get("frame", "world"))


def ros_messages(message: Message, to: Topics) -> list[RosMessage]:
    """The pose of a message and its transform, in metres; nothing of a lost frame.

    The stamp is when the frame was taken: Unix time of a live source, the time of a recording's
    frame or, without times, its number.
    """
    estimate = message.estimate
    if estimate.T_world_object is None:
        return []
    recorded = estimate.frame if estimate.time_s is None else estimate.time_s
    seconds = float(recorded if message.unix_s is None else message.unix_s)
    fields = pose_message(estimate, to.unit, seconds, to.frame_id)
    pose = fields["pose"]["pose"]
    transform = {
        "header": fields["header"],
        "child_frame_id": path_word(estimate.label),
        "transform": {"translation": pose["position"], "rotation": pose["orientation"]},
    }
    return [
        RosMessage(to.poses[estimate.label], POSE, fields),
        RosMessage(to.transforms, TRANSFORMS, {"transforms": [transform]}),
    ]
