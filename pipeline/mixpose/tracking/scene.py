"""All bodies before the sensors, from frame to frame, and where in images they are looked for.

Nothing in a frame tells identical bodies apart; only where they were before does.  The poses of a
frame are given to them so that all together are most likely by what was predicted.  Where two of
them might as well have changed places, because they met or were lost together, both are in doubt
in that frame, with each other's pose among their hypotheses; afterwards they go on as assigned.
Bodies that nothing was known of before get the poses that are left in the order of the world's
x coordinate (then y, then z) of their origins.

Images are looked at where tracks expect the bodies: a frame is sure of them there, or all is seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations
from operator import itemgetter
from typing import TypeAlias

import numpy as np
from scipy.spatial import KDTree

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement import Alternative, Verdict
from mixpose.objective import View, project_body
from mixpose.records import Estimate, Floats, Mask
from mixpose.rigid import transform
from mixpose.sensors import Sensor
from mixpose.tracking.confusion import confusions_of
from mixpose.tracking.frame import Frame
from mixpose.tracking.identity import Rivals, identify
from mixpose.tracking.mirrors import is_flat
from mixpose.tracking.motion import Distances
from mixpose.tracking.rules import SceneRules
from mixpose.tracking.sharing import Explanation, Sharing
from mixpose.tracking.track import Branch, Companion, Track, likely_branches
from mixpose.tracking.tracker import Tracker, followed

Box: TypeAlias = tuple[int, int, int, int]


@dataclass(frozen=True)
class Scene:
    """All bodies that are before the sensors, in the order of their pose lines."""

    bodies: tuple[Tracker, ...]
    rules: SceneRules = SceneRules()

    def begin(self) -> tuple[Track, ...]:
        """The tracks before the first frame."""
        return tuple(tracked.begin() for tracked in self.bodies)

    def advance(
        self, tracks: Sequence[Track], frame: int, time_s: float | None, views: Sequence[View]
    ) -> tuple[tuple[Track, ...], list[Estimate]]:
        """Estimate one frame of every body: tracks for the next, and estimates without latency.

        `views` are all sensors with a frame; those that saw nothing are reported and left out.
        """
        if len(self.bodies) == 1:
            track, estimate = self.bodies[0].advance(tracks[0], frame, time_s, views)
            return (track,), [estimate]
        found = Sharing(self.bodies, tracks, frame, time_s, views, self.rules).explained()
        finders, rivals = {k: k for k in found}, dict[int, Rivals]()
        apart = dict[int, Distances]()
        for name in {one.body.name for one in self.bodies if one.instance is not None}:
            group = [k for k, one in enumerate(self.bodies) if one.body.name == name]
            motion, before = self.bodies[group[0]].rules.motion, tracks[group[0]].distances
            if before is None:
                radius = self.bodies[group[0]].body.radius
                before = Distances.unknown(len(group), radius, motion)
            given, exchanged = identify(group, found, before)
            finders, rivals = finders | given, rivals | exchanged
            places = _places([found[given[k]] for k in group], self.bodies[group[0]].origin)
            apart[group[0]] = before.after(places, motion)
        told = {k: _in_doubt(found[finders[k]].verdict, rivals.get(k, [])) for k in found}
        frames = {k: _seen_by(one.frame, found[finders[k]].frame) for k, one in found.items()}
        alike = confusions_of(frames, told)
        after, estimates = list[Track](), list[Estimate]()
        for k, tracked in enumerate(self.bodies):
            data, verdict = frames[k], found[finders[k]].verdict
            odds = data.track.confused
            if k in alike:
                against = [one.since(odds) for one in alike[k]]
                odds = dict(sorted(against, key=itemgetter(1)))
                verdict, told[k] = verdict.doubted(against), told[k].doubted(against)
            after.append(replace(followed(data, verdict), distances=apart.get(k), confused=odds))
            estimates.append(tracked.estimate(data, after[k], told[k], found[finders[k]].ranked))
        return self._acquainted(after, told), estimates

    def _acquainted(
        self, tracks: Sequence[Track], told: Mapping[int, Verdict]
    ) -> tuple[Track, ...]:
        """The tracks, and where sure bodies are beside each other, but for exchangeable ones."""
        sure = {
            k: one.best.T_world_object
            for k, one in sorted(told.items())
            if self.bodies[k].instance is None and one.status == "ok" and one.best is not None
        }
        after = list(tracks)
        for k, j in permutations(sure, 2):
            label, known = self.bodies[j].label, after[k].companions
            now = Companion.joined(known.get(label), sure[k], sure[j], self.bodies[k].body)
            after[k] = replace(after[k], companions={**known, label: now})
        return tuple(after)


def _places(found: Sequence[Explanation], origin: Floats) -> Floats:
    """Where origins (3,) of bodies are (n, 3); NaN of those without a pose."""
    bests = [one.verdict.best for one in found]
    none = np.full(3, np.nan)
    return np.array(
        [none if one is None else transform(one.T_world_object, origin[None])[0] for one in bests]
    )


def _seen_by(data: Frame, finder: Frame) -> Frame:
    """The frame of a body, with what is left for an identical one that found its pose."""
    if data is finder:
        return data
    return data.changed(views=finder.views, static_views=finder.static_views)


def _in_doubt(verdict: Verdict, rivals: Rivals) -> Verdict:
    """The same, told to be ambiguous with poses that it may have instead, and their odds."""
    best = verdict.best
    if best is None or not rivals:
        return verdict
    # odds that it has none, as its pose is another's, stand beside the poses
    total = sum(weight for _, weight in [*verdict.kept, *rivals])
    told = [*verdict.kept, *(pair for pair in rivals if pair[0] is not best)]
    told.sort(key=lambda pair: (pair[0] is not best, -pair[1]))
    kept = [(pose, weight / total) for pose, weight in told]
    exchanged = [Alternative("", math.log(weight)) for _, weight in rivals]
    return replace(verdict, kept=kept).doubted(exchanged)


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
        poses = np.array([one.T_world_object for one in predictions])
        at = project_body(tuple(self.cameras.values()), self.body).project(poses)
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


@dataclass(frozen=True)
class WindowedScene:
    """A scene that looks where its bodies are expected, and at all there is where it is not sure.

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
        """As `Scene.advance`: around the predictions if that is sure, else of all there is.

        `observe` makes views of boxes by camera, of `images` only; without a box they are whole.
        """
        boxes = {}
        # for what enters the view
        in_turn = any(one.is_in_turn(frame, self.scene.rules.thorough) for one in tracks)
        if images and not in_turn and self._are_sure(tracks):
            boxes = self._windows(tracks, frame, time_s)
        if windows := {name: box for name, box in boxes.items() if name in images}:
            views = observe(windows)
            after, estimates = self.scene.advance(tracks, frame, time_s, views)
            if self._are_sure(after) and all(one.status == "ok" for one in estimates):
                return after, estimates, views
        views = observe({})
        return *self.scene.advance(tracks, frame, time_s, views), views

    def _are_sure(self, tracks: Sequence[Track]) -> bool:
        """Whether the last frame was sure of all bodies, and a flat one is no mirror image."""
        return all(
            not (track.misses or track.doubted)
            and (track.ok_count >= tracked.rules.proposals.whole or not is_flat(tracked))
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
            likely = likely_branches(predictions, tracked.rules.acceptance.confidence)
            for name, box in self._expectations[k].windows(likely).items():
                a, b, c, d = windows.get(name, box)
                windows[name] = min(a, box[0]), min(b, box[1]), max(c, box[2]), max(d, box[3])
        return windows
