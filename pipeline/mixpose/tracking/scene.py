"""Bodies that are tracked, from frame to frame; a scene of one is a scene.

The poses of a moment are proposed, fitted and judged body by body, on what others leave.

Nothing in a frame tells identical bodies apart; only where they were before does.  The poses of a
frame are given to them so that all together are most likely by what was predicted.  Where two of
them might as well have changed places, because they met or were lost together, both are in doubt
in that frame, with each other's pose among their hypotheses; afterwards they go on as assigned.
Bodies that nothing was known of before get the poses that are left in the order of the world's
x coordinate (then y, then z) of their origins.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment

from mixpose.body import Body
from mixpose.fit import EstimatorOptions, free_mask
from mixpose.judgement import ScoredPose, Verdict
from mixpose.objective import View
from mixpose.records import Estimate, Floats, Mask, label_of
from mixpose.rigid import is_rigid
from mixpose.threads import one_blas_thread
from mixpose.tracking.doubt import look_alike_of
from mixpose.tracking.explain import Explanation, estimate_of, explain, followed
from mixpose.tracking.frame import Frame
from mixpose.tracking.motion import per_kind
from mixpose.tracking.proposers import PROPOSERS, REFINEMENTS, Proposer, Refinement
from mixpose.tracking.rules import Rules, SceneRules
from mixpose.tracking.sharing import Sharing
from mixpose.tracking.track import Branch, Companion, Track, predict

# poses that a body may have instead of its own, with odds; its own, with those that it has none
Rivals: TypeAlias = list[tuple[ScoredPose, float]]


@dataclass(frozen=True)
class Tracker:
    """A body, and how its poses are estimated: what stays the same from frame to frame."""

    body: Body
    options: EstimatorOptions
    samples: Floats  # (N, R, 3), of the body, for the objectives that integrate by sampling
    start_uncertainty: Floats  # (6,)
    T_start: Floats | None = None  # (4, 4)
    rules: Rules = Rules()
    proposers: tuple[Proposer, ...] = PROPOSERS  # as tried; the first: where it is expected
    refinements: tuple[Refinement, ...] = REFINEMENTS
    instance: int | None = None  # which of identical bodies, of the same `Body`; None: only one

    @classmethod
    def create(
        cls,
        body: Body,
        options: EstimatorOptions,
        T_start: Floats | None = None,
        *,
        rotation_deg: float | None = None,
        distance: float | None = None,
        rules: Rules = Rules(),
        instance: int | None = None,
    ) -> Self:
        """Prepare tracking, from about T_start (4, 4) within half-widths, or those of the rules."""
        motion = rules.motion
        start = per_kind(body, motion.start)
        if distance is not None:
            start[:3] = distance
        if rotation_deg is not None:
            start[3:] = np.radians(rotation_deg)
        samples = body.sample(options.samples, seed=options.seed)
        return cls(body, options, samples, start, T_start, rules, instance=instance)

    @property
    def free(self) -> Mask:
        """Which of the six directions are estimated."""
        return free_mask(self.options)

    @property
    def label(self) -> str:
        """The body in one word."""
        return label_of(self.body.name, self.instance)

    def begin(self) -> Track:
        """The track before the first frame."""
        if self.T_start is None:
            return Track()
        return Track((Branch(self.T_start, 1.0, self.start_uncertainty),), known=True)

    def advance(
        self, track: Track, frame: int, time_s: float | None, views: Sequence[View]
    ) -> tuple[Track, Estimate]:
        """Estimate one frame, in a scene that has no other body; see `Scene.advance`."""
        (after,), (estimate,) = self._alone.advance((track,), frame, time_s, views)
        return after, estimate

    @cached_property
    def _alone(self) -> Scene:
        return Scene((self,))

    def predictions(self, track: Track, frame: int, time_s: float | None) -> list[Branch]:
        """Where the track expects the body in a frame."""
        return predict(track, self.body, frame, time_s, self.rules.motion)

    def data(self, track: Track, frame: int, time_s: float | None, views: Sequence[View]) -> Frame:
        """A frame, and what is known before it; sensors that saw nothing are left out."""
        seen = [view for view in views if not view.observation.is_empty]
        predictions = self.predictions(track, frame, time_s)
        views = track.delays.applied(seen, time_s, track.seconds_until(time_s))
        data = Frame(
            views=views,
            body=self.body,
            options=self.options,
            samples=self.samples,
            track=track,
            predictions=predictions,
            T_reference=predictions[0].T_world_object if predictions else self.T_start,
            start_uncertainty=self.start_uncertainty,
            rules=self.rules,
            frame=frame,
            time_s=time_s,
        )
        if not predictions or not data.is_timed:
            return data
        T = predictions[0].T_world_object
        return data.in_motion(data.expected(T).at(T))


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
            data = self.bodies[0].data(tracks[0], frame, time_s, views)
            found = {0: explain(Explanation(self.bodies[0], data, len(views)))}
        else:
            seen = [view for view in views if not view.observation.is_empty]
            sharing = Sharing(self.bodies, tracks, frame, time_s, seen, len(views), self.rules)
            found = sharing.explained()
        finders, rivals = {k: k for k in found}, dict[int, Rivals]()
        for group in self._identical:
            given, exchanged = identify(group, found)
            finders, rivals = finders | given, rivals | exchanged
        verdicts = {k: found[finders[k]].verdict for k in found}
        told = {k: _in_doubt(verdicts[k], rivals.get(k, [])) for k in found}
        for k, why in self._look_alikes(told, found).items():
            verdicts[k] = told[k] = verdicts[k].doubted(why)
        after, estimates = [], []
        for k, tracked in enumerate(self.bodies):
            shown = told[k].best or next(iter(found[finders[k]].ranked), None)
            after.append(followed(found[k].frame, verdicts[k]))
            estimate = estimate_of(found[k].frame, views, told[k], shown)
            delays = after[k].delays.seconds
            estimates.append(replace(estimate, instance=tracked.instance, delays=delays))
        return self._acquainted(after, estimates), estimates

    @cached_property
    def _identical(self) -> list[list[int]]:
        """Numbers of the bodies that are identical, group by group."""
        groups: dict[int, list[int]] = {}
        for k, tracked in enumerate(self.bodies):
            groups.setdefault(id(tracked.body), []).append(k)
        return [group for group in groups.values() if len(group) > 1]

    def _look_alikes(
        self, told: Mapping[int, Verdict], found: Mapping[int, Explanation]
    ) -> dict[int, str]:
        """Why sure poses might as well be another body's that is not surely elsewhere."""
        doubts = {}
        sure = {k: verdict.best for k, verdict in told.items() if verdict.status == "ok"}
        for k, best in sure.items() if len(self.bodies) > 1 else ():
            # a body's own markers may repeat themselves: then it may be turned another way
            others = [
                found[j].frame
                for j, other in enumerate(self.bodies)
                if j == k or not (j in sure or other.body is self.bodies[k].body)
            ]
            if best is not None and (why := look_alike_of(found[k].frame, best, others)):
                doubts[k] = why
        return doubts

    def _acquainted(
        self, tracks: Sequence[Track], estimates: Sequence[Estimate]
    ) -> tuple[Track, ...]:
        """The tracks, and where bodies are beside each other; identical ones may be exchanged."""
        sure = {
            tracked.label: one.T_world_object
            for tracked, one in zip(self.bodies, estimates, strict=True)
            if tracked.instance is None and one.status == "ok"
        }
        after = list(tracks)
        for k, tracked in enumerate(self.bodies):
            T, known = sure.get(tracked.label), dict(tracks[k].companions)
            for label, T_other in sure.items():
                if T is not None and T_other is not None and label != tracked.label:
                    known[label] = Companion.joined(known.get(label), T, T_other, tracked.body)
                    after[k] = replace(tracks[k], companions=known)
        return tuple(after)


