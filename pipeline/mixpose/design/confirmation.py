"""Compare a prediction with simulated recordings that are estimated like any other."""

from __future__ import annotations

import csv
import math
import tempfile
from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import tomlkit

from mixpose.body import Body, SegmentFeature
from mixpose.design.prediction import Plan, Prediction, at_tip, predict
from mixpose.errors import SessionError
from mixpose.executing import Executor, in_threads
from mixpose.records import Floats
from mixpose.rigid import TWIST_NAMES, inverse, twist_between
from mixpose.runner import run
from mixpose.sensors import FisheyeCamera, ParallelBeam, PinholeCamera, RangeSensor, Sensor
from mixpose.session import Session, load_session
from mixpose.simulation import SimulationOptions, simulate

_FEWEST_FRAMES = 50  # at a pose, as each pose takes a session and a recording
_MOST_POSES = 8


@dataclass(frozen=True)
class Confirmation:
    """Errors of simulated frames, compared with predicted ones."""

    frames: int  # estimated, with lost ones
    poses: int  # at which they were simulated
    statuses: dict[str, int]
    ratios: Floats  # (6,): RMS error over the predicted one, by direction; NaN where held or open
    overall: float  # the same over all directions at once, by errors in units of their covariance
    chance: float  # standard deviation of `overall` about 1 by chance
    predicted: Floats  # (3,): position, rotation (radians) and tip: RMS over the frames
    found: Floats  # (3,): the same, of simulated frames


_Recording: TypeAlias = tuple[Session, Plan, Floats, int, int]
"""Session, plan, T_world_object, number of frames, and seed of a simulated recording."""


