"""``mixpose learn``: learn tables of markers from a recording in which bodies move."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mixpose.cli import output
from mixpose.cli.app import LearnRequest
from mixpose.cli.notices import say, shown_progress, warn
from mixpose.cli.run import named_sources
from mixpose.errors import RecordingError, SessionError
from mixpose.learning import LearningResult, LearntBody, in_axes_of, in_marker_axes, learn
from mixpose.learning.telling import MARK, doubts_of, lines_of, look_alikes, table_text
from mixpose.session import Session, load_scene
from mixpose.session.marker_files import Markers, read_marker_file
from mixpose.session.messages import BadKeyError


def learn_session(request: LearnRequest) -> None:
    """Learn the bodies of a recording and write their tables; RecordingError if none moves."""
    path = request.session
    session = load_scene(path, allow_code=request.allow_code)
    inputs = path, request.like
    output.refuse_to_overwrite_but(request.output, inputs, MARK)
    output.refuse_suffix(request.output, (".csv", ".txt"), "a body is a table of markers")
    older = None
    if request.like is not None:
        try:
            older = read_marker_file(request.like, session.unit)
        except BadKeyError as problem:
            raise SessionError(f"--like {request.like}: {problem.text}") from problem
    if others := [setup.name for setup in session.sensors if setup.sensor.dimension < 2]:
        warn(f"{', '.join(others)}: bodies are learnt from cameras and clouds, and not from this")
    with shown_progress() as progress:
        lesson = learn(session, named_sources(request.source or ()), progress)
    bodies = _in_frames(lesson, request, older)
    if len(bodies) > 1 and output.is_stdout(request.output):
        raise SessionError(
            f"-o -: found {len(bodies)} bodies, each of which gets a table of its own; name a "
            "file, as -o body.csv"
        )
    first, more = request.output, range(2, len(bodies) + 1)
    files = [first, *(first.with_name(f"{first.stem}-{k}{first.suffix}") for k in more)]
    for file, body in zip(files, bodies, strict=True):
        output.refuse_to_overwrite_but(file, inputs, MARK)
        output.write_text(file, table_text(body), "-o")
    _report(lesson, bodies, files, session)


def _in_frames(
    lesson: LearningResult, request: LearnRequest, older: Markers | None
) -> list[LearntBody]:
    """Return the bodies in the requested axes, first the one that is like the older table."""
    bodies = list(lesson.bodies)
    if older is not None:
        fits = [(in_axes_of(body, older.points, older.names), k) for k, body in enumerate(bodies)]
        alike = [(-fit.shared, fit.max_distance, k, fit) for fit, k in fits if fit is not None]
        if not alike:
            raise RecordingError(
                f"--like {request.like}: found bodies of "
                f"{', '.join(str(len(body.points)) for body in bodies)} markers that move, none "
                "of which has those of the table; see without --like what they are"
            )
        _, off, k, best = min(alike, key=lambda entry: entry[:3])
        say(f"like {request.like}: {best.shared} markers in both, {off:.3g} off at most")
        if best.other_ways:
            warn(
                f"--like {request.like}: the markers can be laid on it in {best.other_ways} other "
                f"way{'s' * (best.other_ways > 1)} with as many of them; the closest is taken"
            )
        bodies = [best.body, *(body for n, body in enumerate(bodies) if n != k)]
    if request.axes is not None:
        bodies[0] = in_marker_axes(bodies[0], request.axes)
    return bodies


def _report(
    lesson: LearningResult, bodies: Sequence[LearntBody], files: Sequence[Path], session: Session
) -> None:
    lines = list[str]()
    shown_files = [Path("body.csv") if output.is_stdout(file) else file for file in files]
    for file, body in zip(shown_files, bodies, strict=True):
        lines += lines_of(body, file.name, session.unit)
    if len(bodies) > 1 or bodies[0].count > 1:
        lines.append("in the session:")
        for file, body in zip(shown_files, bodies, strict=True):
            lines += ["", "[[object]]", f'name = "{file.stem}"', f'file = "{file.name}"']
            lines += [f"count = {body.count}"] if body.count > 1 else []
    output.print_lines(lines, *files)
    names = [file.name for file in shown_files]
    pairs = list(zip(bodies, names, strict=True))
    doubts = [text for pair in pairs for text in doubts_of(*pair, session.unit)]
    doubts += look_alikes(bodies, names)
    if late := [setup.name for setup in session.sensors if setup.delay or setup.readout]:
        doubts += [
            f"{name}: delay and readout of {', '.join(late)} are not looked at for bodies alike, "
            "of which none is followed: move slowly, or learn from a recording of one alone"
            for body, name in pairs
            if body.count > 1
        ]
    for doubt in doubts:
        warn(doubt)
    others = f"; {lesson.still} other points stood still" if lesson.still else ""
    say(f"learnt from {lesson.frames} frames -> {', '.join(map(output.shown, files))}{others}")
