"""Where tracks expect bodies in images; what was met there convinces, or all is looked at."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy.spatial import KDTree

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement import AcceptanceRules
from mixpose.objective import View, project_body
from mixpose.records import Estimate, Mask
from mixpose.sensors import Sensor
from mixpose.tracking.scene import Scene
from mixpose.tracking.track import Branch, Track

Box: TypeAlias = tuple[int, int, int, int]
Tallies: TypeAlias = Mapping[str, tuple[int, int]]  # of features met, and in view


@dataclass(frozen=True)
class Expectation:
    """A body in front of cameras, and how far around a prediction its features are looked for."""

    body: Body
    cameras: Mapping[str, Sensor]  # by name; with two coordinates, in px
    free: Mask  # (6,), directions that are estimated
    reach: float = constant(
        4.0, "standard deviations of the prediction, and of features that have a spread"
    )
    min_margin_px: float = constant(40.0, "around the predicted features: a spot and its ground")

    @cached_property
    def _feature_reach(self) -> float:
        """How far a feature's image reaches: less than half way to that of its neighbour."""
        points = self.body.nodes.points
        apart = KDTree(points).query(points, k=2)[0][:, 1].min() if len(points) > 1 else np.inf
        return float(apart / 2 + self.reach * self.body.spread)

    def windows(self, predictions: Sequence[Branch]) -> dict[str, Box]:
        """Box of pixels (u0, v0, u1, v1) in which each camera will have the body, ends exclusive.

        There is none where the body is not in view, or has one feature: nothing tells how large.
        """
        if not self.cameras or not predictions or not np.isfinite(self._feature_reach):
            return {}
        projection = project_body(tuple(self.cameras.values()), self.body)
        at = projection.project(np.array([one.T_world_object for one in predictions]))
        uncertainty = np.array([one.uncertainty for one in predictions])
        by_pose = np.einsum("lpnij,pj->lpni", at.J**2, (uncertainty * self.free) ** 2)
        scales = np.sqrt((at.J[..., :3] ** 2).sum(axis=(3, 4)).max(axis=2))
        rims = np.maximum(scales * self._feature_reach, self.min_margin_px)
        margins = self.reach * np.sqrt(by_pose) + rims[..., None, None]
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
    agreeing = [(met, in_view) for met, in_view in some if met >= rules.agreeing * in_view > 0]
    met, in_view = np.sum(agreeing if len(agreeing) > 1 else [*some, (0, 0)], axis=0)
    return bool(met > rules.convincing * in_view)


def are_as_good(tallies: Tallies, before: Tallies) -> bool:
    """Whether no sensor misses more of the body than in the frame before."""
    return all(
        in_view - met <= before[name][1] - before[name][0]
        for name, (met, in_view) in tallies.items()
        if name in before
    )


def have_fewer(views: Sequence[View], before: Tallies) -> bool:
    """Whether a camera has fewer detections than it met features in the frame before."""
    seen = {view.name: view.observation.points for view in views if view.name in before}
    return any(
        points is not None and len(points) < before[name][0] for name, points in seen.items()
    )


@dataclass(frozen=True)
class WindowedScene:
    """A scene that looks where its bodies are expected, and at all there is if that is too little.

    Its cameras are those whose features in a part of the image are those of the whole image.
    """

    scene: Scene
    cameras: Mapping[str, Sensor]  # by name

    def advance(
        self,
        tracks: Sequence[Track],
        frame: int,
        time_s: float | None,
        observe: Callable[[Mapping[str, Box]], list[View]],
        images: Collection[str],
    ) -> tuple[tuple[Track, ...], list[Estimate], list[View]]:
        """As `Scene.advance`: around the predictions if that convinces, else of all there is.

        `observe` makes views of boxes by camera, of `images` only; without a box they are whole.
        """
        windows = {}
        if images and self._are_met(tracks):
            windows = self._windows(tracks, frame, time_s)
            windows = {name: box for name, box in windows.items() if name in images}
        if windows:
            views = observe(windows)
            if not any(have_fewer(views, track.tallies) for track in tracks):
                after, estimates = self.scene.advance(tracks, frame, time_s, views)
                pairs = zip(after, tracks, strict=True)
                as_good = all(are_as_good(now.tallies, then.tallies) for now, then in pairs)
                if as_good and self._are_met(after):
                    return after, estimates, views
        views = observe({})
        return *self.scene.advance(tracks, frame, time_s, views), views

    def _are_met(self, tracks: Sequence[Track]) -> bool:
        """Whether the last frame was sure of all bodies, and met most of each."""
        return all(
            not (track.misses or track.doubted)
            and is_convincing(track.tallies, self.cameras, tracked.rules.acceptance)
            for tracked, track in zip(self.scene.bodies, tracks, strict=True)
        )

    @cached_property
    def _expectations(self) -> list[Expectation]:
        return [Expectation(one.body, self.cameras, one.free) for one in self.scene.bodies]

    def _windows(self, tracks: Sequence[Track], frame: int, time_s: float | None) -> dict[str, Box]:
        """In which part of each image the bodies are expected, one window around all of them."""
        windows: dict[str, Box] = {}
        for k, tracked in enumerate(self.scene.bodies):
            predictions = tracked.predictions(tracks[k], frame, time_s)
            for name, box in self._expectations[k].windows(predictions).items():
                a, b, c, d = windows.get(name, box)
                windows[name] = min(a, box[0]), min(b, box[1]), max(c, box[2]), max(d, box[3])
        return windows
