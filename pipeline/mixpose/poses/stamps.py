"""Times for formats that need one with every pose."""

from __future__ import annotations

from typing import TextIO

from mixpose.errors import RecordingError
from mixpose.poses.plain import plain
from mixpose.records import Estimate


class Stamps:
    """The time of each pose; where the recording has none the frame number, as a comment line
    says.
    """

    def __init__(self, stream: TextIO, format_name: str) -> None:
        self._stream, self._format = stream, format_name
        self._has_times: bool | None = None  # the first frame decides

    def time_of(self, estimate: Estimate) -> float:
        """Time in s, or the frame number.

        Raises RecordingError if some frames have a time and others have none.
        """
        has_time = estimate.time_s is not None
        if self._has_times is None:
            self._has_times = has_time
            if not has_time:
                self._stream.write("# time is the frame number: the recording has no times\n")
        if has_time != self._has_times:
            found = "a time" if has_time else "no time"
            raise RecordingError(
                f"frame {estimate.frame} has {found}, unlike the frames before it: format "
                f"{self._format!r} needs times for all frames or for none; give the sensors "
                "times, or write jsonl"
            )
        return float(plain(estimate.frame if estimate.time_s is None else estimate.time_s))
