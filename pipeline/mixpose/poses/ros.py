"""Write ROS 2 messages as YAML: geometry_msgs/msg/PoseWithCovarianceStamped.

They look as by ``ros2 topic echo``, and ``ros2 topic pub --yaml-file`` publishes them:
https://docs.ros.org/en/rolling/p/geometry_msgs/msg/PoseWithCovarianceStamped.html
"""

from __future__ import annotations

import json
from functools import partial
from typing import Any, TextIO

import numpy as np

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.header import Header
from mixpose.poses.writing import PoseWriter, Stamps, plain, pose_of
from mixpose.records import Estimate
from mixpose.units import UNITS_PER_METRE

_LARGEST_SECOND = 2**31 - 1  # builtin_interfaces/Time holds seconds in an int32


class RosWriter(PoseWriter):
    """Writes a YAML document per frame that has a pose; lost frames are left out.

    Metres and radians, relative to `frame_id`. The covariance of mixpose has the order and axes of
    the message already; it is written row by row in m², m·rad and rad², or as 36 zeros, which mean
    "unknown". A comment in front of each message names its frame and status.
    """

    def __init__(self, stream: TextIO, header: Header, *, frame_id: str = "world") -> None:
        import yaml  # noqa: PLC0415 - only this format needs it

        super().__init__(stream, header)
        dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # the former is four times as fast
        self._yaml_of = partial(yaml.dump, Dumper=dumper, sort_keys=False)
        self._stamps = Stamps(stream, "ros")
        self._frame_id = frame_id

    def _write(self, estimate: Estimate) -> None:
        if pose_of(estimate) is None:
            return
        seconds = self._stamps.time_of(estimate)
        message = pose_message(estimate, self._header.unit, seconds, self._frame_id)
        header, pose = message["header"], {"pose": message["pose"]}
        self._stream.write(
            f"# frame {estimate.frame}, {estimate.status}\n"
            "header:\n"
            "  stamp:\n"
            f"    sec: {header['stamp']['sec']}\n"
            f"    nanosec: {header['stamp']['nanosec']}\n"
            f"  frame_id: {json.dumps(header['frame_id'])}\n"
            f"{self._yaml_of(pose)}---\n"
        )


def pose_message(
    estimate: Estimate, unit: str, seconds: float, frame_id: str = "world"
) -> dict[str, Any]:
    """Return a geometry_msgs/msg/PoseWithCovarianceStamped as a dict, in metres and radians.

    The estimate must have a pose, in `unit`, relative to `frame_id`. Raises RecordingError if the
    message cannot hold the time.
    """
    T, per_metre = estimate.T_world_object, UNITS_PER_METRE[unit]
    assert T is not None, "lost frames have no message"
    if abs(seconds) > _LARGEST_SECOND:
        raise RecordingError(
            f"frame {estimate.frame}: time {seconds:.15g} s is beyond what format 'ros' can say, "
            f"{_LARGEST_SECOND} s; give the sensors times in seconds"
        )
    second, nanosecond = divmod(round(1e9 * seconds), 10**9)
    covariance = np.zeros((6, 6)) if estimate.covariance is None else estimate.covariance
    scale = np.array([1 / per_metre] * 3 + [1.0] * 3)
    return {
        "header": {"stamp": {"sec": second, "nanosec": nanosecond}, "frame_id": frame_id},
        "pose": {
            "pose": {
                "position": dict(zip("xyz", plain(T[:3, 3] / per_metre))),
                "orientation": dict(zip("xyzw", plain(rigid.quaternion_xyzw(T)))),
            },
            "covariance": plain((covariance * np.outer(scale, scale)).ravel()),
        },
    }
