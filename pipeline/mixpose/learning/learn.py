"""Bodies from a recording in which they move: what is called from outside."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mixpose.calibration import CalibrationRules, SeenFrame
from mixpose.calibration.recorded import read_frames, require_times, rig_of
from mixpose.calibration.task import Progress, silent
from mixpose.errors import RecordingError, SessionError
from mixpose.learning.adjusting import Eyes, Learnt, adjusted
from mixpose.learning.axes import in_principal_axes
from mixpose.learning.bodies import find_bodies
from mixpose.learning.points import Cloud, are_points, clouds_of, without_places, without_still
from mixpose.learning.rules import RULES
from mixpose.records import Floats
from mixpose.session import Session
from mixpose.threads import one_blas_thread


@dataclass(frozen=True, eq=False)
class Lesson:
    """What a recording told."""

    bodies: tuple[Learnt, ...]  # in their principal axes, those of which most was seen first
    still: int  # other things that were seen and stood still all the time
    frames: int  # that were read
    noise: float  # of detections, as a share of σ_ε, by how closely lines of sight meet


def eyes_of(session: Session) -> Eyes:
    """The sensors of a session; a SessionError without two that have lines of sight, or a cloud."""
    setups = session.sensors
    seeing = [one.name for one in setups if one.sensor.dimension == 2]
    if len(seeing) < 2 and not are_points([one.sensor for one in setups]).any():
        raise SessionError(
            f"{session.path}: learn: found {len(seeing)} camera{'s' * (len(seeing) != 1)}; "
            "allowed: two or more that see the body at the same time, or a cloud of points. With "
            "one camera, put a rough guess of the markers into [object] and let mixpose calibrate "
            "--free body adjust it"
        )
    errors = {k: one.calibration_error for k, one in enumerate(setups) if one.calibration_error}
    return Eyes(rig_of(session), np.array([one.extract.sigma for one in setups]), errors)


def learn(
    session: Session, sources: dict[str, str] | None = None, progress: Progress = silent
) -> Lesson:
    """Learn the bodies that move in a session's recording.

    The session's own bodies are not looked at; `sources` stand in place of its recordings.  Raises
    SessionError if there are fewer than two cameras and no cloud, RecordingError if the recording
    cannot be read, or shows no body that moves.
    """
    eyes = eyes_of(session)
    read = CalibrationRules(most_read=RULES.most_frames, most_candidates=RULES.most_frames)
    runs = eyes.rig.is_late
    frames = read_frames(session, sources or {}, read, progress, runs=runs, known=None)
    if runs:
        found = f"{session.path}: learn: found delay or readout, and frames without times"
        require_times(frames, found)
    return learn_from(frames, eyes, progress, name=str(session.path))


@one_blas_thread()
def learn_from(
    frames: Sequence[SeenFrame], eyes: Eyes, progress: Progress = silent, *, name: str = "recording"
) -> Lesson:
    """Learn bodies from detections of a recording, which messages call by a name.

    Raises a RecordingError if no body is seen to move.
    """
    progress("triangulating", 0, 1)
    clouds, noise = clouds_of(frames, eyes.rig.sensors, eyes.sigmas)
    if not any(len(cloud) for cloud in clouds):
        raise RecordingError(_seen_by_one(frames, eyes, name))
    moving, still = without_still(clouds)
    lessons = list[Lesson]()
    for seen, some, own in ((clouds, moving, noise), *_farther_off(clouds, still, noise, eyes)):
        found = find_bodies(some, np.random.default_rng(0), progress)
        progress("adjusting", 0, 1)
        bodies = tuple(map(in_principal_axes, adjusted(found, seen, eyes)))
        lessons.append(Lesson(bodies, len(still), len(frames), own))
    best = max(lessons, key=_shown)
    if not best.bodies:
        raise RecordingError(_nothing_moves(clouds, moving, still, name))
    return best


def _shown(lesson: Lesson) -> tuple[int, int]:
    """How many markers were found, of which any may be missed, and how often they were seen."""
    seen = np.concatenate([np.zeros(0, np.intp), *(body.frames for body in lesson.bodies)])
    return len(seen), int(seen.sum())


def _farther_off(
    clouds: Sequence[Cloud], still: Sequence[Floats], noise: float, eyes: Eyes
) -> Iterator[tuple[list[Cloud], list[Cloud], float]]:
    """Clouds by the noise of what moves, without what stands still, and that, if surely larger."""
    # of cameras out of step lines of sight of what moves do not meet by the noise of all
    sensors, gates = eyes.rig.sensors, RULES.gate * noise * eyes.sigmas
    rest = [without_places(cloud.seen, still, sensors, gates) for cloud in clouds if still]
    if not any(len(points) for frame in rest for points in frame.points.values()):
        return
    others, wider = clouds_of(rest, sensors, eyes.sigmas)
    if wider > RULES.unlike * noise:
        yield others, without_still(others)[0], wider


def _seen_by_one(frames: Sequence[SeenFrame], eyes: Eyes, name: str) -> str:
    """Why there is no point in space."""
    shared = sum(sum(len(points) > 0 for points in f.points.values()) > 1 for f in frames)
    seen = sorted(
        {eyes.rig.names[s] for f in frames for s, points in f.points.items() if len(points)}
    )
    if not shared:
        return (
            f"{name}: learn: found no frame in which two cameras see anything; {', '.join(seen)} "
            f"saw something in {len(frames)} frames; allowed: frames of two cameras or more with "
            "one number, with the body in view of both"
        )
    return (
        f"{name}: learn: found no lines of sight of two cameras that meet, in {shared} frames in "
        "which two see something; see that T_sensor_world is right and frames are of one moment"
    )


def _nothing_moves(
    clouds: Sequence[Cloud], moving: Sequence[Cloud], still: Sequence[Floats], name: str
) -> str:
    """Why no body was found, and which motion would tell."""
    left = float(np.median([len(cloud) for cloud in moving]))
    seen = float(np.median([len(cloud) for cloud in clouds]))
    far = RULES.apart * RULES.gate * float(np.median(np.concatenate([c.reach for c in clouds])))
    wanted = (
        "move the body by about its own size along each axis and turn it by 30 degrees or more "
        "about each, in view of two cameras"
    )
    if left < 3 <= seen or (still and left < len(still)):
        return (
            f"{name}: learn: found {seen:.0f} points in space in most frames, and {len(still)} "
            f"places that never move; what moves and turns is missing, or frames are of different "
            f"moments: {wanted}"
        )
    if seen < 3:
        return (
            f"{name}: learn: found {seen:.0f} points in space in most frames; allowed: three "
            "markers of the body or more that two cameras see at the same time"
        )
    return (
        f"{name}: learn: found {left:.0f} points in space in most frames, but no three that keep "
        f"their distances while they move by {far:.2g} or more, {RULES.least_frames} times; "
        f"{wanted}"
    )
