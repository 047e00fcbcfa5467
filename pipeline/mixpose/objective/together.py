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
from mixpose.objective.kernel import NEGLIGIBLE_BELL, Match, Overlaps, overlaps, slopes
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
        joint = self.joint
        found = at, sampled, over = joint.match(np.array(poses))
        scales = joint.weights / joint.energies
        apart = over._replace(pairs=over.pairs[:0])
        values, gradients, curvatures = slopes(
            at, sampled, apart, joint.variances, joint.tops, scales
        )
        overlapping = self._overlapping(over)
        models = []
        for k in range(len(poses)):
            own = self._own(found, k, alone=k not in overlapping)
            if k in overlapping:  # it steps otherwise
                terms = joint.variances, joint.tops, scales[:, k : k + 1]
                lone = slopes(*own, *terms)
                models.append(Quadratic(float(lone[0][0]), lone[1][0], lone[2][0], match=own))
                continue
            value = float(values[k])
            models.append(Quadratic(value, gradients[k], curvatures[k], match=own))
        return models

    def _overlapping(self, over: Overlaps) -> list[int]:
        """Bodies of which features overlap."""
        if not len(over.pairs):
            return []
        near = over.bells > NEGLIGIBLE_BELL * self.joint.tops[..., None]
        return np.flatnonzero(near.any(axis=(0, 2))).tolist()

    def match(self, poses: Sequence[Floats]) -> None:
        """Let each objective have at hand what it sees at a pose (4, 4) of its own."""
        found = self.joint.match(np.array(poses))
        overlapping = self._overlapping(found[2])
        for k, (one, T) in enumerate(zip(self.each, poses, strict=True)):
            one.at_hand[:] = [(T, self._own(found, k, alone=k not in overlapping))]

    def _own(self, found: Match, k: int, *, alone: bool) -> Match:
        """What one of the bodies has of what all match; none of its features overlap if alone."""
        at, sampled, over = found
        n = len(self.each[k].projection.body.nodes.points)
        own, norm = at.of(k, n), over.norm[:, k : k + 1]
        if not alone:
            joint = self.joint
            over = overlaps(own.y, own.weights, joint.variances, joint.tops)
        else:
            over = Overlaps(norm, over.pairs[:0], norm, norm)
        return Match(own, sampled[:, k : k + 1, :n], over)
