"""Find reasons to doubt a pose that is sure by itself: what was seen may not be the body.

Other things, or another body of the session, may have three markers in the same places.  What looks
like the body by chance does so for several frames: the track's expectation is no evidence then.
The mirror image of the body, reflected in the plane nearest to the met features, is a rival where
features are missed beside unmatched detections; of few features in the first frames, wherever it
is.  The session may describe the body's mirror image: evidence of this mistake adds up over frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import combinations

import numpy as np

from mixpose.body import mirror_image, other_tilt, thickness
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
from mixpose.records import Floats, Mask, replace
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.likelihood import likelihood_of
from mixpose.tracking.mirrors import IN_A_MIRROR, MIRRORED, is_flat, mirror_odds
from mixpose.tracking.proposers import candidates_of, reason, starts_at
from mixpose.tracking.rivals import log_odds_against

TWICE = (
    "the body seems to be there twice: a mirror image, one more (`count`), or another like it, "
    "which may be an [[object]] of its own"
)
FEW = "few markers are met, which other things may have alike"
UNSURE = "no frame by itself is sure of the body"
CONTRADICTION = "one sensor or another"  # its name in `Track.mistaken`
CHANGED = "features are met much farther off than in the frames before"
OPEN = "features that would fix it are hidden or cut"


def decide_frame(data: Frame, ranked: Sequence[ScoredPose]) -> Verdict:
    """Decide about a frame by its poses, the most evident first, with reasons of doubt."""
    arguments = data.free, data.rules.acceptance, partial(log_odds_against, data)
    verdict = decide(ranked, *arguments)
    if len(verdict.kept) > 1 and (images := _mirror_images(data, verdict)):
        verdict = decide([pose for pose in ranked if pose not in images], *arguments)
    best = verdict.best
    if best is None:
        return verdict
    evidence, shape = _lasting_evidence(data, best)
    verdict = replace(verdict, shape=shape)
    if verdict.status != "ok":
        rivals = [pose for pose, _ in verdict.kept if pose is not best]
        why = reason(data, best, rivals)
        if why := why or next(filter(None, (_contrast(best, pose) for pose in rivals)), ""):
            clutter, *others = verdict.against
            named = [other._replace(what=why) for other in others]
            return replace(verdict, against=(clutter, *named))
    # a sure pose may have rivals for a reason that can be reported
    if not is_sure(best, data.free, data.rules.acceptance):
        return verdict
    rules, views = data.rules, data.static_views or data.views
    tracked = _contradiction_mistake(data, best), reflection_mistake(data, best)
    names = {mistake.name for mistake in tracked}
    before = {name: mistake for name, mistake in data.track.mistaken.items() if name not in names}
    known = rules.judgement.noise, {view.name: view.sensor for view in views}, before
    mistakes = [*possible_mistakes(best, data.body, data.free, *known), *tracked]
    against = _alternatives(data, best, mistakes, evidence)
    return replace(verdict, mistaken=_mistaken_after(data, best, mistakes)).doubted(against)


def _mistaken_after(
    data: Frame, best: ScoredPose, mistakes: Sequence[Mistake]
) -> dict[str, Mistake]:
    """Return what is known of mistakes in the session after a frame, by name."""
    track = data.track
    if best.residual_ratio > data.rules.acceptance.changed:
        # an unusual frame, which may be a doubled image, for example, tells sizes alone
        sizes = {mistake.name: mistake for mistake in mistakes if mistake.lasting}
        for name, mistake in sizes.items():
            least = min(mistake.log_odds, track.log_odds_mistaken(name))
            sizes[name] = mistake._replace(log_odds=least)
        return {**track.mistaken, **sizes}
    # a single frame may mislead as rarely as a session is mistaken
    most, least = 2 * _even_odds(data), -_even_odds(data)
    return {
        mistake.name: mistake._replace(log_odds=max(min(mistake.log_odds, most), -most))
        for mistake in mistakes
        if mistake.log_odds > 0
        or mistake.name == MIRRORED
        or (mistake.lasting and mistake.log_odds > least)
    }


def _contrast(a: ScoredPose, b: ScoredPose) -> str:
    """Return why two likely poses that meet different detections exclude each other; else empty.

    A body that is there twice is seen twice by some sensor; else a sensor has moved.
    """
    if min(a.log_evidence, b.log_evidence) <= 0 or a.matches.names != b.matches.names:
        return ""
    if _are_alike(a, b):
        return ""
    met, other = (np.count_nonzero(pose.matches.detections >= 0, axis=1) for pose in (a, b))
    return TWICE if np.minimum(met, other).sum() >= 0.5 * other.sum() else APART


def _are_alike(a: ScoredPose, b: ScoredPose) -> bool:
    """Test whether poses share half of the first's detections: two tilts, and none in a mirror."""
    if a.matches.names != b.matches.names:
        return False
    pairs = zip(a.matches.detections, b.matches.detections, strict=True)
    shared = sum(np.isin(first[first >= 0], second).sum() for first, second in pairs)
    return bool(shared >= 0.5 * np.count_nonzero(a.matches.detections >= 0))


