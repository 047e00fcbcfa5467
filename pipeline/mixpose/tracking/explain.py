"""Poses that may explain a frame for one body, the verdict on them, and what becomes of that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import expit

from mixpose.fit import Fit
from mixpose.judgement import (
    APART,
    ScoredPose,
    Verdict,
    convinces,
    decide,
    insert,
    is_possible,
    is_sure,
)
from mixpose.matching import Matches
from mixpose.objective import View
from mixpose.records import Estimate, Hypothesis, Mask, Offsets, SensorReport
from mixpose.tracking.doubt import doubt_about, is_known
from mixpose.tracking.frame import Frame, follow
from mixpose.tracking.in_motion import delays_after
from mixpose.tracking.likelihood import Likelihood, Start, likelihood_of
from mixpose.tracking.proposers import reason
from mixpose.tracking.track import Branch, Track

if TYPE_CHECKING:
    from mixpose.tracking.scene import Tracker


@dataclass(frozen=True, eq=False)
class Explanation:
    """What one body makes of what is left of a frame for it."""

    tracked: Tracker
    frame: Frame
    sensors: int = 1  # that had a frame, also those that saw nothing
    left: Mask = field(default_factory=lambda: np.ones(0, np.bool_))  # (D,), see `Claims.left`
    ranked: tuple[ScoredPose, ...] = ()  # distinct poses, most evident first
    tried: int = 0  # of the proposers
    fits: tuple[Fit, ...] = ()  # that were judged
    likelihood: Likelihood | None = None  # that they are of

    @property
    def is_possible(self) -> bool:
        """Whether the best pose is worth telling."""
        frame = self.frame
        return any(is_possible(p, frame.free, frame.rules.acceptance) for p in self.ranked[:1])

    @property
    def convinces(self) -> bool:
        """Whether the best pose, near its prediction, needs no other to compare with."""
        frame = self.frame
        return any(convinces(p, frame.free, frame.rules.acceptance) for p in self.ranked[:1])

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
        if not is_sure(best, data.free, data.rules.acceptance):
            return verdict
        return verdict.doubted(doubt_about(data, best, self.sensors, has_rivals=has_rivals))


def explain(begun: Explanation, *, quickly: bool = False) -> Explanation:
    """Propose, fit and judge poses, from the first proposer on that was not tried yet.

    `quickly` stops where the body is not convincing where it is expected.
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
        if quickly and k == 0 and not (first := explained(1)).convinces:
            return first
    return explained(len(tracked.proposers))


def judged_by(
    other: Explanation, poses: Sequence[ScoredPose], *, fitted: bool = False
) -> Explanation:
    """Poses judged by another frame, and `fitted` to it, most evident first."""
    data, ranked = other.frame, list[ScoredPose]()
    likelihood = likelihood_of(data)
    for one in poses if data.views else ():
        start = Start(one.T_world_object, data.close if fitted else None, left_out=one.left_out)
        fit = likelihood.fit(start)
        judged, blurs = likelihood.judge(fit, start), fit.blurs or one.blurs
        judged = replace(judged, proposer=one.proposer, blurs=blurs)
        insert(ranked, judged, data.body, data.free, data.rules.acceptance)
    return replace(other, ranked=tuple(ranked), tried=len(other.tracked.proposers))


def estimate_of(
    data: Frame, views: Sequence[View], verdict: Verdict, shown: ScoredPose | None
) -> Estimate:
    """The estimate of a frame, with reports of the pose that is shown, believed or not."""
    body, best = data.body, verdict.best
    reports = {view.name: SensorReport(False) for view in views}
    reports |= shown.sensors if shown else {}
    used = shown.used if shown and len(body.nodes.points) == len(body) else None
    if used:
        lengths = (used.sigmas[:, None] * np.sqrt(used.squared)).tolist()
        for name, row, k, in_view in zip(used.names, lengths, used.shares > 0, used.weights > 0):
            residuals = {body.labels[i]: row[i] if k[i] else None for i in np.flatnonzero(in_view)}
            reports[name] = replace(reports[name], residuals=residuals)
    rivals = verdict.kept if verdict.status == "ambiguous" else ()
    return Estimate(
        frame=data.frame,
        time_s=data.time_s,
        object=body.name,
        status=verdict.status,
        T_world_object=best.T_world_object if best else None,
        covariance=best.covariance if best else None,
        score=shown.score if shown else 0.0,
        sensors=reports,
        hypotheses=tuple([Hypothesis(one.T_world_object, weight) for one, weight in rivals]),
        proposer=best.proposer if best else "",
        blurs=best.blurs if best else (),
        guesses=data.searches[-1][0] if data.searches else None,
        doubt=verdict.doubt,
        measured=partial(_offsets, used) if used else dict,
    )


def followed(data: Frame, verdict: Verdict) -> Track:
    """The track after a frame."""
    track, best, is_ok = data.track, verdict.best, verdict.status == "ok"
    if best is None:
        clutter = track.clutter.learnt(data.views, data.rules.static)
        state = data.searches[-1][1] if data.searches else Track.search
        return replace(track.missed(state, clutter), doubted=True)
    found = []
    for one, weight in verdict.kept:
        # what may be mere clutter counts as little in the next frame
        belief = weight * float(expit(one.log_evidence))
        momentary = np.diagonal(one.covariance - one.persistent)
        deviation = np.sqrt(momentary) if data.is_timed else None
        spread = one.spread if data.options.fuse else None
        found.append(Branch(one.T_world_object, belief, spread=spread, deviation=deviation))
    used = best.used
    met, in_view = (np.count_nonzero(one, axis=1) for one in (used.shares, used.weights))
    agreeing = (met >= data.rules.acceptance.agreeing * np.maximum(in_view, 1)).sum() > 1
    # sensors whose delays are not known contradict each other until they are
    late = verdict.doubt == APART and any(view.unsure is not None for view in data.views)
    return replace(
        follow(data, found),
        residuals=best.noise if is_ok else track.residuals,
        tallies=dict(zip(used.names, zip(met.tolist(), in_view.tolist()))),
        delays=delays_after(data, best) if is_ok or late else track.delays,
        agreed=track.agreed or bool(agreeing),
        known=is_known(data, best),
        believed=track.believed + is_ok,
        doubted=not is_ok,
    )


def _offsets(used: Matches) -> dict[str, Offsets]:
    """By how much each sensor met the features of a body whose features are points."""
    offsets = {}
    for k, (name, m, sigma) in enumerate(zip(used.names, used.dimensions, used.sigmas.tolist())):
        i = np.flatnonzero(used.weights[k])
        y, by_shift = used.offsets[k, i, :m], used.J[k, i, :m, :3]
        offsets[name] = Offsets(i, used.shares[k, i] > 0, sigma * y, sigma * by_shift)
    return offsets
