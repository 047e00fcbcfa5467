"""All bodies in view of the sensors, from frame to frame, and the image windows for them.

Nothing in one frame tells identical bodies apart; only their earlier places do.  The poses of a
frame are assigned to them so that together they are likeliest by the predictions.  Two that may
have changed places, because they met or were lost together, are both in doubt in that frame, with
each other's pose among their hypotheses; later frames go on as assigned.  Bodies never seen so far
get the remaining poses in the order of the world's x coordinate (then y, then z) of their origins.

Images are seen in windows around predictions, and as a whole unless the frame is sure there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
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
from mixpose.records import Estimate, Floats, Mask, replace
from mixpose.rigid import transform
from mixpose.sensors import Sensor
from mixpose.tracking.confusion import confusions_of
from mixpose.tracking.frame import Frame
from mixpose.tracking.identity import Rivals, identify
from mixpose.tracking.mirrors import is_flat
from mixpose.tracking.motion import Distances
from mixpose.tracking.reporting import reported_covariances
from mixpose.tracking.rules import SceneRules
from mixpose.tracking.sharing import Explanation, Sharing
from mixpose.tracking.track import Branch, Companion, Track, likely_branches
from mixpose.tracking.tracker import Tracker, track_after

Box: TypeAlias = tuple[int, int, int, int]


@dataclass(frozen=True)
class Scene:
    """All bodies in view of the sensors, in the order of their pose lines."""

    bodies: tuple[Tracker, ...]
    rules: SceneRules = SceneRules()

    def begin(self) -> tuple[Track, ...]:
        """Return the tracks before the first frame."""
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
        explained = Sharing(self.bodies, tracks, frame, time_s, views, self.rules).explain_all()
        finders, rivals = {k: k for k in explained}, dict[int, Rivals]()
        apart = dict[int, Distances]()
        for name in {tracked.body.name for tracked in self.bodies if tracked.instance is not None}:
            group = [k for k, tracked in enumerate(self.bodies) if tracked.body.name == name]
            motion, before = self.bodies[group[0]].rules.motion, tracks[group[0]].distances
            if before is None:
                radius = self.bodies[group[0]].body.radius
                before = Distances.unknown(len(group), radius, motion)
            assigned, exchanged = identify(group, explained, before)
            finders, rivals = finders | assigned, rivals | exchanged
            places = _places([explained[assigned[k]] for k in group], self.bodies[group[0]].origin)
            apart[group[0]] = before.after(places, motion)
        chosen = {k: explained[finders[k]] for k in explained}
        reported = {k: _in_doubt(chosen[k].verdict, rivals.get(k, [])) for k in chosen}
        frames = {k: _seen_by(own.frame, chosen[k].frame) for k, own in explained.items()}
        confusions = confusions_of(frames, reported)
        after = list[Track]()
        for k in range(len(self.bodies)):
            data, verdict = frames[k], chosen[k].verdict
            odds = data.track.confused
            if k in confusions:
                against = [confusion.since(odds) for confusion in confusions[k]]
                odds = dict(sorted(against, key=itemgetter(1)))
                verdict, reported[k] = verdict.doubted(against), reported[k].doubted(against)
            after.append(replace(track_after(data, verdict), distances=apart.get(k), confused=odds))
        shown = [(frames[k], reported[k].best, own.origin) for k, own in enumerate(self.bodies)]
        estimates = [
            tracked.estimate(frames[k], after[k], reported[k], chosen[k].ranked, covariance)
            for (k, tracked), covariance in zip(enumerate(self.bodies), reported_covariances(shown))
        ]
        return self._with_companions(after, reported), estimates

    def _with_companions(
        self, tracks: Sequence[Track], verdicts: Mapping[int, Verdict]
    ) -> tuple[Track, ...]:
        """Return tracks with the relative poses of distinct bodies that the frame is sure of."""
        sure = {
            k: verdict.best.T_world_object
            for k, verdict in sorted(verdicts.items())
            if self.bodies[k].instance is None and verdict.status == "ok" and verdict.best
        }
        after = list(tracks)
        for k, j in permutations(sure, 2):
            label, known = self.bodies[j].label, after[k].companions
            companion = Companion.joined(known.get(label), sure[k], sure[j], self.bodies[k].body)
            after[k] = replace(after[k], companions={**known, label: companion})
        return tuple(after)


def _places(explanations: Sequence[Explanation], origin: Floats) -> Floats:
    """Return the origins (n, 3) of bodies in the world, NaN without a pose."""
    places = np.full((len(explanations), 3), np.nan)
    for k, explanation in enumerate(explanations):
        if best := explanation.verdict.best:
            places[k] = transform(best.T_world_object, origin[None])[0]
    return places


def _seen_by(data: Frame, finder: Frame) -> Frame:
    """Return the frame of a body with the views of the identical body that found its pose."""
    if data is finder:
        return data
    return data.changed(views=finder.views, static_views=finder.static_views)


def _in_doubt(verdict: Verdict, rivals: Rivals) -> Verdict:
    """Return the verdict as ambiguous among its poses and its rivals."""
    best = verdict.best
    if best is None or not rivals:
        return verdict
    # the odds that its pose is another body's count like those of a pose
    total = sum(weight for _, weight in [*verdict.kept, *rivals])
    pairs = [*verdict.kept, *(pair for pair in rivals if pair[0] is not best)]
    pairs.sort(key=lambda pair: (pair[0] is not best, -pair[1]))
    kept = [(pose, weight / total) for pose, weight in pairs]
    exchanged = [Alternative("", math.log(weight)) for _, weight in rivals]
    return replace(verdict, kept=kept).doubted(exchanged)


@dataclass(frozen=True)
class Expectation:
    """A body in front of cameras, and how far around predictions its features are sought."""

    body: Body
    cameras: Mapping[str, Sensor]  # by name; with two coordinates, in px
    free: Mask  # (6,), directions that are estimated
    reach: float = constant(
        4.0, "standard deviations of the prediction, and of features that have a spread"
    )
    min_margin_px: float = constant(40.0, "around the predicted features: a spot and its ground")

    @cached_property
    def _feature_reach(self) -> float:
        """Return how far a feature's image reaches: less than half way to that of its neighbour."""
        points = self.body.nodes.points
        distance = KDTree(points).query(points, k=2)[0][:, 1].min() if len(points) > 1 else np.inf
        return float(distance / 2 + self.reach * self.body.spread)

    def windows(self, predictions: Sequence[Branch]) -> dict[str, Box]:
        """Return the box of pixels (u0, v0, u1, v1) around the body in each camera, ends exclusive.

        There is none where the body is not in view, or has a single feature, which gives no size.
        """
        if not self.cameras or not predictions or not np.isfinite(self._feature_reach):
            return {}
        poses = np.array([branch.T_world_object for branch in predictions])
        images = project_body(tuple(self.cameras.values()), self.body).project(poses)
        uncertainty = np.array([branch.uncertainty for branch in predictions])
        by_pose = np.einsum("lpnij,pj->lpni", images.J**2, (uncertainty * self.free) ** 2)
        scales = np.sqrt((images.J[..., :3] ** 2).sum(axis=(3, 4)).max(axis=2))
        rims = np.maximum(scales * self._feature_reach, self.min_margin_px)
        margins = self.reach * np.sqrt(by_pose) + rims[..., None, None]
        seen = images.seen[..., None]
        lower = np.where(seen, images.y - margins, np.inf).min(axis=(1, 2)).tolist()
        upper = np.where(seen, images.y + margins, -np.inf).max(axis=(1, 2)).tolist()
        return {
            name: (math.floor(u0), math.floor(v0), math.ceil(u1) + 1, math.ceil(v1) + 1)
            for name, (u0, v0), (u1, v1) in zip(self.cameras, lower, upper, strict=True)
            if u0 <= u1
        }