def _mirror_images(data: Frame, verdict: Verdict) -> list[ScoredPose]:
    """Return poses that are mirror images of others."""
    images = list[ScoredPose]()
    for (first, _), (second, _) in combinations(verdict.kept, 2):
        if _are_alike(first, second):
            continue
        odds, is_first = mirror_odds(data, first, second)
        if odds > -data.rules.acceptance.log_doubt:
            images.append(second if is_first else first)
    return images


def _alternatives(
    data: Frame, best: ScoredPose, mistakes: Sequence[Mistake], evidence: float
) -> Iterator[Alternative]:
    """Yield other explanations of a frame with a sure pose, with their log odds.

    `evidence` is against clutter in all frames before the first ok one, see `_lasting_evidence`.
    """
    rules, noise = data.rules.acceptance, data.rules.judgement.noise
    if data.options.mirrors and is_flat(data):
        known = data.log_odds_other_at(best.T_world_object)  # None unless both were seen
        yield Alternative(IN_A_MIRROR, 0.0 if known is None else known)
    yield Alternative(FEW, log_odds_other(data, best))
    # clutter that looks like the body in all frames so far, beyond its odds, which count already
    more = best.log_evidence - evidence
    yield Alternative(UNSURE, math.log(-math.expm1(-more)) - evidence if more > 0 else -math.inf)
    # in a scene with mirrors a frame may show either side
    of_image = 0.5 if data.options.mirrors else rules.mistaken
    likely = [of_image if mistake.name == MIRRORED else rules.mistaken for mistake in mistakes]
    reasons = [mistake.what for mistake in mistakes]
    yield from map(Alternative, reasons, odds_of_mistakes(mistakes, likely))
    if best.residual_ratio > rules.changed:
        yield Alternative(CHANGED)
    if is_open(best, data.free, rules, noise):
        yield Alternative(OPEN)


def _lasting_evidence(data: Frame, best: ScoredPose) -> tuple[float, Shape | None]:
    """Return log odds of the body against lasting clutter, and `Track.shape` after this frame.

    An unexpected pose counts by its frame alone; so does one whose frame is sure by itself.
    """
    track, T, rules = data.track, best.T_world_object, data.rules
    if track.ok_count:
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


def log_odds_other(data: Frame, judged: ScoredPose) -> float:
    """Return log odds of another thing that has exactly the met features alike.

    Three markers are alike if three distances between them are, and so for each further one.  One
    sensor of several may meet a marker by chance.  Another thing is not where the body is expected.
    """
    matches, rules = judged.matches, data.rules
    if 1 in matches.dimensions.tolist():  # single ranges show no markers in space
        return -math.inf
    met = np.minimum(matches.met_by / max(len(data.views) / 2, 1), 1).sum()
    in_view = np.count_nonzero(matches.weights, axis=0)
    covered = np.minimum(in_view, 2)[matches.met_by == 0].sum()
    odds = 3 * (met - 2) * math.log(rules.look_alikes.alike)
    odds -= covered * rules.judgement.detection.log_missed
    if data.track.is_identified:
        odds -= max(data.prior(judged.T_world_object)[0] - data.flat_prior[0], 0.0)
    return float(odds)


