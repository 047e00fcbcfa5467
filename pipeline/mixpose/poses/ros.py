"""ROS 2 messages as YAML: geometry_msgs/msg/PoseWithCovarianceStamped, as ``ros2 topic echo``.

``ros2 topic pub --yaml-file`` publishes them; the fields are those of
https://docs.ros.org/en/rolling/p/geometry_msgs/msg/PoseWithCovarianceStamped.html
"""

from __future__ import annotations

import json
from typing import TextIO

import numpy as np

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.header import UNITS_PER_METRE, Header
from mixpose.poses.plain import plain, pose_of, require_finite
from mixpose.poses.stamps import Stamps
from mixpose.records import Estimate, Floats

_LARGEST_SECOND = 2**31 - 1  # builtin_interfaces/Time counts them in an int32


class RosWriter:
    """Writes a YAML document per frame that has a pose; lost frames are left out.

    Metres and radians.  The covariance is that of mixpose, which has the order and the axes of
    the message, row by row in m², m·rad and rad²; 36 zeros, which say "unknown", where there is
    none.  A comment in front of each message names its frame and status.

    Parameters
    ----------
    stream : text stream
        Stays open; it belongs to the caller.
    header : Header
    frame_id : str
        What the poses are relative to.
    """

    def __init__(self, stream: TextIO, header: Header, *, frame_id: str = "world") -> None:
        self._stream = stream
        self._per_metre = UNITS_PER_METRE[header.unit]
        self._stamps = Stamps(stream, "ros")
        self._frame_id = frame_id

    def write(self, estimate: Estimate) -> None:
        """Write the message of one frame and flush it.

        Raises
        ------
        RecordingError
            If some frames have a time and others have none, or a time is beyond the message's.
        """
        require_finite(estimate)
        T = pose_of(estimate)
        if T is None:
            return
        second, nanosecond = divmod(round(1e9 * self._stamps.time_of(estimate)), 10**9)
        if abs(second) > _LARGEST_SECOND:
            raise RecordingError(
                f"frame {estimate.frame}: time {second} s is beyond what format 'ros' can say, "
                f"{_LARGEST_SECOND} s; give the sensors times in seconds"
            )
        self._stream.write(
            f"# frame {estimate.frame}, {estimate.status}\n"
            "header:\n"
            "  stamp:\n"
            f"    sec: {second}\n"
            f"    nanosec: {nanosecond}\n"
            f"  frame_id: {json.dumps(self._frame_id)}\n"
            "pose:\n"
            "  pose:\n"
            "    position:\n"
            + _fields("xyz", T[:3, 3] / self._per_metre)
            + "    orientation:\n"
            + _fields("xyzw", rigid.quaternion_xyzw(T))
            + "  covariance:\n"
            + "".join(f"  - {_number(value)}\n" for value in self._covariance(estimate))
            + "---\n"
        )
        self._stream.flush()

    def close(self) -> None:
        """Flush; the stream stays open."""
        self._stream.flush()

    def _covariance(self, estimate: Estimate) -> Floats:
        """The covariance in m and rad, (36,)."""
        if estimate.covariance is None:
            return np.zeros(36)
        scale = np.array([1 / self._per_metre] * 3 + [1.0] * 3)
        return np.asarray(estimate.covariance * np.outer(scale, scale)).ravel()


def _fields(names: str, values: Floats) -> str:
    return "".join(f"      {name}: {_number(value)}\n" for name, value in zip(names, values))


def _number(value: float) -> str:
    """A float as YAML 1.1 has it, which takes 1e-07 for text and 1.0e-07 for a number."""
    text = repr(plain(value))
    return text.replace("e", ".0e") if "e" in text and "." not in text else text
