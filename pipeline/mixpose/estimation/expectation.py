"""Where a track expects the body in its cameras, and whether it was met there.

While a body is tracked, features are looked for around the prediction only.  That must never
change what is found: a frame whose pose is not as convincing as the one before it is looked at
again as a whole (`mixpose.runner`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mixpose.body import Body
from mixpose.estimation.meeting import LEAST_SHARE
from mixpose.estimation.track import Prediction
from mixpose.estimation.tracker import CONVINCING
from mixpose.objective import View
from mixpose.objective.gaze import Gaze
from mixpose.records import PointPattern
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]
Box: TypeAlias = tuple[int, int, int, int]

REACH = 4.0  # standard deviations of the prediction, and of features that have a spread
LEAST_MARGIN_PX = 40.0

_REACH_OF_MEETING = -4 * math.log(LEAST_SHARE)  # in σ_ε², as `mixpose.estimation.meeting` has it


@dataclass(frozen=True)
class Encounter:
    """How much of the body was met, by sensor name.

    Attributes
    ----------
    met, missed : dict of str to int
        Features in view with and without a detection next to them.
    """

    met: dict[str, int]
    missed: dict[str, int]

    @property
    def convincing(self) -> bool:
        """Whether so much is met that the prediction is taken without looking elsewhere."""
        met, missed = sum(self.met.values()), sum(self.missed.values())
        return met > CONVINCING * (met + missed)

    def as_good_as(self, before: Encounter) -> bool:
        """Whether no sensor misses more of the body than in the frame before."""
        return all(count <= before.missed.get(name, 0) for name, count in self.missed.items())


class Expectation:
    """A body in front of cameras."""

    def __init__(
        self,
        body: Body,
        cameras: Mapping[str, Sensor],
        free: NDArray[np.bool_],
        gaze: Gaze | None = None,
    ) -> None:
        """Prepare for a body.

        Parameters
        ----------
        body : Body
        cameras : mapping of str to Sensor
            Sensors with two coordinates, in px.
        free : (6,) bool
            Directions that are estimated.
        gaze : Gaze or None
            Of the cameras at the body, where it is at hand.
        """
        self.names = tuple(cameras)
        self._gaze = gaze or (Gaze(list(cameras.values()), body) if cameras else None)
        self._free = free
        points = body.nodes.points
        # A feature's image reaches less than half way to that of its neighbour.
        apart = KDTree(points).query(points, k=2)[0][:, 1].min() if len(points) > 1 else np.inf
        gravity = body.gravity.sigma if body.gravity is not None else 0.0
        self._feature_reach = apart / 2 + REACH * float(np.hypot(body.spread, gravity))

    def windows(self, predictions: Sequence[Prediction]) -> dict[str, Box]:
        """Box of pixels (u0, v0, u1, v1) in which each camera will have the body, ends exclusive.

        It holds all features that a camera will see, four standard deviations of the prediction,
        and the features' images, but at least 40 px, around them.  Cameras that will not see the
        body have none; a body of one feature, whose size in the image nothing tells, neither.
        """
        if self._gaze is None or not np.isfinite(self._feature_reach):
            return {}
        boxes: dict[str, Box] = {}
        for prediction in predictions:
            at = self._gaze.project(prediction.T_world_object)
            variances = (prediction.uncertainty * self._free) ** 2
            by_shift = at.J[..., :3]
            scales = np.sqrt(np.einsum("lnij,lnij->ln", by_shift, by_shift).max(axis=1))
            margins = REACH * np.sqrt(at.J**2 @ variances)
            margins += np.maximum(scales * self._feature_reach, LEAST_MARGIN_PX)[:, None, None]
            seen = at.seen[..., None]
            lower = np.where(seen, at.y - margins, np.inf).min(axis=1).tolist()
            upper = np.where(seen, at.y + margins, -np.inf).max(axis=1).tolist()
            for name, low, high in zip(self.names, lower, upper, strict=True):
                if low[0] > high[0]:
                    continue
                u0, v0 = (math.floor(end) for end in low)
                u1, v1 = (math.ceil(end) + 1 for end in high)
                a, b, c, d = boxes.get(name, (u0, v0, u1, v1))
                boxes[name] = (min(a, u0), min(b, v0), max(c, u1), max(d, v1))
        return boxes

    def encounter(self, views: Sequence[View], T_world_object: Floats) -> Encounter:
        """How much of the body at a pose the cameras' detections meet."""
        met: dict[str, int] = {}
        missed: dict[str, int] = {}
        if self._gaze is None:
            return Encounter(met, missed)
        at = self._gaze.project(T_world_object)
        for view in views:
            pattern = view.observation.pattern
            if view.name not in self.names or not isinstance(pattern, PointPattern):
                continue
            k = self.names.index(view.name)
            y = at.y[k][at.seen[k]]
            near = _REACH_OF_MEETING * view.observation.sigma**2
            if len(pattern.points):
                away = pattern.points[:, None] - y
                nearest = np.einsum("ijk,ijk->ij", away, away).min(axis=0)
                met[view.name] = int(np.count_nonzero(nearest <= near))
            else:
                met[view.name] = 0
            missed[view.name] = len(y) - met[view.name]
        return Encounter(met, missed)
