"""The likelihood of single ranges of small bodies: the sum over all associations.

Where errors are as large as distances of features, densities waste information, and what a range
belongs to remains in doubt whatever the pose.  With n features in view and M detections of one
sensor, every association λ gives each feature at most one detection and the reverse,

    L = Σ_λ  Π_met P_D N(offset; 0, s²)  Π_missed (1 − P_D)  Π_rest c/W,

c being the number of false detections to be expected and W the room they have.  It has many maxima,
also within what the pose before lets expect.  What one frame tells of them adds up from frame to
frame: all are followed that a further frame may make likely, and what the best leaves unexplained
counts for one that no search has found yet.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, expit

from mixpose.body import Body
from mixpose.fit import Fit, blurs_by_view, narrowing, widest_blurs
from mixpose.judgement import DetectionModel, ScoredPose, judge, nearest_alike
from mixpose.matching import Matches
from mixpose.objective import NormalPrior, View, project_body
from mixpose.optimise import NewtonOptions, Quadratic, Sum, ascend
from mixpose.records import Floats, PointPattern
from mixpose.rigid import perturb
from mixpose.search import distinct_poses, is_pointlike
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.rules import RangeRules

# under this name the noise of single ranges is remembered, of all of them together
RANGES = ("",)
_STEPS = 5  # at ranges that err by more than they do: these ascents need not converge


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
    J: Floats  # (L, H, n, 6), of ranges to features by the twist of the pose
    weights: Floats  # (L, H, n, M), what pairs weigh
    pulls: Floats  # (L, H, n, M), weighed offsets


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
    pulls = weights * away
    return AssociationSum(
        log_odds=(missed + np.log(total).reshape(missed.shape)).sum(axis=0),
        gradient=np.einsum("lhn,lhnk->hk", pulls.sum(axis=3), J),
        information=_squares(weights.sum(axis=3), J),
        met=shares.sum(axis=(0, 2, 3)),
        squares=noise**2 * (pulls * away).sum(axis=(0, 2, 3)),
        most=(missed + reached * peak).sum(axis=0),
        reached=reached.sum(axis=0),
        J=J,
        weights=weights,
        pulls=pulls,
    )


def _squares(weights: Floats, J: Floats) -> Floats:
    """Information (H, 6, 6) of coordinates that weigh (L, H, n), by Jacobians (L, H, n, 6)."""
    across = J.transpose(1, 0, 2, 3).reshape(J.shape[1], -1, 6)
    weighed = (J * weights[..., None]).transpose(1, 0, 2, 3).reshape(across.shape)
    return np.asarray(across.swapaxes(1, 2) @ weighed)


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
    """Logarithm of `sum_associations`."""

    frame: Frame
    noise: float  # in σ_ε
    second: bool  # whether second derivatives are given, which are differences of gradients

    def linearise(self, poses: Floats) -> Quadratic:
        """Models at poses (H, 4, 4), with the curvature of known labels."""
        if not self.second:
            found = self._sum(poses)
            return Quadratic(found.log_odds, found.gradient, found.information)
        frame, free = self.frame, self.frame.free
        error = self.noise * min(frame.sigmas)
        arm = float(np.linalg.norm(frame.body.means, axis=1).max())
        # steps that move ranges by a hundredth of their error: half of the digits are left
        scale = 0.01 * np.repeat([error, error / max(arm, error)], 3)[free]
        steps = scale[:, None] * np.eye(6)[free]
        twists = np.vstack([np.zeros(6), steps, -steps])
        found = self._sum(perturb(poses[:, None], twists).reshape(-1, 4, 4))
        gradients = found.gradient.reshape(len(poses), -1, 6)
        here, ahead, behind = np.split(gradients, [1, 1 + len(steps)], axis=1)
        H = np.zeros((len(poses), 6, 6))
        H[:, free] = (behind - ahead) / (2 * scale[:, None])
        at = slice(None, None, len(twists))
        H = (H + H.swapaxes(1, 2)) / 2
        return Quadratic(found.log_odds[at], here[:, 0], found.information[at], H)

    def _sum(self, poses: Floats) -> AssociationSum:
        frame = self.frame
        detection = frame.rules.judgement.detection
        return sum_associations(frame.views, frame.body, poses, self.noise, detection)


@dataclass(frozen=True, eq=False)
class ExpectedTerm:
    """Log density of poses by the prediction that expects each most, or that it is elsewhere."""

    frame: Frame

    def linearise(self, poses: Floats) -> Quadratic:
        """Second-order models at poses (H, 4, 4)."""
        frame, nothing = self.frame, np.zeros((len(poses), 6, 6))
        surprise = frame.rules.motion.surprised(frame.track.misses)
        known = [Quadratic(np.full(len(poses), frame.elsewhere), nothing[..., 0], nothing, nothing)]
        for one in frame.predictions:
            if one.spread is None:  # a step or two tell no covariance
                continue
            there = nearest_alike(poses, frame.body, one.T_world_object)
            prior = NormalPrior(one.T_world_object, one.uncertainty, frame.free).linearise(there)
            peak = one.log_belief(surprise) + one.log_peak(frame.free)
            known.append(prior._replace(value=prior.value + peak))
        chosen, rows = np.argmax([one.value for one in known], axis=0), np.arange(len(poses))
        return Quadratic._make(np.stack(parts)[chosen, rows] for parts in zip(*known, strict=True))


class AssociationLikelihood:
    """All associations of single ranges with a small body, and the pose before as a prior."""

    knows_detections = False

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        known = frame.track.residuals.of(RANGES)[:, 0]
        self._noise = noise_ratio(known, frame.rules.ranges)  # in σ_ε

    def fits(self, starts: Iterable[Start]) -> Iterator[tuple[Start, Fit]]:
        """Climb the posterior from all starts at once, and give what they lead to, the best first.

        Ends at one place are given once; those too far behind the best are left out.
        """
        begun = list(starts)
        if not begun:
            return
        frame, (ends, values, levels) = self.frame, self._climb(begun)
        order = np.argsort(-values, kind="stable")
        cell = 0.1 * min(frame.sigmas) / frame.body.radius
        for k in order[distinct_poses(frame.body, ends[order], cell, whole=True)]:
            if values[k] > values[order[0]] - frame.rules.ranges.behind:
                widths = np.outer(levels[k], frame.sigmas).tolist()
                yield begun[k], Fit(ends[k], blurs_by_view(frame.views, widths))

    def fit(self, start: Start) -> Fit:
        """Climb the posterior, at first with ranges that err as far as the start may be off."""
        return next(self.fits([start]))[1]

    def _climb(self, starts: Sequence[Start]) -> tuple[Floats, Floats, list[list[float]]]:
        """Where starts lead to (H, 4, 4), their log densities, and through what errors, in σ_ε."""
        frame = self.frame
        poses = np.array([one.T_world_object for one in starts])
        unsure = [np.zeros(6) if one.uncertainty is None else one.uncertainty for one in starts]
        blurs = widest_blurs(
            frame.views, frame.body, poses, np.where(frame.free, unsure, 0.0), frame.rules.fit
        )
        begins = (blurs / frame.sigmas).max(axis=1)
        widest = float(begins.max())
        levels = [widest**share for share in narrowing(widest, frame.rules.fit)]
        widths = [one for one in levels if one > self._noise]
        few, many = (NewtonOptions(n, tolerance=1e-7) for n in (_STEPS, 30))
        through = begins[:, None] >= np.array(widths) * (1 - 1e-9)  # (H, W)
        for width, some in zip(widths, through.T, strict=True):
            term = self._posterior(width, second=False)
            poses[some] = ascend(term, poses[some], perturb, frame.free, few).states
        term = self._posterior(self._noise, second=False)
        end = ascend(term, poses, perturb, frame.free, many)
        own = [[*compress(widths, some), self._noise] for some in through.tolist()]
        return frame.oriented(end.states), end.values, own

    def judge(self, fit: Fit, start: Start) -> ScoredPose:
        """Judge a pose by the sum over all associations, and by what the track expects."""
        frame, T, rules = self.frame, fit.T_world_object, self.frame.rules
        model, before = rules.judgement, frame.track.residuals
        found = sum_associations(frame.views, frame.body, T[None], self._noise, model.detection)
        count = int(frame.free.sum())
        degrees = max(float(found.met[0]) - count, 0.0)
        squares = float(found.squares[0]) if degrees else 0.0
        noise = model.noise.memory * before.of(RANGES) + [[squares], [degrees]]
        covariance, volume = self._covariance(T, found)
        # right poses meet all features, off by the noise but for what they are fitted to it
        spare = np.maximum(found.reached - count, 0.0)
        ahead = float((found.most - spare / 2 - found.log_odds)[0])
        expected = float(frame.expectation(T[None])[0]) - frame.elsewhere
        return replace(
            judge(frame.finest, T, frame.free, model),
            covariance=covariance,
            log_evidence=float(found.log_odds[0]) + frame.prior(T)[0] + volume,
            noise=before.followed(RANGES, noise, before.moments, before.biases, before.fields),
            spread=np.sqrt(np.diag(covariance)),
            elsewhere=float(np.logaddexp(frame.track.elsewhere, -expected)) + ahead,
        )

    def _covariance(self, T: Floats, found: AssociationSum) -> tuple[Floats, float]:
        """Of a pose (6, 6), wide enough for where else it may be; the log volume of its peak."""
        frame, free, rules = self.frame, self.frame.free, self.frame.rules
        inner, known = np.ix_(free, free), frame.track.residuals.of(RANGES)
        # a direction that all of it leaves open is as uncertain as anywhere
        information = self._definite(self._posterior(self._noise, second=True).linearise(T[None]))
        information += np.diag(1 / frame.anywhere[1][free] ** 2)
        C = np.linalg.inv(information)
        volume = 0.5 * float(np.linalg.slogdet(2 * np.pi * C)[1])
        degrees = rules.ranges.stated_degrees + float(known[1, 0])
        C *= rules.judgement.noise.enlargement(degrees)
        missed = 1 - rules.acceptance.confidence
        limit, weights = float(chdtri(len(C), missed)), np.linalg.inv(C)
        twists, likely = self._beside(T, found, information)
        for twist in twists[likely > missed]:
            pull = weights @ twist
            squares = float(twist @ pull)
            # its ellipsoid holds what is likelier than that a pose which is ok is wrong
            if squares > limit:
                wider = 1 / limit - 1 / squares
                C += wider * np.outer(twist, twist)
                weights -= wider / (1 + wider * squares) * np.outer(pull, pull)
        covariance = np.zeros((6, 6))
        covariance[inner] = C
        return covariance, volume

    def _beside(self, T: Floats, found: AssociationSum, here: Floats) -> tuple[Floats, Floats]:
        """Twists (K, k) to where a pose would be if a detection were false, and how likely that is.

        One step of least squares without what the detection says, from the information `here`.
        """
        free, pairs = self.frame.free, found.weights[:, 0].swapaxes(1, 2)  # (L, M, n)
        met, J = pairs.sum(axis=2) > 0, found.J[:, 0][..., free]  # (L, n, k)
        pulls = (found.pulls[:, 0].swapaxes(1, 2) @ J)[met]
        rest = here - np.einsum("ljn,lnk,lnq->ljkq", pairs, J, J)[met]
        are_fixed = np.linalg.eigvalsh(rest)[:, 0] > 0
        pulls, rest = pulls[are_fixed], rest[are_fixed]
        twists = np.zeros((len(pulls) + 1, 6))  # the first stays
        twists[1:, free] = -np.linalg.solve(rest, pulls[..., None])[..., 0]
        posterior = self._posterior(self._noise, second=False)
        values = posterior.linearise(perturb(T[None], twists)).value
        wider = 0.5 * (np.linalg.slogdet(here)[1] - np.linalg.slogdet(rest)[1])
        return twists[1:, free], expit(values[1:] - values[0] + wider)

    def density(self, fit: Fit, start: Start, beside: Matches) -> float:
        """As of `MatchedLikelihood`; clutter is as dense for all bodies already."""
        return self.judge(fit, start).log_density

    def _posterior(self, noise: float, *, second: bool) -> Sum:
        """Likelihood of ranges that err by so much in σ_ε, and what the track expects."""
        return Sum((AssociationTerm(self.frame, noise, second), ExpectedTerm(self.frame)))

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
