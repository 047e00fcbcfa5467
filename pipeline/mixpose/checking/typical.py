"""Poses to judge a session by that names no start: the body in view, turned at random."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.records import Floats
from mixpose.rigid import from_parts
from mixpose.sensors import FisheyeCamera, ParallelBeam, PinholeCamera, Sensor
from mixpose.session import Session
from mixpose.simulation.central_pose import count_seen, pivot_of, places

_TRIED = 64


def with_image_sizes(session: Session, sizes: Mapping[str, tuple[int, int] | None]) -> Session:
    """A session whose cameras know the size of their images, as the recordings have them by name.

    Where neither the session nor the recording says, the optical axis is taken to meet the middle
    of the image.
    """
    setups = []
    for setup in session.sensors:
        sensor = setup.sensor
        size = setup.resolution or sizes.get(setup.name) or _size_by_axis(sensor)
        if isinstance(sensor, PinholeCamera | FisheyeCamera | ParallelBeam):
            sensor = replace(sensor, resolution=size)
        setups.append(replace(setup, resolution=size, sensor=sensor))
    return replace(session, sensors=tuple(setups))


def _size_by_axis(sensor: Sensor) -> tuple[int, int] | None:
    if isinstance(sensor, PinholeCamera | FisheyeCamera):
        u, v = sensor.camera_matrix[:2, 2]
    elif isinstance(sensor, ParallelBeam):
        u, v = sensor.principal_point
    else:
        return None
    return max(round(2 * u) + 1, 1), max(round(2 * v) + 1, 1)


def typical_poses(
    session: Session, count: int, *, away: float = 1.0, seed: int = 0
) -> list[Floats]:
    """Poses T_world_object in the sensors' common view, if any, those that show most features.

    Every camera has a resolution. One alone is `away` times as far away as where the body fills
    half of the image's smaller side.
    """
    rotations = Rotation.random(_TRIED, rng=np.random.default_rng(seed)).as_matrix()
    pivot = pivot_of(session.body)
    seen_at_best = 0
    chosen: list[Floats] = []
    for place in places(session):
        if depends_on_distance(session):
            centre = session.sensors[0].sensor.towards(place)
            place = place + (1 - away) * centre  # noqa: PLW2901
        poses = [from_parts(R, place - R @ pivot) for R in rotations]
        seen = np.array([count_seen(session, T) for T in poses])
        if seen.max() > seen_at_best:
            seen_at_best = int(seen.max())
            best = np.argsort(-seen, kind="stable")[:count]
            chosen = [poses[int(i)] for i in best if seen[i]]
    return chosen


def depends_on_distance(session: Session) -> bool:
    """Whether nothing but the distance from one camera says how well poses are seen."""
    return len(session.sensors) == 1 and isinstance(
        session.sensors[0].sensor, PinholeCamera | FisheyeCamera
    )
