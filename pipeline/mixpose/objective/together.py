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
from mixpose.objective.base import Quadratic
from mixpose.objective.kernel import Match
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
        match = self.joint.match(np.array(poses))
        models = zip(*self.joint.slopes_of(match), self._own(match), strict=True)
        return [Quadratic(float(v), g, C, match=own) for v, g, C, own in models]

    def match(self, poses: Sequence[Floats]) -> None:
        """Let each objective have at hand what it sees at a pose (4, 4) of its own."""
        found = self._own(self.joint.match(np.array(poses)))
        for one, T, own in zip(self.each, poses, found, strict=True):
            one.at_hand[:] = [(T, own)]

    def _own(self, match: Match) -> list[Match]:
        """What each of the bodies has of what all match."""
        counts = [len(one.projection.body.nodes.points) for one in self.each]
        return [match.of(slice(k, k + 1), n) for k, n in enumerate(counts)]
