"""A simulated recording: frames of every sensor, the session file that plays them, the truth."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.session import Session
from mixpose.simulation.central_pose import central_pose, pivot_of
from mixpose.simulation.channels import Channel, check_setup, plan_channel
from mixpose.simulation.draws import Purpose, generator
from mixpose.simulation.motion import Motion, plan_motion
from mixpose.simulation.naming import plan_files
from mixpose.simulation.options import DEFAULT_FPS, SimulationOptions
from mixpose.simulation.session_copy import SESSION_NAME, SessionCopy, copy_session
from mixpose.simulation.sighting import Sighting, displacements, look
from mixpose.simulation.writers import SensorWriter

TRUTH_NAME = "truth.jsonl"

_AMPLITUDE = 0.4  # of the body's radius
_DECIMALS = 12  # of true poses: what machines round differently is beyond

Progress: TypeAlias = Callable[[int], None]


@dataclass(frozen=True)
class _Plan:
    """Everything about a recording but its frames."""

    session: Session
    options: SimulationOptions
    copied: SessionCopy
    numbers: Sequence[int]
    fps: float
    motion: Motion
    channels: tuple[Channel, ...]


def simulate(
    session: Session,
    folder: str | Path,
    options: SimulationOptions,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> None:
    """Write a recording that the session plays, with the true poses beside it.

    The folder then holds ``session.toml``, the marker and calibration files that it names,
    frames for the source of each sensor, and ``truth.jsonl``.  The same session, options and
    seed give the same bytes.

    Parameters
    ----------
    session : Session
    folder : path
        Made if it is not there.
    options : SimulationOptions
    overwrite : bool
        Whether a recording in the folder is replaced.
    progress : callable, optional
        Called with the number of frames done, after each.

    Raises
    ------
    SessionError
        If the session cannot be simulated, or the folder holds a recording or cannot be written.
    """
    folder = Path(folder)
    plan = _plan(session, options)
    try:
        _make_room(plan, folder, overwrite=overwrite)
        plan.copied.write(folder)
        _write_times(plan, folder)
        _record(plan, folder, progress)
    except OSError as error:
        raise SessionError(
            f"simulate: {error.filename or folder}: cannot be written: {error.strerror}"
        ) from error


def _plan(session: Session, options: SimulationOptions) -> _Plan:
    check_setup(session)
    copied = copy_session(session)
    sources = list(zip(session.sensors, copied.sources))
    motion = _motion(session, options)
    try:
        numbers, files = plan_files(sources, options.frames)
        fps = _frames_per_second(session, options)
        channels = tuple(
            plan_channel(setup, own, session.body, motion, options, fps=fps, index=i)
            for i, (setup, own) in enumerate(zip(session.sensors, files))
        )
    except SessionError as error:  # which key is known there, which file here
        raise SessionError(f"{session.path}: {error}") from error
    return _Plan(session, options, copied, numbers, fps, motion, channels)


def _frames_per_second(session: Session, options: SimulationOptions) -> float:
    given = {setup.name: setup.fps for setup in session.sensors if setup.fps is not None}
    rates = set(given.values()) | ({options.fps} if options.fps is not None else set())
    if len(rates) > 1:
        stated = [f"{fps:g} (sensor {name!r})" for name, fps in given.items()]
        stated += [f"{options.fps:g} (asked for)"] if options.fps is not None else []
        raise SessionError(
            f"fps: found {', '.join(stated)}; allowed: the same for all, as frames are "
            "taken together"
        )
    return rates.pop() if rates else DEFAULT_FPS


def _motion(session: Session, options: SimulationOptions) -> Motion:
    body = session.body
    amplitude = options.amplitude_translation
    return plan_motion(
        central_pose(session, options.seed),
        pivot_of(body),
        translation=_AMPLITUDE * body.radius if amplitude is None else amplitude,
        rotation_deg=options.amplitude_rotation_deg,
        period_s=options.period_s,
        free=session.estimator.free,
        seed=options.seed,
    )


def _make_room(plan: _Plan, folder: Path, *, overwrite: bool) -> None:
    """See that the frames in the folder will be those of this recording only."""
    if folder.resolve() == plan.session.folder.resolve():
        raise SessionError(
            f"simulate: {folder}: is the folder of {plan.session.path.name} itself; choose "
            "another, as a recording of yours may lie there"
        )
    if folder.exists() and not folder.is_dir():
        raise SessionError(f"simulate: {folder}: is a file; allowed: a folder")
    folder.mkdir(parents=True, exist_ok=True)
    held = [path for channel in plan.channels for path in channel.files.existing(folder)]
    names = [SESSION_NAME, TRUTH_NAME, *plan.copied.times, *(n for _, n in plan.copied.files)]
    held += [path for path in (folder / name for name in names) if path.exists()]
    if held and not overwrite:
        raise SessionError(
            f"simulate: {folder}: holds a recording already ({held[0].name}); choose another "
            "folder, or allow to overwrite it"
        )
    for path in held:
        path.unlink(missing_ok=True)


def _write_times(plan: _Plan, folder: Path) -> None:
    rows = [f"{number},{_time(plan, number):.6f}\n" for number in plan.numbers]
    for name in plan.copied.times:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("frame,time_s\n" + "".join(rows), encoding="ascii", newline="\n")


def _time(plan: _Plan, number: int) -> float:
    return number / plan.fps


def _record(plan: _Plan, folder: Path, progress: Progress | None) -> None:
    with ExitStack() as stack:
        writers = [stack.enter_context(channel.open(folder)) for channel in plan.channels]
        truth = stack.enter_context((folder / TRUTH_NAME).open("w", encoding="ascii", newline="\n"))
        truth.write(_line(_header(plan)))
        for done, number in enumerate(plan.numbers, start=1):
            # the motion begins with the first frame, whatever its number
            moment = (number - plan.numbers[0]) / plan.fps
            T = np.round(plan.motion.poses(np.array(moment)), _DECIMALS) + 0.0
            if _record_frame(plan, writers, number, T):
                truth.write(_line(_pose(plan, number, T)))
            if progress is not None:
                progress(done)


def _record_frame(
    plan: _Plan, writers: Iterable[SensorWriter], number: int, T_world_object: Floats
) -> bool:
    """Record one frame with every sensor; False if all of them missed it."""
    options, body = plan.options, plan.session.body
    offsets = None
    if options.deform:
        offsets = displacements(body, generator(options.seed, Purpose.DEFORMATION, number))
    recorded = False
    for i, (channel, writer) in enumerate(zip(plan.channels, writers)):
        chance = generator(options.seed, Purpose.MISSING, number, i).random()
        is_missing = chance < options.missing
        if is_missing and channel.files.may_lack_frames:
            continue
        rng = generator(options.seed, Purpose.FRAME, number, i)
        sighting = look(channel.view, body, T_world_object, channel.options, rng, offsets=offsets)
        if is_missing:
            sighting = _nothing(sighting)
        writer.write(number, _time(plan, number), sighting, rng)
        recorded = True
    return recorded


def _nothing(sighting: Sighting) -> Sighting:
    return Sighting(sighting.points[:0], sighting.levels[:0], sighting.features[:0])


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


def _pose(plan: _Plan, number: int, T_world_object: Floats) -> dict[str, Any]:
    return {
        "type": "pose",
        "frame": number,
        "time_s": round(_time(plan, number), 6),
        "object": plan.session.body.name,
        "status": "ok",
        "T_world_object": T_world_object.tolist(),
    }


def _line(values: dict[str, Any]) -> str:
    return json.dumps(values, allow_nan=False) + "\n"
