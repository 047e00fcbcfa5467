"""Place cameras that never determine the body's pose alone, by poses of the other sensors."""

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
_TRIPLES = 20_000  # of pairs, tried: if 18 of 360 pairs are right, 150 triples are right
_MOST = 1_000_000  # detections of a frame


def place_camera(
    task: Task,
    state: State,
    sensor: int,
    linked: Sequence[int],
    frames: Sequence[SeenFrame],
    noise: Floats,
    rules: CalibrationRules,
) -> Floats | None:
    """Return T_sensor_world of a camera by known poses of the body; None if these do not suffice.

    Starts are where linked sensors, as they stand in the state by now, expect the camera by the
    session's relative poses.
    """
    others = [s for s in range(len(task.rig.sensors)) if s != sensor]
    own_frames = tuple(frame.without(others) for frame in frames)
    total = sum(len(frame.points.get(sensor, ())) for frame in own_frames)
    if total < rules.least_detections:
        return None
    blocks = blocks_of(state.rig, {sensor: ("pose",)}, body=False, length=1.0, interval=1.0)
    known = np.zeros(6, dtype=np.bool_)
    sure = replace(rules, undetermined=np.inf)
    bundle = Bundle(own_frames, blocks, known, lambda _: np.zeros((0, 6)), task.sigmas, sure)
    best, best_met = None, 0.0
    before: Any = task.rig.sensors  # cameras, which have a T_sensor_world
    now: Any = state.rig.sensors
    T_old = before[sensor].T_sensor_world
    guesses = [T_old @ inverse(before[a].T_sensor_world) @ now[a].T_sensor_world for a in linked]
    for T in _starts(state, sensor, np.array(guesses or [T_old]), own_frames, rules):
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
    state: State, sensor: int, guesses: Floats, frames: Sequence[SeenFrame], rules: CalibrationRules
) -> Floats:
    """Return starts (H, 4, 4) near the mean of guesses (A, 4, 4) of the camera's pose."""
    centre = np.median(np.array([inverse(T)[:3, 3] for T in guesses]), axis=0)
    R = mean_motion(guesses)[:3, :3]
    T_mean = from_parts(R, -R @ centre)
    rig = state.rig.placed(sensor, T_mean)
    seen = [
        (pose, frame.points[sensor])
        for pose, frame in zip(state.poses, frames, strict=True)
        if len(frame.points.get(sensor, ()))
    ]
    # a motion of the world is the opposite motion of the camera
    motions = _motions(rig, sensor, seen, rules)
    blur = rules.widest / 2 * min(feature_spacing(State(rig, state.poses), sensor), 1e6)
    scores = sum(agreement(rig, sensor, motions @ pose, y, blur) * len(y) for pose, y in seen)
    best = np.argsort(-np.asarray(scores), kind="stable")[:_TRIED]
    return np.asarray(T_mean @ motions[best])


def _motions(
    rig: Rig, sensor: int, seen: Sequence[tuple[Floats, Floats]], rules: CalibrationRules
) -> Floats:
    """Return small motions (H, 4, 4) of the world, by three detections each; the first is none."""
    # three features, about equally far off in the image, are brought onto the lines of sight of
    # detections of any frames
    places, lines, offsets, number = _nearby_pairs(rig, sensor, seen, rules)
    none = np.eye(4)[None]
    if len(offsets) < 3:
        return none
    reach = float(np.linalg.norm(offsets, axis=1).max())
    similar = cKDTree(offsets).query_ball_point(offsets, reach / 4)
    count = -(-_TRIPLES // len(offsets))
    rng = np.random.default_rng(0)
    drawn = np.concatenate([rng.choice(near, (count, 2)) for near in similar])
    triples = np.column_stack([np.repeat(np.arange(len(offsets)), count), drawn]).T
    differ = [number[triples[i]] != number[triples[j]] for i, j in SIDES]
    triples = triples[:, np.all(differ, axis=0)]
    cosines = np.array([(lines[triples[i]] * lines[triples[j]]).sum(axis=1) for i, j in SIDES])
    sides = [places[triples[i]] - places[triples[j]] for i, j in SIDES]
    distances, triple = depths(cosines, np.array([(d * d).sum(axis=1) for d in sides]))
    corners, centre = triples[:, triple], centre_of(rig.sensors[sensor])
    on_lines = centre + lines[corners] * distances[..., None]
    motions = align_triples(places[corners].swapaxes(1, 2), on_lines.swapaxes(1, 2))
    shift = np.linalg.norm(inverse(motions) @ np.append(centre, 1) - np.append(centre, 1), axis=1)
    farthest = rules.shift * np.median(np.linalg.norm(places - centre, axis=1))
    small = (rotation_angle_deg(np.eye(4), motions) < rules.turn_deg) & (shift < farthest)
    return np.concatenate([none, motions[small]])


def _nearby_pairs(
    rig: Rig, sensor: int, seen: Sequence[tuple[Floats, Floats]], rules: CalibrationRules
) -> tuple[Floats, Floats, Floats, Indices]:
    """Return features near detections (n): place, line of sight, offset in px, and detection."""
    camera: Any = rig.sensors[sensor]
    parts = []
    for k, (pose, y) in enumerate(seen):
        projected, visible = (rows[0] for rows in rig.project(sensor, pose[None]))
        rays = camera.rays(y)
        offsets = rays.pixels - projected[:, None]
        reach = np.tan(np.radians(rules.turn_deg)) / rays.slope
        i, j = np.nonzero(visible[:, None] & (np.linalg.norm(offsets, axis=2) < reach))
        world = transform(pose, rig.points)
        parts.append((world[i], rays.directions[j], offsets[i, j], k * _MOST + j))
    places, lines, offsets, number = (np.concatenate(p) for p in zip(*parts, strict=True))
    return places, lines, offsets, number
