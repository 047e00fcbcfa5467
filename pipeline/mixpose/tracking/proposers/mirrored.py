"""The other tilt of a flat body in one view.

A flat body that is small in the image looks almost the same when it is tilted the other way:
turned so that depths about its centre change their sign.  Both tilts move as smoothly: where the
frame before left open which is right, motion does not tell.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mixpose.judgement import ScoredPose
from mixpose.rigid import from_parts
from mixpose.tracking.likelihood import FrameData, Start


def mirrored(data: FrameData, ranked: list[ScoredPose]) -> Iterable[Start]:
    """The best pose tilted the other way, where one camera alone meets a nearly flat body."""
    body, views = data.body, data.views
    if ranked and len(views) > 1:
        least = data.rules.acceptance.agreeing
        seen = ranked[0].matches
        met = {n for n, share in zip(seen.names, seen.coverage) if share >= least}
        views = [view for view in views if view.name in met]
    if not ranked or len(views) != 1 or views[0].sensor.dimension != 2:
        return []
    centre = body.means.mean(axis=0)
    _, extents, axes = np.linalg.svd(body.means - centre, full_matrices=False)
    if len(extents) < 3 or extents[2] > data.rules.proposals.flat * extents[1]:
        return []
    T = ranked[0].T_world_object
    R = T[:3, :3]
    centre_world = R @ centre + T[:3, 3]
    towards = views[0].sensor.towards(centre_world[None])[0]
    v = towards / np.linalg.norm(towards)
    n = axes[2]
    # two mirrors make a turn: across the body's own plane, which leaves it alone, and in depth
    R_tilted = (np.eye(3) - 2 * np.outer(v, v)) @ R @ (np.eye(3) - 2 * np.outer(n, n))
    T_tilted = from_parts(R_tilted, centre_world - R_tilted @ centre)
    close = data.start_uncertainty / data.rules.proposals.narrowing
    return [Start(T_tilted, close, T_moved=data.moves_alike(T))]
