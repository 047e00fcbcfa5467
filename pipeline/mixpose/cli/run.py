"""``mixpose run``: poses to a file or to standard output, as soon as each frame is done."""

from __future__ import annotations

import sys
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from mixpose import __version__
from mixpose.cli.notices import Summary, origin_of, say, warn_of_sources
from mixpose.cli.output import (
    Output,
    OutputPerBody,
    is_apart,
    refuse_to_overwrite,
    written_paths,
)
from mixpose.cli.request import RunRequest
from mixpose.errors import SessionError
from mixpose.frames import Source
from mixpose.poses.header import Header
from mixpose.poses.jsonl import read_poses, resume_point
from mixpose.records import Estimate, Floats
from mixpose.runner import Watch, open_sources, run
from mixpose.selection import Selection
from mixpose.session import Session, load_session
from mixpose.tracking.proposers.predicted import predicted

SWITCH_S = 1e-4
"""After so long a thread that has decoded a frame is let on; Python's own 5 ms is a whole frame."""


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
    replaced = named_sources(request.sources)
    header = header_of(session, replaced)
    selection, T_start, resumed = request.selection, None, False
    opened = open_sources(session, replaced)
    outputs = (
        []
        if request.output is None
        else written_paths(request.output, request.format, header.labels)
    )
    for written in outputs:
        if not _is_device(written):
            refuse_to_overwrite(written, _inputs(session))
    if request.resume:
        _refuse_live(opened)
        selection, T_start, resumed = _resumed(request, header)
    warn_of_sources(opened)
    summary = Summary(session)
    with ExitStack() as stack:
        stack.enter_context(prompt_switching())
        watch = _overlay(stack, session, request)
        estimates = run(session, opened=opened, selection=selection, T_start=T_start, watch=watch)
        stack.enter_context(closing(estimates))
        output = _output(request, header, append=resumed)
        stack.enter_context(output)
        for estimate in _with_progress(estimates, session, quiet=request.output is None):
            output.write(estimate)
            summary.add(estimate)
            if request.debug and estimate.proposer != predicted.__name__:
                say(f"frame {estimate.frame}: {origin_of(estimate)}")
    if resumed and not summary.statuses:
        say(f"nothing left to do: {request.output} has all frames asked for already")
        return
    names = [str(each) for each in (*outputs, request.overlay) if each is not None]
    summary.say(f" -> {', '.join(names)}" if names else "")


def _output(request: RunRequest, header: Header, *, append: bool) -> Output | OutputPerBody:
    if is_apart(request.format, header.labels):
        return OutputPerBody(request.output, request.format, header, header.labels)
    return Output(request.output, request.format, header, append=append)


@contextmanager
def prompt_switching() -> Iterator[None]:
    """Let the threads that decode wait less for the one that estimates."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def _overlay(stack: ExitStack, session: Session, request: RunRequest) -> Watch | None:
    """What draws each frame, finished with the stack; None where nothing is to be drawn."""
    if request.overlay is None:
        return None
    from mixpose.pictures.movie import Overlay  # noqa: PLC0415 - only where it is drawn

    return stack.enter_context(Overlay(session, request.overlay, resume=request.resume)).watch


def _is_device(path: Path) -> bool:
    """Whether a path is a pipe or a device, which holds nothing that could be lost."""
    return path.exists() and not path.is_file() and not path.is_dir()


def _inputs(session: Session) -> Iterator[Path]:
    """Files that a run reads."""
    yield session.path
    for setup in session.sensors:
        names = (setup.source,) if isinstance(setup.source, str) else setup.source
        for name in names:
            yield session.folder / name
            if isinstance(setup.source, str) and "://" not in name:
                yield from session.folder.glob(name) if not Path(name).is_absolute() else ()
        if setup.times is not None:
            yield setup.times


def header_of(session: Session, sources: Mapping[str, str] | None = None) -> Header:
    """The first line of the poses of a session, with the recordings given in place of its own."""
    return Header(
        unit=session.unit,
        session=str(session.path),
        session_sha256=session.sha256,
        mixpose=__version__,
        seed=session.estimator.seed,
        symmetries={one.body.name: one.body.symmetries for one in session.objects},
        sources=sources or {},
        sensors=tuple(setup.name for setup in session.sensors),
        objects={one.body.name: one.count for one in session.objects},
    )


def named_sources(named: Iterable[str]) -> dict[str, str]:
    """Recordings by sensor name, from texts like ``left=frames/``.

    Raises
    ------
    SessionError
        If a text is not of this form.
    """
    sources = {}
    for text in named:
        name, separator, path = text.partition("=")
        if not separator or not name or not path:
            raise SessionError(f"--source {text}: found no NAME=PATH, as in --source left=frames/")
        sources[name] = path
    return sources


def _refuse_live(opened: Mapping[str, Source]) -> None:
    for name, source in opened.items():
        if source.kind == "live":
            raise SessionError(
                f"--resume: sensor {name!r} is live, what it missed is gone; leave out --resume "
                "and name another file with -o"
            )


def _resumed(
    request: RunRequest, header: Header
) -> tuple[Selection, dict[str, Floats] | None, bool]:
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
        steps = max(-(-(begin - wanted.start) // wanted.step), 0)
        begin = wanted.start + steps * wanted.step
    elif wanted.step > 1:
        begin = last + wanted.step
    trusted = {
        pose.label: pose.T_world_object
        for pose in read_poses(request.output).poses
        if pose.T_world_object is not None
    }
    return Selection(begin, wanted.stop, wanted.step), trusted, True


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
