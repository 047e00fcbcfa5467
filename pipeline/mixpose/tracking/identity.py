"""Which of some identical bodies is which: by how they move, and how far they are from each other.

Nothing in a frame tells identical bodies apart; only where they were before does.  With predictions
of densities p_k, and distances d_kj between bodies that change by s_kj from frame to frame, poses x
are given to bodies by the assignment a of the largest

    Σ_k ln p_k(x_a(k)) + Σ_k<j ln t((|x_a(k) − x_a(j)| − d_kj) / s_kj),

of Student's t, as velocities and changes of distance are of few frames.  It is found from that of
the first sum by exchanges of two; what one more exchange leaves of the odds is how far two bodies
are in doubt.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment

from mixpose.judgement import ScoredPose
from mixpose.records import Floats, Indices
from mixpose.tracking.motion import MotionRules
from mixpose.tracking.sharing import Explanation

# poses that a body may have instead of its own, with odds; its own, with those that it has none
Rivals: TypeAlias = list[tuple[ScoredPose, float]]


def distances_after(before: Floats, places: Floats, rules: MotionRules) -> Floats:
    """Distances (n, n) between bodies at places (n, 3), and the sums that tell how they change.

    With sums of squared changes and their numbers (3, n, n) in all; NaN where one of two has no
    place, and at first.
    """
    now = np.linalg.norm(places[:, None] - places, axis=2)
    changes, (_, squares, count) = now - before[0], before
    is_seen, changes = np.isfinite(changes), np.nan_to_num(changes)
    squares = np.where(is_seen, rules.recall * squares + changes**2, squares)
    return np.array([now, squares, np.where(is_seen, rules.recall * count + 1, count)])


def no_distances(count: int, radius: float, rules: MotionRules) -> Floats:
    """The same before anything was seen (3, n, n): changes are about as large as the body."""
    guess = np.array([np.nan, (rules.unknown[0] * radius) ** 2, 1.0])
    guess[1:] *= rules.guess_weight
    return np.broadcast_to(guess[:, None, None], (3, count, count))


@dataclass(frozen=True)
class Assignment:
    """How likely n bodies have m poses, or none, and pairs of them their distances."""

    likely: Floats  # (n, m + 1) log densities; 0 of none, in the last column
    before: Floats  # (3, n, n) as of `distances_after`
    now: Floats  # (m + 1, m + 1) distances between poses; NaN of none
    degrees: float  # of Student's t

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
        away, squares, count = self.before
        # of body i with the pose of body j, beside that of body k
        off = self.now[given][:, given][None] - away[:, None]
        squared = off**2 * (count / np.maximum(squares, 1e-12))[:, None]
        terms = np.nan_to_num(np.log1p(squared / self.degrees))
        terms *= -0.5 * (self.degrees + 1)
        i = np.arange(len(given))
        # beside all but the two that change; the distance between these stays
        beside = terms.sum(axis=2) - terms[i, :, i] - terms[:, i, i]
        stays = terms[i, i]
        kept = (stays.sum(axis=1) - stays.diagonal())[:, None] - stays
        with_other = self.likely[:, given] + beside
        with_own = self.likely[i, given][:, None] + kept
        odds = with_other + with_other.T - with_own - with_own.T
        np.fill_diagonal(odds, -np.inf)
        return np.asarray(odds)


def identify(
    group: Sequence[int], found: Mapping[int, Explanation], before: Floats
) -> tuple[dict[int, int], dict[int, Rivals]]:
    """Tell which of some identical bodies found the pose of each, and which are in doubt.

    By distances between them (3, n, n) before, as of `distances_after`.
    """
    bests = {k: best for k in group if (best := found[k].verdict.best) is not None}
    finders = sorted(bests, key=lambda k: tuple(np.round(bests[k].T_world_object[:3, 3], 6)))
    poses, known = [bests[k] for k in finders], [k for k in group if found[k].frame.predictions]
    data = [found[k].frame for k in known]
    # by body (rows) and pose; in the last column none, which says nothing
    rows = [[*(one.nearness(pose.T_world_object) for pose in poses), 0.0] for one in data]
    places = np.array([*(pose.T_world_object[:3, 3] for pose in poses), np.full(3, np.nan)])
    rules = found[group[0]].frame.rules
    chosen = [group.index(k) for k in known]
    assignment = Assignment(
        np.reshape(rows, (len(known), len(poses) + 1)),
        before[:, chosen][:, :, chosen],
        np.linalg.norm(places[:, None] - places, axis=2),
        rules.motion.known_from,
    )
    given = assignment.best()
    pose_of = {k: j for k, j in zip(known, given.tolist()) if j < len(poses)}
    spare = [j for j in range(len(poses)) if j not in pose_of.values()]
    pose_of |= dict(zip([k for k in group if k not in known], spare, strict=False))
    without = iter([k for k in group if k not in bests])
    assigned = {k: finders[pose_of[k]] if k in pose_of else next(without) for k in group}
    odds = assignment.exchanged(given)
    # no velocity is believed any more: they may have changed places, wherever they were before
    lost = np.array([one.track.misses > one.rules.motion.coasting for one in data], np.bool_)
    odds = np.where(lost & lost[:, None], np.maximum(odds, np.log(0.5)), odds)
    rivals, limit = dict[int, Rivals](), rules.acceptance.log_doubt
    for i, j in zip(*np.nonzero(odds > limit), strict=True):
        if i != j and known[i] in pose_of:
            other = pose_of.get(known[j], pose_of[known[i]])
            share = float(np.exp(min(odds[i, j], 0.0)))
            rivals.setdefault(known[i], []).append((poses[other], share))
    return assigned, rivals
