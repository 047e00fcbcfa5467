"""TUM trajectories: ``time tx ty tz qx qy qz qw``, metres; `evo` opens them.

https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from typing import TextIO

from mixpose import rigid
from mixpose.poses.header import UNITS_PER_METRE, Header
from mixpose.poses.plain import plain, pose_of, require_finite
from mixpose.poses.stamps import Stamps
from mixpose.records import Estimate


class TumWriter:
    """Writes one line per frame that has a pose; lost frames are left out."""

    def __init__(self, stream: TextIO, header: Header) -> None:
        self._stream = stream
        self._per_metre = UNITS_PER_METRE[header.unit]
        self._stamps = Stamps(stream, "tum")

    def write(self, estimate: Estimate) -> None:
        """Write the line of one frame and flush it.

        Raises RecordingError if some frames have a time and others have none.
        """
        require_finite(estimate)
        T = pose_of(estimate)
        if T is None:
            return
        time = self._stamps.time_of(estimate)
        position = plain(T[:3, 3] / self._per_metre)
        turn = plain(rigid.quaternion_xyzw(T))
        self._stream.write(" ".join(repr(value) for value in [time, *position, *turn]) + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Flush; the stream stays open."""
        self._stream.flush()
