"""How large a body looks to several cameras together."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from mixpose.body import PointFeature
from mixpose.checking.changes import OTHER_SIZE, Change, of_size
from mixpose.checking.evidence import Frames, anywhere, best_pose
from mixpose.objective import View
from mixpose.records import Floats
from mixpose.rigid import inverse
from mixpose.sensors import FisheyeCamera, PinholeCamera
from mixpose.session import Session

_OTHER_SIZE = (1e-3, 20.0)  # least change of the body's size that is tried, and largest factor


def other_sizes(session: Session, frames: Frames) -> Iterator[Change]:
    """A body of the size that cameras see where each alone finds it.

    Each alone finds it as far away as its size has it; p_b = R p_a + t / size relates the places
    in two cameras that stand at (R, t) to each other.
    """
    body = session.body
    if not all(isinstance(feature, PointFeature) for feature in body.features):
        return
    middle = np.append(body.means.mean(axis=0), 1.0)
    found = []
    for number, views in frames:
        places = [(view.sensor, _alone(session, number, view)) for view in views]
        seen = [(each, T) for each, T in places if T is not None]
        for (a, T_a), (b, T_b) in combinations(seen, 2):
            T_ba = b.T_sensor_world @ inverse(a.T_sensor_world)  # type: ignore[attr-defined]
            p_a = (a.T_sensor_world @ T_a @ middle)[:3]  # type: ignore[attr-defined]
            p_b = (b.T_sensor_world @ T_b @ middle)[:3]  # type: ignore[attr-defined]
            apart = p_b - T_ba[:3, :3] @ p_a
            found.append(float(apart @ T_ba[:3, 3] / max(float(apart @ apart), 1e-300)))
    size, (least, most) = float(np.median(found or [1.0])), _OTHER_SIZE
    if abs(size - 1) > least and 1 / most < size < most:
        yield Change(
            OTHER_SIZE,
            f"with points {size:.3g} times as large",
            body=lambda body: of_size(body, size),
            values=1,
        )


def _alone(session: Session, number: int, view: View) -> Floats | None:
    """T_world_object (4, 4) that one camera finds by itself."""
    if not isinstance(view.sensor, PinholeCamera | FisheyeCamera):
        return None
    pose = best_pose(anywhere(session), session.body, number, [view])
    return None if pose is None else pose.T_world_object
