"""``mixpose run``: write poses to a file or to standard output as soon as each frame is done."""

from __future__ import annotations

import glob
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path

from mixpose import __version__
from mixpose.checking import shared_source_warnings
from mixpose.cli.continuation import Notes, is_device, resume
from mixpose.cli.notices import Summary, bar, origin_of, say, warn
from mixpose.cli.output import Output, refuse_stdout, refuse_to_overwrite, written_paths
from mixpose.cli.request import RunRequest
from mixpose.errors import SessionError
from mixpose.frames import Source
from mixpose.objective import View
from mixpose.poses.header import Header
from mixpose.records import Estimate, FrameSet
from mixpose.runner import Memory, Watch, open_sources, run
from mixpose.session import Session, load_session
from mixpose.threads import prompt_switching
from mixpose.tracking import PosePredictor
from mixpose.tracking.proposers import predicted


def run_session(request: RunRequest) -> None:
    """Write the poses of a recording; whatever is raised, those estimated already stay written."""
    with ExitStack() as pages:  # closed after the poses
        _run_session(request, pages)


def _run_session(request: RunRequest, pages: ExitStack) -> None:
    session = load_session(request.sessions[0], allow_code=request.allow_code)
    replaced = named_sources(request.source or ())
    header = header_of(session, replaced, request.options)
    opened = open_sources(session, replaced)
    outputs = written_paths(request.poses, request.format_name, header.labels)
    for path in outputs:
        if not is_device(path):
            refuse_to_overwrite(path, _inputs(session))
    plan = resume(request, header, opened)
    if plan.is_done:
        say(f"nothing left to do: {request.poses} has all frames asked for already")
        return
    cautions = [f"sensor {k!r}: {text}" for k, s in opened.items() if (text := s.caution())]
    for warning in (*shared_source_warnings(session, replaced), *cautions):
        warn(warning)
    summary = Summary(session)
    view = _view(pages, session, request, opened)
    output = Output(request.poses, request.format_name, header, header.labels, resumed=plan.file)

    def call_watches(frame_set: FrameSet, views: Sequence[View], estimate: Estimate) -> None:
        for watch in watches if plan.is_new(estimate, session.labels) else ():
            watch(frame_set, views, estimate)

    with output, prompt_switching(), ExitStack() as stack:
        watches = [*_watches(stack, session, request, header), summary.findings.watch, *view]
        memories: deque[Memory] = deque(maxlen=1)
        estimates = run(
            session,
            opened=opened,
            selection=plan.selection,
            watch=call_watches,
            memory=plan.memory,
            remember=memories.append,
            labels=request.labels,
        )
        stack.enter_context(closing(estimates))
        notes = stack.enter_context(Notes(request))
        for estimate in _with_progress(estimates, session, quiet=request.poses is None):
            if not plan.is_new(estimate, session.labels):
                continue
            output.write(estimate)
            is_whole = estimate.label == session.labels[-1]  # all bodies of the frame are written
            if output.file is not None and is_whole:
                notes.remember(estimate.frame, output.file, memories[-1])
            summary.add(estimate)
            if request.debug and estimate.proposer != predicted.__name__:
                say(f"frame {estimate.frame}: {origin_of(estimate)}")
    names = [str(path) for path in (*outputs, request.overlay) if path is not None]
    summary.say(f" -> {', '.join(names)}" if names else "")


def _watches(
    stack: ExitStack, session: Session, request: RunRequest, header: Header
) -> Iterator[Watch]:
    """Yield the watches that publish poses and draw overlays, if requested; the stack ends them."""
    ahead_s = request.ahead_s
    if request.publish:
        from mixpose.publishing import Publishing  # noqa: PLC0415 - only where it is published

        bodies = session.bodies.items()
        foresee = {label: _foresee(PosePredictor(body), ahead_s) for label, body in bodies}
        publishing = Publishing(request.publish, header, say, foresee if ahead_s else None, ahead_s)
        yield stack.enter_context(publishing).watch
    if request.overlay is not None:
        instead = "a folder or a video, as --overlay run.mp4"
        refuse_stdout(request.overlay, "--overlay", "pictures", instead)
        from mixpose.pictures.movie import Overlay  # noqa: PLC0415 - only where it is drawn

        overlay = Overlay(session, request.overlay, resume=request.resume)
        yield stack.enter_context(overlay).watch


def _foresee(predictor: PosePredictor, seconds: float) -> Callable[[Estimate], Estimate]:
    """Return a function that predicts a body's pose `seconds` ahead from successive estimates."""

    def foresee(estimate: Estimate) -> Estimate:
        nonlocal predictor
        predictor = predictor.after(estimate)
        return predictor.ahead(estimate, seconds)

    return foresee


def _view(
    stack: ExitStack, session: Session, request: RunRequest, opened: Mapping[str, Source]
) -> list[Watch]:
    """Return the watch that shows frames on a page, if requested; the stack closes the page."""
    if request.view is None:
        if request.pause:
            raise SessionError("--pause: nothing to go on with; add --view")
        return []
    from mixpose.viewing import Viewer  # noqa: PLC0415 - only where it is shown

    waits = all(source.kind != "live" for source in opened.values())
    viewer = Viewer(session, request.view, say, on_files=waits, paused=request.pause)
    stack.enter_context(viewer).announce()
    return [viewer.watch]


def _inputs(session: Session) -> Iterator[Path]:
    """Yield the files that a run reads, which no output may replace."""
    yield session.path
    for setup in session.sensors:
        for pattern in setup.sources:
            yield session.folder / pattern
            if isinstance(setup.source, str) and "://" not in pattern:
                # frames are found by glob.glob, too: Path.glob takes other patterns
                names = glob.glob(pattern, root_dir=session.folder, recursive=True)  # noqa: PTH207
                yield from (session.folder / name for name in names)
        if setup.times is not None:
            yield setup.times


def header_of(
    session: Session,
    sources: Mapping[str, str] | None = None,
    options: Mapping[str, int | bool] | None = None,
) -> Header:
    """Return the header of poses; `sources` replace the session's, `options` change pose lines."""
    return Header(
        unit=session.unit,
        session=str(session.path),
        session_sha256=session.sha256,
        mixpose=__version__,
        seed=session.estimator.seed,
        symmetries={setup.body.name: setup.body.symmetries for setup in session.objects},
        sources=sources or {},
        options=options or {},
        sensors=tuple(setup.name for setup in session.sensors),
        objects={setup.body.name: setup.count for setup in session.objects},
        tips=any(setup.body.tip is not None for setup in session.objects),
    )


def named_sources(named: Iterable[str]) -> dict[str, str]:
    """Return recordings by sensor, from texts like ``left=frames/``; ``left=0`` is camera 0."""
    sources = {}
    for text in named:
        name, separator, path = text.partition("=")
        if not separator or not name or not path:
            raise SessionError(f"--source {text}: found no NAME=PATH, as in --source left=frames/")
        # a session file has a number without quotes here; an existing file of this name comes first
        is_camera = path.isdecimal() and not Path(path).exists()
        sources[name] = f"camera:{path}" if is_camera else path
    return sources


def _with_progress(
    estimates: Generator[Estimate, None, None], session: Session, *, quiet: bool
) -> Iterable[Estimate]:
    """Pass estimates on; show progress on standard error, on a terminal and unless `quiet`."""
    lost = 0
    with bar(str(session.path), None, shown=not quiet, spins=True) as advance:
        for count, estimate in enumerate(estimates, 1):
            lost += estimate.status == "lost"
            advance(advance=1, description=f"frame {estimate.frame}, {count} done, {lost} lost")
            yield estimate
