"""The matched objectives of several bodies on the same densities, evaluated at once.

For a handful of features NumPy spends its time on calls, not on numbers: the poses that one body
is evaluated at in a batch may as well be those of several bodies, one each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from mixpose.body import Body
from mixpose.objective.matched import MatchedObjective
from mixpose.objective.projection import BodyProjection
from mixpose.records import Floats
from mixpose.sensors import Sensor


class BodiesProjection(BodyProjection):
    """Sensors that look at K bodies of bare points, each at a pose of its own.

    Arrays have a row per body; what a body has fewer features than others is filled up with its
    first one, without weight.
    """

    def __init__(self, sensors: Sequence[Sensor], bodies: Sequence[Body]) -> None:
        super().__init__(sensors, max(bodies, key=lambda body: len(body.nodes.points)))
        most = len(self.body.nodes.points)
        self._points = np.zeros((len(bodies), most, 3))
        self._weights = np.zeros((len(bodies), most))
        for points, weights, nodes in zip(self._points, self._weights, (b.nodes for b in bodies)):
            points[:] = nodes.points[0]
            points[: len(nodes.points)] = nodes.points
            weights[: len(nodes.points)] = nodes.weights


@lru_cache(maxsize=64)
def project_bodies(sensors: tuple[Sensor, ...], bodies: tuple[Body, ...]) -> BodiesProjection:
    """The projection of bodies into sensors, which are the same objects from frame to frame."""
    return BodiesProjection(sensors, bodies)


def can_be_together(body: Body) -> bool:
    """Whether a body has bare points only: no normals, and no size of markers."""
    return body.normals is None and (body.node_radii is None or not body.node_radii.any())


@dataclass(frozen=True, eq=False)
class BodiesObjective(MatchedObjective):
    """Objectives of K bodies, whose atlas and blurs are the same, at a pose of each body's own."""

    bodies: tuple[Body, ...] = ()

    def seen(self, objectives: Sequence[MatchedObjective], poses: Floats) -> list[MatchedObjective]:
        """The objectives with what each sees at its own of the poses (K, 4, 4)."""
        match = self.match(poses)
        counts = [len(body.nodes.points) for body in self.bodies]
        parts = [match.of(slice(k, k + 1), n) for k, n in enumerate(counts)]
        pairs = zip(objectives, poses, parts, strict=True)
        return [replace(objective, at_hand=(T, part)) for objective, T, part in pairs]

    def _blocks(self, poses: Floats) -> list[Floats]:
        return [poses]


def together(objectives: Sequence[MatchedObjective]) -> BodiesObjective:
    """Put objectives of different bodies side by side."""
    first, bodies = objectives[0], tuple(one.projection.body for one in objectives)
    return BodiesObjective(
        views=first.views,
        projection=project_bodies(first.projection.sensors, bodies),
        atlas=first.atlas,
        variances=first.variances,
        tops=first.tops,
        energies=np.concatenate([one.energies for one in objectives], axis=1),
        weights=np.concatenate([one.weights for one in objectives], axis=1),
        bodies=bodies,
    )