def _contradiction_mistake(data: Frame, judged: ScoredPose) -> Mistake:
    """Return the mistake that some sensor is elsewhere or out of step, at even odds.

    It begins with a frame in which one sensor alone meets the body and another sees as much
    elsewhere, and lasts until two agree.  A pose between them is farther off than by chance.
    """
    track, rules = data.track, (data.rules.acceptance, data.rules.judgement.noise)
    before = track.log_odds_mistaken(CONTRADICTION)
    known = _noise_before(data, judged), track.sensors_agreed
    if is_seen_elsewhere(judged, *known, *rules, data.body.is_exact):
        before = _even_odds(data)
    elif before and has_two_agreeing(judged, *rules):
        before = 0.0
    return Mistake(CONTRADICTION, APART, before, 0.0 if before else -math.inf)


def contradicted(data: Frame, verdict: Verdict) -> Verdict:
    """Return the verdict, doubted because a sensor sees the body elsewhere than the best pose."""
    mistaken = data.track.mistaken if verdict.mistaken is None else verdict.mistaken
    mistake = Mistake(CONTRADICTION, APART, _even_odds(data), 0.0)
    mistaken = {**mistaken, CONTRADICTION: mistake}
    return replace(verdict, mistaken=mistaken).doubted([Alternative(APART)])


def _even_odds(data: Frame) -> float:
    """Return log odds by frames that make a mistake as likely as not, whatever its prior."""
    return -math.log(data.rules.acceptance.mistaken)


def reflection_mistake(data: Frame, judged: ScoredPose) -> Mistake:
    """Return the mistake that the session describes the body's mirror image, with its evidence.

    A body is mirrored in all frames or in none, so that the first ones count against it too.  A
    mirror in the scene shows it in one frame and not in another.
    """
    track, lasts = data.track, not data.options.mirrors
    before = track.log_odds_mistaken(MIRRORED) if lasts else 0.0
    is_early = track.ok_count < data.rules.proposals.believed and before > -2 * _even_odds(data)
    # one sensor sees hardly more of a reversed depth than larger residuals
    is_far = len(judged.used.images) == 1 and judged.residual_ratio > 1
    is_asked = before > 0 or is_early or is_far
    odds = _log_odds_reflected(data, judged, is_asked, before)
    if odds == -math.inf:  # earlier evidence stays
        return Mistake(MIRRORED, MIRRORED, before, -math.inf)
    return Mistake(MIRRORED, MIRRORED, before + odds, 0.0)


def _log_odds_reflected(data: Frame, judged: ScoredPose, is_asked: bool, before: float) -> float:
    """Return log odds of the mirror image by this frame; minus infinity where it is impossible.

    An unlikely mirror image is only sought where it `is_asked` for.
    """
    rules = data.rules
    # a body that a turn maps onto its mirror image looks the same as that in every camera
    can_be = data.body.is_exact and thickness(data.body) >= 1e-6
    if "mirrored" not in rules.look_alikes.kinds or not can_be:
        return -math.inf
    likely = rules.acceptance.log_doubt - math.log(rules.acceptance.mistaken) - before
    alone = _Alone(data, judged)
    near = _log_odds_near(alone, is_asked, likely)
    if near > likely:
        return near
    otherwise = near if is_asked else -math.inf
    # e.g. rolling shutters: without its motion the body meets nothing
    if not _is_by_chance(data, judged) or alone.evidence == -math.inf:
        return otherwise
    return next((odds for odds in _log_odds_anywhere(alone) if odds > likely), otherwise)


@dataclass(frozen=True, eq=False)
class _Alone:
    """A frame by itself, with nothing known but noise, beside the frame of a track."""

    tracked: Frame
    judged: ScoredPose

    @cached_property
    def frame(self) -> Frame:
        """Return the frame with nothing from the frames before."""
        return self.tracked.alone()

    @cached_property
    def evidence(self) -> float:
        """Return the evidence of the pose in it."""
        start = Start(self.judged.T_world_object, left_out=self.judged.left_out)
        return _evidence(self.frame, start)


