"""Search of a pose without a start: make guesses, refine the best, and rank the candidates."""

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
    distinct_poses,
    evidence,
    label_image,
    matches_of,
    spread_poses,
)
from mixpose.search.problem import THOROUGH, SearchBudget, SearchProblem, can_fix, sensor_detections
from mixpose.search.three_points import Guesses
from mixpose.search.triples import thinned

_MISSED = 4.0  # nats that a missed detection costs


class Candidate(NamedTuple):
    """A pose that may explain the views, ranked by its evidence.

    The evidence is the log odds that the pose is not chance; with ranges among the sensors, it is
    the matched objective at σ_ε, summed over views, with equal weights of detections.
    """

    T_world_object: Floats  # (4, 4)
    evidence: float


class SearchReport(NamedTuple):
    """Numbers of guesses that were made, tested on all features and sensors, and refined."""

    made: int = 0
    tested: int = 0
    refined: int = 0


class SearchState(NamedTuple):
    """Position at which a search with a limited budget goes on in the next frame."""

    generator: int = 0  # not counting the first of several, which is tried in every frame
    batch: int = 0  # number of its batches tried so far


LogPrior: TypeAlias = Callable[[Floats], Floats]
"""Log prior (K,) in nats of poses (K, 4, 4), by what is known before their frame."""


def flat_prior(poses: Floats) -> Floats:
    """Return the same log prior for all poses (K, 4, 4)."""
    return np.zeros(len(poses))


class SearchResult(NamedTuple):
    """Candidates, best first, what they cost, and where the next frame's search goes on."""

    candidates: list[Candidate]
    report: SearchReport = SearchReport()
    state: SearchState = SearchState()


