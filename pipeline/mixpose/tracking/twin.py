"""Whether the body is in a frame twice: a mirror image on a table, or one of which nobody told.

What a pose leaves of the detections is compared with the body as if nothing were known before: a
second pose that is sure says that either may be the body, whichever was followed so far, and in the
frames after it.  Frames are searched in which a sensor sees more that belongs to nothing than in
those searched in vain before, and every few frames anyway; of a flat body all.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import expit, logit

from mixpose.judgement import (
    Alternative,
    ScoredPose,
    Second,
    Verdict,
    is_sure,
    unconfirming_sensors,
)
from mixpose.matching import log_likelihood
from mixpose.objective import View
from mixpose.search import Candidate, Copy, SeenTogether
from mixpose.tracking.doubt import TWICE, contradicted, decided
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.likelihood import likelihood_of
from mixpose.tracking.mirrors import IN_A_MIRROR, MIRRORED, is_flat, mirrored
from mixpose.tracking.proposers import candidates_of

SECOND_POSE = "second_pose"
"""What proposes a pose that goes on from none of the frame before."""


def is_ok_but_for_mirrors(verdict: Verdict) -> bool:
    """Whether a frame is ok if nothing in it is seen in a mirror."""
    return verdict.status == "ok" or verdict.without(IN_A_MIRROR, MIRRORED).status == "ok"


def with_second(verdict: Verdict, data: Frame, rest: SeenTogether) -> Verdict:
    """The same; in doubt where what is left of the frame's views shows the body once more.

    Either may be it then, whichever was followed so far, unless one is the other's mirror image;
    and the other one goes on to be the other.
    """
    best = verdict.best
    if best is None or not is_ok_but_for_mirrors(verdict):
        return verdict
    if others := _may_be_elsewhere(data, best, rest):
        if (apart := _sure_by(data, others)) is not None:
            kept = [*((one, weight / 2) for one, weight in verdict.kept), (apart, 0.5)]
            return contradicted(data, replace(verdict, kept=kept))
        verdict = replace(verdict, tried=_most_tried(data, others))
    accepted, known = data.rules.acceptance, data.other_at(best.T_world_object)
    # how likely it is there: frames that show little of it tell against it, and none for ever
    second, odds = _where_it_was(data, best, rest), -math.inf
    if second is not None:
        odds = min(data.track.twice + second.log_evidence, -accepted.log_doubt)
    is_there = second is not None and is_sure(second, data.free, accepted)
    if not is_there and _is_due(data, best, rest.views):
        tried = {**verdict.tried, **_most_tried(data, rest.views)}
        verdict, found = replace(verdict, tried=tried), _second_pose(data, best, rest)
        if found is not None:
            second, odds = found, -accepted.log_doubt
    if second is None or odds <= accepted.log_doubt:
        against = [] if known is None else [Alternative(TWICE, known)]
        return replace(verdict, second=Second(None, odds, 0.0)).doubted(against)
    farther, elsewhere = (ask(best, second, data) for ask in (_farther_off, _by_features_elsewhere))
    told_by = odds, _more_missed(best, second, data), farther, elsewhere
    either = sum(min(each, 0.0) for each in told_by)
    either, in_mirror = _by_mirror(either, best, second, data)
    # of all frames the one counts that tells most
    if known is not None and abs(known) > abs(either):
        either = known
    is_image, share = in_mirror < accepted.log_doubt, float(expit(either))
    is_told = is_image or elsewhere < accepted.log_doubt
    kept = [*((one, weight * (1 - share)) for one, weight in verdict.kept), (second, share)]
    if either > 0:
        told = _decided_beside(second, data, rest, is_image)
        own = [kept[-1], *kept[:-1]]
        told = replace(told, kept=own, second=Second(best, odds, -either, is_told))
    else:
        against = [
            one._replace(log_odds=in_mirror) if one.what == IN_A_MIRROR else one
            for one in verdict.against
        ]
        told = replace(verdict, kept=kept, against=tuple(against))
        told = replace(told, second=Second(second, odds, either, is_told))
    return replace(told, tried=verdict.tried).doubted([Alternative(TWICE, -abs(either))])


def _decided_beside(second: ScoredPose, data: Frame, rest: SeenTogether, is_image: bool) -> Verdict:
    """The decision about a second pose that is the body's, by what the other one leaves.

    What was mirrored is the other one, and where that `is_image` this is in no mirror.
    """
    mistaken = {name: told for name, told in data.track.mistaken.items() if name != MIRRORED}
    track = replace(data.track, mistaken=mistaken)
    seen = data.seen_otherwise(views=rest.views, still=(), starts=(), track=track)
    told = decided(seen, [second])
    return told.without(IN_A_MIRROR) if is_image else told


def _by_mirror(
    either: float, best: ScoredPose, second: ScoredPose, data: Frame
) -> tuple[float, float]:
    """Log odds that the second pose is the body, with those before that were `either`.

    And that neither of the two shows the other in a mirror.
    """
    odds, is_first = mirrored(data, best, second)
    in_none = -float(np.logaddexp(0.0, odds))
    if is_first:
        return either + in_none, in_none
    return float(np.log(np.expm1(np.logaddexp(0.0, either) - in_none))), in_none


def left_by(pose: ScoredPose, data: Frame) -> SeenTogether:
    """What a pose leaves of a frame; views without single detections leave nothing."""
    numbers = dict(zip(pose.matches.names, pose.matches.detections, strict=True))
    rest = []
    for view in data.still or data.views:
        points = view.observation.points
        is_left = np.ones(0 if points is None else len(points), dtype=np.bool_)
        # what a sensor that is left out meets, it meets by chance
        if len(is_left) and view.name in numbers and view.name not in pose.left_out:
            is_left[numbers[view.name][numbers[view.name] >= 0]] = False
        if is_left.any():
            rest.append(replace(view, observation=view.observation.only(is_left)))
    return SeenTogether(rest, data.rules.judgement, data.rules.search)


def _more_missed(best: ScoredPose, second: ScoredPose, data: Frame) -> float:
    """Log odds for the second of two poses that each explain what they meet, as one is the body's.

    Then the other is its image, or another body: of all but what the body is missed at.  A sensor
    of which nothing is left misses the second one.
    """
    met = [dict(zip(one.used.names, one.used.met.tolist())) for one in (best, second)]
    more: float = sum(own - met[1].get(name, 0.0) for name, own in met[0].items())
    return -more * _log_odds_of_one(data)


def _farther_off(best: ScoredPose, second: ScoredPose, data: Frame) -> float:
    """Log odds for the second pose by its offsets, as detections err as they do at the first.

    As if two were cut unseen, at the least: spots that are cut are so together.
    """
    errors, count = data.rules.judgement.noise.errors, int(np.count_nonzero(data.free))
    noise = dict(zip(best.used.names, best.variances.tolist()))
    pairs = zip(second.used.names, second.variances.tolist(), strict=True)
    known = np.array([noise.get(name, own) for name, own in pairs])
    likely, most = (
        log_likelihood(errors.blur * np.sqrt(one), second.used, count, errors)
        for one in (known, second.variances)
    )
    return max(float(likely - most), 2 * _of_one_cut(data))


def _of_one_cut(data: Frame) -> float:
    """Log of the chance that a spot of the body is off, though it looks whole."""
    return math.log(sum(data.rules.judgement.noise.errors.chances))


def _by_features_elsewhere(best: ScoredPose, second: ScoredPose, data: Frame) -> float:
    """Log odds for the second pose by features that are elsewhere at either of them.

    Of two sensors or more that have it in view none meets such a feature closely, and some far off.
    Detections err as they do where they err least.
    """
    errors, noise = data.rules.judgement.noise.errors, dict[str, float]()
    for one in (best, second):
        for name, variance in zip(one.used.names, one.variances.tolist(), strict=True):
            noise[name] = min(variance, noise.get(name, variance))
    spots = []
    for one in (best, second):
        least = np.array([noise[name] for name in one.used.names])[:, None]
        off = errors.are_off(one.used, least + one.used.extra)
        close = ((one.used.shares > 0) & ~off).any(axis=0)
        elsewhere = ~close & ((one.used.weights > 0).sum(axis=0) > 1)
        spots.append(int(np.count_nonzero(off[:, elsewhere])))
    return (spots[1] - spots[0]) * _of_one_cut(data)


def _is_due(data: Frame, best: ScoredPose, views: Sequence[View]) -> bool:
    """Whether as many detections as are left may be the body once more, and were not searched."""
    used, left = best.matches, {one.name: one.observation.cells for one in views}
    if (used.dimensions != 2).any():
        return False
    rest = np.array([left.get(name, 0) for name in used.names])
    # as much as fixes a pose, and would cast doubt, by as many sensors; what is seen in a mirror is
    # told by where it stands, however much of the body is hidden
    most, is_much = float(np.minimum(rest, used.met).sum()), is_flat(data) and len(left) > 1
    is_much = is_much or most >= used.met.sum() - _most_missed(data)
    if 2 * most < np.count_nonzero(data.free) or not is_much:
        return False
    # a flat body has a mirror image that looks like it
    return is_flat(data) or _is_in_turn(data, views)


def _most_missed(data: Frame) -> float:
    """How many features more a second pose misses at the most that casts doubt on the best one."""
    return -data.rules.acceptance.log_doubt / _log_odds_of_one(data)


def _log_odds_of_one(data: Frame) -> float:
    """Of a feature in view, that it is met and not missed."""
    return float(logit(data.rules.judgement.detection.probability))


def _second_pose(data: Frame, best: ScoredPose, rest: SeenTogether) -> ScoredPose | None:
    """A pose that is sure by itself and may be the body's as well as the best one.

    Where sensors agree about that one, they do about this one.
    """
    agree = min(int(np.count_nonzero(best.used.met)), 2)
    alone = data.alone(views=rest.views, still=(), starts=())
    for pose in _poses(alone, rest):
        least = data.rules.acceptance.log_doubt
        is_likely = _more_missed(best, pose, data) > least or mirrored(data, best, pose)[0] > -least
        is_seen = bool(np.count_nonzero(pose.matches.met) >= agree)
        if is_likely and is_seen and is_sure(pose, data.free, data.rules.acceptance):
            return replace(pose, proposer=SECOND_POSE)
    return None


def _may_be_elsewhere(data: Frame, best: ScoredPose, rest: SeenTogether) -> list[View]:
    """Sensors that see nothing of a pose which one alone meets, and may see the body elsewhere."""
    if (best.matches.dimensions != 2).any():
        return []
    names = unconfirming_sensors(best, data.rules.acceptance)
    views = [one for one in rest.views if one.name in names and _may_fix(one, data)]
    return views if _is_in_turn(data, views) else []


def _may_fix(view: View, data: Frame) -> bool:
    """Whether a sensor sees more than what fixes a pose."""
    return bool(view.observation.cells * view.sensor.dimension > np.count_nonzero(data.free))


def _is_in_turn(data: Frame, views: Sequence[View]) -> bool:
    """Whether views show more than was searched in vain before, or are searched again anyway."""
    track = data.track
    is_more = any(one.observation.cells > track.tried.get(one.name, 0) for one in views)
    again = track.is_in_turn(data.frame, data.rules.proposals.static)
    return bool(views) and (is_more or track.doubted or again)


def _most_tried(data: Frame, views: Sequence[View]) -> dict[str, int]:
    """Detections of views that were searched in vain, now or before."""
    tried = data.track.tried
    return {one.name: max(one.observation.cells, tried.get(one.name, 0)) for one in views}


def _sure_by(data: Frame, views: Sequence[View]) -> ScoredPose | None:
    """A pose that is sure by some views alone.

    Where they see nothing of the best one, nobody knows which of the two is out of step.
    """
    alone = data.alone(views=views, still=(), starts=()).seen_otherwise(options=data.options)
    together = SeenTogether(views, data.rules.judgement, data.rules.search)
    for pose in _poses(alone, together):
        if is_sure(pose, data.free, data.rules.acceptance):
            return replace(pose, proposer=SECOND_POSE)
    return None


def _where_it_was(data: Frame, best: ScoredPose, rest: SeenTogether) -> ScoredPose | None:
    """The second pose of the frame before, in this one."""
    if data.track.twice == -math.inf or not rest.views:
        return None
    if (start := next(_elsewhere(data, best), None)) is None:
        return None
    likelihood = likelihood_of(data.seen_otherwise(views=rest.views, still=(), starts=()))
    return likelihood.judge(likelihood.fit(start), start)


def _elsewhere(data: Frame, best: ScoredPose) -> Iterator[Start]:
    """Where else than at the best pose the body is expected, be it right beside it."""
    own = data.before(best.T_world_object)
    for branch in data.predictions:
        if branch is not own:
            yield Start(branch.T_world_object, branch.uncertainty)


def _poses(alone: Frame, rest: SeenTogether) -> Iterator[ScoredPose]:
    """What a second pose may be, as a search finds."""
    likelihood = likelihood_of(alone)
    found: Sequence[Copy | Candidate]
    if len(rest.views) > 1:  # quickly, by points that cameras see together
        found = rest.copies_of(alone.body, alone.free)
    else:
        found = candidates_of(alone)
    for one in found[: alone.rules.proposals.seconds]:
        start = Start(one.T_world_object, alone.close)
        yield likelihood.judge(likelihood.fit(start), start)
