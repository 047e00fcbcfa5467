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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment

from mixpose.judgement import ScoredPose, Verdict
from mixpose.objective import View
from mixpose.records import Estimate
from mixpose.tracking.doubt import look_alike_of
from mixpose.tracking.rules import SceneRules
from mixpose.tracking.sharing import Explanation, Sharing
from mixpose.tracking.track import Companion, Track
from mixpose.tracking.tracker import Tracker, followed

# poses that a body may have instead of its own, with odds; its own, with those that it has none
Rivals: TypeAlias = list[tuple[ScoredPose, float]]


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
        for name in {one.body.name for one in self.bodies if one.instance is not None}:
            group = [k for k, one in enumerate(self.bodies) if one.body.name == name]
            given, exchanged = identify(group, found)
            finders, rivals = finders | given, rivals | exchanged
        verdicts = {k: found[finders[k]].verdict for k in found}
        told = {k: _in_doubt(verdicts[k], rivals.get(k, [])) for k in found}
        sure = [k for k, verdict in told.items() if verdict.status == "ok"]
        for k in sure:
            # another body that is not surely elsewhere, or its own markers where they repeat
            # themselves: then it may be turned another way
            own, best = self.bodies[k].body, told[k].best
            away = [j for j, one in enumerate(self.bodies) if j not in sure and one.body is not own]
            others = [found[j].frame for j in (k, *away)]
            why = look_alike_of(found[k].frame, best, others) if best else ""
            verdicts[k] = told[k] = verdicts[k].doubted(why)
        after, estimates = [], []
        for k, tracked in enumerate(self.bodies):
            data, ranked = found[k].frame, found[finders[k]].ranked
            after.append(followed(data, verdicts[k]))
            estimates.append(tracked.estimate(data, after[k], told[k], ranked))
        return self._acquainted(after, estimates), estimates

    def _acquainted(
        self, tracks: Sequence[Track], estimates: Sequence[Estimate]
    ) -> tuple[Track, ...]:
        """The tracks, and where sure bodies are beside each other, but for exchangeable ones."""
        sure = {
            k: one.T_world_object
            for k, one in enumerate(estimates)
            if one.instance is None and one.status == "ok" and one.T_world_object is not None
        }
        after = list(tracks)
        for k, T in sure.items():
            body, known = self.bodies[k].body, dict(tracks[k].companions)
            for j in sure.keys() - {k}:
                label = self.bodies[j].label
                known[label] = Companion.joined(known.get(label), T, sure[j], body)
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
