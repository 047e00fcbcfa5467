"""The likelihood of a pose in one frame: how to fit it near a start, and how to judge it.

Of matched densities or, for single ranges of small bodies, see `mixpose.tracking.ranges`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TypeAlias

from mixpose.fit import Fit, fit_near
from mixpose.judgement import Case, ScoredPose, judge_together
from mixpose.matching import Matches
from mixpose.optimise import Ascent
from mixpose.records import Floats, replace
from mixpose.sensors import Motion
from mixpose.tracking.frame import Frame, Start, spread_in_image
from mixpose.tracking.in_motion import fit_in_motion, matches_at, with_motion_unknown
from mixpose.tracking.ranges import AssociationLikelihood, are_associated


class MatchedLikelihood:
    """The likelihood by matched densities of all sensors."""

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        # whether the detection of each feature is known, so that refinements can leave some out
        self.knows_detections = frame.options.objective == "matched"
        self._climbed: dict[frozenset[str], list[Fit]] = {}  # by sensors left out
        if frame.joint_fit:
            self._climbed[frozenset()] = [frame.joint_fit[1]]

    def fits(self, starts: Iterable[Start]) -> Iterator[tuple[Start, Fit]]:
        """Yield fits from starts one by one, as later starts may depend on earlier fits."""
        return ((start, self.fit(start)) for start in starts)

    def fit(self, start: Start, begun: Ascent | None = None) -> Fit:
        """Climb the session's objective through narrowing blurs; `begun` at σ_ε already."""
        T, uncertainty, frame = start.T_world_object, start.uncertainty, self.frame
        if start.left_out:
            frame = frame.without(start.left_out)
        if uncertainty is None:
            return Fit(T, matches=start.matches, noise=start.noise)
        if frame.joint_fit and start is frame.joint_fit[0]:
            return frame.joint_fit[1]
        timed, model = frame.is_timed, frame.rules.judgement
        climbed = None if timed else self._climbed.setdefault(frozenset(start.left_out), [])
        spread = spread_in_image(frame, T) if self.knows_detections and frame.body.spread else 0.0

        def climb(seen: Frame, T_start: Floats, sigma: float = 0.0, wide: float = 1.0) -> Fit:
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
                extra_sigma=max(sigma, spread),
                wide=wide,
                errors=model.noise.errors,
                association=model.association,
                rules=seen.rules.fit,
            )

        return fit_in_motion(frame, T, climb) if timed else climb(frame, T)

    def judge(self, fit: Fit, start: Start) -> ScoredPose:
        """Judge a pose by matched densities at σ_ε; sensors left out miss their features."""
        frame, motion = _as_moving(self.frame, fit)
        if frame.joint_fit and fit is frame.joint_fit[1] and start is frame.joint_fit[0]:
            judged = frame.joint_fit[2]
        else:
            (judged,) = judge_together(
                [case_of(frame, fit, start)], frame.free, frame.rules.judgement, start.left_out
            )
        if frame.track.doubted:  # by lasting errors: volume is no evidence between poses then
            judged = replace(judged, by_count=0.0)
        return judged if motion is None else with_motion_unknown(judged, frame, motion)

    def density(self, fit: Fit, start: Start, other_matches: Matches) -> float:
        """Return the log density of a pose, with the density of clutter at another pose.

        Otherwise that density would depend on the size of the body.
        """
        frame, _ = _as_moving(self.frame, fit)
        T = frame.oriented(fit.T_world_object)
        crowds = other_matches.crowd, other_matches.space_crowd
        seen = replace(matches_at(frame, T), crowd=crowds[0], space_crowd=crowds[1])
        track = frame.track
        case = Case(frame.finest, T, track.residuals, track.rates, frame.prior(T), seen)
        (judged,) = judge_together([case], frame.free, frame.rules.judgement, start.left_out)
        return judged.log_density


def _as_moving(frame: Frame, fit: Fit) -> tuple[Frame, Motion | None]:
    """Return the frame at the common time and the motion of the body, if sensors are timed."""
    if not frame.is_timed:
        return frame, fit.motion
    motion = fit.motion or frame.expected_velocity(fit.T_world_object).at(fit.T_world_object)
    return frame.in_motion(motion), motion


def met_at(frame: Frame, fit: Fit) -> tuple[Floats, Matches]:
    """Return a pose fitted to all sensors and its matches, at less cost than judging it."""
    T = frame.oriented(fit.T_world_object)
    if fit.matches and T is fit.T_world_object and not frame.is_timed:
        return T, fit.matches
    return T, matches_at(_as_moving(frame, fit)[0], T)


def case_of(frame: Frame, fit: Fit, start: Start) -> Case:
    """Collect the inputs for judging a pose that was fitted to a frame."""
    T = frame.oriented(fit.T_world_object)
    prior = frame.prior(T if start.T_moved is None else start.T_moved)
    is_seen = T is fit.T_world_object and not (frame.is_timed or start.left_out)
    seen = (fit.matches, fit.noise) if is_seen else (None, None)
    return Case(frame.finest, T, frame.track.residuals, frame.track.rates, prior, *seen)


Likelihood: TypeAlias = MatchedLikelihood | AssociationLikelihood


def likelihood_of(frame: Frame) -> Likelihood:
    """Return the likelihood for a frame."""
    are_ranges = frame.options.objective == "matched" and are_associated(
        frame.views, frame.body, frame.rules.ranges
    )
    return AssociationLikelihood(frame) if are_ranges else MatchedLikelihood(frame)
