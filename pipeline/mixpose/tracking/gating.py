"""Where a track expects the body in its cameras, and whether it was met there.

A frame of which only that was looked at, and whose poses are not as convincing as those before it,
is looked at again as a whole.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement import AcceptanceRules
from mixpose.objective import View, project_body
from mixpose.records import PointPattern
from mixpose.sensors import Sensor
from mixpose.tracking.scene import Outcome, Scene
from mixpose.tracking.track import Prediction, SensorTally, Track

Box: TypeAlias = tuple[int, int, int, int]
Tallies: TypeAlias = Mapping[str, SensorTally]
Observe: TypeAlias = Callable[[Mapping[str, Box]], list[View]]


@dataclass(frozen=True)
class GatingRules:
    """How far around a prediction features are looked for."""

    reach: float = constant(
        4.0, "standard deviations of the prediction, and of features that have a spread"
    )
    min_margin_px: float = constant(40.0, "around the predicted features: a spot and its ground")


@dataclass(frozen=True)
class Expectation:
    """A body in front of cameras."""

    body: Body
    cameras: Mapping[str, Sensor]  # by name; with two coordinates, in px
    free: NDArray[np.bool_]  # (6,), directions that are estimated
    rules: GatingRules = GatingRules()

    @cached_property
    def _feature_reach(self) -> float:
        """How far a feature's image reaches: less than half way to that of its neighbour."""
        points = self.body.nodes.points
        apart = KDTree(points).query(points, k=2)[0][:, 1].min() if len(points) > 1 else np.inf
        return float(apart / 2 + self.rules.reach * self.body.spread)

    def windows(self, predictions: Sequence[Prediction]) -> dict[str, Box]:
        """Box of pixels (u0, v0, u1, v1) in which each camera will have the body, ends exclusive.

        It holds all features that a camera will see, four standard deviations of the prediction,
        and the features' images, but at least 40 px, around them.  Cameras that will not see the
        body have none; a body of one feature, whose size in the image nothing tells, neither.
        """
        if not self.cameras or not predictions or not np.isfinite(self._feature_reach):
            return {}
        projection = project_body(tuple(self.cameras.values()), self.body)
        at = projection.project(np.array([one.T_world_object for one in predictions]))
        uncertainty = np.array([one.uncertainty for one in predictions])
        by_pose = np.einsum("lpnij,pj->lpni", at.J**2, (uncertainty * self.free) ** 2)
        scales = np.sqrt((at.J[..., :3] ** 2).sum(axis=(3, 4)).max(axis=2))
        rims = np.maximum(scales * self._feature_reach, self.rules.min_margin_px)
        margins = self.rules.reach * np.sqrt(by_pose) + rims[..., None, None]
        seen = at.seen[..., None]
        lower = np.where(seen, at.y - margins, np.inf).min(axis=(1, 2)).tolist()
        upper = np.where(seen, at.y + margins, -np.inf).max(axis=(1, 2)).tolist()
        return {
            name: (math.floor(u0), math.floor(v0), math.ceil(u1) + 1, math.ceil(v1) + 1)
            for name, (u0, v0), (u1, v1) in zip(self.cameras, lower, upper, strict=True)
            if u0 <= u1
        }


def is_convincing(tallies: Tallies, cameras: Iterable[str], rules: AcceptanceRules) -> bool:
    """Whether cameras met so much of the body that the next frame need not be seen whole."""
    some = [tallies[name] for name in cameras if name in tallies]
    agreeing = [one for one in some if one.is_met(rules.agreeing)]
    some = agreeing if len(agreeing) > 1 else some
    return sum(one.met for one in some) > rules.convincing * sum(one.in_view for one in some)


def are_as_good(tallies: Tallies, before: Tallies) -> bool:
    """Whether no sensor misses more of the body than in the frame before."""
    return all(
        one.in_view - one.met <= before[name].in_view - before[name].met
        for name, one in tallies.items()
        if name in before
    )


def have_fewer(views: Sequence[View], before: Tallies) -> bool:
    """Whether a camera has fewer detections than it met features in the frame before."""
    return any(
        isinstance(view.observation.pattern, PointPattern)
        and view.name in before
        and len(view.observation.pattern.points) < before[view.name].met
        for view in views
    )


@dataclass(frozen=True)
class WindowedScene:
    """A scene that looks where its bodies are expected, and at all there is if that is too little.

    Attributes
    ----------
    scene : Scene
    expectations : tuple of Expectation
        One per body; their cameras are those whose features in a part of the image are those of
        the whole image.
    """

    scene: Scene
    expectations: tuple[Expectation, ...]

    @classmethod
    def of(cls, scene: Scene, cameras: Mapping[str, Sensor]) -> WindowedScene:
        """A scene before cameras that may be looked at in part."""
        return cls(scene, tuple(Expectation(one.body, cameras, one.free) for one in scene.bodies))

    def advance(
        self,
        tracks: Sequence[Track],
        frame: int,
        time_s: float | None,
        observe: Observe,
        images: Collection[str],
    ) -> tuple[list[Outcome], list[View]]:
        """Estimate a frame: around the predictions if that convinces, else from all that is there.

        Parameters
        ----------
        tracks, frame, time_s
            As of `Scene.advance`.
        observe : callable
            From boxes of pixels by camera to the views of all sensors; cameras without a box are
            seen whole.
        images : collection of str
            Cameras of which the frame has an image.
        """
        if self._are_followed(tracks):
            windows = self._windows(tracks, frame, time_s, images)
            views = observe(windows) if windows else []
            if windows and not any(have_fewer(views, track.tallies) for track in tracks):
                outcomes = self.scene.advance(tracks, frame, time_s, views)
                after = [one.track for one in outcomes]
                if self._are_followed(after) and all(
                    are_as_good(now.tallies, then.tallies)
                    for now, then in zip(after, tracks, strict=True)
                ):
                    return outcomes, views
        views = observe({})
        return self.scene.advance(tracks, frame, time_s, views), views

    def _are_followed(self, tracks: Sequence[Track]) -> bool:
        """Whether the last frame was sure of all bodies, and met most of each."""
        bodies = zip(self.scene.bodies, self.expectations, tracks, strict=True)
        return all(
            not track.misses
            and not track.doubted
            and is_convincing(track.tallies, expected.cameras, tracked.rules.acceptance)
            for tracked, expected, track in bodies
        )

    def _windows(
        self, tracks: Sequence[Track], frame: int, time_s: float | None, images: Collection[str]
    ) -> dict[str, Box]:
        """In which part of each image the bodies are expected, one window around all of them."""
        windows: dict[str, Box] = {}
        if not images:
            return windows
        for tracked, expected, track in zip(
            self.scene.bodies, self.expectations, tracks, strict=True
        ):
            for name, box in expected.windows(tracked.predictions(track, frame, time_s)).items():
                if name in images:
                    a, b, c, d = windows.get(name, box)
                    windows[name] = min(a, box[0]), min(b, box[1]), max(c, box[2]), max(d, box[3])
        return windows
