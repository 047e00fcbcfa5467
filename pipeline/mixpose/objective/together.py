"""The matched objectives of several bodies on the same densities, evaluated at once.

For a handful of features NumPy spends its time on calls, not on numbers: the poses that one body
is evaluated at in a batch may as well be those of several bodies, one each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.objective.base import Quadratic
from mixpose.objective.matched import MatchedObjective
from mixpose.objective.projection import BodyProjection
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]


class BodiesProjection(BodyProjection):
    """Sensors that look at K bodies of bare points, each at a pose of its own.

    Arrays have a row per body; what a body has fewer features than others is filled up with its
    first one, without weight.
    """

    def __init__(self, sensors: Sequence[Sensor], bodies: Sequence[Body]) -> None:
        super().__init__(sensors, max(bodies, key=lambda body: len(body.nodes.points)))
        most = len(self.body.nodes.points)
        self.counts = [len(body.nodes.points) for body in bodies]
        fill = [np.minimum(np.arange(most), n) % n for n in self.counts]
        nodes = [body.nodes for body in bodies]
        self._points = np.array([one.points[i] for one, i in zip(nodes, fill, strict=True)])
        self._weights = np.zeros((len(bodies), most))
        for row, one in zip(self._weights, nodes, strict=True):
            row[: len(one.weights)] = one.weights


@lru_cache(maxsize=64)
def project_bodies(sensors: tuple[Sensor, ...], bodies: tuple[Body, ...]) -> BodiesProjection:
    """The projection of bodies into sensors, which are the same objects from frame to frame."""
    return BodiesProjection(sensors, bodies)


def can_be_together(body: Body) -> bool:
    """Whether a body has bare points only: no normals, and no size of markers."""
    return body.normals is None and (body.node_radii is None or not body.node_radii.any())


@dataclass(frozen=True, eq=False)
class Together:
    """Objectives of K bodies, whose atlas and blurs are the same."""

    each: tuple[MatchedObjective, ...]
    joint: MatchedObjective

    @classmethod
    def of(cls, each: Sequence[MatchedObjective]) -> Together:
        """Put objectives side by side."""
        projection = project_bodies(
            each[0].projection.sensors, tuple(one.projection.body for one in each)
        )
        energies = np.concatenate([one.energies for one in each], axis=1)
        weights = np.concatenate([one.weights for one in each], axis=1)
        joint = replace(each[0], projection=projection, energies=energies, weights=weights)
        return cls(tuple(each), joint)

    def models(self, poses: Sequence[Floats]) -> list[Quadratic]:
        """Value, gradient and curvature of each objective at a pose (4, 4) of its own."""
        found = self.joint.slopes(np.array(poses))
        return [Quadratic(float(v), g, c) for v, g, c in zip(*found, strict=True)]

    def match(self, poses: Sequence[Floats]) -> None:
        """Let each objective have at hand what it sees at a pose (4, 4) of its own."""
        at, sampled, over = self.joint.match(np.array(poses))
        counts = project_bodies(
            self.joint.projection.sensors, tuple(one.projection.body for one in self.each)
        ).counts
        for k, (one, T, n) in enumerate(zip(self.each, poses, counts, strict=True)):
            own = at.of(k, n)
            kept = (over.pairs < n).all(axis=1)
            pairs = over.pairs[kept]
            norm = over.norm[:, k : k + 1]
            bells, away = norm, norm
            if len(pairs):
                bells, away = over.bells[:, k : k + 1, kept], over.away[:, k : k + 1, kept]
            one.last[:] = [
                (T, (own, sampled[:, k : k + 1, :n], type(over)(norm, pairs, bells, away)))
            ]
