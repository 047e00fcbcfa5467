"""Simulate a recording: frames of every sensor, the session file that plays them, and the truth."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.rigid import from_rotation_vector, inverse
from mixpose.session import SensorSetup, Session
from mixpose.simulation.central_pose import central_pose, motion_about, plan_companions
from mixpose.simulation.channels import Channel, Planner, check_setup
from mixpose.simulation.motion import Motion
from mixpose.simulation.naming import plan_files
from mixpose.simulation.options import DEFAULT_FPS, Purpose, SimulationOptions, generator
from mixpose.simulation.render import Write
from mixpose.simulation.scenery import Actor, plan_scenery
from mixpose.simulation.session_copy import SESSION_NAME, SessionCopy, copy_session
from mixpose.simulation.visible_spots import VisibleSpots, displacements, look, shifted

TRUTH_NAME = "truth.jsonl"

_DECIMALS = 12  # of true poses: machines round later ones differently

Progress: TypeAlias = Callable[[int], None]


@dataclass(frozen=True)
class _Plan:
    """All data of a recording except its frames."""

    session: Session
    options: SimulationOptions
    copied: SessionCopy
    numbers: Sequence[int]
    fps: float
    motion: Motion
    channels: tuple[Channel, ...]
    companions: tuple[Actor, ...] = ()


def simulate(
    session: Session,
    folder: str | Path,
    options: SimulationOptions,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> tuple[str, ...]:
    """Write a recording that the session plays, and its true poses.

    Returns the names of options that affect none of its sensors.

    The folder, made if missing, then holds ``session.toml``, the marker and calibration files that
    it names, frames for the source of each sensor, and ``truth.jsonl``.  The same session, options
    and seed give the same bytes.  `progress` receives the number of frames done.  Raises a
    `SessionError` if the session cannot be simulated, or the folder cannot be written or holds a
    recording that is not to be overwritten.
    """
    folder = Path(folder)
    plan = _plan(session, options)
    try:
        _clear_folder(plan, folder, overwrite=overwrite)
        plan.copied.write(folder)
        _write_times(plan, folder)
        _record(plan, folder, progress)
    except OSError as error:
        raise SessionError(
            f"simulate: {error.filename or folder}: cannot be written: {error.strerror}"
        ) from error
    outputs = {channel.output for channel in plan.channels}
    return options.unused(outputs, is_exact=session.body.spread == 0)


def _plan(session: Session, options: SimulationOptions) -> _Plan:
    check_setup(session)
    copied = copy_session(session)
    sources = list(zip(session.sensors, copied.sources))
    motion = motion_about(session, central_pose(session, options.seed), options, options.seed)
    companions = plan_companions(session, motion, options)
    try:
        numbers, files = plan_files(sources, options.frames)
        fps = _frames_per_second(session, options)
        steps = _steps_s(session, [source.kind for source in files], options)
        setups = _with_turned_camera(session.sensors, options)
        cameras = [setup.sensor for setup in setups if setup.sensor.dimension == 2]
        scenery = plan_scenery(session.body, motion, cameras, options)
        scenery = replace(scenery, actors=(*companions, *scenery.actors))
        planner = Planner(session.body, motion, options, fps, scenery)
        numbered = enumerate(zip(setups, files, steps))
        channels = tuple(planner.channel(a, source, i, step) for i, (a, source, step) in numbered)
    except SessionError as error:  # it names the key, but not the file
        raise SessionError(f"{session.path}: {error}") from error
    return _Plan(session, options, copied, numbers, fps, motion, channels, companions)


def _steps_s(session: Session, kinds: Sequence[str], options: SimulationOptions) -> list[float]:
    """Return the seconds by which each sensor's times are later than those of the first."""
    names = {setup.name for setup in session.sensors}
    for name in options.delay:
        if name not in names:
            raise SessionError(
                f"delay: found the sensor {name!r}; allowed: {', '.join(sorted(names))}"
            )
    for setup, kind in zip(session.sensors, kinds, strict=True) if options.out_of_step else ():
        if setup.times is None and (kind != "detections" or setup.fps is not None):
            raise SessionError(
                f"sensor {setup.name!r}: times: missing; sensors that are out of step need a table "
                "of times each"
            )
    tables = [setup.times for setup in session.sensors if setup.times is not None]
    if options.out_of_step and len(set(tables)) < len(tables):
        raise SessionError("times: found one table for several sensors; allowed: one for each")
    count = len(session.sensors)
    return [options.out_of_step * i / max(count - 1, 1) for i in range(count)]


def _with_turned_camera(
    setups: Sequence[SensorSetup], options: SimulationOptions
) -> Sequence[SensorSetup]:
    """Return the sensors with the last camera turned from the direction that the session states."""
    cameras = [i for i, setup in enumerate(setups) if setup.sensor.dimension == 2]
    if not options.turned_camera_deg or not cameras:
        return setups
    turned = list(setups)
    chosen = setups[cameras[-1]]
    axis = generator(options.seed, Purpose.TURNED).standard_normal(3)
    turn = np.radians(options.turned_camera_deg) * axis / np.linalg.norm(axis)
    sensor: Any = chosen.sensor
    T = sensor.T_sensor_world
    motion = inverse(T) @ from_rotation_vector(turn, np.zeros(3)) @ T
    turned[cameras[-1]] = replace(chosen, sensor=chosen.sensor.moved(motion))
    return turned


