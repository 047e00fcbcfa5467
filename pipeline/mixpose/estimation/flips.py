"""The other tilt of a flat body in one view.

A flat body that is small in the image looks almost the same when it is tilted the other way:
turned so that depths about its centre change their sign.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.objective import View
from mixpose.rigid import from_parts

Floats: TypeAlias = NDArray[np.float64]

FLAT = 0.15
"""Thickness of a body against its smaller width below which it counts as nearly flat."""


def flipped(T_world_object: Floats, body: Body, views: Sequence[View]) -> list[Floats]:
    """The pose tilted the other way, where one camera alone sees a nearly flat body.

    Parameters
    ----------
    T_world_object : (4, 4) array
    body : Body
    views : sequence of View
        Those that see something.

    Returns
    -------
    list of (4, 4) array
        One pose or none.
    """
    if len(views) != 1 or views[0].sensor.dimension != 2:
        return []
    centre = body.means.mean(axis=0)
    _, extents, axes = np.linalg.svd(body.means - centre, full_matrices=False)
    if len(extents) < 3 or extents[2] > FLAT * extents[1]:
        return []
    R = T_world_object[:3, :3]
    centre_world = R @ centre + T_world_object[:3, 3]
    towards = views[0].sensor.towards(centre_world[None])[0]
    v = towards / np.linalg.norm(towards)
    n = axes[2]
    # two mirrors make a turn: across the body's own plane, which leaves it alone, and in depth
    R_flipped = (np.eye(3) - 2 * np.outer(v, v)) @ R @ (np.eye(3) - 2 * np.outer(n, n))
    return [from_parts(R_flipped, centre_world - R_flipped @ centre)]
