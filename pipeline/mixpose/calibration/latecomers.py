"""Cameras that never knew the body's pose alone, placed by the poses that the others tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mixpose.calibration.adjust import adjust
from mixpose.calibration.bundle import Bundle
from mixpose.calibration.matching import feature_spacing
from mixpose.calibration.rig import Rig, State, blocks_of, centre_of
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.start import agreement
from mixpose.calibration.task import SeenFrame, Task
from mixpose.records import Floats, Indices
from mixpose.rigid import from_parts, inverse, mean_motion, rotation_angle_deg, transform
from mixpose.search import SIDES, align_triples, depths

_TRIED = 6  # starts that are adjusted
_TRIPLES = 20_000  # of pairs that are tried: of 360 pairs, 18 of them right, 150 triples are right
_MOST = 1_000_000  # detections of a frame


def placed(
    task: Task,
    state: State,
    sensor: int,
    linked: Sequence[int],
    frames: Sequence[SeenFrame],
    noise: Floats,
    rules: CalibrationRules,
) -> Floats | None:
    """T_sensor_world of a camera from known poses of the body; None where they do not tell.

    It is believed to stand to one of the linked sensors about as the session has it; in the state
    these are where they are by now.
    """
    others = [s for s in range(len(task.rig.sensors)) if s != sensor]
    own = tuple(frame.without(others) for frame in frames)
    total = sum(len(frame.points.get(sensor, ())) for frame in own)
    if total < rules.least_detections:
        return None
    blocks = blocks_of(state.rig, {sensor: ("pose",)}, body=False, length=1.0, interval=1.0)
    known = np.zeros(6, dtype=np.bool_)
    sure = replace(rules, undetermined=np.inf)
    bundle = Bundle(own, blocks, known, lambda _: np.zeros((0, 6)), task.sigmas, sure)
    best, best_met = None, 0.0
    before: Any = task.rig.sensors  # of which those that are asked for stand somewhere, turned
    now: Any = state.rig.sensors
    own_T = before[sensor].T_sensor_world
    told = [own_T @ inverse(before[a].T_sensor_world) @ now[a].T_sensor_world for a in linked]
    for T in _starts(state, sensor, np.array(told or [own_T]), own, rules):
        start = State(state.rig.placed(sensor, T), state.poses)
        blurs = np.array(noise)
        blurs[sensor] = rules.widest * min(feature_spacing(start, sensor), 1e6)
        fit = adjust(bundle, start, blurs=blurs, noise=noise)
        met = float(np.count_nonzero(fit.weighted[sensor][1] > rules.faintest))
        if met > best_met:
            best, best_met = fit.state.rig.sensors[sensor].T_sensor_world, met  # type: ignore[attr-defined]
    enough = best_met >= max(rules.explained * total, rules.least_detections)
    return best if enough else None


def _starts(
    state: State, sensor: int, told: Floats, frames: Sequence[SeenFrame], rules: CalibrationRules
) -> Floats:
    """Where to begin (H, 4, 4): near the mean of what linked sensors tell of it (A, 4, 4)."""
    centre = np.median(np.array([inverse(T)[:3, 3] for T in told]), axis=0)
    R = mean_motion(told)[:3, :3]
    T_mean = from_parts(R, -R @ centre)
    rig = state.rig.placed(sensor, T_mean)
    seen = [
        (pose, frame.points[sensor])
        for pose, frame in zip(state.poses, frames, strict=True)
        if len(frame.points.get(sensor, ()))
    ]
    # moving the world is moving the camera the other way
    motions = _motions(rig, sensor, seen, rules)
    blur = rules.widest / 2 * min(feature_spacing(State(rig, state.poses), sensor), 1e6)
    worth = sum(agreement(rig, sensor, motions @ pose, y, blur) * len(y) for pose, y in seen)
    best = np.argsort(-np.asarray(worth), kind="stable")[:_TRIED]
    return np.asarray(T_mean @ motions[best])


def _motions(
    rig: Rig, sensor: int, seen: Sequence[tuple[Floats, Floats]], rules: CalibrationRules
) -> Floats:
    """Small motions (H, 4, 4) of the world, each of which three detections of any frames tell."""
    # three features near them, about equally far off in the image, are brought onto their lines of
    # sight. The first motion is none
    places, lines, off, number = _near(rig, sensor, seen, rules)
    none = np.eye(4)[None]
    if len(off) < 3:
        return none
    reach = float(np.linalg.norm(off, axis=1).max())
    alike = cKDTree(off).query_ball_point(off, reach / 4)
    each = -(-_TRIPLES // len(off))
    rng = np.random.default_rng(0)
    drawn = np.concatenate([rng.choice(near, (each, 2)) for near in alike])
    triples = np.column_stack([np.repeat(np.arange(len(off)), each), drawn]).T
    differ = [number[triples[i]] != number[triples[j]] for i, j in SIDES]
    triples = triples[:, np.all(differ, axis=0)]
    cosines = np.array([(lines[triples[i]] * lines[triples[j]]).sum(axis=1) for i, j in SIDES])
    apart = [places[triples[i]] - places[triples[j]] for i, j in SIDES]
    away, which = depths(cosines, np.array([(d * d).sum(axis=1) for d in apart]))
    corners, centre = triples[:, which], centre_of(rig.sensors[sensor])
    on_lines = centre + lines[corners] * away[..., None]
    motions = align_triples(places[corners].swapaxes(1, 2), on_lines.swapaxes(1, 2))
    shift = np.linalg.norm(inverse(motions) @ np.append(centre, 1) - np.append(centre, 1), axis=1)
    farthest = rules.shift * np.median(np.linalg.norm(places - centre, axis=1))
    small = (rotation_angle_deg(np.eye(4), motions) < rules.turn_deg) & (shift < farthest)
    return np.concatenate([none, motions[small]])


def _near(
    rig: Rig, sensor: int, seen: Sequence[tuple[Floats, Floats]], rules: CalibrationRules
) -> tuple[Floats, Floats, Floats, Indices]:
    """Features and detections that may be the same (n): place, line of sight, px between, which."""
    eye: Any = rig.sensors[sensor]
    found = []
    for k, (pose, y) in enumerate(seen):
        at, visible = (each[0] for each in rig.seen(sensor, pose[None]))
        rays = eye.rays(y)
        off = rays.pixels - at[:, None]
        reach = np.tan(np.radians(rules.turn_deg)) / rays.slope
        i, j = np.nonzero(visible[:, None] & (np.linalg.norm(off, axis=2) < reach))
        world = transform(pose, rig.points)
        found.append((world[i], rays.directions[j], off[i, j], k * _MOST + j))
    places, lines, off, number = (np.concatenate(each) for each in zip(*found, strict=True))
    return places, lines, off, number