def _frames_per_second(session: Session, options: SimulationOptions) -> float:
    stated = [(f"sensor {setup.name!r}", setup.fps) for setup in session.sensors]
    rates = {who: fps for who, fps in (*stated, ("asked for", options.fps)) if fps is not None}
    if len(set(rates.values())) > 1:
        listed = ", ".join(f"{fps:g} ({who})" for who, fps in rates.items())
        raise SessionError(
            f"fps: found {listed}; allowed: the same for all, as frames are taken together"
        )
    return next(iter(rates.values()), DEFAULT_FPS)


def _clear_folder(plan: _Plan, folder: Path, *, overwrite: bool) -> None:
    """Make the folder, and remove an earlier recording if it may be overwritten."""
    if folder.resolve() == plan.session.folder.resolve():
        raise SessionError(
            f"simulate: {folder}: is the folder of {plan.session.path.name} itself; choose "
            "another, as a recording of yours may lie there"
        )
    if folder.exists() and not folder.is_dir():
        raise SessionError(f"simulate: {folder}: is a file; allowed: a folder")
    folder.mkdir(parents=True, exist_ok=True)
    existing = [path for channel in plan.channels for path in channel.files.existing(folder)]
    names = [SESSION_NAME, TRUTH_NAME, *plan.copied.times, *(n for _, n in plan.copied.files)]
    existing += [path for path in (folder / name for name in names) if path.exists()]
    if existing and not overwrite:
        raise SessionError(
            f"simulate: {folder}: holds a recording already ({existing[0].name}); choose another "
            "folder, or --overwrite (in Python overwrite=True)"
        )
    for path in existing:
        path.unlink(missing_ok=True)


def _write_times(plan: _Plan, folder: Path) -> None:
    steps = {channel.files.sensor: channel.step_s for channel in plan.channels}
    for name, sensor in plan.copied.times.items():
        times = [number / plan.fps + steps[sensor] for number in plan.numbers]
        rows = [f"{n},{t:.6f}\n" for n, t in zip(plan.numbers, times, strict=True)]
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("frame,time_s\n" + "".join(rows), encoding="ascii", newline="\n")


def _record(plan: _Plan, folder: Path, progress: Progress | None) -> None:
    # in the order of the session's bodies
    names = [(entry.body.name, i) for entry in plan.session.objects for i in entry.instances]
    paths = [plan.motion.pose, *(companion.pose for companion in plan.companions)]
    with ExitStack() as stack:
        writers = [stack.enter_context(c.writing(folder)) for c in plan.channels]
        truth = stack.enter_context((folder / TRUTH_NAME).open("w", encoding="ascii", newline="\n"))
        truth.write(_line(_header(plan)))
        for done, number in enumerate(plan.numbers, start=1):
            # the motion begins at the first frame, whatever its number
            moment = (number - plan.numbers[0]) / plan.fps
            poses = [np.round(pose(moment), _DECIMALS) + 0.0 for pose in paths]
            is_recorded = _record_frame(plan, writers, number, poses[0], moment)
            for (name, instance), T in zip(names, poses, strict=True) if is_recorded else ():
                pose_line = {
                    "type": "pose",
                    "frame": number,
                    "time_s": round(number / plan.fps, 6),
                    "object": name,
                    **({} if instance is None else {"instance": instance}),
                    "status": "ok",
                    "T_world_object": T.tolist(),
                }
                truth.write(_line(pose_line))
            if progress is not None:
                progress(done)


def _record_frame(
    plan: _Plan, writers: Iterable[Write], number: int, T_world_object: Floats, moment: float
) -> bool:
    """Record one frame with every sensor; return False if none has it or the body is away."""
    options, body = plan.options, plan.session.body
    offsets = None
    frames_present = options.away_from
    is_away = frames_present is not None and number - plan.numbers[0] >= frames_present
    if options.deform:
        rng = generator(options.seed, Purpose.DEFORMATION, number)
        offsets = displacements(body, T_world_object, rng)
    recorded = False
    for i, (channel, write) in enumerate(zip(plan.channels, writers)):
        chance = generator(options.seed, Purpose.MISSING, number, i).random()
        is_missing = chance < options.missing
        if is_missing and channel.files.may_lack_frames:
            continue
        rng = generator(options.seed, Purpose.FRAME, number, i)
        view = channel.view
        later = None if view.shutter.is_ideal else shifted(plan.motion.pose, moment)
        seen = view, body, T_world_object, channel.options, rng
        visible = look(*seen, offsets=offsets, pose_after=later, time_s=moment, is_away=is_away)
        if is_missing:
            visible = VisibleSpots(visible.points[:0], visible.levels[:0], visible.features[:0])
        write(number, number / plan.fps + channel.step_s, visible, rng)
        recorded = True
    return recorded and not is_away


def _header(plan: _Plan) -> dict[str, Any]:
    return {
        "type": "header",
        "format": "mixpose-poses",
        "version": 1,
        "unit": plan.session.unit,
        "session": SESSION_NAME,
        "session_sha256": hashlib.sha256(plan.copied.content).hexdigest(),
        "seed": plan.options.seed,
        "simulation": asdict(plan.options),
    }


def _line(values: dict[str, Any]) -> str:
    return json.dumps(values, allow_nan=False) + "\n"
