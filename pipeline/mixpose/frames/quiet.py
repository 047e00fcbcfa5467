"""Keeps what OpenCV and its decoders print away from the user's standard error."""

from __future__ import annotations

import os

import cv2


def quieten_opencv() -> None:
    """Turn off the messages of OpenCV and of its FFmpeg backend.

    A recording that cannot be read is one line on standard error, written by mixpose; the
    decoders' own account of the same fault would surround it with dozens more.  Whoever set
    ``OPENCV_LOG_LEVEL`` or ``OPENCV_FFMPEG_LOGLEVEL`` wants to see it and keeps it.

    FFmpeg's level counts only before the first video is opened, so call this before that.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    if "OPENCV_LOG_LEVEL" not in os.environ:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
