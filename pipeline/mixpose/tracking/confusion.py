"""Find bodies that may be taken for each other, by all that they meet and by the frames before.

Of two bodies that meet the same detections only the features that each misses, and earlier frames,
tell which of the two it is: clutter is as dense for either.  A followed thing stays what it is, so
that its motion tells nothing more.  Features hidden in one frame are hidden in the next, so that
only the frame that tells most counts, not the product of all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from mixpose.body import FEWEST, LookAlike, like_features, of_size, tolerance_of
from mixpose.fit import Fit
from mixpose.judgement import Alternative, ScoredPose, Verdict
from mixpose.objective import project_body
from mixpose.records import Floats, replace
from mixpose.search import is_pointlike
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.likelihood import likelihood_of
from mixpose.tracking.proposers import met_features


class Confusion(NamedTuple):
    """Another explanation of all that a body meets."""

    what: str  # in words
    log_odds: float
    alone: float  # log odds by this frame alone
    before: float = -math.inf  # log odds of the other body by the frames before

    def since(self, before: Mapping[str, float]) -> Alternative:
        """Return the alternative with its odds by the frames before too, known by reason."""
        known = max(before.get(self.what, -math.inf), self.before)
        return Alternative(self.what, max(self.log_odds, min(known, self.alone)))


def confusions_of(
    frames: Mapping[int, Frame], verdicts: Mapping[int, Verdict]
) -> dict[int, list[Confusion]]:
    """Return other explanations of all that bodies meet, by body, for those that meet something.

    Another body that is not surely elsewhere; the body itself turned another way, if its markers
    repeat themselves; or a body that seems to be elsewhere, if this one may be there instead.
    """
    bests = {k: v.best for k, v in verdicts.items() if v.best and v.best.log_evidence > 0}
    sure = [k for k, verdict in verdicts.items() if verdict.status == "ok"]

    @cache
    def met(k: int) -> frozenset[int]:
        return met_features(frames[k], bests[k])

    @cache
    def instead(k: int, j: int) -> list[Confusion]:
        against = confusions_with(frames[k], bests[k], met(k), frames[j])
        return sorted(against, key=lambda confusion: confusion.log_odds)

    confusions = {k: [*instead(k, k)] for k in bests}
    for k, j in permutations(frames, 2):
        if k in bests and j not in sure and frames[k].body is not frames[j].body:
            confusions[k] += _despite_loss(instead(k, j), frames[k], frames[j])
    for steps in _exchanges(bests, frames, sure, instead):
        against = [instead(*step)[-1] for step in steps]
        log_odds, alone = sum(c.log_odds for c in against), sum(c.alone for c in against)
        reasons = [(k, j, c.what) for (k, j), c in zip(steps, against, strict=True)]
        before = max(frames[k].track.confused.get(what, -math.inf) for k, _, what in reasons)
        for k, j, what in reasons:
            if j in sure:
                changed = Confusion(what, log_odds, alone, before)
                confusions[k] += _despite_loss([changed], frames[k], frames[j])
    return confusions


def _exchanges(
    bests: Mapping[int, ScoredPose],
    frames: Mapping[int, Frame],
    sure: Sequence[int],
    instead: Callable[[int, int], list[Confusion]],
) -> Iterator[list[tuple[int, int]]]:
    """Yield steps from bodies to those that may have their poses instead.

    Two or three bodies exchange poses in a cycle; or the last one is not surely elsewhere.
    """
    # a body that meets more is seldom the other one
    ranked = sorted(bests, key=lambda k: -bests[k].features[0])

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


def confusions_with(
    data: Frame, best: ScoredPose, met: frozenset[int], other: Frame
) -> Iterator[Confusion]:
    """Yield parts of another body, or other parts of its own, that a pose may have met instead."""
    parts = list(_alike_parts(data, best, met, other))
    if not parts:
        return
    T = best.T_world_object
    start = Start(T, left_out=best.left_out)
    own_density = likelihood_of(data).density(Fit(T), start, best.matches)
    seen = other.changed(views=data.views, static_views=data.static_views)
    likelihood = likelihood_of(seen)
    # the matches of a pose do not depend on the drawn densities
    drawn = replace(data.finest, projection=project_body(data.finest.projection.sensors, seen.body))
    as_it_stands = likelihood_of(replace(seen, precomputed=drawn))
    for part, T_other in parts:
        ahead = as_it_stands.density(Fit(T_other), start, best.matches) - own_density
        if ahead > -other.rules.look_alikes.behind:  # else no fit makes it likely
            rival = other.rival(best, T_other, other.close_uncertainty, left_out=best.left_out)
            fitted = likelihood.density(likelihood.fit(rival), rival, best.matches)
            ahead = max(ahead, fitted - own_density)
        known = other.prior(T_other)[0] - other.flat_prior[0]
        known = known - data.prior(T)[0] + data.flat_prior[0]
        alone = ahead - known
        # for a part of the met features only, the prediction of the other body tells nothing
        is_all = len(part.features) == len(met)
        yield Confusion(part.reason, ahead if is_all else min(ahead, alone), alone)


def _alike_parts(
    data: Frame, best: ScoredPose, met: frozenset[int], other: Frame
) -> Iterator[tuple[LookAlike, Floats]]:
    """Yield parts of a body that lie like the features met at a pose, with its pose (4, 4) there.

    Another body may lack one of the features, which then counts against it.  One camera cannot tell
    a body from one larger by some factor and as much farther away.
    """
    if not (is_pointlike(data.body) and is_pointlike(other.body)):
        return
    sizes, centre = [1.0], np.zeros(3)
    factor = data.body.radius / other.body.radius
    if abs(factor - 1) > 1e-9 and (camera_centre := _centre_of_only_camera(data, best)) is not None:
        sizes, centre = [1.0, factor], camera_centre
    for size in sizes:
        body = other.body if size == 1 else of_size(other.body, size)
        tolerance = tolerance_of(data.body, body, other.rules.look_alikes.alike)
        for part in like_features(data.body, met, body, tolerance, FEWEST):
            if len(part.features) == len(met) or _is_open(data, part, other):
                T_other = best.T_world_object @ part.T_body_other
                T_other[:3, 3] += (1 / size - 1) * (T_other[:3, 3] - centre)
                yield part, T_other


def _is_open(data: Frame, part: LookAlike, other: Frame) -> bool:
    """Test whether a marker that another body lacks may be met by chance, for a body in doubt."""
    track, rules = data.track, data.rules
    is_new = track.ok_count < rules.proposals.believed or track.misses or track.doubted
    is_doubted = track.confused.get(part.reason, -math.inf) > rules.acceptance.log_doubt
    return other.body is not data.body and bool(is_new or is_doubted)


def _centre_of_only_camera(data: Frame, best: ScoredPose) -> Floats | None:
    """Return the centre of projection (3,) of the camera, if a single one meets a pose."""
    meets = [name for name, met in zip(best.used.names, best.used.met.tolist()) if met]
    if len(meets) != 1:
        return None
    (view,) = (view for view in data.views if view.name == meets[0])
    points = view.observation.points
    rays = None if points is None else view.sensor.rays(points[:1])
    return rays.origins[0] if rays and rays.central and len(rays) else None


def _despite_loss(against: Sequence[Confusion], first: Frame, second: Frame) -> list[Confusion]:
    """Return confusions of two bodies that may be each other, at most even.

    Those that were lost may be either; of those that both missed frames as few are exchanged as
    sessions are mistaken.
    """
    prior = -math.inf
    if first.was_lost and second.was_lost:
        prior = 0.0
    elif first.track.misses and second.track.misses:
        prior = math.log(first.rules.acceptance.mistaken)
    even = math.log(0.5)
    return [c._replace(log_odds=max(c.log_odds, min(even, prior + c.alone))) for c in against]
