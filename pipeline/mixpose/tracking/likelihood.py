"""What one frame says of a pose: how to fit it near a start, and how to judge it.

Matched densities, or, for single ranges of small bodies, the sum over all associations: where
errors are as large as distances of features, densities waste information, and what a range belongs
to remains in doubt whatever the pose.  With n features in view and M detections of one sensor,
every association λ gives each feature at most one detection and the reverse,

    L = Σ_λ  Π_met P_D N(offset; 0, s²)  Π_missed (1 − P_D)  Π_rest c/W,

c being the number of false detections to be expected and W the room they have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from mixpose.body import Body
from mixpose.fit import Fit, blur_schedule, fit_near
from mixpose.judgement import (
    Case,
    DetectionModel,
    ScoredPose,
    judge,
    judge_together,
)
from mixpose.matching import Matches
from mixpose.objective import NormalPrior, View, project_body
from mixpose.optimise import Ascent, NewtonOptions, Quadratic, Sum, ascend
from mixpose.records import Floats, PointPattern
from mixpose.rigid import perturb
from mixpose.search import is_pointlike
from mixpose.sensors import Motion
from mixpose.tracking.frame import Frame, Start, given
from mixpose.tracking.in_motion import fit_in_motion, matches_at, with_motion_unknown
from mixpose.tracking.rules import RangeRules

# under this name the noise of single ranges is remembered, of all of them together
RANGES = ("",)


class MatchedLikelihood:
    """Matched densities of all sensors."""

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        # whether each feature's detection is known, so that one may be left out
        self.knows_detections = frame.options.objective == "matched"
        self._climbed: dict[frozenset[str], list[Fit]] = {}  # by sensors left out

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
                beside=max(beside, spread),
                wide=wide,
                errors=model.noise.errors,
                association=model.association,
                rules=seen.rules.fit,
            )

        return fit_in_motion(frame, T, climb) if timed else climb(frame, T)

    def judge(self, fit: Fit, start: Start) -> ScoredPose:
        """Judge a pose by matched densities at σ_ε, and take what is left out for missed."""
        if self.frame.together and fit is self.frame.together[1]:
            return self.frame.together[2]
        frame, motion = _as_moving(self.frame, fit)
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
        seen = replace(matches_at(frame, T), crowd=beside.crowd, others=beside.others)
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


def are_associated(views: Sequence[View], body: Body, rules: RangeRules = RangeRules()) -> bool:
    """Whether all sensors gave single ranges, of a body of few points."""
    return (
        all(view.sensor.dimension == 1 for view in views)
        and all(view.observation.points is not None for view in views)
        and is_pointlike(body)
        and len(body) <= rules.max_features
    )


def noise_ratio(noise: Floats, rules: RangeRules) -> float:
    """Standard deviation of ranges in σ_ε, by squares and degrees of freedom (2,) so far."""
    squares, degrees = noise + rules.stated_degrees
    return max(1.0, float(np.sqrt(squares / degrees)))


class AssociationSum(NamedTuple):
    """The likelihood over all associations in all sensors, at H poses."""

    log_odds: Floats  # (H,), logarithm of the likelihood, over that of mere clutter
    gradient: Floats  # (H, 6), of it, by the twist of the pose
    information: Floats  # (H, 6, 6), what the ranges would say if their labels were known
    met: Floats  # (H,), expected number of detections that belong to features
    squares: Floats  # (H,), expected sum of their squared offsets, in σ_ε²
    most: Floats  # (H,), log odds if all features in view were met exactly
    reached: Floats  # (H,), how many these are


def sum_associations(
    views: Sequence[View],  # `are_associated`, none with an empty observation
    body: Body,
    poses: Floats,  # (H, 4, 4)
    noise: float = 1.0,  # standard deviation of offsets, in σ_ε
    detection: DetectionModel = DetectionModel(),
) -> AssociationSum:
    """Sum the likelihood over all associations at poses."""
    patterns = [view.observation.pattern for view in views]
    ranges = [one.points[one.weights > 0, 0] for one in patterns if isinstance(one, PointPattern)]
    counts = np.array([len(one) for one in ranges])
    there = np.arange(counts.max()) < counts[:, None]
    detected = np.zeros(there.shape)  # those that never were make widths alike
    detected[there] = np.concatenate(ranges)
    sigma = np.array([[view.observation.sigma] for view in views])
    at = project_body(tuple(view.sensor for view in views), body).project(poses)
    J, away = at.J[..., 0, :], detected[:, None, None] - at.y[..., :1]
    probability, found = detection.probability, counts[:, None]
    expected = at.seen.sum(axis=2)
    false = np.maximum(found - probability * expected, 1 - probability)
    room = np.maximum(2 * detection.room * body.radius, 20 * sigma)
    missed = expected * np.log(1 - probability) + found * np.log(false / found) + found - false
    error = (noise * sigma)[..., None, None]
    odds = np.exp(-0.5 * (away / error) ** 2) / (np.sqrt(2 * np.pi) * error)
    ratio = probability / (1 - probability) * room / false
    reached = np.minimum(expected, found)
    peak = np.log(ratio / (np.sqrt(2 * np.pi) * noise * sigma))
    odds *= ratio[..., None, None]
    odds *= at.seen[..., None] & there[:, None, None]
    total, shares = _summed(odds.reshape(-1, *odds.shape[2:]))
    shares = shares.reshape(odds.shape)
    weights = shares / error**2
    return AssociationSum(
        log_odds=(missed + np.log(total).reshape(missed.shape)).sum(axis=0),
        gradient=np.einsum("lhnj,lhnj,lhnk->hk", weights, away, J),
        information=np.einsum("lhnj,lhnk,lhnq->hkq", weights, J, J),
        met=shares.sum(axis=(0, 2, 3)),
        squares=noise**2 * (weights * away**2).sum(axis=(0, 2, 3)),
        most=(missed + reached * peak).sum(axis=0),
        reached=reached.sum(axis=0),
    )


def _summed(odds: Floats) -> tuple[Floats, Floats]:
    """Sum over associations (H,) and how probable each pair is (H, n, M), of odds (H, n, M).

    From the first detection to the last, the odds of each subset of features being taken so far;
    and the same backwards.
    """
    count, n, M = odds.shape
    subsets = np.arange(2**n)
    without = [subsets[(subsets >> i) & 1 == 0] for i in range(n)]
    taken = np.zeros((M + 1, count, 2**n))
    taken[0, :, 0] = 1.0
    for j in range(M):
        taken[j + 1] = taken[j]
        for i, rest in enumerate(without):
            taken[j + 1][:, rest | 1 << i] += odds[:, i, j, None] * taken[j][:, rest]
    left, shares = np.ones((count, 2**n)), np.zeros_like(odds)
    total = taken[M].sum(axis=1)
    for j in range(M - 1, -1, -1):
        before = left.copy()
        for i, rest in enumerate(without):
            then = odds[:, i, j, None] * left[:, rest | 1 << i]
            shares[:, i, j] = (taken[j][:, rest] * then).sum(axis=1) / total
            before[:, rest] += then
        left = before
    return total, shares


@dataclass(frozen=True, eq=False)
class AssociationTerm:
    """Logarithm of `sum_associations`, whose second derivatives are differences of gradients."""

    frame: Frame
    noise: float  # in σ_ε

    def linearise(self, poses: Floats) -> Quadratic:
        """Second-order models at poses (H, 4, 4)."""
        frame, free, model = self.frame, self.frame.free, self.frame.rules.judgement
        error = self.noise * min(frame.sigmas)
        arm = float(np.linalg.norm(frame.body.means, axis=1).max())
        # steps that move ranges by a hundredth of their error: half of the digits are left
        scale = 0.01 * np.repeat([error, error / max(arm, error)], 3)[free]
        steps = scale[:, None] * np.eye(6)[free]
        twists = np.vstack([np.zeros(6), steps, -steps])
        around = perturb(poses[:, None], twists).reshape(-1, 4, 4)
        found = sum_associations(frame.views, frame.body, around, self.noise, model.detection)
        gradients = found.gradient.reshape(len(poses), -1, 6)
        here, ahead, behind = np.split(gradients, [1, 1 + len(steps)], axis=1)
        H = np.zeros((len(poses), 6, 6))
        H[:, free] = (behind - ahead) / (2 * scale[:, None])
        at = slice(None, None, len(twists))
        H = (H + H.swapaxes(1, 2)) / 2
        return Quadratic(found.log_odds[at], here[:, 0], found.information[at], H)


class AssociationLikelihood:
    """All associations of single ranges with a small body, and the pose before as a prior."""

    knows_detections = False

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        known = frame.track.residuals.of(RANGES)[:, 0]
        self._noise = noise_ratio(known, frame.rules.ranges)  # in σ_ε

    def fit(self, start: Start) -> Fit:
        """Climb the posterior, at first with ranges that err as far as the prior may."""
        T, frame, known, widths = start.T_world_object, self.frame, start.prediction, [self._noise]
        if known is None or known.spread is None:  # nothing is known: matched densities lead there
            T = MatchedLikelihood(frame).fit(start).T_world_object
            T = frame.oriented(T)
        else:
            uncertainty = np.where(frame.free, known.uncertainty, 0.0)
            levels = blur_schedule(frame.views, frame.body, T, uncertainty)
            ratios = (np.array(levels) / frame.sigmas).max(axis=1).tolist()
            widths = [ratio for ratio in ratios if ratio > self._noise] + widths
        states, options = T[None], NewtonOptions(tolerance=1e-7)
        for width in widths:
            end = ascend(self._posterior(start, width), states, perturb, frame.free, options)
            states = end.states
        return Fit.of(end, frame.views, np.outer(widths, frame.sigmas).tolist())

    def judge(self, fit: Fit, start: Start) -> ScoredPose:
        """Judge a pose by the sum over all associations, with the prior of the start."""
        frame, T, free, rules = self.frame, fit.T_world_object, self.frame.free, self.frame.rules
        model, before = rules.judgement, frame.track.residuals
        found = sum_associations(frame.views, frame.body, T[None], self._noise, model.detection)
        count, inner = int(free.sum()), np.ix_(free, free)
        degrees = max(float(found.met[0]) - count, 0.0)
        squares = float(found.squares[0]) if degrees else 0.0
        known = before.of(RANGES)
        noise = model.noise.memory * known + [[squares], [degrees]]
        # a direction that all of it leaves open is as uncertain as anywhere
        information = self._definite(self._posterior(start, self._noise).linearise(T[None]))
        information += np.diag(1 / frame.anywhere[1][free] ** 2)
        covariance = np.zeros((6, 6))
        covariance[inner] = np.linalg.inv(information)
        volume = 0.5 * np.linalg.slogdet(2 * np.pi * covariance[inner])[1]
        degrees = rules.ranges.stated_degrees + float(known[1, 0])
        covariance *= model.noise.enlargement(degrees)
        # maxima at other turns: right poses meet all features, off by the noise
        ahead = float((found.most - found.reached / 2 - found.log_odds)[0])
        expected = float(frame.expectation(T[None])[0]) - frame.elsewhere
        return replace(
            judge(frame.finest, T, free, model),
            covariance=covariance,
            log_evidence=float(found.log_odds[0]) + frame.prior(T)[0] + float(volume),
            noise=before.followed(RANGES, noise, before.moments, before.biases, before.fields),
            spread=np.sqrt(np.diag(covariance)),
            elsewhere=max(ahead, 0.0) - expected,
        )

    def density(self, fit: Fit, start: Start, beside: Matches) -> float:
        """As of `MatchedLikelihood`; clutter is as dense for all bodies already."""
        return self.judge(fit, start).log_density

    def _posterior(self, start: Start, noise: float) -> Sum:
        """Likelihood and prior, of ranges that err by so much in σ_ε."""
        likelihood, known = AssociationTerm(self.frame, noise), start.prediction
        if known is None or known.spread is None:
            return Sum((likelihood,))
        prior = NormalPrior(known.T_world_object, known.uncertainty, self.frame.free)
        return Sum((likelihood, prior))

    def _definite(self, here: Quadratic) -> Floats:
        """Minus the Hessian (k, k) where definite; in directions where not, next to nothing."""
        assert here.hessian is not None
        free, least = self.frame.free, self.frame.rules.ranges.min_information
        diagonal = np.diagonal(here.curvature[0])[free]
        scale = 1 / np.sqrt(np.maximum(diagonal, np.finfo(np.float64).eps))
        hessian = here.hessian[0][np.ix_(free, free)]
        values, vectors = np.linalg.eigh(hessian * scale * scale[:, None])
        # bounded, in its own units again
        return np.asarray(
            (vectors * np.maximum(values, least)) @ vectors.T / np.outer(scale, scale)
        )


Likelihood: TypeAlias = MatchedLikelihood | AssociationLikelihood


def likelihood_of(frame: Frame) -> Likelihood:
    """The likelihood for a frame."""
    are_ranges = frame.options.objective == "matched" and are_associated(
        frame.views, frame.body, frame.rules.ranges
    )
    return AssociationLikelihood(frame) if are_ranges else MatchedLikelihood(frame)
