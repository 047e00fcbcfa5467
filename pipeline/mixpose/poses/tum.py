"""TUM trajectories: ``time tx ty tz qx qy qz qw``, metres; `evo` opens them.

https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from typing import TextIO

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.header import UNITS_PER_METRE, Header
from mixpose.poses.plain import plain, pose_of, require_finite
from mixpose.records import Estimate


class TumWriter:
    """Writes one line per frame that has a pose; lost frames are left out.

    A trajectory needs a time in every line.  Where the recording has none, the frame number
    stands in its place and a comment line, which readers skip, says so.

    Parameters
    ----------
    stream : text stream
        Stays open; it belongs to the caller.
    header : Header
    """

    def __init__(self, stream: TextIO, header: Header) -> None:
        self._stream = stream
        self._per_metre = UNITS_PER_METRE[header.unit]
        self._has_times: bool | None = None  # the first frame decides

    def write(self, estimate: Estimate) -> None:
        """Write the line of one frame and flush it.

        Raises
        ------
        RecordingError
            If some frames have a time and others have none.
        """
        require_finite(estimate)
        T = pose_of(estimate)
        if T is None:
            return
        time = self._time(estimate)
        position = plain(T[:3, 3] / self._per_metre)
        turn = plain(rigid.quaternion_xyzw(T))
        self._stream.write(" ".join(repr(value) for value in [time, *position, *turn]) + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Flush; the stream stays open."""
        self._stream.flush()

    def _time(self, estimate: Estimate) -> float:
        has_time = estimate.time_s is not None
        if self._has_times is None:
            self._has_times = has_time
            if not has_time:
                self._stream.write("# time is the frame number: the recording has no times\n")
        if has_time != self._has_times:
            found = "a time" if has_time else "no time"
            raise RecordingError(
                f"frame {estimate.frame} has {found}, unlike the frames before it: format 'tum' "
                "needs times for all frames or for none; give the sensors times, or write jsonl"
            )
        time_s = estimate.time_s if estimate.time_s is not None else estimate.frame
        return float(plain(time_s))
