"""Which bodies may be taken for each other, by all that they meet, and by the frames before.

Of two bodies that meet the same detections only what each misses, and what was known before, tells
which of the two it is: clutter is as dense for either.  What is followed stays what it is, so that
where it goes tells nothing more.  Features that are hidden in one frame are in the next, so that of
all frames the one counts that tells most, and not their product.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from mixpose.body import FEWEST, LookAlike, like_features, of_size, tolerance_of
from mixpose.fit import Fit
from mixpose.judgement import Alternative, ScoredPose, Verdict
from mixpose.objective import project_body
from mixpose.records import Floats
from mixpose.search import is_pointlike
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.likelihood import likelihood_of
from mixpose.tracking.proposers import met_features


class Confusion(NamedTuple):
    """What else all that a body meets may be."""

    what: str  # in words
    log_odds: float
    alone: float  # log odds by this frame alone
    before: float = -math.inf  # log odds by the frames before, of the other body

    def since(self, before: Mapping[str, float]) -> Alternative:
        """By the frames before as well, of which the odds are known, by reasons."""
        known = max(before.get(self.what, -math.inf), self.before)
        return Alternative(self.what, max(self.log_odds, min(known, self.alone)))


def confusions_of(
    frames: Mapping[int, Frame], told: Mapping[int, Verdict]
) -> dict[int, list[Confusion]]:
    """What else all that bodies meet may be, by body, of those that meet something.

    Another body that is not surely elsewhere, its own markers where they repeat themselves, so that
    it may be turned another way, or one that is elsewhere, if that may be this one.
    """
    bests = {k: one.best for k, one in told.items() if one.best and one.best.log_evidence > 0}
    sure = [k for k, one in told.items() if one.status == "ok"]

    @cache
    def instead(k: int, j: int) -> list[Confusion]:
        against = confusions_with(frames[k], bests[k], frames[j])
        return sorted(against, key=lambda one: one.log_odds)

    found = {k: [*instead(k, k)] for k in bests}
    for k, j in permutations(frames, 2):
        if k in bests and j not in sure and frames[k].body is not frames[j].body:
            found[k] += _as_lost(instead(k, j), frames[k], frames[j])
    for steps in _exchanges(bests, frames, sure, instead):
        against = [instead(*step)[-1] for step in steps]
        log_odds, alone = sum(one.log_odds for one in against), sum(one.alone for one in against)
        asked = [(k, j, one.what) for (k, j), one in zip(steps, against, strict=True)]
        before = max(frames[k].track.confused.get(what, -math.inf) for k, _, what in asked)
        for k, j, what in asked:
            if j in sure:
                changed = Confusion(what, log_odds, alone, before)
                found[k] += _as_lost([changed], frames[k], frames[j])
    return found


def _exchanges(
    bests: Mapping[int, ScoredPose],
    frames: Mapping[int, Frame],
    sure: Sequence[int],
    instead: Callable[[int, int], list[Confusion]],
) -> Iterator[list[tuple[int, int]]]:
    """Steps from bodies to those that may be what was found of them.

    Two or three go round; or the last is one that is not surely elsewhere.
    """
    # what meets more is seldom the other
    ranked = sorted(bests, key=lambda one: -bests[one].features[0])

    def may_be(k: int, j: int) -> bool:
        return frames[k].body is not frames[j].body and bool(instead(k, j))

    def is_likely(k: int, j: int) -> bool:
        if not may_be(k, j):
            return False
        likeliest = instead(k, j)[-1]
        least = -frames[k].rules.look_alikes.behind
        return max(likeliest.log_odds, likeliest.alone) > least

    for place, k in enumerate(ranked):
        for j in filter(partial(is_likely, k), later := ranked[place + 1 :]):
            if may_be(j, k):
                yield [(k, j), (j, k)]
            thirds = [i for i in later if i != j and may_be(j, i) and may_be(i, k)]
            yield from ([(k, j), (j, i), (i, k)] for i in thirds)
    for j in filter(bests.__contains__, sure):
        thirds = [i for i in frames if i not in sure and may_be(j, i)]
        others = [k for k in sure if k in bests and k != j and is_likely(k, j)] if thirds else []
        for k, i in product(others, thirds):
            yield [(k, j), (j, i)]


def confusions_with(data: Frame, best: ScoredPose, other: Frame) -> Iterator[Confusion]:
    """Parts of another body, or of its own, that what a pose meets might be as well."""
    met = met_features(data, best)
    parts = list(_in_place_of(data, best, met, other))
    if not parts:
        return
    T = best.T_world_object
    here = Start(T, left_out=best.left_out)
    own = likelihood_of(data).density(Fit(T), here, best.matches)
    seen = other.changed(views=data.views, static_views=data.static_views)
    likelihood = likelihood_of(seen)
    # what a pose meets does not depend on what is drawn
    drawn = replace(data.finest, projection=project_body(data.finest.projection.sensors, seen.body))
    as_it_stands = likelihood_of(replace(seen, precomputed=drawn))
    for part, T_other in parts:
        there = as_it_stands.density(Fit(T_other), here, best.matches)
        if there - own > -other.rules.look_alikes.behind:  # else it is none, however fitted
            start = other.rival(best, T_other, other.close_uncertainty, left_out=best.left_out)
            there = max(there, likelihood.density(likelihood.fit(start), start, best.matches))
        known = other.prior(T_other)[0] - other.anywhere[0] - data.prior(T)[0] + data.anywhere[0]
        alone = there - own - known
        # of more than what may be either, where the other one was expected tells nothing
        is_all = len(part.features) == len(met)
        yield Confusion(part.reason, there - own if is_all else min(there - own, alone), alone)


def _in_place_of(
    data: Frame, best: ScoredPose, met: frozenset[int], other: Frame
) -> Iterator[tuple[LookAlike, Floats]]:
    """Parts of a body that lie like what a pose meets, with its pose (4, 4) there.

    Of another body like all but one of these, which is then held against it.
    One camera sees a body that is larger by some factor, and as much farther away, as the same.
    """
    if not (is_pointlike(data.body) and is_pointlike(other.body)):
        return
    sizes, centre = [1.0], np.zeros(3)
    factor = data.body.radius / other.body.radius
    if abs(factor - 1) > 1e-9 and (of_one := _centre_of_one(data, best)) is not None:
        sizes, centre = [1.0, factor], of_one
    for size in sizes:
        body = other.body if size == 1 else of_size(other.body, size)
        tolerance = tolerance_of(data.body, body, other.rules.look_alikes.alike)
        for part in like_features(data.body, met, body, tolerance, FEWEST):
            if len(part.features) == len(met) or _is_open(data, part, other):
                T_other = best.T_world_object @ part.T_body_other
                T_other[:3, 3] += (1 / size - 1) * (T_other[:3, 3] - centre)
                yield part, T_other


def _is_open(data: Frame, part: LookAlike, other: Frame) -> bool:
    """Whether a marker that another body lacks may be met by chance, as it may be that one.

    Of a body that is new, was away, or in doubt so far.
    """
    track, rules = data.track, data.rules
    is_new = track.ok_count < rules.proposals.believed or track.misses or track.doubted
    is_doubted = track.confused.get(part.reason, -math.inf) > rules.acceptance.log_doubt
    return other.body is not data.body and bool(is_new or is_doubted)


def _centre_of_one(data: Frame, best: ScoredPose) -> Floats | None:
    """Centre of projection (3,) of the camera that meets a pose, if it is the only sensor."""
    meets = [name for name, met in zip(best.used.names, best.used.met.tolist()) if met]
    if len(meets) != 1:
        return None
    (view,) = (view for view in data.views if view.name == meets[0])
    points = view.observation.points
    rays = None if points is None else view.sensor.rays(points[:1])
    return rays.origins[0] if rays and rays.central and len(rays) else None


def _as_lost(against: Sequence[Confusion], one: Frame, other: Frame) -> list[Confusion]:
    """Odds of two bodies of which the one may be the other, even where both were lost."""
    least = math.log(0.5) if one.was_lost and other.was_lost else -math.inf
    return [each._replace(log_odds=max(each.log_odds, min(least, each.alone))) for each in against]
