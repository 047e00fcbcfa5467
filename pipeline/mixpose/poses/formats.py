"""List the formats of poses files, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from mixpose.poses.benchmarks import BopWriter, TumWriter
from mixpose.poses.csvtable import CsvWriter
from mixpose.poses.jsonl import JsonlWriter
from mixpose.poses.ros import RosWriter
from mixpose.poses.writing import PoseWriter

ONE_TRAJECTORY = ("tum", "ros")  # formats whose files hold one body each
# called with a text stream and a `Header`; BOP and ROS have further options
FORMATS: Mapping[str, Callable[..., PoseWriter]] = {
    "jsonl": JsonlWriter,
    "csv": CsvWriter,
    "tum": TumWriter,
    "bop": BopWriter,
    "ros": RosWriter,
}
