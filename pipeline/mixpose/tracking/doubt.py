"""Why a pose that is sure by itself is in doubt: what was seen may not be the body.

Other things, or another body of the session, may have three markers in the same places.  What
looks like the body by chance does so for several frames: what the track expects then tells nothing.
The mirror image of the body is a rival where features are missed beside detections that belong to
none, reflected in the plane nearest to those met; of few in the first frames, wherever it is.  That
the session tells it as its mirror image is a mistake like others: what frames say of it adds up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np

from mixpose.body import mirror_image, thickness
from mixpose.judgement import (
    APART,
    Alternative,
    Mistake,
    ScoredPose,
    Shape,
    Verdict,
    decide,
    has_two_agreeing,
    is_far_off,
    is_open,
    is_seen_elsewhere,
    is_sure,
    odds_of_mistakes,
    possible_mistakes,
    shape_shown,
)
from mixpose.records import Floats, Mask
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.likelihood import likelihood_of
from mixpose.tracking.mirrors import IN_A_MIRROR, MIRRORED, is_flat, mirrored
from mixpose.tracking.proposers import candidates_of, reason, starts_at
from mixpose.tracking.rivals import odds_beside

TWICE = (
    "the body seems to be there twice: a mirror image, one more (`count`), or another like it, "
    "which may be an [[object]] of its own"
)
FEW = "few markers are met, which other things may have alike"
UNSURE = "no frame by itself is sure of the body"
CONTRADICTION = "one sensor or another"  # by which name it is remembered
CHANGED = "features are met much farther off than in the frames before"
OPEN = "features that would fix it are hidden or cut"


def decided(data: Frame, ranked: Sequence[ScoredPose]) -> Verdict:
    """The decision about a frame by its poses, the most evident first, and why it is in doubt."""
    given = data.free, data.rules.acceptance, partial(odds_beside, data)
    verdict = decide(ranked, *given)
    if len(verdict.kept) > 1 and (images := _in_mirrors(data, verdict)):
        verdict = decide([one for one in ranked if one not in images], *given)
    best = verdict.best
    if best is None:
        return verdict
    told, shape = _told(data, best)
    verdict = replace(verdict, shape=shape)
    if verdict.status != "ok":
        rivals = [one for one, _ in verdict.kept if one is not best]
        why = reason(data, best, rivals)
        if why := why or next(filter(None, (_seen_beside(best, one) for one in rivals)), ""):
            clutter, *others = verdict.against
            named = [one._replace(what=why) for one in others]
            return replace(verdict, against=(clutter, *named))
    # a sure pose that has rivals may have them for a reason that can be told
    if not is_sure(best, data.free, data.rules.acceptance):
        return verdict
    rules, sensors = data.rules, {view.name: view.sensor for view in data.still or data.views}
    own = _of_contradiction(data, best), of_reflection(data, best)
    names = {one.name for one in own}
    before = {name: odds for name, odds in data.track.mistaken.items() if name not in names}
    known = rules.judgement.noise, sensors, before
    mistakes = [*possible_mistakes(best, data.body, data.free, *known), *own]
    # one frame in as many as there are sessions with a mistake may be of another kind
    most = _most_told(data)
    mistaken = {
        one.name: max(min(one.log_odds, most), -most)
        for one in mistakes
        if one.log_odds > 0 or one.name == MIRRORED
    }
    against = _alternatives(data, best, mistakes, told)
    # what lasts shows in frames like those before; one that is not is a doubled image, or the like
    is_usual = best.residual_ratio <= rules.acceptance.changed
    return replace(verdict, mistaken=mistaken if is_usual else None).doubted(against)


def _seen_beside(a: ScoredPose, b: ScoredPose) -> str:
    """In words, what two poses are that are likely, and meet detections of their own; else empty.

    What is there twice some sensor sees twice; where each sees one of them, one stands elsewhere.
    """
    if min(a.log_evidence, b.log_evidence) <= 0 or a.matches.names != b.matches.names:
        return ""
    if _meet_the_same(a, b):
        return ""
    met, other = (np.count_nonzero(one.matches.detections >= 0, axis=1) for one in (a, b))
    return TWICE if np.minimum(met, other).sum() >= 0.5 * other.sum() else APART


def _meet_the_same(a: ScoredPose, b: ScoredPose) -> bool:
    """Whether two poses of a frame explain the same detections, half of what the first one meets.

    What is not in view twice may be turned in two ways, and is in no mirror.
    """
    if a.matches.names != b.matches.names:
        return False
    pairs = zip(a.matches.detections, b.matches.detections, strict=True)
    shared = sum(np.isin(one[one >= 0], other).sum() for one, other in pairs)
    return bool(shared >= 0.5 * np.count_nonzero(a.matches.detections >= 0))


def _in_mirrors(data: Frame, verdict: Verdict) -> list[ScoredPose]:
    """Poses that show others in a mirror."""
    images = list[ScoredPose]()
    for (one, _), (other, _) in combinations(verdict.kept, 2):
        if _meet_the_same(one, other):
            continue
        odds, is_first = mirrored(data, one, other)
        if odds > -data.rules.acceptance.log_doubt:
            images.append(other if is_first else one)
    return images


def _alternatives(
    data: Frame, best: ScoredPose, mistakes: Sequence[Mistake], told: float
) -> Iterator[Alternative]:
    """What else a frame may show that a sure pose is told from."""
    rules, noise = data.rules.acceptance, data.rules.judgement.noise
    if data.options.mirrors and is_flat(data):
        known = data.other_at(best.T_world_object)  # where it was seen beside its mirror image
        yield Alternative(IN_A_MIRROR, 0.0 if known is None else known)
    yield Alternative(FEW, of_other_things(data, best))
    yield Alternative(UNSURE, _of_chance_that_lasts(best, told))
    # of a scene with mirrors nobody knows which side a frame shows
    of_image = 0.5 if data.options.mirrors else rules.mistaken
    likely = [of_image if one.name == MIRRORED else rules.mistaken for one in mistakes]
    yield from map(Alternative, (one.what for one in mistakes), odds_of_mistakes(mistakes, likely))
    if best.residual_ratio > rules.changed:
        yield Alternative(CHANGED)
    if is_open(best, data.free, rules, noise):
        yield Alternative(OPEN)


def _of_chance_that_lasts(best: ScoredPose, told: float) -> float:
    """Log odds of clutter where no frame was ok before: what looks like the body goes on to do so.

    What is `told` of the body counts, by a frame itself or by all that go on from each other.
    """
    more = best.log_evidence - told
    # beyond that of clutter, which counts already
    return math.log(-math.expm1(-more)) - told if more > 0 else -math.inf


def _told(data: Frame, best: ScoredPose) -> tuple[float, Shape | None]:
    """Log odds of the body against clutter that lasts, and `Track.shape` with a frame.

    A pose that nobody expected goes by its frame alone; that of a frame which is sure by itself
    needs no others.
    """
    track, T, rules = data.track, best.T_world_object, data.rules
    if track.believed:
        return math.inf, None
    alone = best.log_evidence
    if track.frame is not None:
        alone = _evidence(data.alone(), Start(T, left_out=best.left_out))
    if alone > -rules.acceptance.log_doubt:
        return alone, None
    before = track.shape if not track.misses and data.is_expected(T) else None
    model = rules.judgement.noise
    shape = shape_shown(best.used, best.variances, data.body, T, alone, model, before)
    return shape.log_odds(data.body.radius, model), shape


def _gained(data: Frame, best: ScoredPose) -> float:
    """How much likelier the frames before make a pose, in nats."""
    return max(data.prior(best.T_world_object)[0] - data.anywhere[0], 0.0)


def of_other_things(data: Frame, judged: ScoredPose) -> float:
    """Log odds of another thing that has what is met of the body alike, and nothing else.

    Three markers are alike where three lengths between them are, and each further one as well.  A
    sensor of several may meet one by chance.  It is not where the body is expected.
    """
    seen, rules = judged.matches, data.rules
    if 1 in seen.dimensions.tolist():  # which are no markers in space
        return -math.inf
    met = np.minimum(seen.met_by / max(len(data.views) / 2, 1), 1).sum()
    in_view = np.count_nonzero(seen.weights, axis=0)
    covered = np.minimum(in_view, 2)[seen.met_by == 0].sum()
    odds = 3 * (met - 2) * math.log(rules.look_alikes.alike)
    odds -= covered * rules.judgement.detection.log_missed
    return float(odds - (_gained(data, judged) if data.track.known else 0.0))


def _most_told(data: Frame) -> float:
    """Log odds of a mistake that frames tell at the most."""
    return 2 * _as_likely_as_not(data)


def _of_contradiction(data: Frame, judged: ScoredPose) -> Mistake:
    """That a sensor is elsewhere or out of step, and nobody knows which: as likely as not.

    From a frame on in which one alone meets the body and another sees as much of it elsewhere, and
    until two agree.  A pose between them is farther off than chance makes it.
    """
    track, known = data.track, (data.rules.acceptance, data.rules.judgement.noise)
    before = track.mistaken.get(CONTRADICTION, 0.0)
    if is_seen_elsewhere(judged, _noise_before(data, judged), track.agreed, *known):
        before = _as_likely_as_not(data)
    elif before and has_two_agreeing(judged, *known):
        before = 0.0
    return Mistake(CONTRADICTION, APART, before, 0.0 if before else -math.inf)


def contradicted(data: Frame, verdict: Verdict) -> Verdict:
    """The same, where a sensor sees the body elsewhere than the best pose has it."""
    mistaken = data.track.mistaken if verdict.mistaken is None else verdict.mistaken
    mistaken = {**mistaken, CONTRADICTION: _as_likely_as_not(data)}
    return replace(verdict, mistaken=mistaken).doubted([Alternative(APART)])


def _as_likely_as_not(data: Frame) -> float:
    """Log odds by frames of a mistake that makes up for how few sessions have it."""
    return -math.log(data.rules.acceptance.mistaken)


def of_reflection(data: Frame, judged: ScoredPose) -> Mistake:
    """By how much likelier the body's mirror image is, by this frame and those before it.

    A body is mirrored in all frames or in none, so that the first ones tell against it as well.  A
    mirror in the scene shows it in one frame and not in another.
    """
    track, lasts = data.track, not data.options.mirrors
    before = track.mistaken.get(MIRRORED, 0.0) if lasts else 0.0
    is_early = track.believed < data.rules.proposals.believed
    asked = before > 0 or (lasts and is_early and before > -_most_told(data))
    odds = _reflected(data, judged, asked, before)
    if odds == -math.inf:  # what is known of it holds
        return Mistake(MIRRORED, MIRRORED, before, -math.inf)
    return Mistake(MIRRORED, MIRRORED, before + odds, 0.0)


def _reflected(data: Frame, judged: ScoredPose, asked: bool, before: float) -> float:
    """Log odds by this frame, with those `before`; minus infinity where it cannot be.

    What is not likely is looked for only where it is `asked` for.
    """
    rules, seen, T = data.rules, judged.matches, judged.T_world_object
    # where a turn brings it onto its mirror image no camera tells one side's markers
    can_be = data.body.is_exact and thickness(data.body) >= 1e-6
    if "mirrored" not in rules.look_alikes.kinds or not can_be:
        return -math.inf
    accepted, met, near = rules.acceptance, seen.met_by, -math.inf
    own = judged.log_evidence
    likely = accepted.log_doubt - math.log(accepted.mistaken) - before
    # of these the mirror image may meet more than the body
    if asked or sum(np.minimum(seen.missed, seen.unmatched_nearby).tolist()) > 0.5:
        # one camera alone may have met a feature by chance
        sharp = met >= min(2, met.max())
        there = _mirrored(data, sharp if sharp.sum() >= 3 else met > 0)
        # no rival meets less than a quarter of what the body meets; values grow as the square
        value = float(data.finest.weights[:, 0] @ seen.explained)
        if asked or there.finest.value(T) > value / 16:
            # fitted, which may end at clutter, and where it is asked for as it stands
            rival = data.rival(judged, T, data.close, ahead=likely)
            starts = [rival, *([Start(T)] if asked else [])]
            near = max([_evidence(there, one) for one in starts]) - own
            if near > likely:
                return near
    if not _is_by_chance(data, judged):
        return near if asked else -math.inf
    # wherever it is found, and nothing known of either; the first guesses meet what explains more
    alone = data.alone()
    own = _evidence(alone, Start(T, left_out=judged.left_out))
    if own == -math.inf:  # by itself, as where only its motion tells what rows saw, it meets none
        return near if asked else -math.inf
    mirror = _mirrored(alone, met >= 0)
    rivals = [one for one in candidates_of(mirror) if one.evidence > own - rules.search.outdone]
    found = (_evidence(mirror, start) - own for start in starts_at(mirror, rivals))
    return next((odds for odds in found if odds > likely), near if asked else -math.inf)


def _is_by_chance(data: Frame, judged: ScoredPose) -> bool:
    """Whether features may be met by chance: few, others missed or these far off, early on."""
    rules, seen, track = data.rules, judged.matches, data.track
    are_few = judged.measurements - 6 <= rules.look_alikes.by_chance
    if not are_few or track.believed >= rules.proposals.believed or (seen.dimensions != 2).any():
        return False
    is_missed, noise = (seen.missed > 0.5).any(), rules.judgement.noise
    return bool(is_missed) or is_far_off(seen, _noise_before(data, judged), rules.acceptance, noise)


def _noise_before(data: Frame, judged: ScoredPose) -> Floats:
    """Squares and degrees of freedom (2,) that sensors of a pose have left so far."""
    return np.asarray(data.track.residuals.of(judged.matches.names).sum(axis=1))


def _evidence(data: Frame, start: Start) -> float:
    likelihood = likelihood_of(data)
    return likelihood.judge(likelihood.fit(start), start).log_evidence


def _mirrored(data: Frame, chosen: Mask) -> Frame:
    """The frame, of the body reflected in the plane nearest to some of its features (N,)."""
    return data.of_body(mirror_image(data.body, frozenset(np.flatnonzero(chosen).tolist())))
