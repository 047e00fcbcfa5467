"""The formats that poses are written in, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol, TextIO

from mixpose.poses.bop import BopWriter
from mixpose.poses.csvtable import CsvWriter
from mixpose.poses.header import Header
from mixpose.poses.jsonl import JsonlWriter
from mixpose.poses.tum import TumWriter
from mixpose.records import Estimate


class PoseWriter(Protocol):
    """Writes estimates to a text stream, each as soon as it is given."""

    def write(self, estimate: Estimate) -> None:
        """Write one frame and flush it."""

    def close(self) -> None:
        """Write what is still due and flush; the stream stays open."""


FORMATS: Mapping[str, Callable[[TextIO, Header], PoseWriter]] = {
    "jsonl": JsonlWriter,
    "csv": CsvWriter,
    "tum": TumWriter,
    "bop": BopWriter,
}