def search_frame(
    views: Sequence[View],
    body: Body,
    *,
    free: Mask,  # (6,) world directions to search
    T_reference: Floats | None,  # gives the held directions; may be None if all are free
    rules: JudgementRules = JudgementRules(),
    seed: int = 0,
    budget: SearchBudget = THOROUGH,
    state: SearchState = SearchState(),
    log_prior: LogPrior = flat_prior,
) -> SearchResult:
    """Find poses that explain the views of one frame, without a start.

    `rules` rank them, the same that judge the result.  `seed` sets the random order of guesses,
    `state` is the result's of the frame before.  `log_prior` decides between poses that explain
    about as much.  Raises `SessionError` if directions are held without a reference pose.
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
    problem = SearchProblem(detections, body, free, T, rules, budget, seed)
    return _Search(problem, log_prior).run(state)


class _Search:
    """One search: its inputs, and its poses so far, the best first."""

    def __init__(self, problem: SearchProblem, log_prior: LogPrior) -> None:
        self._log_prior = log_prior
        self._problem, self._body, self._budget = problem, problem.body, problem.budget
        views, cameras = [sensor.view for sensor in problem.detections], problem.cameras
        self._images = [label_image(*camera, problem.reach(camera[0])) for camera in cameras]
        self._sufficient = self._budget.sufficient * sum(  # detections explained
            min(len(rays), len(self._body)) for _, rays in cameras
        )
        # ranges are met by chance too often, and err too much, to count single detections
        self._by_evidence = bool(cameras) and all(
            sensor.rays is not None for sensor in problem.detections
        )
        self._camera_count = len(cameras) if self._by_evidence else 0
        self._descent = Descent(
            views, thinned(self._body, 4 * self._budget.sample), problem.free, self._budget
        )
        # where not all sensors are cameras the descent ends at σ_ε
        plan = self._budget.descent_plan if self._by_evidence else self._budget.wide_plan
        self._stages = [((blur,) * len(views), n, self._budget.shortlist) for blur, n in plan]
        # rows of scores: the two of `_judge`, and the log prior
        self._poses, self._scores = np.zeros((0, 4, 4)), np.zeros((3, 0))
        self._cost = Counter(made=0)

    def run(self, state: SearchState) -> SearchResult:
        """Make guesses until a pose convinces or the budget is used up; return the candidates."""
        budget, next_state = self._budget, SearchState()
        generators = generators_of(self._problem) if self._images else []
        if len(generators) > 1:
            self._draw(generators.pop(0), budget.max_guesses / 2)
        for k, generator in enumerate(generators[state.generator :], state.generator):
            if self._coverage() >= budget.convincing or self._is_convincing():
                break
            skip = state.batch if k == state.generator else 0
            batches = self._draw(generator, budget.max_guesses, skip)
            if self._cost["made"] >= budget.max_guesses:
                next_state = SearchState(k, batches)
                break
        # guesses from detections lead to any pose that has evidence
        is_guessed = self._by_evidence and (self._cost["made"] > 0 or budget.useful >= 0)
        if self._coverage() < budget.sufficient and not is_guessed:
            self._refine(*spread_poses(self._problem))
        return SearchResult(self._candidates(), SearchReport(**self._cost), next_state)

    def _candidates(self) -> list[Candidate]:
        """Return distinct poses, best first, without those too far behind the best."""
        budget, ranks = self._budget, self._scores[0]
        kept = self._distinct(budget.sample)
        if self._by_evidence and kept:
            threshold = max(ranks[0] - budget.outdone, budget.hopeless)
            kept = kept[:1] + [k for k in kept[1:] if ranks[k] > threshold]
            # a fit hardly gains more evidence than the right pose may be behind
            kept = [k for k in kept if ranks[k] > budget.useful - budget.outdone]
        return [Candidate(self._poses[k], float(ranks[k])) for k in kept]

    def _draw(self, generator: Guesses, max_guesses: float, skip: int = 0) -> int:
        """Draw batches of guesses until `max_guesses` were made, and refine the best of them.

        Return the number of batches.  The best explain most distinct detections, of equals most
        closely.  A few that explain more than all before are refined at once: they may suffice.
        """
        budget, body = self._budget, self._body
        # features on sides that are turned away are not seen
        most_seen = max(len(rays) for _, rays in self._problem.cameras)
        seen = max(min(most_seen, len(body)), 1)
        margin = budget.outdone / _MISSED  # detections
        reduced, limit = thinned(body, 2 * budget.sample * len(body) // seen), budget.refined(seen)
        poses, ranks, priors = np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0)
        best, best_checked, batches, repeats = 0.0, 0.0, skip, 0
        for make_guesses in islice(generator, skip, None):
            batches += 1
            guesses = self._problem.constrained(make_guesses())
            self._cost["made"] += len(guesses)
            if reduced is not body and len(guesses) > budget.shortlist:
                rank = self._count(reduced, guesses)
                guesses = guesses[np.argsort(-rank, kind="stable")[: budget.shortlist]]
            self._cost["tested"] += len(guesses)
            rank = self._count(body, guesses)
            is_likely, previous = rank > ranks.max(initial=0.0) - margin, poses[:1]
            poses = np.concatenate([poses, guesses[is_likely]])
            ranks = np.append(ranks, rank[is_likely])
            priors = np.append(priors, self._log_prior(guesses[is_likely]))
            order = np.argsort(-ranks - priors / _MISSED, kind="stable")
            order = order[distinct_poses(body, poses[order], budget.alike)][:limit]
            poses, ranks, priors = poses[order], ranks[order], priors[order]
            best = float(ranks.max(initial=0.0))
            if self._camera_count == 1:
                near_best = guesses[rank > best - 1]
                repeats = self._count_repeats(poses[:1], near_best, previous, repeats)
                if repeats * _share_of_rivals(best - margin, best) >= budget.repeats:
                    break
            if best > 1.1 * best_checked + 1:
                best_checked = best
                if self._are_sufficient(poses[:3], best):
                    rivals = slice(3, 3 + 2 * budget.sample)
                    poses, ranks = poses[rivals], ranks[rivals]
                    break
            if self._cost["made"] >= max_guesses:
                break
        self._refine(poses[ranks > best - margin], self._stages)
        return batches

    def _count_repeats(self, best: Floats, batch: Floats, previous: Floats, repeats: int) -> int:
        """Count the guesses that put the body where the best of them (1, 4, 4) does.

        `repeats` guesses were at the `previous` best (1, 4, 4); they still count if that is near.
        The last `batch` (K, 4, 4) holds guesses that explain about as much as the best.
        """
        means, radius = self._body.means, self._budget.same_pose * self._body.radius
        features = transform(best, means)
        is_near = [
            np.linalg.norm(transform(poses, means) - features, axis=2).mean(axis=1) < radius
            for poses in (previous, batch)
        ]
        return repeats * int(np.count_nonzero(is_near[0])) + int(np.count_nonzero(is_near[1]))

    def _count(self, body: Body, poses: Floats) -> Floats:
        """Return the number of distinct detections explained, plus a tenth of their nearness."""
        counts, near = count_inliers(self._images, body, poses)
        return np.asarray(counts.sum(axis=0) + 0.1 * near)

    def _are_sufficient(self, guesses: Floats, explained: float) -> bool:
        """Refine the best guesses of several cameras, and test whether the search may end."""
        if self._camera_count < 2 or (
            explained < self._sufficient and self._judge(guesses)[0].max() < self._budget.hopeless
        ):
            return False
        self._refine(guesses, self._stages)
        return self._is_convincing()

    def _is_convincing(self) -> bool:
        """Test whether the best pose of several cameras is so evident that the search may end."""
        budget, ranks = self._budget, self._scores[0]
        if self._camera_count < 2 or ranks.max(initial=0.0) <= 0:
            return False
        lead = ranks[0] - ranks[self._distinct(2)[-1]]
        if ranks[0] <= budget.beyond_doubt and lead <= budget.outdone:
            return False
        # where offsets are larger than spots err, the body may meet more of its markers elsewhere
        if self._coverage() < budget.convincing and not self._is_close():
            return False
        explained = int(self._count(self._body, self._poses[:1])[0])
        return self._coverage() >= budget.sufficient or explained >= self._sufficient

    def _is_close(self) -> bool:
        """Test whether the best pose meets its detections as closely as spots err."""
        met = matches_of(self._problem, self._poses[:1])
        limit = self._budget.close**2 * float(met.measurements.sum())
        return float(met.squares.sum()) <= limit

    def _coverage(self) -> float:
        """Return the mean share of features that the sensors meet at the best pose."""
        return float(self._scores[1, :1].sum())

    def _distinct(self, count: int) -> list[int]:
        """Return indices of the best poses that differ, symmetries of the body aside."""
        means, kept, images = self._body.means, list[int](), np.zeros((0, len(self._body), 3))
        radius = self._budget.alike * self._body.radius  # root mean square distance of features
        for k, pose in enumerate(self._poses):
            if len(kept) == count:
                break
            squares = ((transform(pose, means) - images) ** 2).sum(axis=-1).mean(axis=-1)
            if (squares > radius**2).all():
                kept.append(k)
                images = np.append(images, transform(pose @ self._body.symmetries, means), axis=0)
        return kept

    def _refine(self, guesses: Floats, stages: Sequence[Stage]) -> None:
        """Descend from guesses through narrowing blurs, and keep the poses reached."""
        self._cost["refined"] += len(guesses)
        if len(poses := self._descent.refine(guesses, stages)):
            scores = np.array([*self._judge(poses), self._log_prior(poses)])
            scores = np.append(self._scores, scores, axis=1)
            best = np.argsort(-scores[0] - scores[2], kind="stable")
            self._poses, self._scores = np.append(self._poses, poses, axis=0)[best], scores[:, best]

    def _judge(self, poses: Floats) -> tuple[Floats, Floats]:
        """Return the evidence (all cameras) or the score, and the share of the body met."""
        if self._by_evidence:
            return evidence(self._problem, poses)
        shares = self._descent.objective().shares(poses)
        return shares.sum(axis=0), np.sqrt(shares).mean(axis=0)


def _share_of_rivals(explained: float, best: float) -> float:
    """Return the share of a pose's triples of detections that a rival explaining fewer has too."""
    return comb(max(int(explained), 0), 3) / max(comb(int(best), 3), 1)
