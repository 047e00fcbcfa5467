"""The formats that poses are written in, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from mixpose.poses.bop import BopWriter
from mixpose.poses.csvtable import CsvWriter
from mixpose.poses.jsonl import JsonlWriter
from mixpose.poses.ros import RosWriter
from mixpose.poses.tum import TumWriter
from mixpose.records import Estimate


class PoseWriter(Protocol):
    """Writes estimates to a text stream, each as soon as it is given."""

    def write(self, estimate: Estimate) -> None:
        """Write one frame and flush it."""

    def close(self) -> None:
        """Write what is still due and flush; the stream stays open."""


ONE_TRAJECTORY = ("tum", "ros")
"""Formats whose files hold one body each."""

# each is called with a text stream and a `Header`; BOP and ROS have options of their own
FORMATS: Mapping[str, Callable[..., PoseWriter]] = {
    "jsonl": JsonlWriter,
    "csv": CsvWriter,
    "tum": TumWriter,
    "bop": BopWriter,
    "ros": RosWriter,
}
