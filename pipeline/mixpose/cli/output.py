"""Write poses and texts to a stream or a file; never replace files that mixpose did not write."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Self, TextIO, cast

from mixpose.cli.lines import LineFile
from mixpose.cli.notices import warn
from mixpose.errors import SessionError, reporting
from mixpose.naming import distinct
from mixpose.poses import jsonl, writers, writing
from mixpose.poses.header import Header
from mixpose.records import Estimate
from mixpose.whole_files import appearing_whole

_HEADER = '{"type": "header"'
_WHOLE_LINES = map(re.escape, (writers.BOP_COLUMNS, writers.TUM_COLUMNS, writing.NO_TIMES))
_FIRST_LINES = re.compile(
    rf"{re.escape(_HEADER)}.*|{','.join(writers.FRAME_COLUMNS[:3])},.*|{'|'.join(_WHOLE_LINES)}"
    r"|# frame -?\d+, (ok|ambiguous)"
)
"""First lines of files of poses that mixpose wrote."""

_FOREIGN = "{} {}: holds something that mixpose did not write; name another file"


class Output(ExitStack):
    """Write poses; the first pose opens the file, so that an earlier failure does not empty it.

    Without a path poses go to standard output. If the format holds one body only, each of several
    bodies (`labels`) gets a file, ``poses.<body>.tum`` for ``poses.tum``; this needs a path, else
    SessionError. `resumed` is an open file of JSON lines that has its header already and replaces
    `path`; `options` are further arguments of the format's writer; a `whole` file appears once all
    is written.
    """

    def __init__(
        self,
        path: Path | None,
        format_name: str,
        header: Header,
        labels: Sequence[str] = (),
        *,
        resumed: LineFile | None = None,
        options: Mapping[str, int | str] | None = None,
        whole: bool = False,
    ) -> None:
        super().__init__()
        self._named = self._path = path
        self._format, self._header = format_name, header
        self._options, self._is_whole = options or {}, whole
        self._writer: writing.PoseWriter | None = None
        self.file = resumed
        if resumed is not None:
            self._writer = jsonl.JsonlWriter(cast(TextIO, resumed), header, resume=True)
        self._by_label: dict[str, Output] = {}  # if bodies have separate files
        if format_name not in writers.ONE_TRAJECTORY or len(labels) < 2:
            return
        if path is None:
            raise SessionError(
                f"--format {format_name}: holds one body, found {', '.join(labels)}; name a file "
                "with -o: each body gets one with its own name in it"
            )
        for label, file in zip(labels, written_paths(path, format_name, labels), strict=True):
            self._by_label[label] = Output(file, format_name, header, options=options, whole=whole)

    def __enter__(self) -> Self:
        for output in self._by_label.values():
            self.enter_context(output)
        if not self._by_label:
            if self._is_whole and self._named is not None:
                self._path = self.enter_context(appearing_whole(self._named))
            self.push(self._end)
        return super().__enter__()

    def _end(self, kind: object, error: object, trace: object) -> None:
        try:
            if error is None and self._writer is None:
                self._open()  # a run without frames still writes a header
            if self._writer is not None and not isinstance(error, OSError | SessionError):
                self._writer.close()
        finally:
            if self.file is not None:
                self.file.close()

    def write(self, estimate: Estimate) -> None:
        """Write the pose of one body in one frame without delay."""
        if self._by_label:
            self._by_label[estimate.label].write(estimate)
            return
        if self._writer is None and self._format == "tum" and estimate.time_s is None:
            warn(
                f"{self._named or 'standard output'}: poses have no times, so that frame numbers "
                "stand for seconds; fps or times in [[sensor]] gives them times"
            )
        writer = self._writer or self._open()
        writer.write(estimate)

    def _open(self) -> writing.PoseWriter:
        if self._path is not None:
            self.file = LineFile(self._path, shown=self._named)
        # writers of poses call only write and flush
        stream = sys.stdout if self.file is None else cast(TextIO, self.file)
        self._writer = writers.FORMATS[self._format](stream, self._header, **self._options)
        return self._writer


def written_paths(path: Path | None, format_name: str, labels: Sequence[str]) -> list[Path]:
    """Return the files that poses go to; of several bodies perhaps ``poses.<body>.tum``."""
    if path is None or format_name not in writers.ONE_TRAJECTORY or len(labels) < 2:
        return [] if path is None else [path]
    words = distinct(labels, partial(re.sub, r"[^\w\- ]", "_"), str.casefold)
    return [path.with_name(f"{path.stem}.{word}{path.suffix}") for word in words]


def refuse_to_overwrite(path: Path, inputs: Iterable[Path]) -> None:
    """Raise SessionError unless a file to be written is new, or holds poses that mixpose wrote."""
    beginning = _beginning(path, inputs)
    first = beginning.partition("\n")[0].rstrip("\r")
    is_rerun = beginning.startswith("RRF") and "mixpose" in beginning
    if beginning and not (_FIRST_LINES.fullmatch(first) or is_rerun):
        raise SessionError(_FOREIGN.format("-o", path))
    if first.startswith(_HEADER) and '"mixpose": ' not in first:
        raise SessionError(f"-o {path}: holds poses of another origin; name another file")


def refuse_to_overwrite_but(
    path: Path, inputs: Iterable[Path | None], mark: str, option: str = "-o", *, begins: str = ""
) -> None:
    """Raise SessionError unless a file is new, empty, or `begins` as told and has `mark` in it."""
    if is_stdout(path):
        return
    beginning = _beginning(path, inputs, option)
    if beginning and not (beginning.startswith(begins) and mark in beginning):
        raise SessionError(_FOREIGN.format(option, path))


def _beginning(path: Path, inputs: Iterable[Path | None], option: str = "-o") -> str:
    """Return the first characters of an existing file at a path to be written, else none."""
    if not path.parent.is_dir():
        raise SessionError(f"{option} {path}: there is no folder {path.parent}")
    if path.is_dir():
        raise SessionError(f"{option} {path}: is a folder; name a file")
    if not path.is_file():
        return ""
    if any(source is not None and source.exists() and path.samefile(source) for source in inputs):
        raise SessionError(f"{option} {path}: is an input of this run; name another file")
    with path.open("rb") as stream:
        return stream.read(4096).decode("utf-8", errors="replace")


def is_stdout(named: Path | None) -> bool:
    """Test whether an option names standard output."""
    return named == Path("-")


def refuse_suffix(named: Path, allowed: Sequence[str], reason: str) -> None:
    """Raise SessionError, with a reason, if the suffix of a file is none of those `allowed`."""
    if named.suffix and named.suffix.casefold() not in allowed:
        raise SessionError(
            f"-o {named}: found the suffix {named.suffix}; {reason}: name it "
            f"{named.with_suffix(allowed[0]).name}"
        )


def refuse_stdout(named: Path | None, option: str, content: str, instead: str) -> None:
    """Raise SessionError if an option names standard output, which cannot take `content`."""
    if is_stdout(named):
        raise SessionError(f"{option} -: {content} cannot go to standard output; name {instead}")


def refuse_one_for_two(named: Path | None, option: str, other: Path | None, before: str) -> None:
    """Raise SessionError if two options name one file, which only the later output would keep."""
    if named is not None and other is not None and named.resolve() == other.resolve():
        raise SessionError(f"{option} {named}: {before} goes there, too; name another file")


def shown(named: Path) -> str:
    """Return the name of an output in messages."""
    return "standard output" if is_stdout(named) else str(named)


def print_lines(lines: Iterable[str], *written: Path | None) -> None:
    """Print lines for people; to standard error if one of the outputs `written` is `-`."""
    stream = sys.stderr if any(map(is_stdout, written)) else sys.stdout
    stream.write("\n".join(lines) + "\n")


def write_text(path: Path, text: str, option: str) -> None:
    """Write a text to the file that an option names or to standard output; else SessionError."""
    if is_stdout(path):
        sys.stdout.flush()
        sys.stdout.buffer.write(text.encode("utf-8"))  # the same bytes on every system
        sys.stdout.buffer.flush()
        return
    errors = reporting(SessionError, f"{option} {path}: cannot be written")
    with errors, appearing_whole(path) as part:
        part.write_text(text, encoding="utf-8", newline="\n")