def _in_doubt(verdict: Verdict, rivals: Rivals) -> Verdict:
    """The same, told to be ambiguous with poses that it may have instead, and their odds."""
    best = verdict.best
    if best is None or not rivals:
        return verdict
    # odds that it has none, as its pose is another's, stand beside the poses
    total = sum(weight for _, weight in [*verdict.kept, *rivals])
    kept = [*verdict.kept, *((pose, odds) for pose, odds in rivals if pose is not best)]
    kept = [(pose, weight / total) for pose, weight in kept]
    kept.sort(key=lambda pair: (pair[0] is not best, -pair[1]))
    return Verdict("ambiguous", best, kept)


def identify(
    group: Sequence[int], found: Mapping[int, Explanation]
) -> tuple[dict[int, int], dict[int, Rivals]]:
    """Tell which of some identical bodies found the pose of each, and which are in doubt."""
    bests = {k: best for k in group if (best := found[k].verdict.best) is not None}
    finders = sorted(bests, key=lambda k: tuple(np.round(bests[k].T_world_object[:3, 3], 6)))
    poses, known = [bests[k] for k in finders], [k for k in group if found[k].frame.predictions]
    data = [found[k].frame for k in known]
    # by body (rows) and pose; in the last column none, which says nothing
    likely = np.zeros((len(known), len(poses) + 1))
    for row, one in zip(likely, data, strict=True):
        row[:-1] = [one.prior(pose.T_world_object).log_density for pose in poses]
    rows, columns = linear_sum_assignment(likely[:, :-1], maximize=True)
    pose_of = {known[i]: int(j) for i, j in zip(rows, columns, strict=True)}
    spare = [j for j in range(len(poses)) if j not in pose_of.values()]
    pose_of |= dict(zip([k for k in group if k not in known], spare, strict=False))
    without = iter([k for k in group if k not in bests])
    assigned = {k: finders[pose_of[k]] if k in pose_of else next(without) for k in group}
    # how much likelier two bodies (rows, columns) are with each other's poses
    given = likely[:, [pose_of.get(k, -1) for k in known]]
    odds = given + given.T - given.diagonal() - given.diagonal()[:, None]
    # no velocity is believed any more: they may have changed places, wherever they were before
    lost = np.array([one.track.misses > one.rules.motion.coasting for one in data], np.bool_)
    odds = np.where(lost & lost[:, None], np.maximum(odds, np.log(0.5)), odds)
    rivals: dict[int, Rivals] = {}
    limit = np.log(found[group[0]].frame.rules.acceptance.rival)
    for i, j in zip(*np.nonzero(odds > limit), strict=True):
        if i != j and known[i] in pose_of:
            other = pose_of.get(known[j], pose_of[known[i]])
            share = float(np.exp(min(odds[i, j], 0.0)))
            rivals.setdefault(known[i], []).append((poses[other], share))
    return assigned, rivals


def estimate_pose(
    views: Sequence[View],
    model: Body,
    start: Floats | None = None,
    options: EstimatorOptions | None = None,
) -> Estimate:
    """Estimate one pose, as of frame 0, near a start (4, 4) or anywhere.

    Raises
    ------
    ValueError
        If the start is no rigid motion, or a view's features are not of its sensor's dimension.
    """
    if start is not None and not (np.shape(start) == (4, 4) and is_rigid(np.asarray(start))):
        raise ValueError("start: not a rotation and a translation as one 4x4 matrix")
    for view in views:
        found, allowed = view.observation.dimension, view.sensor.dimension
        if found != allowed:
            raise ValueError(
                f"view {view.name!r}: features of {found} coordinates; its sensor has {allowed}"
            )
    tracker = Tracker.create(model, options or EstimatorOptions(), start)
    began = time.perf_counter()
    with one_blas_thread():
        _, estimate = tracker.advance(tracker.begin(), 0, None, views)
    return replace(estimate, latency_ms=1e3 * (time.perf_counter() - began))
