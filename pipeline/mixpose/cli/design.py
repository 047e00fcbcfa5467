"""``mixpose design``: predict the accuracy of planned systems."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from mixpose.checking import with_image_sizes
from mixpose.cli import output
from mixpose.cli.app import DesignRequest
from mixpose.cli.notices import counted, say, warn
from mixpose.design import Request, spread_poses, study
from mixpose.design.texts import JSON_MARK, study_json, study_text
from mixpose.errors import SessionError
from mixpose.executing import executor
from mixpose.pictures.signature import refuse_foreign, sign_figure
from mixpose.poses.jsonl import read_poses
from mixpose.records import Floats
from mixpose.session import Session, load_session
from mixpose.session.values import as_number
from mixpose.whole_files import appearing_whole

_MOST_POSES = 2000


def design_sessions(request: DesignRequest) -> None:
    """Print a study of the systems of several session files. Raises SessionError."""
    paths = request.sessions
    sessions = [with_image_sizes(load_session(path), {}) for path in paths]
    for path, session in zip(paths, sessions, strict=True):
        if session.unit != sessions[0].unit:
            raise SessionError(
                f"{path}: unit: found {session.unit!r}; allowed: {sessions[0].unit!r}, as of "
                f"{paths[0]}, to compare them"
            )
    _require_room(request, paths)
    for path, session in zip(paths, sessions, strict=True):
        if len(session.objects) > 1:
            bodies = ", ".join(setup.body.name for setup in session.objects)
            warn(f"{path}: {session.body.name!r} alone is judged, the first of {bodies}")
    # named by the file or, if that is session.toml, by its folder
    stems = [path.resolve().parent.name if path.stem == "session" else path.stem for path in paths]
    names = [s if stems.count(s) == 1 else f"{s} ({k + 1})" for k, s in enumerate(stems)]
    task = Request(
        poses=_poses(sessions[0], request),
        tip=sessions[0].body.tip if request.tip is None else _three("--tip", request.tip),
        noises=_noises(request.noise or (), sessions, names),
        runs=request.monte_carlo,
        seed=request.seed,
        tolerance=request.tolerance,
    )
    progress = say if sys.stderr.isatty() else lambda text: None
    # frames are simulated in this process, in others, or on a cluster
    is_serial = not request.monte_carlo or (request.workers == 1 and request.scheduler is None)
    worker_count = request.workers if request.workers > 1 else None
    with nullcontext() if is_serial else executor(request.scheduler, worker_count) as workers:
        results = study(list(zip(names, sessions, strict=True)), task, progress, workers)
    output.print_lines([study_text(results).removesuffix("\n")], request.json)
    if request.json is not None:
        output.write_text(request.json, json.dumps(study_json(results), indent=1) + "\n", "--json")
    if request.plot is not None:
        from mixpose.design.plot import draw_study  # noqa: PLC0415

        with appearing_whole(request.plot) as draft:
            draw_study(results, draft)
            sign_figure(draft)
    if written := [output.shown(path) for path in (request.json, request.plot) if path is not None]:
        say(f"{counted(len(names), 'system')} -> {', '.join(written)}")


def _require_room(request: DesignRequest, sessions: Sequence[Path]) -> None:
    """Raise SessionError if an output cannot be written, before anything is computed."""
    inputs = *sessions, request.poses
    if request.json is not None:
        output.refuse_to_overwrite_but(request.json, inputs, JSON_MARK, "--json")
    output.refuse_stdout(request.plot, "--plot", "a picture", "a file, as --plot study.png")
    output.refuse_one_for_two(request.plot, "--plot", request.json, "--json")
    if request.plot is not None:
        from mixpose.design.plot import require_picture  # noqa: PLC0415

        require_picture(request.plot)
        if not request.plot.parent.is_dir():
            raise SessionError(f"--plot {request.plot}: there is no folder {request.plot.parent}")
        refuse_foreign(request.plot, "--plot")


def _poses(session: Session, request: DesignRequest) -> Floats:
    if request.poses is None:
        volume = None if request.volume is None else _three("--volume", request.volume)
        if volume is not None and (volume < 0).any():
            raise SessionError(f"--volume: found {request.volume}; allowed: three lengths from 0")
        return spread_poses(
            session, request.count, volume=volume, turn_deg=request.turn, seed=request.seed
        )
    file = read_poses(request.poses)
    file.require_unit(session.unit, SessionError)
    name = session.body.name
    poses = [
        pose.T_world_object
        for pose in file.poses
        if pose.T_world_object is not None and pose.object == name
    ]
    if not poses:
        others = ", ".join(dict.fromkeys(pose.object for pose in file.poses)) or "none"
        raise SessionError(
            f"--poses {file.path}: holds no pose of {name!r}, the body of {session.path}; found "
            f"lines of {others}"
        )
    if len(poses) > _MOST_POSES:
        poses = [poses[int(k)] for k in np.linspace(0, len(poses) - 1, _MOST_POSES)]
    return np.array(poses)


def _three(option: str, text: str) -> Floats:
    values = np.array([as_number(cell) for cell in text.split(",")])
    if values.shape != (3,) or not (np.abs(values) < 1e9).all():
        raise SessionError(f"{option}: found {text!r}; allowed: three numbers as 0,0,-100")
    return values


def _noises(
    texts: Sequence[str], sessions: Sequence[Session], names: Sequence[str]
) -> dict[tuple[int | None, str], float]:
    """Parse noise: ``SENSOR=NUMBER``, or ``SYSTEM:SENSOR=NUMBER`` for one; ``*`` is any sensor."""
    noises: dict[tuple[int | None, str], float] = {}
    # texts for fewer systems or sensors override more general ones, in any order
    for text in sorted(texts, key=lambda text: ("*" not in text, ":" in text)):
        place, _, number = text.rpartition("=")
        system, _, sensor = place.rpartition(":")
        value = as_number(number)
        if not (place and 0 < value < 1e9):
            raise SessionError(
                f"--noise: found {text!r}; allowed: SENSOR=NUMBER or SYSTEM:SENSOR=NUMBER, in px "
                "or lengths, greater than 0"
            )
        if system and system not in names:
            raise SessionError(f"--noise: found no system {system!r}; systems: {', '.join(names)}")
        selected = [
            (k, setup.name)
            for k, (name, session) in enumerate(zip(names, sessions, strict=True))
            for setup in session.sensors
            if system in ("", name) and sensor in ("*", setup.name)
        ]
        noises |= dict.fromkeys(selected, value)
        if not selected:
            known = sorted({setup.name for session in sessions for setup in session.sensors})
            raise SessionError(f"--noise: found no sensor {sensor!r}; sensors: {', '.join(known)}")
    return noises
