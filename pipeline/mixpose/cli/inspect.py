"""``mixpose inspect``: draw and describe one frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from mixpose.body import Body
from mixpose.cli.app import InspectRequest
from mixpose.cli.output import print_lines, refuse_stdout
from mixpose.cli.run import named_sources
from mixpose.cli.session_formats import recording_of
from mixpose.errors import RecordingError, SessionError, reporting, require_plots
from mixpose.frames import Source, pair
from mixpose.pictures import advice, finding, scene, sheet, signature
from mixpose.pictures.canvas import Picture
from mixpose.poses.jsonl import PoseFile, read_poses
from mixpose.records import Estimate, FrameSet, PointPattern
from mixpose.runner import clouds_of, observe, open_sources, scene_of
from mixpose.session import Session, load_session
from mixpose.tracking import with_clouds


def inspect_frame(request: InspectRequest) -> None:
    """Draw and describe a frame; its poses are estimated from it alone, or taken from a run."""
    folder, poses = request.output, request.poses
    refuse_stdout(folder, "-o", "pictures", "a folder, as -o seen")
    session = load_session(request.session, allow_code=request.allow_code)
    require_plots("inspect: plots need")
    _check_folder(folder, session)
    pose_file, named = None if poses is None else read_poses(poses), request.source or ()
    if pose_file is None:
        opened = open_sources(session, named_sources(named))
    else:
        pose_file.require_unit(session.unit, SessionError)
        opened = recording_of(pose_file, session, named)
    frame_set = _frame(opened, request.frame)
    number = frame_set.number
    views = observe(session, frame_set)
    tracked = scene_of(session)
    if pose_file is None:
        _, estimates = tracked.advance(tracked.begin(), number, frame_set.time_s, views)
    else:
        estimates = _from_file(pose_file, session, number)
    bodies = [*session.bodies.values()]
    clouds = clouds_of(session)
    estimates = [with_clouds(estimate, clouds) for estimate in estimates]
    drawn = tuple(setup for setup in session.sensors if setup.name not in clouds)
    all_findings = finding.find_several(drawn, frame_set.frames, views, bodies, estimates)
    shown = replace(session, sensors=drawn)
    pictures: dict[str, Picture] = {}
    lines = []
    if len(bodies) > 1 and drawn:
        pictures[sheet.BODIES] = scene.draw_scene(shown, frame_set, *estimates)
    entries = zip(sheet.prefixes_of(session.labels), bodies, all_findings, estimates, strict=True)
    for prefix, body, findings, estimate in entries:
        drawn_pictures = sheet.inspection_pictures(shown, body, findings, estimate) if drawn else {}
        pictures |= {prefix + name: picture for name, picture in drawn_pictures.items()}
        lines += summary(session, body, estimate, findings, poses)
        lines += _of_clouds(session, frame_set, body, estimate)
    with reporting(SessionError, f"-o {folder}: cannot be made"):
        folder.mkdir(exist_ok=True)
    for name, picture in pictures.items():
        signature.write_png(folder / name, picture)
    lines.append(f"pictures in {folder}: {', '.join(pictures) or 'none'}")
    print_lines(lines)


def _check_folder(folder: Path, session: Session) -> None:
    if folder.exists() and not folder.is_dir():
        raise SessionError(f"-o {folder}: is a file; name a folder for the pictures")
    if not folder.parent.is_dir():
        raise SessionError(f"-o {folder}: there is no folder {folder.parent}")
    places = [(s.name, (session.folder / e).resolve()) for s in session.sensors for e in s.sources]
    for name in sheet.possible_names(session):
        path = (folder / name).resolve()
        signature.refuse_foreign(folder / name, "-o")
        for sensor, place in places:
            if path.parent == place or path.match(str(place)):
                raise SessionError(
                    f"-o {folder}: {name} would be taken for a frame of the sensor {sensor!r}; "
                    "name another folder"
                )


def _frame(opened: Mapping[str, Source], number: int | None) -> FrameSet:
    with closing(pair(opened, number, None if number is None else number + 1)) as frames:
        frame_set = next(frames, None)
    if frame_set is not None:
        return frame_set
    recordings = "; ".join(f"{name}: {source.describe()}" for name, source in opened.items())
    if number is None:
        raise RecordingError(f"the recording has no frame; it has {recordings}")
    raise SessionError(f"--frame {number}: the recording has no such frame; it has {recordings}")


def _from_file(file: PoseFile, session: Session, number: int) -> list[Estimate]:
    """Return the poses of a frame as a run wrote them, one per body."""
    path = file.path
    estimates: list[Estimate] = []
    for label in session.labels:
        of_body = [pose for pose in file.poses if pose.label == label]
        if not of_body:
            others = ", ".join(sorted({pose.label for pose in file.poses}))
            raise SessionError(
                f"--poses {path}: found poses of {others or 'nothing'}, the session's object is "
                f"{label}"
            )
        of_frame = [pose for pose in of_body if pose.frame == number]
        if not of_frame:
            numbers = [pose.frame for pose in of_body]
            raise SessionError(
                f"--frame {number}: {path} has no pose of it, found frames {min(numbers)} to "
                f"{max(numbers)}"
            )
        estimates.append(of_frame[0])
    return estimates


def _of_clouds(
    session: Session, frame_set: FrameSet, body: Body, estimate: Estimate
) -> Iterator[str]:
    """Yield what a pose meets in each cloud; clouds are not drawn."""
    for name in clouds_of(session):
        frame, report = frame_set.frames.get(name), estimate.sensors.get(name)
        data = None if frame is None else frame.data
        if not isinstance(data, PointPattern):
            yield f"{name}: no frame"
            continue
        met = [r for r in report.residuals.values() if r is not None] if report else []
        rms = None if report is None else report.rms
        within = "" if rms is None else f" within {rms:.3g} {session.unit} RMS"
        yield (
            f"{name}: {len(data.points)} points found; the pose meets {len(met)} of {len(body)} "
            f"features{within}; clouds are not drawn"
        )


def summary(
    session: Session,
    body: Body,
    estimate: Estimate,
    findings: Sequence[finding.Finding],
    poses: Path | None,
) -> list[str]:
    """Return lines about a body in a frame: the origin of its pose, and what to change."""
    origin = "estimated on its own" if poses is None else f"pose of {poses}"
    whose = f"{estimate.label} " if len(session.labels) > 1 else ""
    head = f"{session.path}, frame {estimate.frame}: {whose}{estimate.status} ({origin})"
    if len(estimate.hypotheses) > 1:
        weights = ", ".join(f"{hypothesis.weight:.2g}" for hypothesis in estimate.hypotheses)
        head += f"; {len(estimate.hypotheses)} poses with weights {weights}, the first is shown"
    lines, why = [head], estimate.doubt
    if estimate.status == "ambiguous" and len(estimate.hypotheses) < 2:
        why = why or "so little is met that other things may look so"
    if why:
        lines.append(f"why: {why}; confidence {estimate.confidence:.3g}")
    if estimate.proposer:
        lines.append(f"the pose came from: {estimate.proposer}")
    for result in findings:
        lines += advice.describe(result, body, session.unit)
    if estimate.status == "lost":
        lines.append(
            f"lost: once the counts are right, mixpose check {session.path} tries what else may be "
            "wrong with calibrations, places, sources or the body"
        )
    return lines
