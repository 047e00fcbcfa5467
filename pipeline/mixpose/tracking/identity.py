"""Which of some identical bodies is which: by how they move, and how far they are from each other.

Nothing in a frame tells identical bodies apart; only where they were before does.  With predictions
of densities p_k, and distances d_kj between bodies that change by s_kj from frame to frame, poses x
are given to bodies by the assignment a of the largest

    Σ_k ln p_k(x_a(k)) + Σ_k<j ln [t((|x_a(k) − x_a(j)| − d_kj) / s_kj) / s_kj],

of Student's t, as velocities and changes of distance are of few frames.  Bodies that were not seen
for m frames have distances that may have changed by m + 1 times as much, and pairs never seen
together any up to where bodies may be.  Bodies that nobody saw yet may be anywhere, and seldom are
in view; others are elsewhere than expected as seldom.  The assignment is found from that of the
first sum by exchanges of two; what one more exchange leaves of the odds is how far two bodies are
in doubt.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment

from mixpose.judgement import ScoredPose
from mixpose.records import Floats, Indices
from mixpose.tracking.motion import Distances
from mixpose.tracking.sharing import Explanation

# poses that a body may have instead of its own, with odds; its own, with those that it has none
Rivals: TypeAlias = list[tuple[ScoredPose, float]]


@dataclass(frozen=True)
class Assignment:
    """How likely n bodies have m poses, or none, and pairs of them their distances."""

    likely: Floats  # (n, m + 1) log densities; of none in the last column
    before: Distances  # between the bodies
    now: Floats  # (m + 1, m + 1) distances between poses; NaN of none
    degrees: float  # of Student's t
    room: float  # largest distance of two of which nothing is known

    def best(self) -> Indices:
        """The likeliest poses (n,), from the likeliest one by one, by exchanges of two."""
        n, m = len(self.likely), self.likely.shape[1] - 1
        given = np.full(n, m)
        rows, columns = linear_sum_assignment(self.likely[:, :-1], maximize=True)
        given[rows] = columns
        for _ in range(n * n):  # of as many exchanges none is left to be made
            odds = self.exchanged(given)
            i, j = np.unravel_index(int(odds.argmax()), odds.shape)
            if odds[i, j] <= 1e-9:
                break
            given[[i, j]] = given[[j, i]]
        return given

    def exchanged(self, given: Indices) -> Floats:
        """How much likelier two bodies (n, n) have each other's poses than their own."""
        # of body i with the pose of body j, beside that of body k
        terms, i = self._likely_distances(self.now[given][:, given]), np.arange(len(given))
        # beside all but the two that change; the distance between these stays
        beside = terms.sum(axis=2) - terms[i, :, i] - terms[:, i, i]
        stays = terms[i, i]
        kept = (stays.sum(axis=1) - stays.diagonal())[:, None] - stays
        with_other = self.likely[:, given] + beside
        with_own = self.likely[i, given][:, None] + kept
        odds = with_other + with_other.T - with_own - with_own.T
        np.fill_diagonal(odds, -np.inf)
        return np.asarray(odds)

    def _likely_distances(self, now: Floats) -> Floats:
        """Log densities (n, n, n) of bodies i to be as far from k as j is now (n, n); 0 of none."""
        n, before = self.degrees, self.before
        squared = np.maximum(before.squares / before.numbers, 1e-12) * (1 + before.missed) ** 2
        off = (now - before.last[:, None]) ** 2 / squared[:, None]
        peak = math.lgamma((n + 1) / 2) - math.lgamma(n / 2) - 0.5 * math.log(n * math.pi)
        known = peak - 0.5 * (n + 1) * np.log1p(off / n) - 0.5 * np.log(squared)[:, None]
        logs = np.where(np.isnan(off), -math.log(self.room), known)
        return np.where(np.isnan(now), 0.0, logs)


def identify(
    group: Sequence[int], found: Mapping[int, Explanation], before: Distances
) -> tuple[dict[int, int], dict[int, Rivals]]:
    """Tell which of some identical bodies found the pose of each, and which are in doubt.

    By distances between them before.
    """
    bests = {k: best for k in group if (best := found[k].verdict.best) is not None}
    finders = sorted(bests, key=lambda k: tuple(np.round(bests[k].T_world_object[:3, 3], 6)))
    poses, data = [bests[k] for k in finders], [found[k].frame for k in group]
    # by body (rows) and pose; in the last column none, as it is of one in view now and then
    rules, rows = data[0].rules, list[list[float]]()
    there = np.reshape([pose.T_world_object for pose in poses], (-1, 4, 4))
    for one in data:
        hidden = 0.5 if one.track.misses else rules.motion.hidden
        # one that nobody saw yet is as seldom in view as one that was is somewhere else
        hidden = hidden if one.predictions else 1 - rules.motion.surprise
        rows.append([*(math.log1p(-hidden) + one.log_densities(there)).tolist(), math.log(hidden)])
    places = np.array([*(pose.T_world_object[:3, 3] for pose in poses), np.full(3, np.nan)])
    assignment = Assignment(
        np.array(rows),
        before,
        np.linalg.norm(places[:, None] - places, axis=2),
        rules.motion.known_from,
        rules.judgement.detection.room * found[group[0]].frame.body.radius,
    )
    given, is_new = assignment.best(), np.array([not one.predictions for one in data])
    # those that nobody saw yet in the order of their poses
    given[is_new] = np.sort(given[is_new])
    pose_of = {k: j for k, j in zip(group, given.tolist()) if j < len(poses)}
    without = iter([k for k in group if k not in bests])
    assigned = {k: finders[pose_of[k]] if k in pose_of else next(without) for k in group}
    odds = assignment.exchanged(given)
    # they may have changed places, wherever they were before
    lost = np.array([one.was_lost for one in data])
    odds = np.where(lost & lost[:, None], np.maximum(odds, np.log(0.5)), odds)
    odds[is_new & is_new[:, None]] = -np.inf
    rivals, limit = dict[int, Rivals](), rules.acceptance.log_doubt
    for i, j in zip(*np.nonzero(odds > limit), strict=True):
        if i != j and group[i] in pose_of:
            other = pose_of.get(group[j], pose_of[group[i]])
            share = float(np.exp(min(odds[i, j], 0.0)))
            rivals.setdefault(group[i], []).append((poses[other], share))
    return assigned, rivals
