"""Learn bodies from a recording in which they move: the entry points of this room."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mixpose.calibration import CalibrationRules, SeenFrame
from mixpose.calibration.recorded import read_frames, require_times, rig_of
from mixpose.calibration.task import Progress, silent
from mixpose.errors import RecordingError, SessionError
from mixpose.learning.adjusting import LearntBody, SensorSet, adjust_bodies
from mixpose.learning.axes import in_principal_axes
from mixpose.learning.bodies import find_bodies
from mixpose.learning.points import Cloud, are_points, clouds_of, without_places, without_still
from mixpose.learning.rules import RULES
from mixpose.records import Floats
from mixpose.session import Session
from mixpose.threads import one_blas_thread


@dataclass(frozen=True, eq=False)
class LearningResult:
    """The bodies that a recording shows."""

    bodies: tuple[LearntBody, ...]  # in their principal axes, those seen most first
    still: int  # points of other things, which stood still throughout
    frames: int  # number of frames read
    noise: float  # of detections, as a share of σ_ε, from the gaps between lines of sight


def sensor_set_of(session: Session) -> SensorSet:
    """Return the sensors of a session; raise a SessionError without two cameras or a cloud."""
    setups = session.sensors
    cameras = [setup.name for setup in setups if setup.sensor.dimension == 2]
    if len(cameras) < 2 and not are_points([setup.sensor for setup in setups]).any():
        raise SessionError(
            f"{session.path}: learn: found {len(cameras)} camera{'s' * (len(cameras) != 1)}; "
            "allowed: two or more that see the body at the same time, or a cloud of points. With "
            "one camera, put a rough guess of the markers into [object] and let mixpose calibrate "
            "--free body adjust it"
        )
    errors = {k: s.calibration_error for k, s in enumerate(setups) if s.calibration_error}
    return SensorSet(rig_of(session), np.array([setup.extract.sigma for setup in setups]), errors)


def learn(
    session: Session, sources: dict[str, str] | None = None, progress: Progress = silent
) -> LearningResult:
    """Learn the bodies that move in a session's recording.

    The bodies that the session states are ignored; `sources` replace its recordings.  Raises
    SessionError if there are fewer than two cameras and no cloud, RecordingError if the recording
    cannot be read, or shows no body that moves.
    """
    sensor_set = sensor_set_of(session)
    rules = CalibrationRules(most_read=RULES.most_frames, most_candidates=RULES.most_frames)
    is_late = sensor_set.rig.is_late
    frames = read_frames(session, sources or {}, rules, progress, runs=is_late, known=None)
    if is_late:
        problem = f"{session.path}: learn: found delay or readout, and frames without times"
        require_times(frames, problem)
    return learn_from(frames, sensor_set, progress, name=str(session.path))


@one_blas_thread()
def learn_from(
    frames: Sequence[SeenFrame],
    sensor_set: SensorSet,
    progress: Progress = silent,
    *,
    name: str = "recording",
) -> LearningResult:
    """Learn bodies from the detections of a recording, which error messages call `name`.

    Raises a RecordingError if no body is seen to move.
    """
    progress("triangulating", 0, 1)
    clouds, noise = clouds_of(frames, sensor_set.rig.sensors, sensor_set.sigmas)
    if not any(len(cloud) for cloud in clouds):
        raise RecordingError(_why_no_points(frames, sensor_set, name))
    moving, still = without_still(clouds)
    results = list[LearningResult]()
    separately = _with_noise_of_moving(clouds, still, noise, sensor_set)
    for all_clouds, body_clouds, deviation in ((clouds, moving, noise), *separately):
        placed = find_bodies(body_clouds, np.random.default_rng(0), progress)
        progress("adjusting", 0, 1)
        bodies = tuple(map(in_principal_axes, adjust_bodies(placed, all_clouds, sensor_set)))
        results.append(LearningResult(bodies, len(still), len(frames), deviation))
    best = max(results, key=_sightings)
    if not best.bodies:
        raise RecordingError(_why_no_bodies(clouds, moving, still, name))
    return best


def _sightings(result: LearningResult) -> tuple[int, int]:
    """Return how many markers were found and how often they were seen, to rank results."""
    seen = np.concatenate([np.zeros(0, np.intp), *(body.frames for body in result.bodies)])
    return len(seen), int(seen.sum())


def _with_noise_of_moving(
    clouds: Sequence[Cloud], still: Sequence[Floats], noise: float, sensor_set: SensorSet
) -> Iterator[tuple[list[Cloud], list[Cloud], float]]:
    """Yield clouds, moving clouds and noise of detections that do not stand still, if larger."""
    # if cameras are out of step, lines of sight of moving points miss each other by more than noise
    sensors, gates = sensor_set.rig.sensors, RULES.gate * noise * sensor_set.sigmas
    frames = [without_places(cloud.frame, still, sensors, gates) for cloud in clouds if still]
    if not any(len(points) for frame in frames for points in frame.points.values()):
        return
    all_clouds, wider = clouds_of(frames, sensors, sensor_set.sigmas)
    if wider > RULES.unlike * noise:
        yield all_clouds, without_still(all_clouds)[0], wider


def _why_no_points(frames: Sequence[SeenFrame], sensor_set: SensorSet, name: str) -> str:
    """Return the message for a recording without any point in space."""
    shared = sum(sum(len(points) > 0 for points in f.points.values()) > 1 for f in frames)
    names = sensor_set.rig.names
    seen = sorted({names[s] for f in frames for s, points in f.points.items() if len(points)})
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


def _why_no_bodies(
    clouds: Sequence[Cloud], moving: Sequence[Cloud], still: Sequence[Floats], name: str
) -> str:
    """Return the message for a recording without a body, with the motion that is needed."""
    moved = float(np.median([len(cloud) for cloud in moving]))
    total = float(np.median([len(cloud) for cloud in clouds]))
    far = RULES.apart * RULES.gate * float(np.median(np.concatenate([c.sigma for c in clouds])))
    wanted = (
        "move the body by about its own size along each axis and turn it by 30 degrees or more "
        "about each, in view of two cameras"
    )
    if moved < 3 <= total or (still and moved < len(still)):
        return (
            f"{name}: learn: found {total:.0f} points in space in most frames, and {len(still)} "
            f"places that never move; what moves and turns is missing, or frames are of different "
            f"moments: {wanted}"
        )
    if total < 3:
        return (
            f"{name}: learn: found {total:.0f} points in space in most frames; allowed: three "
            "markers of the body or more that two cameras see at the same time"
        )
    return (
        f"{name}: learn: found {moved:.0f} points in space in most frames, but no three that keep "
        f"their distances while they move by {far:.2g} or more, {RULES.least_frames} times; "
        f"{wanted}"
    )