def _log_odds_near(alone: _Alone, is_asked: bool, likely: float) -> float:
    """Return log odds of the mirror image where the body is; −∞ where it is not worth a look."""
    data, judged = alone.tracked, alone.judged
    matches, T, met = judged.matches, judged.T_world_object, judged.matches.met_by
    # missed features beside unmatched detections: a mirror image may meet more than the body
    if not is_asked and sum(np.minimum(matches.missed, matches.unmatched_nearby).tolist()) <= 0.5:
        return -math.inf
    # one camera alone may have met a feature by chance
    sharp = met >= min(2, met.max())
    features = _numbers(sharp if sharp.sum() >= 3 else met > 0)
    mirror = _reflected_frame(data, features)
    # rivals meet at least a quarter of the body's features; values grow as the square
    value = float(data.finest.weights[:, 0] @ matches.explained)
    if not is_asked and mirror.finest.value(T) <= value / 16:
        return -math.inf
    # fitted, which may end at clutter; and as it stands, if asked for
    rival = data.rival(judged, T, data.close_uncertainty, ahead=likely)
    starts = [rival, *([Start(T)] if is_asked else [])]
    odds = max([_evidence(mirror, start) for start in starts]) - judged.log_evidence
    # at rest, late sensors meet moving bodies elsewhere; two features have no tilt
    can_tilt = len(features) > 2 and not data.is_timed
    if is_asked and can_tilt and alone.evidence > -math.inf:
        # with its depth reversed; the track followed the body, and not this one
        by_shift = judged.used.J[..., :3].reshape(-1, 3)
        across = np.linalg.eigh(by_shift.T @ by_shift)[1][:, 0]  # in which shifts are seen least
        T_reversed = other_tilt(data.body, features, T, across)
        start = Start(T_reversed, alone.frame.close_uncertainty)
        odds = max(odds, _evidence(_reflected_frame(alone.frame, features), start) - alone.evidence)
    return odds


def _log_odds_anywhere(alone: _Alone) -> Iterator[float]:
    """Yield log odds of the mirror image wherever it is found, with nothing known of either."""
    mirror = _reflected_frame(alone.frame, _numbers(alone.judged.matches.met_by >= 0))
    # the first guesses meet the better of the two
    least = alone.evidence - alone.tracked.rules.search.outdone
    rivals = [rival for rival in candidates_of(mirror) if rival.evidence > least]
    for start in starts_at(mirror, rivals):
        yield _evidence(mirror, start) - alone.evidence


def _is_by_chance(data: Frame, judged: ScoredPose) -> bool:
    """Test whether few features are met in the first frames, others missed or these far off."""
    rules, matches, track = data.rules, judged.matches, data.track
    are_few = judged.measurements - 6 <= rules.look_alikes.by_chance
    if not are_few or track.ok_count >= rules.proposals.believed or (matches.dimensions != 2).any():
        return False
    is_missed, before = (matches.missed > 0.5).any(), _noise_before(data, judged)
    return bool(is_missed) or is_far_off(matches, before, rules.acceptance, rules.judgement.noise)


def _noise_before(data: Frame, judged: ScoredPose) -> Floats:
    """Return squares and degrees of freedom (2,) of residuals of a pose's sensors so far."""
    return np.asarray(data.track.residuals.of(judged.matches.names).sum(axis=1))


def _evidence(data: Frame, start: Start) -> float:
    likelihood = likelihood_of(data)
    return likelihood.judge(likelihood.fit(start), start).log_evidence


def _reflected_frame(data: Frame, features: frozenset[int]) -> Frame:
    """Return the frame for the body reflected in the plane nearest to some features."""
    return data.with_body(mirror_image(data.body, features))


def _numbers(chosen: Mask) -> frozenset[int]:
    """Return the numbers of chosen features (N,)."""
    return frozenset(np.flatnonzero(chosen).tolist())
