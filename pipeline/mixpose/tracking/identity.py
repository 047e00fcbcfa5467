"""Tell identical bodies apart: by how they move, and how far they are from each other.

Nothing in one frame tells identical bodies apart; only their earlier places do.  With predictions
of densities p_k, and distances d_kj between bodies that change by s_kj from frame to frame, poses x
are given to bodies by the assignment a of the largest

    Σ_k ln p_k(x_a(k)) + Σ_k<j ln [t((|x_a(k) − x_a(j)| − d_kj) / s_kj) / s_kj],

of Student's t, as velocities and changes of distance are of few frames.  Distances of bodies not
seen for m frames may have changed m + 1 times as much; of pairs never seen together any distance in
the room is as likely.  Bodies never seen so far may be anywhere, and are seldom in view; others are
as seldom elsewhere than predicted.  The assignment is found from that of the first sum by exchanges
of two; the odds of one more exchange are the doubt about two bodies.
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
from mixpose.tracking.frame import log_densities_by
from mixpose.tracking.motion import Distances
from mixpose.tracking.sharing import Explanation

# poses that a body may have instead, with odds; with its own pose the odds that it has none
Rivals: TypeAlias = list[tuple[ScoredPose, float]]


@dataclass(frozen=True)
class Assignment:
    """Log densities of n bodies at m poses or none, and of the distances of pairs."""

    likely: Floats  # (n, m + 1) log densities; the last column is for no pose
    before: Distances  # between the bodies
    now: Floats  # (m + 1, m + 1) distances between poses; NaN for no pose
    degrees: float  # of Student's t
    room: float  # largest distance of two bodies never seen together

    def best(self) -> Indices:
        """Return the likeliest poses (n,): the best single ones, improved by exchanges of two."""
        n, m = len(self.likely), self.likely.shape[1] - 1
        assigned = np.full(n, m)
        rows, columns = linear_sum_assignment(self.likely[:, :-1], maximize=True)
        assigned[rows] = columns
        for _ in range(n * n):  # more exchanges are never needed
            odds = self.exchanged(assigned)
            i, j = np.unravel_index(int(odds.argmax()), odds.shape)
            if odds[i, j] <= 1e-9:
                break
            assigned[[i, j]] = assigned[[j, i]]
        return assigned

    def exchanged(self, assigned: Indices) -> Floats:
        """Return log odds that two bodies (n, n) have each other's poses."""
        # of body i at the pose of body j, at its distance from body k
        terms, i = self._likely_distances(self.now[assigned][:, assigned]), np.arange(len(assigned))
        # distances from all but the two exchanged ones, whose distance from each other stays
        moved = terms.sum(axis=2) - terms[i, :, i] - terms[:, i, i]
        between = terms[i, i]
        kept = (between.sum(axis=1) - between.diagonal())[:, None] - between
        with_other = self.likely[:, assigned] + moved
        with_own = self.likely[i, assigned][:, None] + kept
        odds = with_other + with_other.T - with_own - with_own.T
        np.fill_diagonal(odds, -np.inf)
        return np.asarray(odds)

    def _likely_distances(self, now: Floats) -> Floats:
        """Return log densities (n, n, n) of body i as far from k as j is now; 0 without a pose."""
        n, before = self.degrees, self.before
        squared = np.maximum(before.squares / before.numbers, 1e-12) * (1 + before.missed) ** 2
        off = (now - before.last[:, None]) ** 2 / squared[:, None]
        peak = math.lgamma((n + 1) / 2) - math.lgamma(n / 2) - 0.5 * math.log(n * math.pi)
        known = peak - 0.5 * (n + 1) * np.log1p(off / n) - 0.5 * np.log(squared)[:, None]
        logs = np.where(np.isnan(off), -math.log(self.room), known)
        return np.where(np.isnan(now), 0.0, logs)


def identify(
    group: Sequence[int], explained: Mapping[int, Explanation], before: Distances
) -> tuple[dict[int, int], dict[int, Rivals]]:
    """Assign poses to identical bodies by earlier distances, and return rivals in doubt.

    The first mapping gives for each body the body that found its pose.
    """
    bests = {k: best for k in group if (best := explained[k].verdict.best) is not None}
    finders = sorted(bests, key=lambda k: tuple(np.round(bests[k].T_world_object[:3, 3], 6)))
    poses, frames = [bests[k] for k in finders], [explained[k].frame for k in group]
    # by body (rows) and pose; the last column is for no pose, as when a body in view is missed
    rules, rows = frames[0].rules, list[list[float]]()
    transforms = np.reshape([pose.T_world_object for pose in poses], (-1, 4, 4))
    for frame, log_densities in zip(frames, log_densities_by(frames, transforms), strict=True):
        hidden = 0.5 if frame.track.misses else rules.motion.hidden
        # a body never seen so far is as seldom in view as another one is somewhere else
        hidden = hidden if frame.predictions else 1 - rules.motion.surprise
        logs = math.log1p(-hidden) + log_densities
        rows.append([*logs.tolist(), math.log(hidden)])
    places = np.array([*(pose.T_world_object[:3, 3] for pose in poses), np.full(3, np.nan)])
    assignment = Assignment(
        np.array(rows),
        before,
        np.linalg.norm(places[:, None] - places, axis=2),
        rules.motion.known_from,
        rules.judgement.detection.room * explained[group[0]].frame.body.radius,
    )
    chosen, is_new = assignment.best(), np.array([not frame.predictions for frame in frames])
    # bodies never seen so far get poses in order
    chosen[is_new] = np.sort(chosen[is_new])
    pose_of = {k: j for k, j in zip(group, chosen.tolist()) if j < len(poses)}
    without = iter([k for k in group if k not in bests])
    assigned = {k: finders[pose_of[k]] if k in pose_of else next(without) for k in group}
    odds = assignment.exchanged(chosen)
    # lost bodies may have changed places, whatever was predicted
    lost = np.array([frame.was_lost for frame in frames])
    odds = np.where(lost & lost[:, None], np.maximum(odds, np.log(0.5)), odds)
    odds[is_new & is_new[:, None]] = -np.inf
    rivals, limit = dict[int, Rivals](), rules.acceptance.log_doubt
    for i, j in zip(*np.nonzero(odds > limit), strict=True):
        if i != j and group[i] in pose_of:
            other = pose_of.get(group[j], pose_of[group[i]])
            share = float(np.exp(min(odds[i, j], 0.0)))
            rivals.setdefault(group[i], []).append((poses[other], share))
    return assigned, rivals
