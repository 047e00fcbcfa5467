"""Which few points stand for many."""

from __future__ import annotations

from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body

Floats: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.intp]


@lru_cache(maxsize=32)
def sparse(body: Body, count: int) -> Body:
    """A body with `count` of its features, far from one another; itself where it has no more."""
    if len(body) <= count or len(body.nodes.points) != len(body):
        return body
    few = far_apart(body.means, count)
    normals = None if body.normals is None else body.normals[few]
    return Body(body.name, tuple(body.features[k] for k in few), normals, body.gravity)


def far_apart(points: Floats, count: int) -> Indices:
    """Indices of points that are far from one another, starting at the outermost."""
    count = min(count, len(points))
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.intp)
