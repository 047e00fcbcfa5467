"""What one frame says of a pose: how to fit it near a start, and how to judge it.

Matched densities, or, for single ranges of small bodies, `mixpose.tracking.ranges`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TypeAlias

from mixpose.fit import Fit, fit_near
from mixpose.judgement import Case, ScoredPose, judge_together
from mixpose.matching import Matches
from mixpose.optimise import Ascent
from mixpose.records import Floats
from mixpose.sensors import Motion
from mixpose.tracking.frame import Frame, Start, given
from mixpose.tracking.in_motion import fit_in_motion, matches_at, with_motion_unknown
from mixpose.tracking.ranges import AssociationLikelihood, are_associated


class MatchedLikelihood:
    """Matched densities of all sensors."""

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        # whether each feature's detection is known, so that one may be left out
        self.knows_detections = frame.options.objective == "matched"
        self._climbed: dict[frozenset[str], list[Fit]] = {}  # by sensors left out
        if frame.together:
            self._climbed[frozenset()] = [frame.together[1]]

    def fits(self, starts: Iterable[Start]) -> Iterator[tuple[Start, Fit]]:
        """Fits from starts, one after the other, as later ones may hang on those before."""
        return ((start, self.fit(start)) for start in starts)

    def fit(self, start: Start, begun: Ascent | None = None) -> Fit:
        """Ascend the session's objective through narrowing blurs; `begun` at σ_ε already."""
        T, uncertainty, frame = start.T_world_object, start.uncertainty, self.frame
        if start.left_out:
            frame = frame.without(start.left_out)
        if uncertainty is None:
            return Fit(T, matches=start.matches, noise=start.noise)
        if frame.together and start is frame.together[0]:
            return frame.together[1]
        timed, model = frame.is_timed, frame.rules.judgement
        climbed = None if timed else self._climbed.setdefault(frozenset(start.left_out), [])
        spread = given(frame, T) if self.knows_detections and frame.body.spread else 0.0

        def climb(seen: Frame, T_start: Floats, beside: float = 0.0, wide: float = 1.0) -> Fit:
            return fit_near(
                seen.views,
                seen.body,
                T_start,
                uncertainty,
                seen.options,
                seen.samples,
                finest=seen.finest,
                begun=begun,
                climbed=climbed,
                blur=start.blur,
                least=start.least,
                noise=seen.noise,
                fields=seen.track.residuals.fields,
                extra_sigma=max(beside, spread),
                wide=wide,
                errors=model.noise.errors,
                association=model.association,
                rules=seen.rules.fit,
            )

        return fit_in_motion(frame, T, climb) if timed else climb(frame, T)

    def judge(self, fit: Fit, start: Start) -> ScoredPose:
        """Judge a pose by matched densities at σ_ε, and take what is left out for missed."""
        frame, motion = _as_moving(self.frame, fit)
        if frame.together and fit is frame.together[1] and start is frame.together[0]:
            judged = frame.together[2]
        else:
            (judged,) = judge_together(
                [case_of(frame, fit, start)], frame.free, frame.rules.judgement, start.left_out
            )
        if frame.track.doubted:  # by errors that last: it tells nothing against other poses now
            judged = replace(judged, by_count=0.0)
        return judged if motion is None else with_motion_unknown(judged, frame, motion)

    def density(self, fit: Fit, start: Start, beside: Matches) -> float:
        """Log density of a pose, of clutter that is as dense as around what another one meets.

        To bodies of other sizes clutter beside the same detections seems to be as dense as they
        are large.
        """
        frame, _ = _as_moving(self.frame, fit)
        T = frame.oriented(fit.T_world_object)
        seen = replace(matches_at(frame, T), crowd=beside.crowd, space_crowd=beside.space_crowd)
        track = frame.track
        case = Case(frame.finest, T, track.residuals, track.rates, frame.prior(T), seen)
        (judged,) = judge_together([case], frame.free, frame.rules.judgement, start.left_out)
        return judged.log_density


def _as_moving(frame: Frame, fit: Fit) -> tuple[Frame, Motion | None]:
    """The frame as of the common time, and how the body moves, where sensors see moments."""
    if not frame.is_timed:
        return frame, fit.motion
    motion = fit.motion or frame.expected(fit.T_world_object).at(fit.T_world_object)
    return frame.in_motion(motion), motion


def met_at(frame: Frame, fit: Fit) -> tuple[Floats, Matches]:
    """A pose that was fitted to all sensors, and what it meets, which is less than to judge it."""
    T = frame.oriented(fit.T_world_object)
    if fit.matches and T is fit.T_world_object and not frame.is_timed:
        return T, fit.matches
    return T, matches_at(_as_moving(frame, fit)[0], T)


def case_of(frame: Frame, fit: Fit, start: Start) -> Case:
    """What a pose that was fitted to a frame is judged by."""
    T = frame.oriented(fit.T_world_object)
    prior = frame.prior(T if start.T_moved is None else start.T_moved)
    is_seen = T is fit.T_world_object and not (frame.is_timed or start.left_out)
    seen = (fit.matches, fit.noise) if is_seen else (None, None)
    return Case(frame.finest, T, frame.track.residuals, frame.track.rates, prior, *seen)


Likelihood: TypeAlias = MatchedLikelihood | AssociationLikelihood


def likelihood_of(frame: Frame) -> Likelihood:
    """The likelihood for a frame."""
    are_ranges = frame.options.objective == "matched" and are_associated(
        frame.views, frame.body, frame.rules.ranges
    )
    return AssociationLikelihood(frame) if are_ranges else MatchedLikelihood(frame)
