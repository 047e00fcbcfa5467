"""What pose lines of one body have to have before a motion is told from them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from mixpose.errors import RecordingError
from mixpose.poses.poseline import PoseLine


def require_frames_once(lines: Sequence[PoseLine]) -> None:
    """Raise a RecordingError if a frame stands twice among lines in the order of frames."""
    for before, line in pairwise(lines):
        if before.frame == line.frame:
            raise RecordingError(
                f"frame {line.frame} of {line.label!r} stands twice; allowed: a line per frame"
            )


def require_covariances(lines: Sequence[PoseLine]) -> None:
    """Raise a RecordingError if a pose has no covariance."""
    for line in lines:
        if line.covariance is None or not line.covariance.any():
            raise RecordingError(
                f"line {line.line}: the pose of {line.label!r} in frame {line.frame} has no "
                "covariance; allowed: poses as mixpose run writes them"
            )
