"""A prediction held against simulated recordings that are estimated as any other."""

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

_FEWEST_FRAMES = 50  # at a pose, which takes a session and a recording of its own
_MOST_POSES = 8


@dataclass(frozen=True)
class Confirmation:
    """Errors of simulated frames beside those that were predicted."""

    frames: int  # estimated, lost ones included
    poses: int  # at which they were simulated
    statuses: dict[str, int]
    ratios: Floats  # (6,): RMS error over the predicted one, by direction; NaN where held or open
    overall: float  # the same over all directions at once: of errors in units of their covariance
    chance: float  # what `overall` is off 1 by through chance alone, one standard deviation
    predicted: Floats  # (3,): position, rotation (radians) and tip: RMS over the frames
    found: Floats  # (3,)


_Place: TypeAlias = tuple[Session, Plan, Floats, int, int]
"""Where to simulate how many frames of what: T_world_object, and a seed at the end."""


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
    """Simulate so many frames of a body that stands still at some of the poses, and estimate them.

    The plan is of the session's system, perhaps with other noises, and everything is determined at
    the poses (P, 4, 4), which an executor does; one after the other if it is left out.
    """
    count = min(len(poses), _MOST_POSES, max(1, runs // _FEWEST_FRAMES))
    chosen = poses[np.linspace(0, len(poses) - 1, count).astype(int)]
    prediction = predict(plan, chosen)
    places = [
        # a seed of its own for each pose and each study
        (session, plan, T, frames, int(np.random.SeedSequence([seed, k]).generate_state(1)[0]))
        for k, T in enumerate(chosen)
        if (frames := runs // count + (k < runs % count))
    ]
    done: dict[int, tuple[list[Floats], Counter[str]]] = {}
    with nullcontext(executor) if executor is not None else in_threads(1) as workers:
        for k, result in workers.run(_errors_at, places):
            if isinstance(result, Exception):
                raise result
            done[k] = result
    errors = [error for k in sorted(done) for error in done[k][0]]
    which = [k for k in sorted(done) for _ in done[k][0]]
    statuses = sum((told for _, told in done.values()), Counter[str]())
    return _compared(plan, prediction, np.array(errors).reshape(-1, 6), which, tip, statuses)


def _errors_at(place: _Place) -> tuple[list[Floats], Counter[str]]:
    """Twists (6,) from the truth to the estimate, modulo the body's symmetries; and statuses."""
    session, plan, T, frames, seed = place
    least = {
        m: min((n for n, one in zip(plan.noises, plan.sensors) if one.dimension == m), default=0.0)
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
        recording = Path(folder) / "recording"
        simulate(load_session(path), recording, options)
        rng = np.random.default_rng([seed, frames])
        for name, sensor, noise in zip(plan.names, plan.sensors, plan.noises, strict=True):
            more = math.sqrt(max(noise**2 - least[sensor.dimension] ** 2, 0.0))
            if more > 0:
                _made_noisier(recording / f"{name}.csv", more, rng)
        for estimate in run(load_session(recording / "session.toml")):
            statuses[estimate.status] += 1
            if estimate.T_world_object is None:
                continue
            twists = twist_between(alike, np.broadcast_to(estimate.T_world_object, alike.shape))
            nearest = int(np.linalg.norm(twists[:, 3:], axis=1).argmin())
            # errors of a pose that looks the same, taken back to the pose itself
            same = estimate.T_world_object @ inverse(plan.body.symmetries[nearest])
            errors.append(twist_between(T, same))
    return errors, statuses


def _plan_text(session: Session, plan: Plan, T_world_object: Floats) -> str:
    """A session of a plan's body at a pose, with tables of detections, exact to the last bit."""
    rows = zip(plan.names, plan.sensors, plan.sigmas, strict=True)
    free = [name for name, is_free in zip(TWIST_NAMES, plan.free, strict=True) if is_free]
    tables = {
        "unit": session.unit,
        "object": _body(plan.body),
        "start": {"T_world_object": T_world_object},
        # every frame stands for itself: none is to profit from the one before
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
    """The same of lists and Python's own numbers; None for what is not finite."""
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _made_noisier(table: Path, noise: float, rng: np.random.Generator) -> None:
    """Add noise to the coordinates of a table; `simulate` has one noise for all cameras."""
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
    which: list[int],
    tip: Floats,
    statuses: Counter[str],
) -> Confirmation:
    covariances = prediction.covariances[which]
    free = np.flatnonzero(plan.free)
    variances = np.einsum("nii->ni", covariances)
    summed = variances.reshape(-1, 2, 3).sum(axis=2).mean(axis=0)
    ratios = np.full(6, np.nan)
    if len(errors):
        ratios[free] = np.sqrt((errors[:, free] ** 2 / variances[:, free]).mean(axis=0))
    inner = covariances[:, free][:, :, free]
    solved = np.linalg.solve(inner, errors[:, free, None])[..., 0]
    squares = np.einsum("ni,ni->n", errors[:, free], solved)
    tips = np.einsum("nii->n", at_tip(prediction, tip)[which])
    arms = (prediction.poses[:, :3, :3] @ tip)[which]
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
