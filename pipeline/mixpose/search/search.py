"""The first pose from nothing: guesses, a shortlist, descent, and the candidates left of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from itertools import islice
from math import comb
from typing import NamedTuple, TypeAlias

import numpy as np

from mixpose.body import Body
from mixpose.errors import SessionError
from mixpose.judgement import JudgementRules
from mixpose.objective import View
from mixpose.records import Floats, Mask
from mixpose.rigid import transform
from mixpose.search.from_points import generators_of
from mixpose.search.poses import (
    Descent,
    Stage,
    count_inliers,
    evidence,
    from_spread_orientations,
    label_image,
    matches_of,
    unlike,
)
from mixpose.search.problem import (
    THOROUGH,
    SearchBudget,
    SearchProblem,
    can_fix,
    sensor_detections,
)
from mixpose.search.three_points import Guesses
from mixpose.search.triples import sparse

_MISSED = 4.0  # nats that a detection costs that is missed


class Candidate(NamedTuple):
    """A pose that may explain the views, ranked by its evidence.

    That is the logarithm of the odds that it is not chance; with ranges among the sensors, the
    matched objective at σ_ε, summed over views, every detection counting alike.
    """

    T_world_object: Floats  # (4, 4)
    evidence: float


class SearchReport(NamedTuple):
    """What a search cost: guesses made, tested on all features and sensors, and refined."""

    made: int = 0
    tested: int = 0
    refined: int = 0


class SearchState(NamedTuple):
    """Where a search with a limited budget goes on in the next frame."""

    generator: int = 0  # after the first, which is tried in every frame
    batch: int = 0  # batches of it tried


Known: TypeAlias = Callable[[Floats], Floats]
"""By how many nats (K,) poses (K, 4, 4) are likelier by what is known before their frame."""


def nothing_known(poses: Floats) -> Floats:
    """All poses (K, 4, 4) are as likely."""
    return np.zeros(len(poses))


class SearchResult(NamedTuple):
    """Candidates, best first, what they cost, and where to go on while none convinces."""

    candidates: list[Candidate]
    report: SearchReport = SearchReport()
    state: SearchState = SearchState()


def search_frame(
    views: Sequence[View],
    body: Body,
    *,
    free: Mask,  # (6,) world directions to search
    T_reference: Floats | None,  # where those that are not free stay; may be None if all are free
    rules: JudgementRules = JudgementRules(),
    seed: int = 0,
    budget: SearchBudget = THOROUGH,
    state: SearchState = SearchState(),
    known: Known = nothing_known,
) -> SearchResult:
    """Find poses that explain the views of one frame, without a start.

    They are ranked by `rules`, as they are judged in the end.  `seed` is of the order in which
    guesses are tried, where not all can be; `state` of the frame before, where its budget was used
    up.  What explains about as much goes by what is `known` before the frame.  Raises
    `SessionError` if directions are held without a reference pose.
    """
    if T_reference is None and not free.all():
        raise SessionError(
            "search: start: found none, but some directions are not free: a start must say where "
            "they stay"
        )
    detections = sensor_detections(views, body)
    if not can_fix(detections, body, free):
        return SearchResult([])
    T = np.eye(4) if T_reference is None else T_reference
    return _Search(SearchProblem(detections, body, free, T, rules, budget, seed), known).run(state)


class _Search:
    """What stays the same during one search, and its poses so far, the best first."""

    def __init__(self, problem: SearchProblem, known: Known) -> None:
        self._known = known
        self._problem, self._body, self._budget = problem, problem.body, problem.budget
        views, cameras = [one.view for one in problem.detections], problem.cameras
        self._images = [label_image(*camera, problem.reach(camera[0])) for camera in cameras]
        self._enough = self._budget.sufficient * sum(  # detections explained
            min(len(rays), len(self._body)) for _, rays in cameras
        )
        # ranges are met by chance too often, and err too coarsely, to be counted one by one
        self._by_evidence = bool(cameras) and all(
            one.rays is not None for one in problem.detections
        )
        self._confirm = self._by_evidence and len(cameras) > 1  # cameras each other
        self._is_alone = self._by_evidence and len(cameras) == 1
        self._descent = Descent(
            views, sparse(self._body, 4 * self._budget.sample), problem.free, self._budget
        )
        # to σ_ε with others than cameras
        plan = self._budget.descent_plan if self._by_evidence else self._budget.wide_plan
        self._stages = [((blur,) * len(views), n, self._budget.shortlist) for blur, n in plan]
        # by pose: as `_judge` has it, and what is known before the frame
        self._poses, self._judged = np.zeros((0, 4, 4)), np.zeros((3, 0))
        self._cost = Counter(made=0)

    def run(self, state: SearchState) -> SearchResult:
        """Make as many guesses as are needed and allowed."""
        budget, after = self._budget, SearchState()
        generators = generators_of(self._problem) if self._images else []
        if len(generators) > 1:
            self._draw(generators.pop(0), budget.max_guesses / 2)
        for k, generator in enumerate(generators[state.generator :], state.generator):
            if self._coverage() >= budget.convincing or self._is_found():
                break
            skipped = state.batch if k == state.generator else 0
            done = self._draw(generator, budget.max_guesses, skipped)
            if self._cost["made"] >= budget.max_guesses:
                after = SearchState(k, done)
                break
        # a pose with evidence is one that some of its detections would have led to
        is_guessed = self._by_evidence and (self._cost["made"] > 0 or budget.useful >= 0)
        if self._coverage() < budget.sufficient and not is_guessed:
            self._refine(*from_spread_orientations(self._problem))
        return SearchResult(self._candidates(), SearchReport(**self._cost), after)

    def _candidates(self) -> list[Candidate]:
        """Distinct poses, best first, without those that the best leaves no chance."""
        budget, ranks = self._budget, self._judged[0]
        kept = self._distinct(budget.sample)
        if self._by_evidence and kept:
            least = max(ranks[0] - budget.outdone, budget.hopeless)
            kept = kept[:1] + [k for k in kept[1:] if ranks[k] > least]
            # a fit hardly gains more than what the right pose may be behind
            kept = [k for k in kept if ranks[k] > budget.useful - budget.outdone]
        return [Candidate(self._poses[k], float(ranks[k])) for k in kept]

    def _draw(self, generator: Guesses, most: float, skipped: int = 0) -> int:
        """Batches tried of a generator until `most` guesses were made, the best of them refined.

        The guesses that explain most distinct detections, and among equals most closely, are
        refined.  A few are at once, where they explain more than all before: that may be enough.
        """
        budget, body = self._budget, self._body
        # of the sides of a body that are turned away nothing is seen
        most_seen = max(len(rays) for _, rays in self._problem.cameras)
        seen = max(min(most_seen, len(body)), 1)
        behind = budget.outdone / _MISSED  # detections
        few, length = sparse(body, 2 * budget.sample * len(body) // seen), budget.refined(seen)
        poses, ranks, gains = np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0)
        best, checked, done, alike = 0.0, 0.0, skipped, 0
        for make in islice(generator, skipped, None):
            done += 1
            more = self._problem.allowed(make())
            self._cost["made"] += len(more)
            if few is not body and len(more) > budget.shortlist:
                rank = self._count(few, more)
                more = more[np.argsort(-rank, kind="stable")[: budget.shortlist]]
            self._cost["tested"] += len(more)
            rank = self._count(body, more)
            likely, before = rank > ranks.max(initial=0.0) - behind, poses[:1]
            poses = np.concatenate([poses, more[likely]])
            ranks = np.append(ranks, rank[likely])
            gains = np.append(gains, self._known(more[likely]))
            order = np.argsort(-ranks - gains / _MISSED, kind="stable")
            order = order[unlike(body, poses[order], budget.alike)][:length]
            poses, ranks, gains = poses[order], ranks[order], gains[order]
            best = float(ranks.max(initial=0.0))
            if self._is_alone:
                alike = self._as_the_best(poses[:1], more[rank > best - 1], before, alike)
                if alike * _share_of_rivals(best - behind, best) >= budget.repeats:
                    break
            if best > 1.1 * checked + 1:
                checked = best
                if self._are_enough(poses[:3], best):
                    rivals = slice(3, 3 + 2 * budget.sample)
                    poses, ranks = poses[rivals], ranks[rivals]
                    break
            if self._cost["made"] >= most:
                break
        self._refine(poses[ranks > best - behind], self._stages)
        return done

    def _as_the_best(self, best: Floats, more: Floats, before: Floats, alike: int) -> int:
        """How many guesses put the body where the best of them (1, 4, 4) does.

        `alike` did so where the best one `before` (1, 4, 4) put it; to these come those of the last
        batch, `more` (K, 4, 4) that explain about as much.
        """
        means, near = self._body.means, self._budget.same_pose * self._body.radius
        there = transform(best, means)
        at = [
            np.linalg.norm(transform(some, means) - there, axis=2).mean(axis=1) < near
            for some in (before, more)
        ]
        return alike * int(np.count_nonzero(at[0])) + int(np.count_nonzero(at[1]))

    def _count(self, body: Body, poses: Floats) -> Floats:
        """Distinct detections explained, and a tenth of how near they are met."""
        counts, near = count_inliers(self._images, body, poses)
        return np.asarray(counts.sum(axis=0) + 0.1 * near)

    def _are_enough(self, guesses: Floats, explained: float) -> bool:
        """Whether the best guesses of several cameras, refined, leave no need for others."""
        if not self._confirm or (
            explained < self._enough and self._judge(guesses)[0].max() < self._budget.hopeless
        ):
            return False
        self._refine(guesses, self._stages)
        return self._is_found()

    def _is_found(self) -> bool:
        """Whether only a pose that explains most of the detections could still be better.

        Chance would hardly make the best pose so evident, by itself or among those that there are.
        """
        budget, ranks = self._budget, self._judged[0]
        if not self._confirm or ranks.max(initial=0.0) <= 0:
            return False
        lead = ranks[0] - ranks[self._distinct(2)[-1]]
        if ranks[0] <= budget.beyond_doubt and lead <= budget.outdone:
            return False
        # where it meets less closely than spots err, its own markers may meet more elsewhere
        if self._coverage() < budget.convincing and not self._is_close():
            return False
        explained = int(self._count(self._body, self._poses[:1])[0])
        return self._coverage() >= budget.sufficient or explained >= self._enough

    def _is_close(self) -> bool:
        """Whether detections are as near to the features of the best pose as spots err."""
        met = matches_of(self._problem, self._poses[:1])
        most = self._budget.close**2 * float(met.measurements.sum())
        return float(met.squares.sum()) <= most

    def _coverage(self) -> float:
        """Mean share of the features that the sensors meet at the best pose."""
        return float(self._judged[1, :1].sum())

    def _distinct(self, count: int) -> list[int]:
        """Indices of the best poses that put the body, symmetries aside, somewhere else each."""
        means, kept, images = self._body.means, list[int](), np.zeros((0, len(self._body), 3))
        alike = self._budget.alike * self._body.radius  # root mean square distance of features
        for k, pose in enumerate(self._poses):
            if len(kept) == count:
                break
            squares = ((transform(pose, means) - images) ** 2).sum(axis=-1).mean(axis=-1)
            if (squares > alike**2).all():
                kept.append(k)
                images = np.append(images, transform(pose @ self._body.symmetries, means), axis=0)
        return kept

    def _refine(self, guesses: Floats, stages: Sequence[Stage]) -> None:
        """Keep what guesses lead to from less to less blur."""
        self._cost["refined"] += len(guesses)
        if len(poses := self._descent.refine(guesses, stages)):
            judged = np.array([*self._judge(poses), self._known(poses)])
            judged = np.append(self._judged, judged, axis=1)
            best = np.argsort(-judged[0] - judged[2], kind="stable")
            self._poses, self._judged = np.append(self._poses, poses, axis=0)[best], judged[:, best]

    def _judge(self, poses: Floats) -> tuple[Floats, Floats]:
        """Evidence where all sensors are cameras, else the score; and the share of the body met."""
        if self._by_evidence:
            return evidence(self._problem, poses)
        shares = self._descent.objective().shares(poses)
        return shares.sum(axis=0), np.sqrt(shares).mean(axis=0)


def _share_of_rivals(explained: float, best: float) -> float:
    """Of the triples of detections of a pose, those of one that explains fewer."""
    return comb(max(int(explained), 0), 3) / max(comb(int(best), 3), 1)
