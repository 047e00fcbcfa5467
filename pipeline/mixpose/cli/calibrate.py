"""``mixpose calibrate``: calibrate the sensors of a session from its recording."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from mixpose import __version__
from mixpose.calibration import Calibration, CalibrationRules, Task, calibrate, words
from mixpose.calibration.recorded import read_frames, require_points, require_times, rig_of
from mixpose.calibration.searching import MARK as SAVED_MARK
from mixpose.calibration.searching import Saved
from mixpose.calibration.task import Progress
from mixpose.calibration.telling import check_lines, doubts_of, lines_of
from mixpose.calibration.writing import MARK, calibrated_text
from mixpose.cli import output
from mixpose.cli.app import CalibrateRequest
from mixpose.cli.notices import say, shown_progress, warn
from mixpose.cli.run import named_sources
from mixpose.errors import RecordingError, SessionError
from mixpose.fit import free_mask
from mixpose.poses.jsonl import read_poses
from mixpose.records import Floats
from mixpose.report.calibration import MARK as REPORT_MARK
from mixpose.report.calibration import render_calibration
from mixpose.session import Session, load_session
from mixpose.session.rewriting import refuse_held_directions, refuse_lost_code


def calibrate_session(request: CalibrateRequest) -> None:
    """Calibrate a session; write the calibrated session and the report."""
    path = request.session
    session = load_session(path, allow_code=request.allow_code)
    target = request.output
    if (target is None) is not request.check:
        raise SessionError("calibrate: found no -o; allowed: -o CALIBRATED.toml, or --check alone")
    output.refuse_one_for_two(request.report, "--report", target, "-o")
    if target is not None:
        output.refuse_suffix(target, (".toml",), "it is a session that is written")
        refuse_lost_code(session, target)
        if request.world is not None:
            refuse_held_directions(session)
    inputs = path, request.poses
    for written, mark, option in ((target, MARK, "-o"), (request.report, REPORT_MARK, "--report")):
        if written is not None:
            output.refuse_to_overwrite_but(written, inputs, mark, option)
    with _calibrated(session, request, inputs) as result:
        if target is not None:
            output.write_text(target, calibrated_text(session, result, target, __version__), "-o")
        if request.report is not None:
            page = render_calibration(result, path.name, session.unit, __version__)
            output.write_text(request.report, page, "--report")
    lines = (check_lines if target is None else lines_of)(result, session.unit)
    output.print_lines(lines, target, request.report)
    _warn(result, session.unit)
    if target is not None:
        say(f"calibrated from {len(result.used)} frames -> {output.shown(target)}")


@contextmanager
def _calibrated(
    session: Session, request: CalibrateRequest, inputs: Sequence[Path | None]
) -> Iterator[Calibration]:
    """Yield the calibration; frames already searched stay saved until it is written."""
    rules = CalibrationRules()
    with ExitStack() as stack:
        with shown_progress() as progress:
            task = task_of(session, request, rules, progress)
            say(f"free: {words.words_of(task.rig.names, task.free, task.body_free)}")
            if len(session.objects) > 1:
                say(f"of {len(session.objects)} bodies {session.body.name!r} is looked at")
            saved = None
            if request.output is not None and not output.is_stdout(request.output):
                partial = request.output.with_name(f"{request.output.name}.partial")
                output.refuse_to_overwrite_but(partial, inputs, SAVED_MARK)
                saved = stack.enter_context(Saved(partial, _key_of(session, task)))
                if saved.resumed:
                    say(f"going on: {saved.resumed} frames of cameras were searched before")
            calibration = calibrate(task, rules, progress=progress, found=saved)
        if request.length is not None:
            calibration = words.in_length(calibration, request.length)
        yield calibration if request.world is None else words.in_world(calibration, request.world)


def task_of(
    session: Session, request: CalibrateRequest, rules: CalibrationRules, progress: Progress
) -> Task:
    """Read the recording, and known poses if there are any."""
    require_points(session.body)
    setups, rig = session.sensors, rig_of(session)
    known = None if request.poses is None else known_poses(request.poses, session)
    free_words = " ".join(request.free or ()).split()  # one of --free may hold several
    is_known = known is not None
    free, body = words.free_parameters(rig, free_words, poses_known=is_known, world=request.world)
    pair = None if request.length is None else words.known_length(rig, request.length)[0]
    if pair is not None and known is not None:
        raise SessionError("--length: stands beside --poses, which give the scale; drop one")
    kinds = {kind for parameters in free.values() for kind in parameters}
    runs = bool(kinds & {"delay", "drift"}) or rig.is_late
    frames = read_frames(
        session, named_sources(request.source or ()), rules, progress, runs=runs, known=known
    )
    if runs:
        require_times(frames, f"{session.path}: --free delay: found frames without times")
    if request.world is not None:
        words.check_world(rig, request.world, [frame.number for frame in frames])
    start = session.start
    return Task(
        rig=rig,
        frames=frames,
        sigmas=np.array([setup.extract.sigma for setup in setups]),
        free=free,
        body_free=body,
        pose_free=free_mask(session.estimator),
        T_held=None if start is None else start.T_world_object,
        around=(None, None) if start is None else (start.rotation_deg, start.distance),
        fuse=session.estimator.fuse,
        known=known,
        length=pair,
        errors={
            k: words.error_of_held(setup.calibration_error, free.get(k, ()))
            for k, setup in enumerate(setups)
            if setup.calibration_error is not None
        },
    )


def known_poses(path: Path, session: Session) -> dict[int, Floats]:
    """Return poses (4, 4) of the session's body by frame number; RecordingError if none is ok."""
    poses = read_poses(path)
    poses.require_unit(session.unit, RecordingError)
    by_frame = {
        line.frame: line.T_world_object
        for line in poses.poses
        if line.T_world_object is not None
        and line.status == "ok"
        and line.object == session.body.name
    }
    if not by_frame:
        raise RecordingError(
            f"--poses {path}: found no pose of {session.body.name!r} that is ok; allowed: pose "
            "lines of the session's object"
        )
    return by_frame


def _key_of(session: Session, task: Task) -> str:
    """Return a digest of all that the pose hypotheses of single cameras depend on."""
    digest = hashlib.sha256(f"{__version__} {session.sha256}".encode())
    for frame in task.frames:
        digest.update(str(frame.number).encode())
        for sensor, points in sorted(frame.points.items()):
            digest.update(str(sensor).encode() + np.ascontiguousarray(points).tobytes())
    return digest.hexdigest()


def _warn(result: Calibration, unit: str) -> None:
    names = result.after.names
    for sensor in result.unlinked:
        warn(
            f"sensor {names[sensor]!r} shares no view of the body with the others and stays as it "
            "was: record the body where both see it"
        )
    for doubt in doubts_of(result, unit):
        warn(doubt)
    for direction in result.refused:
        warn(f"not determined: {direction}: what is written of it tells nothing")
    if result.bad:
        numbers = ", ".join(map(str, result.bad[:8])) + (", ..." if len(result.bad) > 8 else "")
        warn(f"{len(result.bad)} frames left out, most of their features are not met: {numbers}")
