"""Where an interrupted run goes on: what it knew after a frame, in a file beside its poses.

The file is replaced as a whole, after the lines of the frame.  It says how long the poses were and
their checksum, so that it is believed only where it fits them; lines written after it are
estimated again.  Without it the frames before are estimated again, and not written.
"""

from __future__ import annotations

import json
import time
import zlib
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

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
from mixpose.runner import Memory
from mixpose.selection import Selection
from mixpose.whole_files import appearing_whole

INTERVAL_S = 0.1
"""Between two notes of what the run knows: so much at most is estimated again."""


@dataclass(frozen=True)
class Note:
    """What a run knew after a frame."""

    mixpose: str  # version; others may know other things
    frame: int
    # of the poses so far: bytes and CRC-32
    size: int
    checksum: int
    memory: Memory


class Notes:
    """Writes down every now and then what a run knows; gone when the recording is done.

    A context; of poses that cannot be gone on with nothing is written.
    """

    def __init__(self, request: RunRequest) -> None:
        poses, format_name = request.poses, request.format_name
        can_go_on = poses is not None and format_name == "jsonl" and not is_device(poses)
        self._path = note_path(poses) if poses is not None and can_go_on else None
        self._is_all = request.stop is None
        self._last: tuple[int, LineFile, Memory] | None = None
        self._written_at = -INTERVAL_S

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is not None or not self._is_all:
            self._write()
        elif self._path is not None:
            with suppress(OSError):
                self._path.unlink(missing_ok=True)

    def remember(self, frame: int, file: LineFile, memory: Memory) -> None:
        """Take what is known after a frame whose lines are written."""
        self._last = frame, file, memory
        if time.monotonic() - self._written_at >= INTERVAL_S:
            self._write()

    def _write(self) -> None:
        """Write down what was taken last, where there is room: poses are worth more than notes."""
        if self._last is None or self._path is None:
            return
        frame, file, memory = self._last
        note = Note(__version__, frame, file.size, file.checksum, memory)
        # without it, as on a full disk, frames are estimated again
        with suppress(OSError), appearing_whole(self._path) as part:
            part.write_text(json.dumps(encode(note)), encoding="ascii")
        self._last, self._written_at = None, time.monotonic()


def is_device(path: Path) -> bool:
    """Whether a path is a pipe or a device, which holds nothing that could be lost."""
    return path.exists() and not path.is_file() and not path.is_dir()


@dataclass(frozen=True)
class Continuation:
    """How a run goes on."""

    # what it writes to, at the place where it goes on; None: a file that is opened afresh
    file: LineFile | None
    selection: Selection  # frames to estimate
    memory: Memory | None = None  # what is known before the first of them
    # the last line that is there already, where frames are estimated again up to it
    there: ResumePoint | None = None
    is_done: bool = False  # whether nothing is left to do


def continuation(request: RunRequest, header: Header, opened: dict[str, Source]) -> Continuation:
    """How a run goes on in a poses file.

    Raises SessionError if there is none, it is of another run, another run writes to it, or a
    sensor is live. Raises RecordingError if it holds no poses, or the recording cannot be read.
    """
    for name, source in opened.items():
        if source.kind == "live" or (isinstance(source, Video) and is_pipe(source.address)):
            raise SessionError(
                f"--resume: sensor {name!r} is live, what it missed is gone; leave out --resume "
                "and name another file with -o"
            )
    poses, wanted = request.poses, request.selection
    if poses is None or request.format_name != "jsonl":
        raise SessionError("--resume: needs -o FILE in the format jsonl, which it goes on writing")
    if not poses.is_file():
        return Continuation(None, wanted)
    file = LineFile(poses, afresh=False)  # from here on nobody else writes
    try:
        reached = resume_point(poses, header)
        if reached is None:
            file.close()
            return Continuation(None, wanted)
        _require_same_beginning(poses, reached.first, wanted, opened)
        file.rewind(reached.size, reached.checksum)
        after = _after(wanted, reached.frame)
        with closing(pair(opened, after.start, after.stop, after.step)) as frames:
            if next(frames, None) is None:
                return Continuation(file, after, is_done=True)
        note = _note(poses)
        if note is not None:
            file.rewind(note.size, note.checksum)
            return Continuation(file, _after(wanted, note.frame), note.memory)
    except BaseException:
        with suppress(OSError):
            file.close()
        raise
    say(
        f"{poses}: what the run knew is not written beside it; its frames up to {reached.frame} "
        "are estimated again and left as they are"
    )
    return Continuation(file, wanted, there=reached)


def _require_same_beginning(
    poses: Path, begun: int, wanted: Selection, opened: dict[str, Source]
) -> None:
    """Raise SessionError where what was written begins at another frame than this run would."""
    with closing(pair(opened, wanted.start, wanted.stop, wanted.step)) as frames:
        first = next(frames, None)
    if first is not None and first.number != begun:
        raise SessionError(
            f"--resume: {poses} begins with frame {begun}, this run with {first.number}; leave out "
            "--resume to write the file anew, or give --start as it was"
        )


def _after(wanted: Selection, last: int) -> Selection:
    """What is left of a selection after a frame, on the numbers that all of it would take."""
    begin = last + 1
    if wanted.start is not None:
        steps = max(-(-(begin - wanted.start) // wanted.step), 0)
        begin = wanted.start + steps * wanted.step
    elif wanted.step > 1:
        begin = last + wanted.step
    return replace(wanted, start=begin)


def _note(poses: Path) -> Note | None:
    """The note about a poses file, if there is one that fits it."""
    try:
        note = decode(Note, json.loads(note_path(poses).read_bytes()))
    except (OSError, ValueError, RecursionError):
        return None
    beginning = poses.read_bytes()[: note.size]
    fits = note.mixpose == __version__ and len(beginning) == note.size > 0
    return note if fits and zlib.crc32(beginning) == note.checksum else None