def confirm(
    session: Session,
    plan: Plan,
    poses: Floats,
    runs: int,
    *,
    tip: Floats,
    seed: int = 0,
    executor: Executor | None = None,
) -> Confirmation:
    """Simulate `runs` frames of a body at rest at some of the poses, estimate them, compare errors.

    The plan is of the session's system, perhaps with other noises; all poses (P, 4, 4) are
    determined. Without an executor the simulated poses follow one after the other.
    """
    count = min(len(poses), _MOST_POSES, max(1, runs // _FEWEST_FRAMES))
    selected = poses[np.linspace(0, len(poses) - 1, count).astype(int)]
    prediction = predict(plan, selected)
    recordings = [
        # a different seed for each pose and each study
        (session, plan, T, frames, int(np.random.SeedSequence([seed, k]).generate_state(1)[0]))
        for k, T in enumerate(selected)
        if (frames := runs // count + (k < runs % count))
    ]
    done: dict[int, tuple[list[Floats], Counter[str]]] = {}
    with nullcontext(executor) if executor is not None else in_threads(1) as workers:
        for k, result in workers.run(_errors_at, recordings):
            if isinstance(result, Exception):
                raise result
            done[k] = result
    errors = [error for k in sorted(done) for error in done[k][0]]
    owners = [k for k in sorted(done) for _ in done[k][0]]
    statuses = sum((counts for _, counts in done.values()), Counter[str]())
    return _compared(plan, prediction, np.array(errors).reshape(-1, 6), owners, tip, statuses)


def _errors_at(recording: _Recording) -> tuple[list[Floats], Counter[str]]:
    """Return twists (6,) from truth to estimates, modulo the body's symmetries, and statuses."""
    session, plan, T, frames, seed = recording
    least = {
        m: min((n for n, s in zip(plan.noises, plan.sensors) if s.dimension == m), default=0.0)
        for m in (1, 2)
    }
    options = SimulationOptions(
        frames=frames,
        seed=seed,
        amplitude_translation=0.0,
        amplitude_rotation_deg=0.0,
        pixel_noise=least[2],
        range_noise=least[1],
        deform=bool(plan.body.spread),
    )
    alike = T @ plan.body.symmetries
    errors: list[Floats] = []
    statuses: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.toml"
        path.write_text(_plan_text(session, plan, T), encoding="utf-8")
        recorded = Path(folder) / "recording"
        simulate(load_session(path), recorded, options)
        rng = np.random.default_rng([seed, frames])
        for name, sensor, noise in zip(plan.names, plan.sensors, plan.noises, strict=True):
            added = math.sqrt(max(noise**2 - least[sensor.dimension] ** 2, 0.0))
            if added > 0:
                _add_noise(recorded / f"{name}.csv", added, rng)
        for estimate in run(load_session(recorded / "session.toml")):
            statuses[estimate.status] += 1
            if estimate.T_world_object is None:
                continue
            twists = twist_between(alike, np.broadcast_to(estimate.T_world_object, alike.shape))
            nearest = int(np.linalg.norm(twists[:, 3:], axis=1).argmin())
            # an estimate turned by a symmetry is turned back before it is compared
            same = estimate.T_world_object @ inverse(plan.body.symmetries[nearest])
            errors.append(twist_between(T, same))
    return errors, statuses


def _plan_text(session: Session, plan: Plan, T_world_object: Floats) -> str:
    """Return a session of a plan's body at a pose, with exact tables of detections."""
    rows = zip(plan.names, plan.sensors, plan.sigmas, strict=True)
    free = [name for name, is_free in zip(TWIST_NAMES, plan.free, strict=True) if is_free]
    tables = {
        "unit": session.unit,
        "object": _body(plan.body),
        "start": {"T_world_object": T_world_object},
        # each frame is estimated by itself, without the one before as a prior
        "estimator": {"fuse": False, "free": free},
        "sensor": [_sensor(name, sensor, sigma) for name, sensor, sigma in rows],
    }
    return str(tomlkit.dumps(plain(tables)))


def _body(body: Body) -> dict[str, Any]:
    points = [f.mean for f in body.features if not isinstance(f, SegmentFeature)]
    segments = [[f.start, f.end] for f in body.features if isinstance(f, SegmentFeature)]
    table: dict[str, Any] = {"name": body.name}
    if points:
        table["points"] = points
    if segments:
        table["segments"] = segments
    if body.covariances.any():
        table |= {"sigma": body.covariances, "spread": body.features[0].spread}
    if body.normals is not None:
        table["normals"] = body.normals
    if body.gravity is not None:
        table["gravity"] = {"direction": body.gravity.direction, "sigma": body.gravity.sigma}
    return table


def _sensor(name: str, sensor: Sensor, width: float) -> dict[str, Any]:
    table: dict[str, Any] = {"name": name, "source": f"{name}.csv", "extract": {"sigma": width}}
    match sensor:
        case RangeSensor():
            table |= {"model": "lateration", "position": sensor.position}
            return table | {"range_bias": sensor.range_bias}
        case PinholeCamera() | FisheyeCamera():
            table["model"] = "pinhole" if isinstance(sensor, PinholeCamera) else "fisheye"
            table["camera_matrix"] = sensor.camera_matrix
            if sensor.distortion.size:
                table["distortion"] = sensor.distortion
        case ParallelBeam():
            table |= {"model": "parallel", "pixel_size": sensor.pixel_size}
            table["principal_point"] = sensor.principal_point
        case _:
            raise SessionError(f"design: a {type(sensor).__name__} cannot be simulated")
    return table | {"resolution": sensor.resolution or (), "T_sensor_world": sensor.T_sensor_world}


def plain(value: Any) -> Any:
    """Return lists and Python's own numbers in place of arrays; None for infinite and NaN."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _add_noise(table: Path, noise: float, rng: np.random.Generator) -> None:
    """Add noise to the coordinates of a table, as `simulate` has one noise for all cameras."""
    with table.open(encoding="utf-8", newline="") as stream:
        header, *rows = csv.reader(stream)
    columns = [header.index(name) for name in ("u", "v", "range") if name in header]
    for row in rows:
        for column in columns:
            row[column] = repr(float(row[column]) + noise * rng.standard_normal())
    with table.open("w", encoding="utf-8", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows([header, *rows])


def _compared(
    plan: Plan,
    prediction: Prediction,
    errors: Floats,
    owners: list[int],  # number of the pose of each error
    tip: Floats,
    statuses: Counter[str],
) -> Confirmation:
    covariances = prediction.covariances[owners]
    free = np.flatnonzero(plan.free)
    variances = np.einsum("nii->ni", covariances)
    summed = variances.reshape(-1, 2, 3).sum(axis=2).mean(axis=0)
    ratios = np.full(6, np.nan)
    if len(errors):
        ratios[free] = np.sqrt((errors[:, free] ** 2 / variances[:, free]).mean(axis=0))
    inner = covariances[:, free][:, :, free]
    solved = np.linalg.solve(inner, errors[:, free, None])[..., 0]
    squares = np.einsum("ni,ni->n", errors[:, free], solved)
    tips = np.einsum("nii->n", at_tip(prediction, tip)[owners])
    arms = (prediction.poses[:, :3, :3] @ tip)[owners]
    parts = errors[:, :3], errors[:, 3:], errors[:, :3] + np.cross(errors[:, 3:], arms)
    return Confirmation(
        frames=sum(statuses.values()),
        poses=len(prediction.poses),
        statuses=dict(statuses),
        ratios=ratios,
        overall=float(np.sqrt(squares.mean() / len(free))) if len(errors) else math.nan,
        chance=1 / math.sqrt(2 * max(len(errors), 1) * len(free)),
        predicted=np.sqrt([*summed, tips.mean()]),
        found=np.sqrt([(part**2).sum(axis=1).mean() for part in parts]),
    )
