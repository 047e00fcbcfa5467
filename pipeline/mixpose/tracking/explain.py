"""Poses that may explain what is left of a frame for one body, and the verdict on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from mixpose.fit import Fit
from mixpose.judgement import (
    APART,
    ScoredPose,
    Verdict,
    contradict,
    convinces,
    decide,
    insert,
    is_possible,
    is_sure,
)
from mixpose.tracking.claims import Claim, Unclaimed, claims_of
from mixpose.tracking.frame import Frame
from mixpose.tracking.likelihood import Likelihood, Start, likelihood_of
from mixpose.tracking.proposers import reason
from mixpose.tracking.recognition import (
    ALONE,
    MIRRORED,
    TRIANGLE,
    is_alone,
    is_known,
    is_reflection,
)
from mixpose.tracking.tracked_body import TrackedBody


@dataclass(frozen=True, eq=False)
class Explanation:
    """What one body makes of what is left of a frame.

    Attributes
    ----------
    tracked : TrackedBody
    frame : Frame
    left : Unclaimed
        What `frame` has of all that was seen.
    ranked : tuple of ScoredPose
        Distinct poses, most evident first.
    tried : int
        How many of the proposers were asked.
    fits : tuple of Fit
        That were judged.
    likelihood : Likelihood or None
        None where nothing was seen.
    """

    tracked: TrackedBody
    frame: Frame
    left: Unclaimed
    ranked: tuple[ScoredPose, ...] = ()
    tried: int = 0
    fits: tuple[Fit, ...] = ()
    likelihood: Likelihood | None = None

    @property
    def is_possible(self) -> bool:
        """Whether the best pose is worth telling."""
        rules = self.tracked.rules.acceptance
        return bool(self.ranked) and is_possible(self.ranked[0], self.frame.free, rules)

    @property
    def convinces(self) -> bool:
        """Whether the best pose, near its prediction, needs no other to compare with."""
        rules = self.tracked.rules.acceptance
        return bool(self.ranked) and convinces(self.ranked[0], self.frame.free, rules)

    @property
    def is_sure(self) -> bool:
        """Whether the verdict is ok."""
        return self.verdict.status == "ok"

    @property
    def evidence(self) -> float:
        """Log odds of the best pose."""
        return self.ranked[0].log_evidence

    @cached_property
    def claims(self) -> Mapping[str, Claim]:
        """The detections that the best pose meets, by sensor."""
        return claims_of(self.ranked[0], self.left)

    @cached_property
    def verdict(self) -> Verdict:
        """The decision about the frame, and why it is in doubt."""
        return _verdict(self)


def explain(
    tracked: TrackedBody,
    frame: Frame,
    left: Unclaimed,
    before: Explanation | None = None,
    *,
    quickly: bool = False,
) -> Explanation:
    """Distinct poses that may explain a frame, most evident first: propose, fit, judge.

    Parameters
    ----------
    tracked : TrackedBody
    frame : Frame
    left : Unclaimed
        The views of `frame`.
    before : Explanation or None
        Of the same frame, by the first proposers, after which the others go on.
    quickly : bool
        Whether to stop where the body is not convincing where it is expected.
    """
    begun = before or Explanation(tracked, frame, left)
    if not frame.views or begun.tried == len(tracked.proposers):
        return begun
    likelihood = begun.likelihood or likelihood_of(frame)
    ranked, fits = list(begun.ranked), list(begun.fits)

    def consider(start: Start, name: str) -> ScoredPose | None:
        fit = likelihood.fit(start)
        if start.T_moved is None and any(fit is one for one in fits):
            return None  # judged before, and by the same prior
        fits.append(fit)
        judged = replace(likelihood.judge(fit, start), proposer=name, blurs=fit.blurs)
        insert(ranked, judged, tracked.body, frame.free, tracked.rules.acceptance)
        return judged

    def explained(tried: int) -> Explanation:
        return Explanation(tracked, frame, left, tuple(ranked), tried, tuple(fits), likelihood)

    for k, propose in enumerate(tracked.proposers[begun.tried :], begun.tried):
        for start in propose(frame, ranked):
            judged = consider(start, propose.__name__)
            if judged is None:
                continue
            for refine in tracked.refinements:
                for better in refine(frame, likelihood, judged):
                    consider(better, refine.__name__)
        if quickly and k == 0 and not (first := explained(1)).convinces:
            return first
    return explained(len(tracked.proposers))


def explain_by(
    tracked: TrackedBody,
    frame: Frame,
    left: Unclaimed,
    poses: Sequence[ScoredPose],
    *,
    fitted: bool,
) -> Explanation:
    """Poses judged by other views, and fitted to them, most evident first."""
    ranked: list[ScoredPose] = []
    likelihood = likelihood_of(frame)
    for one in poses if frame.views else ():
        start = Start(one.T_world_object, frame.close if fitted else None, left_out=one.left_out)
        fit = likelihood.fit(start)
        blurs = fit.blurs or one.blurs
        judged = replace(likelihood.judge(fit, start), proposer=one.proposer, blurs=blurs)
        insert(ranked, judged, tracked.body, frame.free, tracked.rules.acceptance)
    return Explanation(tracked, frame, left, tuple(ranked), len(tracked.proposers))


def _verdict(found: Explanation) -> Verdict:
    frame, rules = found.frame, found.tracked.rules.acceptance
    verdict = decide(found.ranked, frame.free, rules)
    best = verdict.best
    if best is None:
        return verdict
    if verdict.status != "ok":
        rivals = [one for one, _ in verdict.kept if one is not best]
        if why := reason(frame, best, rivals):
            return replace(verdict, doubt=why)
    # a sure pose that has rivals may have them for a reason that can be told
    if not is_sure(best, frame.free, rules):
        return verdict
    return verdict.doubted(_doubt(found, best, has_rivals=verdict.status != "ok"))


def _doubt(found: Explanation, best: ScoredPose, *, has_rivals: bool) -> str:
    """Why a pose that is sure by itself is in doubt all the same; empty where it is not."""
    frame, rules = found.frame, found.tracked.rules
    if is_reflection(frame, best):
        return MIRRORED
    before, noise = frame.track.residuals.total, rules.judgement.noise
    if contradict(best, before, frame.track.agreed, rules.acceptance, noise):
        return APART
    if has_rivals:
        return ""
    if not is_known(frame, best):
        return TRIANGLE
    return ALONE if is_alone(frame, best, found.left.sensors) else ""