@dataclass(frozen=True)
class WindowedScene:
    """A scene that reads images where its bodies are expected, and as a whole where it is not sure.

    Its cameras find the same features in a part of an image as in the whole image.
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
        """Estimate a frame as `Scene.advance`, in windows around the predictions if that is sure.

        `observe` makes views of boxes by camera, of `images` only; without a box they are whole.
        """
        boxes = {}
        # a frame in turn is seen as a whole, for bodies that enter the view
        in_turn = any(track.is_in_turn(frame, self.scene.rules.thorough) for track in tracks)
        if images and not in_turn and self._are_sure(tracks):
            boxes = self._windows(tracks, frame, time_s)
        if windows := {name: box for name, box in boxes.items() if name in images}:
            views = observe(windows)
            after, estimates = self.scene.advance(tracks, frame, time_s, views)
            if self._are_sure(after) and all(estimate.status == "ok" for estimate in estimates):
                return after, estimates, views
        views = observe({})
        return *self.scene.advance(tracks, frame, time_s, views), views

    def _are_sure(self, tracks: Sequence[Track]) -> bool:
        """Test whether the last frame was sure of all bodies, and of no flat mirror image."""
        return all(
            not (track.misses or track.doubted)
            and (track.ok_count >= tracked.rules.proposals.whole or not is_flat(tracked))
            for tracked, track in zip(self.scene.bodies, tracks, strict=True)
        )

    @cached_property
    def _expectations(self) -> list[Expectation]:
        return [Expectation(each.body, self.cameras, each.free) for each in self.scene.bodies]

    def _windows(self, tracks: Sequence[Track], frame: int, time_s: float | None) -> dict[str, Box]:
        """Return the window of each image that contains all expected bodies."""
        windows: dict[str, Box] = {}
        for k, tracked in enumerate(self.scene.bodies):
            predictions = tracked.predictions(tracks[k], frame, time_s)
            likely = likely_branches(predictions, tracked.rules.acceptance.confidence)
            for name, box in self._expectations[k].windows(likely).items():
                a, b, c, d = windows.get(name, box)
                windows[name] = min(a, box[0]), min(b, box[1]), max(c, box[2]), max(d, box[3])
        return windows
