"""Where everything is to begin with: sensors linked, and a pose for every frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mixpose.calibration.frames import SeenFrame
from mixpose.calibration.linking import Seen
from mixpose.calibration.rig import Rig
from mixpose.records import Floats
from mixpose.rigid import inverse, transform
from mixpose.sensors import facing


def start_poses(
    rig: Rig, frames: Sequence[SeenFrame], seen: Seen, linked: Sequence[int], blurs: Floats
) -> tuple[Floats, Floats]:
    """The pose of each frame that most detections of all linked sensors agree with.

    Parameters
    ----------
    seen : by frame, by sensor
        Hypotheses of single sensors.
    blurs : (L,) array
        By which a linked sensor may be off.

    Returns
    -------
    (K, 4, 4) array
        Identity where no sensor knew a pose.
    (K,) array
        Mean share of features in view that are met; -1 where no sensor knew a pose.
    """
    poses, worth = np.tile(np.eye(4), (len(frames), 1, 1)), np.full(len(frames), -1.0)
    for k, (frame, each) in enumerate(zip(frames, seen, strict=True)):
        starts = [
            inverse(rig.sensors[a].T_sensor_world) @ T  # type: ignore[attr-defined]
            for a in linked
            if a in each
            for T in each[a].poses
        ]
        if not starts:
            continue
        at = np.array(starts)
        met = sum(
            agreement(rig, a, at, frame.points[a], blurs[a]) for a in linked if a in frame.points
        )
        best = int(np.argmax(met))
        seeing = sum(1 for a in linked if a in frame.points and len(frame.points[a]))
        poses[k], worth[k] = at[best], np.asarray(met)[best] / max(seeing, 1)
    return poses, worth


def agreement(rig: Rig, sensor: int, poses: Floats, points: Floats, blur: float) -> Floats:
    """Share (H,) of features in view, or of detections if fewer, that are met at poses."""
    if not len(points):
        return np.zeros(len(poses))
    eye = rig.sensors[sensor]
    world = transform(poses, rig.points)
    y, visible = eye.project(world)
    visible = visible & facing(eye, poses, world, rig.normals)
    squared = ((y[:, :, None] - points) ** 2).sum(axis=3)
    kernel = np.exp(-squared / (4 * blur * blur)) * visible[:, :, None]
    # a detection counts once, a feature too
    score = np.minimum(kernel.max(axis=2).sum(axis=1), kernel.max(axis=1).sum(axis=1))
    return np.asarray(score / np.maximum(np.minimum(visible.sum(axis=1), len(points)), 1))
