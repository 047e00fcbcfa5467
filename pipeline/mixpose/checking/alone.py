"""What cameras that each find the body alone tell of a session: its size, where they stand.

This needs no start, and no values that are nearly right.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from mixpose.body import PointFeature
from mixpose.checking.changes import (
    OTHER_SIZE,
    Change,
    misplaced,
    moved_by,
    of_size,
    times_as_large,
    with_sensor,
)
from mixpose.checking.evidence import Frames, anywhere, best_pose
from mixpose.objective import View
from mixpose.records import Floats
from mixpose.rigid import inverse
from mixpose.sensors import FisheyeCamera, PinholeCamera
from mixpose.session import Session

_OTHER_SIZE = (1e-3, 20.0)  # least change of the body's size that is tried, and largest factor

Alone = dict[str, tuple[Any, Floats]]  # by camera: itself, and T_world_object that it finds alone


def by_cameras_alone(session: Session, frames: Frames) -> Iterator[Change]:
    """Another size of the body, and other places of cameras, in what a few frames show of them."""
    found = []
    for number, views in frames:
        poses = [(view, _alone(session, number, view)) for view in views]
        found.append({view.name: (view.sensor, T) for view, T in poses if T is not None})
    if all(isinstance(feature, PointFeature) for feature in session.body.features):
        yield from _other_sizes(session, found)
    yield from _other_places(session, found)


def _other_sizes(session: Session, found: Sequence[Alone]) -> Iterator[Change]:
    """A body of the size that cameras see.

    Each alone finds it as far away as its size has it; p_b = R p_a + t / size relates the places
    in two cameras that stand at (R, t) to each other.
    """
    middle, sizes = np.append(session.body.means.mean(axis=0), 1.0), list[float]()
    for each in found:
        for (a, T_a), (b, T_b) in combinations(each.values(), 2):
            T_ba = b.T_sensor_world @ inverse(a.T_sensor_world)
            p_a = (a.T_sensor_world @ T_a @ middle)[:3]
            p_b = (b.T_sensor_world @ T_b @ middle)[:3]
            apart = p_b - T_ba[:3, :3] @ p_a
            sizes.append(float(apart @ T_ba[:3, 3] / max(float(apart @ apart), 1e-300)))
    size, (least, most) = float(np.median(sizes or [1.0])), _OTHER_SIZE
    if abs(size - 1) > least and 1 / most < size < most:
        yield Change(
            OTHER_SIZE,
            f"with points {times_as_large(size)}",
            body=lambda body: of_size(body, size),
            values=1,
        )


def _other_places(session: Session, found: Sequence[Alone]) -> Iterator[Change]:
    """Cameras where each has the body where the first of the others finds it."""
    for setup in session.sensors:
        name = setup.name
        for each in found:
            others = [T for other, (_, T) in each.items() if other != name]
            if name not in each or not others:
                continue
            sensor, T_own = each[name]
            moved = sensor.T_sensor_world @ T_own @ inverse(others[0])
            elsewhere = replace(sensor, T_sensor_world=moved)
            yield Change(
                misplaced(setup),
                moved_by(sensor.T_sensor_world, moved, session.unit),
                lambda views, name=name, elsewhere=elsewhere: [  # type: ignore[misc]
                    with_sensor(view, elsewhere) if view.name == name else view for view in views
                ],
                cost=0.5 * 6 * math.log(2 * len(session.body) * len(found)),
                values=6,
            )
            break


def _alone(session: Session, number: int, view: View) -> Floats | None:
    """T_world_object (4, 4) that one camera finds by itself."""
    if not isinstance(view.sensor, PinholeCamera | FisheyeCamera):
        return None
    pose = best_pose(anywhere(session), session.body, number, [view])
    return None if pose is None else pose.T_world_object
