"""Why a pose that is sure by itself is in doubt: what was seen may not be the body.

Other things, or another body of the session, may have three markers in the same places.  What
looks like the body by chance does so for several frames: what the track expects then tells nothing.
The mirror image of the body is a rival where features are missed beside detections that belong to
none, reflected in the plane nearest to those met; of few in the first frames, wherever it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from mixpose.body import like_features, mirror_image, thickness, tolerance_of
from mixpose.judgement import (
    APART,
    ScoredPose,
    Verdict,
    contradict,
    decide,
    is_far_off,
    is_open,
    is_sure,
)
from mixpose.records import Mask
from mixpose.tracking.frame import Frame
from mixpose.tracking.likelihood import Start, likelihood_of
from mixpose.tracking.proposers import candidates_of, met_features, reason, starts_at
from mixpose.tracking.track import Track

TRIANGLE = "three markers are met, which other things may have alike"
ALONE = "one sensor of several meets the body, which none of its frames was sure of by itself"
CHANGED = "features are met much farther off than in the frames before"
OPEN = "features that would fix it are hidden or cut"
MIRRORED = "it shows the body's mirror image"


def decided(data: Frame, ranked: Sequence[ScoredPose]) -> Verdict:
    """The decision about a frame by its poses, the most evident first, and why it is in doubt."""
    verdict = decide(ranked, data.free, data.rules.acceptance)
    best, has_rivals = verdict.best, verdict.status != "ok"
    if best is None:
        return verdict
    rivals = [one for one, _ in verdict.kept if one is not best]
    why = reason(data, best, rivals) if has_rivals else ""
    # a sure pose that has rivals may have them for a reason that can be told
    if not why and is_sure(best, data.free, data.rules.acceptance):
        why = _doubt_about(data, best, has_rivals=has_rivals)
    return verdict.doubted(why)


def _doubt_about(data: Frame, best: ScoredPose, *, has_rivals: bool) -> str:
    """Why a sure pose is in doubt; empty if it is not."""
    rules, track, noise = data.rules.acceptance, data.track, data.rules.judgement.noise
    reasons: dict[str, Callable[[], bool]] = {
        MIRRORED: lambda: is_reflection(data, best),
        APART: lambda: contradict(best, track.residuals.total, track.agreed, rules, noise),
        CHANGED: lambda: best.residual_ratio > rules.changed,
        OPEN: lambda: is_open(best, data.free, rules, noise),
        TRIANGLE: lambda: not has_rivals and not is_known(data, best),
        ALONE: lambda: not has_rivals and _is_alone(data, best),
    }
    return next((why for why, applies in reasons.items() if applies()), "")


def _is_alone(data: Frame, best: ScoredPose) -> bool:
    """Whether one sensor of several meets the body, and is not sure of it by its own frame."""
    met = np.count_nonzero(best.matches.met)
    if data.track.believed or len(data.sensors) < 2 or met != 1:
        return False
    # a pose that is sure for doubtful ones before it alone errs as they do
    gained = max(data.prior(best.T_world_object)[0] - data.anywhere[0], 0.0)
    return best.log_evidence - gained <= data.rules.acceptance.sure


def is_known(data: Frame, judged: ScoredPose) -> bool:
    """Whether a pose is the body's, by what it meets or by where it was expected."""
    are_ranges = 1 in judged.matches.dimensions.tolist()  # which are no markers in space
    others = sorted(judged.matches.met_by.tolist())[:-3]
    # one sensor of several may meet a marker by chance
    if are_ranges or not others or sum(others) >= max(len(data.views) / 2, 1):
        return True
    return (
        data.track.known
        and not data.track.misses
        and bool((data.prior(judged.T_world_object)[1] < data.anywhere[1]).all())
    )


def is_reflection(data: Frame, judged: ScoredPose) -> bool:
    """Whether the frame shows the body's mirror image rather than the body."""
    rules, seen, T = data.rules, judged.matches, judged.T_world_object
    # where a turn brings it onto its mirror image no camera tells one side's markers
    can_be = data.body.is_exact and thickness(data.body) >= 1e-6
    if "mirrored" not in rules.look_alikes.kinds or not can_be:
        return False
    ahead, met = rules.acceptance.standing_out, seen.met_by
    # of these the mirror image may meet more than the body
    if sum(np.minimum(seen.missed, seen.unmatched_nearby).tolist()) > 0.5:
        # one camera alone may have met a feature by chance
        sharp = met >= min(2, met.max())
        there = _mirrored(data, sharp if sharp.sum() >= 3 else met > 0)
        # no rival meets less than a quarter of what the body meets; values grow as the square
        value, own = (one.finest.value(T[None])[0] for one in (there, data))
        start, least = Start(T, data.close), judged.log_evidence + ahead
        if value > own / 16 and _evidence(there, start) > least:
            return True
    if not _is_by_chance(data, judged):
        return False
    # wherever it is found, and nothing known of either; the first guesses meet what explains more
    live, track = replace(data.options, search="live"), Track(residuals=data.track.residuals)
    alone = data.seen_otherwise(predictions=(), beside=None, searches=[], track=track, options=live)
    own, mirror = _evidence(alone, Start(T)), _mirrored(alone, met >= 0)
    rivals = [one for one in candidates_of(mirror) if one.evidence > own - rules.search.outdone]
    return any(_evidence(mirror, start) > own + ahead for start in starts_at(mirror, rivals))


def look_alike_of(data: Frame, best: ScoredPose, others: Iterable[Frame]) -> str:
    """Why all that a pose meets might as well be a part of other bodies, or another of its own.

    `others` are the frames of the bodies in question; empty if it is none of theirs.
    """
    met = met_features(best)
    for other in others:
        rules = other.rules
        limit = best.log_evidence + float(np.log(rules.acceptance.rival))
        tolerance = tolerance_of(data.body, other.body, rules.look_alikes.alike)
        seen = other.seen_otherwise(views=data.views, still=data.still)
        for part in like_features(data.body, met, other.body, tolerance):
            if len(part.features) == len(met):
                T = best.T_world_object @ part.T_body_other
                if _evidence(seen, Start(T, other.close, left_out=best.left_out)) > limit:
                    return part.reason
    return ""


def _is_by_chance(data: Frame, judged: ScoredPose) -> bool:
    """Whether features may be met by chance: few, others missed or these far off, early on."""
    rules, seen, track = data.rules, judged.matches, data.track
    are_few = judged.measurements - 6 <= rules.look_alikes.by_chance
    if not are_few or track.believed >= rules.proposals.believed or (seen.dimensions != 2).any():
        return False
    is_missed, noise = (seen.missed > 0.5).any(), rules.judgement.noise
    return bool(is_missed) or is_far_off(seen, track.residuals.total, rules.acceptance, noise)


def _evidence(data: Frame, start: Start) -> float:
    likelihood = likelihood_of(data)
    return likelihood.judge(likelihood.fit(start), start).log_evidence


def _mirrored(data: Frame, chosen: Mask) -> Frame:
    """The frame, of the body reflected in the plane nearest to some of its features (N,)."""
    return data.seen_otherwise(
        body=mirror_image(data.body, frozenset(np.flatnonzero(chosen).tolist()))
    )
