"""Resume an interrupted run from its state after a frame, kept in a file beside the poses.

This note is replaced as a whole, after the lines of a frame.  It holds the length and checksum of
the poses so far, and is used only if they match; lines written after it are estimated again.
Without it earlier frames are estimated again, but not written.
"""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Sequence
from contextlib import AbstractContextManager, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from mixpose import __version__
from mixpose.cli.lines import LineFile, note_path
from mixpose.cli.notices import say
from mixpose.cli.request import RunRequest
from mixpose.encoding import decode, encode
from mixpose.errors import SessionError
from mixpose.frames import Source, pair
from mixpose.frames.capture import is_pipe
from mixpose.frames.video import Video
from mixpose.poses.header import Header
from mixpose.poses.jsonl import ResumePoint, resume_point
from mixpose.records import Estimate
from mixpose.runner import Memory
from mixpose.selection import Selection
from mixpose.whole_files import appearing_whole

INTERVAL_S = 0.1
"""Seconds between two notes: at most this part of a run is estimated again."""


@dataclass(frozen=True)
class Note:
    """The state of a run after a frame."""

    mixpose: str  # version; that of another may differ in structure
    frame: int
    size: int  # bytes of the poses so far
    checksum: int  # CRC-32 of the poses so far
    memory: Memory


class Notes(AbstractContextManager["Notes"]):
    """Save the state of a run at intervals if it can be resumed, and remove it at the end."""

    def __init__(self, request: RunRequest) -> None:
        poses, format_name = request.poses, request.format_name
        can_resume = poses is not None and format_name == "jsonl" and not is_device(poses)
        self._path = note_path(poses) if poses is not None and can_resume else None
        self._reaches_end = request.stop is None
        self._last: tuple[int, LineFile, Memory] | None = None
        self._written_at = -INTERVAL_S

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is not None or not self._reaches_end:
            self._write()
        elif self._path is not None:
            with suppress(OSError):
                self._path.unlink(missing_ok=True)

    def remember(self, frame: int, file: LineFile, memory: Memory) -> None:
        """Take the state after a frame whose lines are written."""
        self._last = frame, file, memory
        if time.monotonic() - self._written_at >= INTERVAL_S:
            self._write()

    def _write(self) -> None:
        """Save the latest state; errors, as on a full disk, are ignored so that poses go on."""
        if self._last is None or self._path is None:
            return
        frame, file, memory = self._last
        note = Note(__version__, frame, file.size, file.checksum, memory)
        with suppress(OSError), appearing_whole(self._path) as part:
            part.write_text(json.dumps(encode(note)), encoding="ascii")
        self._last, self._written_at = None, time.monotonic()


def is_device(path: Path) -> bool:
    """Test whether a path is a pipe or a device, which holds nothing that could be lost."""
    return path.exists() and not path.is_file() and not path.is_dir()


@dataclass(frozen=True)
class Continuation:
    """Where a run begins or resumes."""

    file: LineFile | None  # at the place where writing continues; None for a new file
    selection: Selection  # frames to estimate
    memory: Memory | None = None  # state of the run before the first of them
    # the last line in the file, if frames up to it are estimated again but not written
    last_written: ResumePoint | None = None
    is_done: bool = False  # whether no frame remains to be estimated

    def is_new(self, estimate: Estimate, labels: Sequence[str]) -> bool:
        """Test whether an estimate of one of the bodies comes after the last line in the file."""
        last, line = self.last_written, labels.index(estimate.label) + 1  # of the frame
        return last is None or (estimate.frame, line) > (last.frame, last.lines)


def resume(request: RunRequest, header: Header, opened: dict[str, Source]) -> Continuation:
    """Find where a run begins or, by --resume, goes on in its file of poses.

    Raises SessionError if no file is named, it belongs to another run, another run writes to it,
    or a sensor is live; RecordingError if it holds no poses, or the recording cannot be read.
    """
    if not request.resume:
        return Continuation(None, request.selection)
    for name, source in opened.items():
        if source.kind == "live" or (isinstance(source, Video) and is_pipe(source.address)):
            raise SessionError(
                f"--resume: sensor {name!r} is live, what it missed is gone; leave out --resume "
                "and name another file with -o"
            )
    poses, requested = request.poses, request.selection
    if poses is None or request.format_name != "jsonl":
        raise SessionError("--resume: needs -o FILE in the format jsonl, which it goes on writing")
    if not poses.is_file():
        return Continuation(None, requested)
    file = LineFile(poses, afresh=False)  # locked: no other run writes from here on
    try:
        reached = resume_point(poses, header)
        if reached is None:
            file.close()
            return Continuation(None, requested)
        _require_same_beginning(poses, reached.first, requested, opened)
        file.rewind(reached.size, reached.checksum)
        after = _after(requested, reached.frame)
        with closing(pair(opened, after.start, after.stop, after.step)) as frames:
            if next(frames, None) is None:
                return Continuation(file, after, is_done=True)
        note = _note(poses)
        if note is not None:
            file.rewind(note.size, note.checksum)
            return Continuation(file, _after(requested, note.frame), note.memory)
    except BaseException:
        with suppress(OSError):
            file.close()
        raise
    say(
        f"{poses}: what the run knew is not written beside it; its frames up to {reached.frame} "
        "are estimated again and left as they are"
    )
    return Continuation(file, requested, last_written=reached)


def _require_same_beginning(
    poses: Path, begun: int, requested: Selection, opened: dict[str, Source]
) -> None:
    """Raise SessionError if the written poses begin at another frame than this run would."""
    with closing(pair(opened, requested.start, requested.stop, requested.step)) as frames:
        first = next(frames, None)
    if first is not None and first.number != begun:
        raise SessionError(
            f"--resume: {poses} begins with frame {begun}, this run with {first.number}; leave out "
            "--resume to write the file anew, or give --start as it was"
        )


def _after(selection: Selection, last: int) -> Selection:
    """Return the remaining selection after frame `last`, on the same grid of frame numbers."""
    begin = last + 1
    if selection.start is not None:
        steps = max(-(-(begin - selection.start) // selection.step), 0)
        begin = selection.start + steps * selection.step
    elif selection.step > 1:
        begin = last + selection.step
    return replace(selection, start=begin)


def _note(poses: Path) -> Note | None:
    try:
        note = decode(Note, json.loads(note_path(poses).read_bytes()))
    except (OSError, ValueError, RecursionError):
        return None
    beginning = poses.read_bytes()[: note.size]
    is_whole = note.mixpose == __version__ and len(beginning) == note.size > 0
    return note if is_whole and zlib.crc32(beginning) == note.checksum else None
