"""Cameras that never knew the body's pose alone, placed by the poses that the others tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.calibration.adjust import adjust
from mixpose.calibration.bundle import Bundle
from mixpose.calibration.frames import SeenFrame
from mixpose.calibration.interpolation import neighbours
from mixpose.calibration.matching import clock_of, feature_spacing
from mixpose.calibration.rig import Rig, blocks_of
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.starting import agreement
from mixpose.calibration.task import Task
from mixpose.records import Floats
from mixpose.rigid import from_parts, inverse

_STEP_DEG = 0.5
_TRIED = 6  # starts that are adjusted


def placed(
    task: Task,
    rig: Rig,
    sensor: int,
    linked: Sequence[int],
    frames: Sequence[SeenFrame],
    poses: Floats,
    noise: Floats,
    rules: CalibrationRules,
) -> Floats | None:
    """T_sensor_world of a camera from known poses of the body; None where they do not tell.

    It is believed to stand to one of the linked sensors about as the session has it.

    Parameters
    ----------
    task : Task
    rig : Rig
        With the linked sensors where they are by now.
    sensor : int
    linked : sequence of int
    frames : sequence of SeenFrame
        With what the camera saw.
    poses : (K, 4, 4) array
    noise : (L,) array
    rules : CalibrationRules
    """
    own = [
        replace(frame, points={s: y for s, y in frame.points.items() if s == sensor})
        for frame in frames
    ]
    total = sum(len(frame.points.get(sensor, ())) for frame in own)
    if total < rules.least_detections:
        return None
    near = neighbours([frame.time_s for frame in own], rules.gap)
    clock = clock_of(own, near, len(rig.sensors))
    blocks = blocks_of(rig, {sensor: ("pose",)}, body=False, length=1.0, interval=1.0)
    known = np.zeros(6, dtype=np.bool_)
    bundle = Bundle(tuple(own), clock, blocks, known, np.inf)
    best, best_met = None, 0.0
    for T in _starts(task, rig, sensor, linked, own, poses, rules):
        start = rig.placed(sensor, T)
        blurs = np.array(noise)
        blurs[sensor] = rules.widest * min(feature_spacing(start, poses, sensor), 1e6)
        fit = adjust(
            bundle,
            start,
            poses,
            lambda _: np.zeros((0, 6)),
            task.sigmas,
            rules,
            blurs=blurs,
            noise=noise,
        )
        met = float(np.count_nonzero(fit.weighted[sensor][2] > rules.faintest))
        if met > best_met:
            best, best_met = fit.rig.sensors[sensor].T_sensor_world, met  # type: ignore[attr-defined]
    enough = best_met >= max(rules.explained * total, rules.least_detections)
    return best if enough else None


def _starts(
    task: Task,
    rig: Rig,
    sensor: int,
    linked: Sequence[int],
    frames: Sequence[SeenFrame],
    poses: Floats,
    rules: CalibrationRules,
) -> Floats:
    """Where to begin (H, 4, 4): turns about the mean of what all linked sensors tell.

    A shift looks like a turn from afar, so that turns alone are tried.
    """
    session = [one.T_sensor_world for one in task.rig.sensors]  # type: ignore[attr-defined]
    told = np.array(
        [
            session[sensor] @ inverse(session[a]) @ rig.sensors[a].T_sensor_world  # type: ignore[attr-defined]
            for a in linked
        ]
    )
    centre = np.median(np.array([inverse(T)[:3, 3] for T in told]), axis=0)
    R = Rotation.from_matrix(told[:, :3, :3]).mean().as_matrix()
    T_mean = from_parts(R, -R @ centre)
    reach = np.radians(np.arange(-rules.turn_deg, rules.turn_deg + 1e-9, _STEP_DEG))
    turns = [[rx, ry, 0.0] for rx in reach for ry in reach]
    tried = from_parts(Rotation.from_rotvec(turns).as_matrix(), np.zeros(3)) @ T_mean
    blur = rules.widest / 2 * min(feature_spacing(rig.placed(sensor, T_mean), poses, sensor), 1e6)
    worth = []
    for T in tried:
        one = rig.placed(sensor, T)
        worth.append(
            sum(
                float(agreement(one, sensor, pose[None], frame.points[sensor], blur)[0])
                * len(frame.points[sensor])
                for pose, frame in zip(poses, frames, strict=True)
                if sensor in frame.points
            )
        )
    best = np.argsort(-np.array(worth), kind="stable")[:_TRIED]
    return np.asarray(tried[best])
