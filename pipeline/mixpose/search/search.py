"""The first pose from nothing: guesses, a shortlist, descent, and the candidates left of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.errors import SessionError
from mixpose.judgement import JudgementRules
from mixpose.objective import View
from mixpose.records import Floats
from mixpose.search.budget import THOROUGH, SearchBudget
from mixpose.search.detections import is_pointlike, sensor_detections
from mixpose.search.evidence import evidence
from mixpose.search.from_orientations import from_spread_orientations
from mixpose.search.from_point_and_rays import from_point_and_rays
from mixpose.search.from_point_triples import by_promise, from_point_triples
from mixpose.search.from_three_rays import from_three_rays
from mixpose.search.inlier_counts import count_inliers, label_images
from mixpose.search.problem import (
    Candidate,
    Generator,
    SearchProblem,
    SearchReport,
    SearchResult,
    SearchState,
)
from mixpose.search.refinement import Descent, Stage, first_of_each, unlike
from mixpose.search.spread import sparse
from mixpose.search.triangulation import triangulate


def search_frame(
    views: Sequence[View],
    body: Body,
    *,
    free: NDArray[np.bool_],
    T_reference: Floats | None,
    rules: JudgementRules = JudgementRules(),
    seed: int = 0,
    budget: SearchBudget = THOROUGH,
    state: SearchState = SearchState(),
) -> SearchResult:
    """Find poses that explain the views of one frame, without a start.

    Parameters
    ----------
    views : sequence of View
        Views that saw nothing are passed over.
    body : Body
    free : (6,) bool
        World directions to search, order of `mixpose.rigid`.
    T_reference : (4, 4) array or None
        Where the directions that are not free stay; may be None when all are free.
    rules : JudgementRules
        By which poses are ranked, as they are judged in the end.
    seed : int
        Of the order in which guesses are tried, where not all can be.
    budget : SearchBudget
    state : SearchState
        Of the frame before, where its budget was used up.

    Raises
    ------
    SessionError
        If directions are held without a reference pose.
    """
    free = np.asarray(free, dtype=np.bool_)
    if T_reference is None and not free.all():
        raise SessionError(
            "search: start: found none, but some directions are not free: a start must say where "
            "they stay"
        )
    detections = sensor_detections(views, body, budget)
    if not detections:
        return SearchResult([])
    reference = np.eye(4) if T_reference is None else np.asarray(T_reference, dtype=np.float64)
    search = _Search(SearchProblem(detections, body, free, reference, rules, budget, seed))
    after = search.run(state)
    return SearchResult(search.candidates(), SearchReport(**search.cost), after)


def generators_of(problem: SearchProblem) -> list[Generator]:
    """Ways to make guesses from rays, the quickest first.

    Points in space; one such point and two rays, in crowds at last; three rays of one camera.
    """
    budget, rays = problem.budget, [rays for _, rays in problem.cameras]
    reaches = [problem.reach(sensor) for sensor, _ in problem.cameras]
    generators = [from_three_rays(problem, *pair) for pair in zip(reaches, rays, strict=True)]
    if len(rays) < 2:
        return generators
    points = by_promise(problem, triangulate(rays, reaches, budget.min_sine))
    crowded = sum(map(len, rays)) > budget.crowded * len(problem.body) * len(rays)
    # of the points tried in a crowd, and of the rays near them, few are right
    place = len(generators) if crowded else 0
    generators.insert(place, from_point_and_rays(problem, points))
    return [from_point_triples(problem, points), *generators]


class _Search:
    """What stays the same during one search, and its poses so far, the best first."""

    def __init__(self, problem: SearchProblem) -> None:
        self._problem, self._body, self._budget = problem, problem.body, problem.budget
        self._images = label_images(problem) if is_pointlike(self._body) else []
        self._explainable = sum(min(image.count, len(self._body)) for image in self._images)
        views, budget = [sensor.view for sensor in problem.detections], self._budget
        # ranges are met by chance too often, and err too coarsely, to be counted one by one
        are_cameras = all(sensor.rays is not None for sensor in problem.detections)
        self._by_evidence = bool(self._images) and are_cameras
        self._may_be_sure = self._by_evidence and len(views) > 1
        few = sparse(self._body, 4 * budget.sample)
        self._descent = Descent(views, self._body, problem.free, budget)
        self._quick_descent = Descent(views, few, problem.free, budget)
        plan = budget.descent_plan if self._by_evidence else budget.wide_plan
        most = budget.shortlist
        self._stages = [Stage((blur,) * len(views), steps, most) for blur, steps in plan]
        self._poses = np.zeros((0, 4, 4))
        self._ranks, self._met = np.zeros((2, 0))
        self.cost = Counter(made=0)

    def run(self, state: SearchState) -> SearchState:
        """Make as many guesses as are needed and allowed; where to go on in the next frame."""
        after = self._from_rays(state) if self._images else SearchState()
        doubtful = self._coverage() < self._budget.sufficient
        if doubtful and not (self._by_evidence and self.cost["made"]):
            poses, stages = from_spread_orientations(self._problem)
            self._keep(self._descent.refine(poses, stages))
        return after

    def _from_rays(self, state: SearchState) -> SearchState:
        """Guesses of one generator after the other; after the first, from where they stopped."""
        generators, most = generators_of(self._problem), self._budget.max_guesses
        if len(generators) > 1:
            self._draw(generators.pop(0), most / 2)
        for k, generator in enumerate(generators):
            if self._is_settled():
                break
            if k >= state.generator:
                done = self._draw(generator, most, state.batch if k == state.generator else 0)
                if self.cost["made"] >= most:
                    return SearchState(k, done)
        return SearchState()

    def _draw(self, generator: Generator, most: float, skipped: int = 0) -> int:
        """Try batches until `most` guesses were made; how many batches of it were tried so far."""
        done = skipped

        def guesses() -> Iterator[Floats]:
            nonlocal done
            for batch in islice(generator.batches, skipped, None):
                if self.cost["made"] >= most:
                    return
                done += 1
                yield generator.poses(batch)

        self._keep(self._descended(self._shortlist(guesses())))
        return done

    def candidates(self) -> list[Candidate]:
        """Distinct poses, best first, without those that the best leaves no chance."""
        kept, ranks = self._distinct(self._budget.sample), self._ranks
        if self._by_evidence and kept:
            least = max(ranks[kept[0]] - self._budget.outdone, self._budget.hopeless)
            kept = kept[:1] + [k for k in kept[1:] if ranks[k] > least]
        return [Candidate(self._poses[k], float(ranks[k])) for k in kept]

    def _distinct(self, count: int) -> list[int]:
        return first_of_each(self._body, self._poses, count, self._budget.alike)

    def _keep(self, poses: Floats) -> None:
        if len(poses):
            ranks, met = self._judged(poses)
            ranks, met = np.append(self._ranks, ranks), np.append(self._met, met)
            best = np.argsort(-ranks, kind="stable")
            self._poses = np.concatenate([self._poses, poses])[best]
            self._ranks, self._met = ranks[best], met[best]

    def _judged(self, poses: Floats) -> tuple[Floats, Floats]:
        """Evidence where all sensors are cameras, else the score; and the share of the body met."""
        if self._by_evidence:
            return evidence(self._problem, poses)
        shares = self._descent.objective().shares(poses)
        return shares.sum(axis=0), np.sqrt(shares).mean(axis=0)

    def _is_settled(self) -> bool:
        """Whether no other guesses are needed.

        Where the evidence of several cameras is beyond doubt, only a pose that explains most of
        the detections could still be better.
        """
        budget, coverage = self._budget, self._coverage()
        if coverage >= budget.convincing:
            return True
        if not self._is_beyond_doubt():
            return False
        most = budget.sufficient * self._explainable
        explained = self._count(self._body, self._poses[:1])[0]
        return coverage >= budget.sufficient or int(explained) >= most

    def _is_beyond_doubt(self) -> bool:
        """Whether chance would hardly make a pose so evident, by itself or among those found."""
        budget, best = self._budget, self._ranks.max(initial=0.0)
        if not self._may_be_sure or best <= 0:
            return False
        two = self._distinct(2)
        lead = best - self._ranks[two[1]] if len(two) > 1 else 0.0
        return bool(best > budget.beyond_doubt or lead > budget.outdone)

    def _coverage(self) -> float:
        """Mean share of the features that the sensors meet at the best pose."""
        return float(self._met[:1].sum())

    def _descended(self, guesses: Floats) -> Floats:
        """Guesses refined from less to less blur, or to σ_ε where there are other than cameras."""
        self.cost["refined"] += len(guesses)
        return self._quick_descent.refine(guesses, self._stages)

    def _shortlist(self, guesses: Iterable[Floats]) -> Floats:
        """The guesses that explain most distinct detections, and among equals most closely."""
        budget, most = self._budget, self._budget.refined(len(self._body))
        poses, ranks, best, checked = np.zeros((0, 4, 4)), np.zeros(0), 0.0, 0.0
        for batch in guesses:
            more = self._promising(self._problem.allowed(batch))
            rank = self._count(self._body, more)
            better = rank > (ranks[-1] if len(ranks) == most else -np.inf)
            poses = np.concatenate([poses, more[better]])
            ranks = np.append(ranks, rank[better])
            order = np.argsort(-ranks, kind="stable")
            order = order[unlike(self._body, poses[order], budget.alike)][:most]
            poses, ranks = poses[order], ranks[order]
            best = float(ranks.max(initial=0.0))
            improved = best > budget.improvement * checked + 1
            checked = best if improved else checked
            if improved and self._is_found(poses[: budget.checked], best):
                rivals = slice(budget.checked, budget.checked + 2 * budget.sample)
                poses, ranks = poses[rivals], ranks[rivals]
                break
        return np.asarray(poses[ranks > best - budget.behind])

    def _count(self, body: Body, poses: Floats) -> Floats:
        """Distinct detections explained, and a tenth of how near they are met."""
        counts, near = count_inliers(self._images, body, poses, self._budget.cache)
        return np.asarray(counts.sum(axis=0) + 0.1 * near)

    def _promising(self, poses: Floats) -> Floats:
        """The better of many guesses, judged by some features where the body has many."""
        few, most = sparse(self._body, 2 * self._budget.sample), self._budget.shortlist
        self.cost["made"] += len(poses)
        if few is not self._body and len(poses) > most:
            poses = poses[np.argsort(-self._count(few, poses), kind="stable")[:most]]
        self.cost["tested"] += len(poses)
        return poses

    def _is_found(self, guesses: Floats, explained: float) -> bool:
        """Whether the best guesses of several cameras leave no need for others."""
        doubtful = explained < self._budget.sufficient * self._explainable
        if not self._may_be_sure or (
            doubtful and self._judged(guesses)[0].max() < self._budget.hopeless
        ):
            return False
        self._keep(self._descended(guesses))
        return self._is_beyond_doubt() and self._is_settled()
