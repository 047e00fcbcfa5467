"""Trajectories of labelled markers, as files for programs that study movement have them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mixpose.errors import RecordingError
from mixpose.poses.poseline import PoseLine
from mixpose.records import Floats, Mask


@dataclass(frozen=True, eq=False)
class Trajectories:
    """N markers over F frames of successive numbers."""

    names: tuple[str, ...]  # N, all different
    places: Floats  # (F, N, 3), in the world; NaN where a marker is not known
    # (F, N), of places that sensors measured, a length; NaN of those that are not, or by the pose
    residuals: Floats
    by_sensor: Mask  # (F, N, L), which sensors measured it
    first: int  # number of the first frame
    rate: float  # frames per second
    unit: str  # of lengths

    @property
    def is_known(self) -> Mask:
        """Where there is a place (F, N)."""
        return np.asarray(np.isfinite(self.places[..., 0]))

    @property
    def is_measured(self) -> Mask:
        """Where sensors measured it (F, N)."""
        return np.asarray(np.isfinite(self.residuals))


def rate_of(lines: Sequence[PoseLine]) -> tuple[float, float] | None:
    """Frames per second by the times of pose lines, and how far off the times are, in frames.

    None where lines have no times, or all are of one frame. Raises RecordingError if times do not
    ascend with the frames.
    """
    times = {line.frame: line.time_s for line in lines if line.time_s is not None}
    if len(times) < 2:
        return None
    frames = np.array(sorted(times), dtype=np.float64)
    seconds = np.array([times[int(frame)] for frame in frames])
    if (np.diff(seconds) <= 0).any():
        k = int(np.argmax(np.diff(seconds) <= 0))
        raise RecordingError(
            f"frame {frames[k + 1]:.0f} is at {seconds[k + 1]:g} s and the one before it at "
            f"{seconds[k]:g} s; times that ascend are needed: say how many frames a second with "
            "--fps"
        )
    rate = (frames[-1] - frames[0]) / (seconds[-1] - seconds[0])
    off = np.abs((seconds - seconds[0]) * rate - (frames - frames[0])).max()
    return float(rate), float(off)
