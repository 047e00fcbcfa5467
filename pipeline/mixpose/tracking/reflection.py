"""The body's mirror image, as a window or a polished floor shows it.

Any three markers of a mirror image lie as three of the body do, and markers that are nearly in a
plane all do.  So where the features met lie in a plane as far as their noise tells, and others are
missed, the body reflected in that plane is a rival: it puts the same features where they are met,
and the missed ones on the other side.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body, PointFeature
from mixpose.judgement import Judged
from mixpose.tracking.likelihood import FrameData, Start, likelihood_of

Floats: TypeAlias = NDArray[np.float64]


MIRRORED = "it shows the body's mirror image"


def is_reflection(data: FrameData, judged: Judged) -> bool:
    """Whether the frame shows the body's mirror image rather than the body."""
    if all(one.missed < 0.5 for one in judged.associations) or not data.body.is_exact:
        return False
    mirror = _reflected(data, judged)
    if mirror is None:
        return False
    data = replace(data, body=mirror)
    likelihood = likelihood_of(data)
    start = Start(judged.T_world_object, data.start_uncertainty / data.rules.proposals.narrowing**2)
    rival = likelihood.judge(likelihood.fit(start), start)
    return rival.log_evidence > judged.log_evidence + data.rules.acceptance.standing_out


def _reflected(data: FrameData, judged: Judged) -> Body | None:
    """The body reflected in the plane of the features met; None where they are in no plane."""
    points = data.body.means
    views, scale = np.zeros(len(points)), np.zeros(len(points))
    for one in judged.associations:
        met = one.features[one.shares > 0]
        views[met] += 1
        by_shift = np.linalg.norm(one.J[one.shares > 0][..., :3], axis=(1, 2)) / one.sigma
        scale[met] = np.maximum(scale[met], by_shift)
    sharp = views >= min(2, views.max())  # one camera alone may have met them by chance
    sharp = sharp if sharp.sum() >= 3 else views > 0
    centre = points[sharp].mean(axis=0)
    normal = np.linalg.svd(points[sharp] - centre)[2][-1]
    height = (points - centre) @ normal
    if np.sqrt(np.mean((height * scale)[sharp] ** 2)) > data.rules.proposals.in_plane:
        return None
    mirrored = points - 2 * height[:, None] * normal
    outward = data.body.normals
    if outward is not None:
        outward = outward - 2 * (outward @ normal)[:, None] * normal
    return Body(data.body.name, tuple(PointFeature(one) for one in mirrored), outward)
