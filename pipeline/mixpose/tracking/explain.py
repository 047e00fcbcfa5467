"""Poses that may explain what is left of a frame for one body, and the verdict on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from mixpose.fit import Fit
from mixpose.judgement import Checks, ScoredPose, Verdict, assess, decide, insert
from mixpose.records import Mask
from mixpose.tracking.doubt import doubt_about
from mixpose.tracking.likelihood import FrameData, Likelihood, Start, likelihood_of
from mixpose.tracking.proposers.look_alikes import reason

if TYPE_CHECKING:
    from mixpose.tracking.tracker import Tracker


@dataclass(frozen=True, eq=False)
class Explanation:
    """What one body makes of what is left of a frame for it."""

    tracked: Tracker
    frame: FrameData
    sensors: int = 1  # that had a frame, also those that saw nothing
    left: Mask = field(default_factory=lambda: np.ones(0, np.bool_))  # (D,), see `Claims.left`
    ranked: tuple[ScoredPose, ...] = ()  # distinct poses, most evident first
    tried: int = 0  # of the proposers
    fits: tuple[Fit, ...] = ()  # that were judged
    likelihood: Likelihood | None = None  # that they are of

    @cached_property
    def checks(self) -> Checks:
        """What the best pose is worth by itself."""
        rules = self.frame.rules.acceptance
        return assess(self.ranked[0], self.frame.free, rules) if self.ranked else Checks(rules)

    @property
    def evidence(self) -> float:
        """Log odds of the best pose."""
        return self.ranked[0].log_evidence

    @cached_property
    def verdict(self) -> Verdict:
        """The decision about the frame, and why it is in doubt."""
        data = self.frame
        verdict = decide(self.ranked, data.free, data.rules.acceptance)
        best, has_rivals = verdict.best, verdict.status != "ok"
        if best is None:
            return verdict
        if has_rivals:
            rivals = [one for one, _ in verdict.kept if one is not best]
            if why := reason(data, best, rivals):
                return replace(verdict, doubt=why)
        # a sure pose that has rivals may have them for a reason that can be told
        if not assess(best, data.free, data.rules.acceptance).is_sure:
            return verdict
        return verdict.doubted(doubt_about(data, best, self.sensors, has_rivals=has_rivals))


def explain(begun: Explanation, *, quickly: bool = False) -> Explanation:
    """Distinct poses that may explain a frame, most evident first: propose, fit, judge.

    Goes on after the proposers that were tried already; `quickly` stops where the body is not
    convincing where it is expected.
    """
    tracked, data = begun.tracked, begun.frame
    if not data.views or begun.tried == len(tracked.proposers):
        return begun
    likelihood = begun.likelihood or likelihood_of(data)
    ranked, fits = list(begun.ranked), list(begun.fits)

    def consider(start: Start, name: str) -> ScoredPose | None:
        fit = likelihood.fit(start)
        if start.T_moved is None and any(fit is one for one in fits):
            return None  # judged before, and by the same prior
        fits.append(fit)
        judged = replace(likelihood.judge(fit, start), proposer=name, blurs=fit.blurs)
        insert(ranked, judged, tracked.body, data.free, data.rules.acceptance)
        return judged

    def explained(tried: int) -> Explanation:
        poses, judged = tuple(ranked), tuple(fits)
        return replace(begun, ranked=poses, tried=tried, fits=judged, likelihood=likelihood)

    for k, propose in enumerate(tracked.proposers[begun.tried :], begun.tried):
        for start in propose(data, ranked):
            judged = consider(start, propose.__name__)
            if judged is None:
                continue
            for refine in tracked.refinements:
                for better in refine(data, likelihood, judged):
                    consider(better, refine.__name__)
        if quickly and k == 0 and not (first := explained(1)).checks.convinces:
            return first
    return explained(len(tracked.proposers))


def judged_by(other: Explanation, poses: Sequence[ScoredPose]) -> Explanation:
    """Poses judged by another frame as they are, most evident first."""
    data, ranked = other.frame, list[ScoredPose]()
    likelihood = likelihood_of(data)
    for one in poses if data.views else ():
        start = Start(one.T_world_object, left_out=one.left_out)
        judged = likelihood.judge(likelihood.fit(start), start)
        judged = replace(judged, proposer=one.proposer, blurs=one.blurs)
        insert(ranked, judged, data.body, data.free, data.rules.acceptance)
    return replace(other, ranked=tuple(ranked), tried=len(other.tracked.proposers))
