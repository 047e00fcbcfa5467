"""Recordings on their way to the disk: one writer per kind of source, frame by frame."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from mixpose.errors import SessionError
from mixpose.simulation.naming import SourceFiles
from mixpose.simulation.options import SimulationOptions
from mixpose.simulation.render import ImageFormat, ProfileFormat, render_image, render_profile
from mixpose.simulation.visible_spots import VisibleSpots

# Runs and no filter: the best for noise, and fast.
_PNG = (
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_RLE,
    cv2.IMWRITE_PNG_FILTER,
    cv2.IMWRITE_PNG_FILTER_NONE,
)
_VIDEO_QUALITY = 95


class SensorWriter(Protocol):
    """Writes what one sensor records."""

    def write(
        self, number: int, time_s: float, visible: VisibleSpots, rng: np.random.Generator
    ) -> None:
        """Record one frame; numbers ascend."""

    def close(self) -> None:
        """Finish the file."""


def _made(files: SourceFiles, folder: Path) -> Path:
    """The one file of a source, in a folder that is there."""
    path = folder / files.path
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


class ImageWriter:
    """A file per image."""

    def __init__(
        self, files: SourceFiles, folder: Path, options: SimulationOptions, form: ImageFormat
    ) -> None:
        self._files, self._folder, self._options, self._form = files, folder, options, form

    def write(
        self, number: int, time_s: float, visible: VisibleSpots, rng: np.random.Generator
    ) -> None:
        """Draw and write one image."""
        image = render_image(visible, self._form, self._options, rng)
        path = self._folder / self._files.name(number)
        path.parent.mkdir(parents=True, exist_ok=True)
        suffix = path.suffix.casefold()
        path.write_bytes(cv2.imencode(suffix, image, _PNG if suffix == ".png" else ())[1].tobytes())

    def close(self) -> None:
        """Nothing is left to do: every image is whole."""


class VideoWriter:
    """All images in one video: MJPEG in .avi, MPEG-4 in .mp4."""

    def __init__(
        self,
        files: SourceFiles,
        folder: Path,
        options: SimulationOptions,
        form: ImageFormat,
        fps: float,
    ) -> None:
        self._options, self._form = options, form
        path = _made(files, folder)
        # OpenCV's own writer of MJPEG lets the quality be set
        own = path.suffix.casefold() == ".avi"
        self._video = cv2.VideoWriter(
            str(path),
            cv2.CAP_OPENCV_MJPEG if own else cv2.CAP_FFMPEG,
            cv2.VideoWriter.fourcc(*("MJPG" if own else "mp4v")),
            fps,
            form.resolution,
            (cv2.VIDEOWRITER_PROP_QUALITY, _VIDEO_QUALITY) if own else (),
        )
        if not self._video.isOpened():
            raise SessionError(
                f"simulate: sensor {files.sensor!r}: source: {files.path} cannot be written as a "
                'video; write images, with a glob like "left*.png"'
            )

    def write(
        self, number: int, time_s: float, visible: VisibleSpots, rng: np.random.Generator
    ) -> None:
        """Draw one image and append it."""
        image = render_image(visible, self._form, self._options, rng)
        self._video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))

    def close(self) -> None:
        """Finish the container."""
        self._video.release()


class ProfileWriter:
    """A row per frame: .npy of float32, or .csv without a header."""

    def __init__(
        self, files: SourceFiles, folder: Path, options: SimulationOptions, form: ProfileFormat
    ) -> None:
        self._options, self._form = options, form
        path = _made(files, folder)
        self._is_text = path.suffix.casefold() == ".csv"
        self._file = path.open("wb")
        if not self._is_text:
            shape = (options.frames, form.bins)
            header = {"descr": "<f4", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(self._file, header)

    def write(
        self, number: int, time_s: float, visible: VisibleSpots, rng: np.random.Generator
    ) -> None:
        """Draw one profile and append it."""
        profile = render_profile(visible, self._form, self._options, rng)
        row = profile.astype("<f4").tobytes()
        if self._is_text:
            row = (",".join(f"{value:.6g}" for value in profile.tolist()) + "\n").encode("ascii")
        self._file.write(row)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class DetectionWriter:
    """A row per detection, in no order, or one of weight 0: the sensor looked, and saw none."""

    def __init__(
        self, files: SourceFiles, folder: Path, *, noise: float, coordinates: tuple[str, ...]
    ) -> None:
        self._noise, self._coordinates = noise, coordinates
        self._file = _made(files, folder).open("w", encoding="ascii", newline="\n")
        self._file.write(",".join(["frame", "time_s", *coordinates, "weight"]) + "\n")

    def write(
        self, number: int, time_s: float, visible: VisibleSpots, rng: np.random.Generator
    ) -> None:
        """Append the detections of one frame."""
        noise = self._noise * rng.standard_normal(visible.points.shape)
        shown = np.ones(len(noise), dtype=bool)
        for cover in visible.covers:  # of something dark before cameras
            corners = cover.astype(np.float32)
            inside = [cv2.pointPolygonTest(corners, y.tolist(), False) for y in visible.points]
            shown &= np.array(inside, dtype=float) < 0
        points, weights = (visible.points + noise)[shown], visible.levels[shown]
        if not len(points):
            points, weights = np.zeros((1, len(self._coordinates))), np.zeros(1)
        for i in rng.permutation(len(points)):
            cells = [f"{value:.9g}" for value in (*points[i], weights[i])]
            self._file.write(",".join([str(number), f"{time_s:.6f}", *cells]) + "\n")

    def close(self) -> None:
        """Close the file."""
        self._file.close()
