"""Write an overlay: a video, or a folder with a picture per frame."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median

import cv2

from mixpose.errors import SessionError, reporting
from mixpose.objective import View
from mixpose.pictures.canvas import Picture, fit_into
from mixpose.pictures.scene import draw_scene, with_sizes
from mixpose.pictures.signature import is_ours, refuse_foreign, sign_video, write_png
from mixpose.records import Estimate, FrameSet
from mixpose.session import Session
from mixpose.whole_files import partial_of

CODECS = {".mp4": "mp4v", ".mkv": "mp4v", ".avi": "MJPG"}  # all part of OpenCV's wheels

_PICTURES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"}
_DEFAULT_FPS = 25.0
_SLOWEST, _FASTEST = 0.5, 120.0
_WAITING = 9  # frames whose times give the rate, even if a few are missing


class Overlay:
    """Draw and write every frame of a run; a context for ``run(watch=...)``.

    The path is a video, by its extension, or a folder, in which it can `resume`. Raises a
    `SessionError` if it is neither, or contains something that mixpose did not write.
    """

    def __init__(self, session: Session, path: Path, *, resume: bool = False) -> None:
        self._session, self._is_sized = session, False
        self._estimates: list[Estimate] = []
        if not path.parent.is_dir():
            raise SessionError(f"--overlay {path}: there is no folder {path.parent}")
        suffix = path.suffix.casefold()
        is_folder = path.is_dir() or not suffix
        if not is_folder and suffix not in CODECS:
            raise SessionError(
                f"--overlay {path}: found the extension {suffix}, allowed are {', '.join(CODECS)} "
                "for a video, and a name without one for a folder of pictures"
            )
        if not is_folder and resume:
            raise SessionError(
                f"--overlay {path}: --resume cannot go on in a video; name a folder, which gets a "
                "picture per frame"
            )
        self._sink = FolderSink(path, resume=resume) if is_folder else VideoSink(path)

    def __enter__(self) -> Overlay:
        return self

    def __exit__(self, *_: object) -> None:
        self._sink.close()

    def watch(self, frame_set: FrameSet, views: Sequence[View], estimate: Estimate) -> None:
        """Collect the estimates of a frame; draw it with that of its last body."""
        self._estimates.append(estimate)
        if len(self._estimates) == len(self._session.labels):
            if not self._is_sized:  # sizes by the first frame apply to all
                self._session, self._is_sized = with_sizes(self._session, frame_set), True
            picture = draw_scene(self._session, frame_set, *self._estimates)
            self._sink.add(picture, estimate.frame, estimate.time_s)
            self._estimates = []


class FolderSink:
    """Write ``overlay_000012.png`` and so on into a folder, which the first of them makes."""

    def __init__(self, folder: Path, *, resume: bool = False) -> None:
        self._folder = folder
        if folder.exists() and not folder.is_dir():
            raise SessionError(f"--overlay {folder}: is a file; name a folder or a video")
        self._earlier: list[Path] = []
        for path in sorted(folder.iterdir()) if folder.is_dir() else ():
            if path.suffix.casefold() in _PICTURES and path.is_file():
                if not is_ours(path):
                    raise SessionError(
                        f"--overlay {folder}: holds {path.name}, which mixpose did not write; "
                        "name another folder"
                    )
                if not resume and path.match("overlay_*.png"):
                    self._earlier.append(path)

    def add(self, picture: Picture, frame: int, time_s: float | None) -> None:
        """Write the picture of a frame; the first one also deletes those of an earlier run."""
        with reporting(SessionError, f"--overlay {self._folder}: cannot be written"):
            self._folder.mkdir(exist_ok=True)
            for path in self._earlier:
                path.unlink(missing_ok=True)
        self._earlier = []
        write_png(self._folder / f"overlay_{frame:06d}.png", picture)

    def close(self) -> None:
        """Do nothing: every picture is complete."""


class VideoSink:
    """Write a video that plays at the rate of the frames' times, if known."""

    def __init__(self, path: Path) -> None:
        refuse_foreign(path, "--overlay")
        self._path, self._part = path, partial_of(path)
        self._waiting: list[tuple[Picture, float | None]] = []
        self._writer: cv2.VideoWriter | None = None
        self._size = (0, 0)
        self._count = 0

    def add(self, picture: Picture, frame: int, time_s: float | None) -> None:
        """Write the picture of a frame; the first ones wait until the rate can be estimated."""
        self._waiting.append((picture, time_s))
        if self._writer is not None or len(self._waiting) == _WAITING:
            self._write()

    def close(self) -> None:
        """Finish the file, sign it and rename it to its path from a temporary name."""
        if self._waiting:
            self._write()
        if self._writer is None:
            return
        self._writer.release()
        self._writer = None
        try:
            with reporting(SessionError, f"--overlay {self._path}: cannot be written"):
                sign_video(self._part)
                # FFmpeg does not report a full disk
                written = cv2.VideoCapture(str(self._part))
                count = int(written.get(cv2.CAP_PROP_FRAME_COUNT)) if written.isOpened() else 0
                written.release()
                if count < self._count - 1:  # containers that estimate the count may be off by one
                    raise SessionError(
                        f"--overlay {self._path}: {count} of {self._count} frames could be "
                        "written: is the disk full?"
                    )
                self._part.replace(self._path)
        finally:
            self._part.unlink(missing_ok=True)

    def _write(self) -> None:
        """Write the waiting pictures, and open the video for the first ones."""
        waiting, self._waiting = self._waiting, []
        if self._writer is None:
            picture, fps = waiting[0][0], _rate([time_s for _, time_s in waiting])
            # codecs need even sides
            self._size = picture.shape[1] // 2 * 2, picture.shape[0] // 2 * 2
            codec = cv2.VideoWriter.fourcc(*CODECS[self._path.suffix.casefold()])
            writer = cv2.VideoWriter(str(self._part), codec, fps, self._size)
            if not writer.isOpened():
                raise SessionError(
                    f"--overlay {self._path}: cannot be written as a video; name an .avi, or a "
                    "folder"
                )
            self._writer = writer
        for picture, _ in waiting:
            self._writer.write(fit_into(picture, self._size))
            self._count += 1


def _rate(times: Sequence[float | None]) -> float:
    """Estimate frames per second from the times of the first frames."""
    gaps = [
        later - earlier
        for earlier, later in pairwise(times)
        if earlier is not None and later is not None and later > earlier
    ]
    return min(max(1 / median(gaps), _SLOWEST), _FASTEST) if gaps else _DEFAULT_FPS
