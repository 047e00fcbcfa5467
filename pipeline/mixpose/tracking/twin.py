"""Test whether the body is in view twice: as a mirror image, or as a second body like it.

A second pose among the unclaimed detections that is sure without the track says that either may be
the body, now and in later frames.  Frames are searched for one if a sensor has more unclaimed
detections than in the frames searched in vain before, and every few frames; of a flat body all are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

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
from mixpose.records import replace
from mixpose.search import Candidate, Copy, SeenTogether
from mixpose.tracking.doubt import TWICE, contradicted, decide_frame
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.likelihood import likelihood_of
from mixpose.tracking.mirrors import IN_A_MIRROR, MIRRORED, is_flat, mirror_odds
from mixpose.tracking.proposers import candidates_of

SECOND_POSE = "second_pose"
"""The proposer of a pose that does not go on from the frame before."""


def is_ok_but_for_mirrors(verdict: Verdict) -> bool:
    """Test whether a frame is ok if nothing in it is a mirror image."""
    return verdict.status == "ok" or verdict.without(IN_A_MIRROR, MIRRORED).status == "ok"


def with_second(verdict: Verdict, data: Frame, leftover: SeenTogether) -> Verdict:
    """Return the verdict, in doubt if the leftover detections show the body a second time.

    Either may be the body then, unless one is a mirror image; both are followed, one as another
    thing.
    """
    best = verdict.best
    if best is None or not is_ok_but_for_mirrors(verdict):
        return verdict
    if others := _may_be_elsewhere(data, best, leftover):
        if (contrary := _sure_pose_by(data, others)) is not None:
            kept = [*((pose, weight / 2) for pose, weight in verdict.kept), (contrary, 0.5)]
            return contradicted(data, replace(verdict, kept=kept))
        verdict = replace(verdict, tried=_most_tried(data, others))
    accepted, known = data.rules.acceptance, data.log_odds_other_at(best.T_world_object)
    # log odds of the second pose: frames that show little of it lower them, within bounds
    second, odds = _previous_second(data, best, leftover), -math.inf
    if second is not None:
        odds = min(data.track.log_odds_twice + second.log_evidence, -accepted.log_doubt)
    is_convincing = second is not None and is_sure(second, data.free, accepted)
    if not is_convincing and _is_due(data, best, leftover.views):
        tried = {**verdict.tried, **_most_tried(data, leftover.views)}
        verdict, new_pose = replace(verdict, tried=tried), _second_pose(data, best, leftover)
        if new_pose is not None:
            second, odds = new_pose, -accepted.log_doubt
    if second is None or odds <= accepted.log_doubt:
        against = [] if known is None else [Alternative(TWICE, known)]
        return replace(verdict, second=Second(None, odds, 0.0)).doubted(against)
    farther, elsewhere = (ask(best, second, data) for ask in (_by_offsets, _by_features))
    reasons = odds, _by_misses(best, second, data), farther, elsewhere
    log_odds = sum(min(reason, 0.0) for reason in reasons)
    log_odds, in_mirror = _by_mirror(log_odds, best, second, data)
    # of all frames only the one that tells most counts
    if known is not None and abs(known) > abs(log_odds):
        log_odds = known
    is_image, share = in_mirror < accepted.log_doubt, float(expit(log_odds))
    is_decided = is_image or elsewhere < accepted.log_doubt
    kept = [*((pose, weight * (1 - share)) for pose, weight in verdict.kept), (second, share)]
    if log_odds > 0:
        changed = _decide_for(second, data, leftover, is_image)
        kept = [kept[-1], *kept[:-1]]
        changed = replace(changed, kept=kept, second=Second(best, odds, -log_odds, is_decided))
    else:
        against = [
            other._replace(log_odds=in_mirror) if other.what == IN_A_MIRROR else other
            for other in verdict.against
        ]
        changed = replace(verdict, kept=kept, against=tuple(against))
        changed = replace(changed, second=Second(second, odds, log_odds, is_decided))
    return replace(changed, tried=verdict.tried).doubted([Alternative(TWICE, -abs(log_odds))])


def _decide_for(second: ScoredPose, data: Frame, leftover: SeenTogether, is_image: bool) -> Verdict:
    """Decide about a second pose that is the body, by the detections that the first one leaves.

    Evidence of a mirror image was of the first one; with `is_image` the second one is in no mirror.
    """
    before = data.track.mistaken
    mistaken = {name: mistake for name, mistake in before.items() if name != MIRRORED}
    track = replace(data.track, mistaken=mistaken)
    seen = data.changed(views=leftover.views, static_views=(), starts=(), track=track)
    verdict = decide_frame(seen, [second])
    return verdict.without(IN_A_MIRROR) if is_image else verdict


def _by_mirror(
    log_odds: float, best: ScoredPose, second: ScoredPose, data: Frame
) -> tuple[float, float]:
    """Return log odds that the second pose is the body, and that neither is in a mirror."""
    odds, is_first = mirror_odds(data, best, second)
    in_none = -float(np.logaddexp(0.0, odds))
    if is_first:
        return log_odds + in_none, in_none
    return float(np.log(np.expm1(np.logaddexp(0.0, log_odds) - in_none))), in_none


def leftover_of(pose: ScoredPose, data: Frame) -> SeenTogether:
    """Return the detections that a pose leaves; views without single detections leave none."""
    numbers = dict(zip(pose.matches.names, pose.matches.detections, strict=True))
    views = []
    for view in data.static_views or data.views:
        points = view.observation.points
        is_left = np.ones(0 if points is None else len(points), dtype=np.bool_)
        # a sensor that is left out meets its detections by chance
        if len(is_left) and view.name in numbers and view.name not in pose.left_out:
            is_left[numbers[view.name][numbers[view.name] >= 0]] = False
        if is_left.any():
            views.append(view.only(is_left))
    return SeenTogether(views, data.rules.judgement, data.rules.search)


def _by_misses(best: ScoredPose, second: ScoredPose, data: Frame) -> float:
    """Return log odds for the second pose by how many fewer features it meets.

    If one is the body, the other is its image or another body, of all but the features that the
    body is missed at.  A sensor without leftover detections misses all of the second.
    """
    met = [dict(zip(pose.used.names, pose.used.met.tolist())) for pose in (best, second)]
    more: float = sum(count - met[1].get(name, 0.0) for name, count in met[0].items())
    return -more * _log_odds_of_match(data)


def _by_offsets(best: ScoredPose, second: ScoredPose, data: Frame) -> float:
    """Return log odds for the second pose by its offsets, with the noise at the first.

    Not below those of two spots cut unseen, as spots are cut together.
    """
    errors, count = data.rules.judgement.noise.errors, int(np.count_nonzero(data.free))
    noise = dict(zip(best.used.names, best.variances.tolist()))
    pairs = zip(second.used.names, second.variances.tolist(), strict=True)
    known = np.array([noise.get(name, variance) for name, variance in pairs])
    likely, likeliest = (
        log_likelihood(errors.blur * np.sqrt(variances), second.used, count, errors)
        for variances in (known, second.variances)
    )
    return max(float(likely - likeliest), 2 * _log_cut(data))


def _log_cut(data: Frame) -> float:
    """Return the log of the chance that a spot of the body is off though it looks whole."""
    return math.log(sum(data.rules.judgement.noise.errors.chances))


def _by_features(best: ScoredPose, second: ScoredPose, data: Frame) -> float:
    """Return log odds for the second pose by features that are elsewhere at either pose.

    Two or more sensors have such a feature in view, none meets it closely, and some far off.
    Detections err as they do where they err least.
    """
    errors, noise = data.rules.judgement.noise.errors, dict[str, float]()
    for pose in (best, second):
        for name, variance in zip(pose.used.names, pose.variances.tolist(), strict=True):
            noise[name] = min(variance, noise.get(name, variance))
    spots = []
    for pose in (best, second):
        least = np.array([noise[name] for name in pose.used.names])[:, None]
        off = errors.are_off(pose.used, least + pose.used.extra)
        close = ((pose.used.shares > 0) & ~off).any(axis=0)
        elsewhere = ~close & ((pose.used.weights > 0).sum(axis=0) > 1)
        spots.append(int(np.count_nonzero(off[:, elsewhere])))
    return (spots[1] - spots[0]) * _log_cut(data)


def _is_due(data: Frame, best: ScoredPose, views: Sequence[View]) -> bool:
    """Test whether enough detections are left for the body once more, and were not searched."""
    used, cells = best.matches, {view.name: view.observation.cells for view in views}
    if (used.dimensions != 2).any():
        return False
    counts = np.array([cells.get(name, 0) for name in used.names])
    # enough to fix a pose, and to cast doubt, in as many sensors; a mirror image is recognised by
    # its place, however much of the body is hidden
    most, is_much = float(np.minimum(counts, used.met).sum()), is_flat(data) and len(cells) > 1
    may_miss = -data.rules.acceptance.log_doubt / _log_odds_of_match(data)
    is_much = is_much or most >= used.met.sum() - may_miss
    if 2 * most < np.count_nonzero(data.free) or not is_much:
        return False
    # a flat body has a mirror image that looks like it
    return is_flat(data) or _is_in_turn(data, views)


def _log_odds_of_match(data: Frame) -> float:
    """Return log odds that a feature in view is met."""
    return float(logit(data.rules.judgement.detection.probability))


def _second_pose(data: Frame, best: ScoredPose, leftover: SeenTogether) -> ScoredPose | None:
    """Return a sure pose that as many sensors meet as the best one, two at most; else None."""
    agree = min(int(np.count_nonzero(best.used.met)), 2)
    least = data.rules.acceptance.log_doubt
    alone = data.alone(views=leftover.views, static_views=(), starts=())
    for pose in _sure_poses(alone, leftover):
        is_likely = _by_misses(best, pose, data) > least
        is_likely = is_likely or mirror_odds(data, best, pose)[0] > -least
        if is_likely and np.count_nonzero(pose.matches.met) >= agree:
            return pose
    return None


def _may_be_elsewhere(data: Frame, best: ScoredPose, leftover: SeenTogether) -> list[View]:
    """Return sensors that miss a pose met by one alone, and may see the body elsewhere."""
    if (best.matches.dimensions != 2).any():
        return []
    names, needed = unconfirming_sensors(best, data.rules.acceptance), np.count_nonzero(data.free)
    views = [
        view
        for view in leftover.views
        if view.name in names and view.observation.cells * view.sensor.dimension > needed
    ]
    return views if _is_in_turn(data, views) else []


def _is_in_turn(data: Frame, views: Sequence[View]) -> bool:
    """Test whether views have more detections than those searched in vain, or are due again."""
    track = data.track
    is_more = any(view.observation.cells > track.tried.get(view.name, 0) for view in views)
    again = track.is_in_turn(data.frame, data.rules.proposals.static)
    return bool(views) and (is_more or track.doubted or again)


def _most_tried(data: Frame, views: Sequence[View]) -> dict[str, int]:
    """Return the largest number of detections by view that were searched in vain."""
    tried = data.track.tried
    return {view.name: max(view.observation.cells, tried.get(view.name, 0)) for view in views}


def _sure_pose_by(data: Frame, views: Sequence[View]) -> ScoredPose | None:
    """Return a pose that is sure by views alone that see nothing of the best pose; else None."""
    together = SeenTogether(views, data.rules.judgement, data.rules.search)
    alone = data.alone(views=views, static_views=(), starts=()).changed(options=data.options)
    return next(_sure_poses(alone, together), None)


def _previous_second(data: Frame, best: ScoredPose, leftover: SeenTogether) -> ScoredPose | None:
    """Judge the second pose of the frame before in this frame."""
    if data.track.log_odds_twice == -math.inf or not leftover.views:
        return None
    predecessor = data.predecessor(best.T_world_object)
    # another prediction, even right beside that of the best pose
    others = [branch for branch in data.predictions if branch is not predecessor]
    if not others:
        return None
    start = Start(others[0].T_world_object, others[0].uncertainty)
    likelihood = likelihood_of(data.changed(views=leftover.views, static_views=(), starts=()))
    return likelihood.judge(likelihood.fit(start), start)


def _sure_poses(alone: Frame, leftover: SeenTogether) -> Iterator[ScoredPose]:
    """Yield candidates of a search, fitted and judged, that are sure by themselves."""
    likelihood = likelihood_of(alone)
    candidates: Sequence[Copy | Candidate]
    if len(leftover.views) > 1:  # quickly, by triangulated points
        candidates = leftover.copies_of(alone.body, alone.free)
    else:
        candidates = candidates_of(alone)
    for candidate in candidates[: alone.rules.proposals.seconds]:
        start = Start(candidate.T_world_object, alone.close_uncertainty)
        pose = likelihood.judge(likelihood.fit(start), start)
        if is_sure(pose, alone.free, alone.rules.acceptance):
            yield replace(pose, proposer=SECOND_POSE)
