"""``mixpose run``: poses to a file or to standard output, as soon as each frame is done."""

from __future__ import annotations

import sys
from collections.abc import Generator, Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from mixpose import __version__
from mixpose.errors import SessionError
from mixpose.poses.formats import FORMATS, PoseWriter
from mixpose.poses.header import Header
from mixpose.poses.jsonl import JsonlWriter, read_poses, resume_point
from mixpose.records import Estimate, Floats
from mixpose.runner import Selection, run
from mixpose.session import Session, load_session


@dataclass(frozen=True)
class RunRequest:
    """The options of ``mixpose run``."""

    output: Path | None
    format: str
    sources: tuple[str, ...]
    selection: Selection
    resume: bool


def run_session(path: Path, request: RunRequest) -> None:
    """Estimate every frame of a session's recording and write the poses.

    Raises
    ------
    SessionError
        If the session or the options are wrong.
    RecordingError
        If the recording cannot be read; frames already estimated stay written.
    """
    session = load_session(path)
    header = header_of(session)
    selection, T_start = request.selection, None
    resumed = False
    if request.resume:
        selection, T_start, resumed = _resumed(request, header)
    estimates = run(
        session, sources=_sources(request.sources), selection=selection, T_start=T_start
    )
    with ExitStack() as stack:
        stack.enter_context(closing(estimates))
        stream = _open(request.output, stack, append=resumed)
        writer: PoseWriter
        if request.format == "jsonl":
            writer = JsonlWriter(stream, header, resume=resumed)
        else:
            writer = FORMATS[request.format](stream, header)
        stack.callback(writer.close)
        for estimate in _with_progress(estimates, session, quiet=request.output is None):
            writer.write(estimate)


def header_of(session: Session) -> Header:
    """The first line of the poses of a session."""
    return Header(
        unit=session.unit,
        session=str(session.path),
        session_sha256=session.sha256,
        mixpose=__version__,
        seed=session.estimator.seed,
        symmetries={session.body.name: session.body.symmetries},
        sensors=tuple(setup.name for setup in session.sensors),
    )


def _sources(named: Iterable[str]) -> dict[str, str]:
    sources = {}
    for text in named:
        name, separator, path = text.partition("=")
        if not separator or not name or not path:
            raise SessionError(f"--source {text}: found no NAME=PATH, as in --source left=frames/")
        sources[name] = path
    return sources


def _resumed(request: RunRequest, header: Header) -> tuple[Selection, Floats | None, bool]:
    """What is left to do after the frames that stand in the output already."""
    if request.output is None or request.format != "jsonl":
        raise SessionError("--resume: needs -o FILE in the format jsonl, which it goes on writing")
    last = resume_point(request.output, header)
    if last is None:
        return request.selection, None, False
    wanted = request.selection
    begin = last + 1
    if wanted.start is not None:
        # stay on the numbers that the whole run would have taken
        begin = wanted.start + -(-(begin - wanted.start) // wanted.step) * wanted.step
    elif wanted.step > 1:
        begin = last + wanted.step
    trusted = [
        pose.T_world_object
        for pose in read_poses(request.output).poses
        if pose.T_world_object is not None
    ]
    T_start = trusted[-1] if trusted else None
    return Selection(begin, wanted.stop, wanted.step), T_start, True


def _open(output: Path | None, stack: ExitStack, *, append: bool) -> TextIO:
    if output is None:
        return sys.stdout
    try:
        stream = output.open("a" if append else "w", encoding="utf-8", newline="\n")
    except OSError as error:
        raise SessionError(f"-o {output}: cannot be written: {error.strerror}") from error
    return stack.enter_context(stream)


def _with_progress(
    estimates: Generator[Estimate, None, None], session: Session, *, quiet: bool
) -> Iterable[Estimate]:
    """Show a bar on standard error while poses go to a file and a person is watching."""
    if quiet or not sys.stderr.isatty():
        yield from estimates
        return
    from rich.console import Console  # noqa: PLC0415 - only where it is shown
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn  # noqa: PLC0415

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(str(session.path), total=None)
        lost = 0
        for count, estimate in enumerate(estimates, 1):
            lost += estimate.status == "lost"
            text = f"frame {estimate.frame}, {count} done, {lost} lost"
            progress.update(task, advance=1, description=text)
            yield estimate
