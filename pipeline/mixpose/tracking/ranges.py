"""The likelihood of single ranges of small bodies: the sum over all associations.

Where errors are as large as distances of features, densities waste information, and at any pose it
stays open which range belongs to which feature.  With n features in view and M detections of one
sensor, every association λ gives each feature at most one detection and the reverse,

    L = Σ_λ  Π_met P_D N(offset; 0, s²)  Π_missed (1 − P_D)  Π_rest c/W,

c being the expected number of false detections and W the room they have.  A sensor may also fail,
its ranges all off alike or of something else: then all of them are clutter.  What frames show of
that adds up, from the odds of a mistake in the session.  The product over sensors has many maxima,
also within the prior of the track.  Their evidence adds up over frames: all maxima that a further
frame may make likely are followed.  What the best leaves unexplained counts for one not found so
far.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, expit, logit

from mixpose.body import Body
from mixpose.fit import Fit, blurs_by_view, narrowing, widest_blurs
from mixpose.judgement import DetectionModel, ScoredPose, judge, nearest_alike
from mixpose.matching import Matches
from mixpose.objective import NormalPrior, View, project_body
from mixpose.optimise import NewtonOptions, Quadratic, Sum, ascend
from mixpose.records import Floats, PointPattern, replace
from mixpose.rigid import perturb
from mixpose.search import distinct_poses, is_pointlike
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.rules import RangeRules

# the name under which the noise of all single ranges together is remembered
RANGES = ("",)
_STEPS = 5  # at enlarged errors of ranges, where ascents need not converge


def are_associated(views: Sequence[View], body: Body, rules: RangeRules = RangeRules()) -> bool:
    """Test whether all sensors gave single ranges, of a body of few points."""
    return (
        all(view.sensor.dimension == 1 for view in views)
        and all(view.observation.points is not None for view in views)
        and is_pointlike(body)
        and len(body) <= rules.max_features
    )


def noise_ratio(noise: Floats, rules: RangeRules) -> float:
    """Return the standard deviation of ranges in σ_ε, by squares and degrees of freedom (2,)."""
    squares, degrees = noise + rules.stated_degrees
    return max(1.0, float(np.sqrt(squares / degrees)))


class AssociationSum(NamedTuple):
    """The likelihood over all associations in all sensors, at H poses."""

    log_odds: Floats  # (H,), logarithm of the likelihood, over that of mere clutter
    gradient: Floats  # (H, 6), of it, by the twist of the pose
    information: Floats  # (H, 6, 6), of the ranges if their labels were known
    met: Floats  # (H,), expected number of detections that belong to features
    squares: Floats  # (H,), expected sum of their squared offsets, in σ_ε²
    most: Floats  # (H,), log odds if all features in view were met exactly
    reached: Floats  # (H,), number of these features
    by_sensor: Floats  # (L, H), log odds of each sensor if it does not fail
    J: Floats  # (L, H, n, 6), of ranges to features by the twist of the pose
    weights: Floats  # (L, H, n, M), of pairs
    pulls: Floats  # (L, H, n, M), weighted offsets


def sum_associations(
    views: Sequence[View],  # `are_associated`, none with an empty observation
    body: Body,
    poses: Floats,  # (H, 4, 4)
    noise: float = 1.0,  # standard deviation of offsets, in σ_ε
    detection: DetectionModel = DetectionModel(),
    failing: Floats | float = -np.inf,  # (L, 1) log odds that sensors fail
) -> AssociationSum:
    """Sum the likelihood over all associations at poses."""
    patterns = [view.observation.pattern for view in views]
    ranges = [p.points[p.weights > 0, 0] for p in patterns if isinstance(p, PointPattern)]
    counts = np.array([len(detections) for detections in ranges])
    is_range = np.arange(counts.max()) < counts[:, None]
    detected = np.zeros(is_range.shape)  # padded to one width
    detected[is_range] = np.concatenate(ranges)
    sigma = np.array([[view.observation.sigma] for view in views])
    images = project_body(tuple(view.sensor for view in views), body).project(poses)
    J, offsets = images.J[..., 0, :], detected[:, None, None] - images.y[..., :1]
    probability, M = detection.probability, counts[:, None]
    expected = images.seen.sum(axis=2)
    false = np.maximum(M - probability * expected, 1 - probability)
    room = np.maximum(2 * detection.room * body.radius, 20 * sigma)
    missed = expected * np.log(1 - probability) + M * np.log(false / M) + M - false
    error = (noise * sigma)[..., None, None]
    odds = np.exp(-0.5 * (offsets / error) ** 2) / (np.sqrt(2 * np.pi) * error)
    ratio = probability / (1 - probability) * room / false
    reached = np.minimum(expected, M)
    peak = np.log(ratio / (np.sqrt(2 * np.pi) * noise * sigma))
    odds *= ratio[..., None, None]
    odds *= images.seen[..., None] & is_range[:, None, None]
    total, shares = _sum_and_shares(odds.reshape(-1, *odds.shape[2:]))
    by_sensor = missed + np.log(total).reshape(missed.shape)
    most = missed + reached * peak
    working, usual = expit(by_sensor - failing), expit(most - failing)
    shares = shares.reshape(odds.shape) * working[..., None, None]
    weights = shares / error**2
    pulls = weights * offsets
    return AssociationSum(
        log_odds=_with_failure(by_sensor, failing),
        gradient=np.einsum("lhn,lhnk->hk", pulls.sum(axis=3), J),
        information=_squares(weights.sum(axis=3), J),
        met=shares.sum(axis=(0, 2, 3)),
        squares=noise**2 * (pulls * offsets).sum(axis=(0, 2, 3)),
        most=_with_failure(most, failing),
        reached=(usual * reached).sum(axis=0),
        by_sensor=by_sensor,
        J=J,
        weights=weights,
        pulls=pulls,
    )


def _with_failure(log_odds: Floats, failing: Floats | float) -> Floats:
    """Return log odds (H,) of all sensors, by those of each (L, H) if it does not fail."""
    return np.asarray((np.logaddexp(log_odds, failing) - np.logaddexp(0.0, failing)).sum(axis=0))


def _squares(weights: Floats, J: Floats) -> Floats:
    """Return the information (H, 6, 6) by weights (L, H, n) and Jacobians (L, H, n, 6)."""
    rows = J.transpose(1, 0, 2, 3).reshape(J.shape[1], -1, 6)
    weighed = (J * weights[..., None]).transpose(1, 0, 2, 3).reshape(rows.shape)
    return np.asarray(rows.swapaxes(1, 2) @ weighed)


def _sum_and_shares(odds: Floats) -> tuple[Floats, Floats]:
    """Return the sum over associations (H,) and probabilities of pairs, of odds (H, n, M).

    Over detections, `taken` has the odds that each subset of features is taken; then backward.
    """
    count, n, M = odds.shape
    subsets = np.arange(2**n)
    without = [subsets[(subsets >> i) & 1 == 0] for i in range(n)]
    taken = np.zeros((M + 1, count, 2**n))
    taken[0, :, 0] = 1.0
    for j in range(M):
        taken[j + 1] = taken[j]
        for i, sets in enumerate(without):
            taken[j + 1][:, sets | 1 << i] += odds[:, i, j, None] * taken[j][:, sets]
    remaining, shares = np.ones((count, 2**n)), np.zeros_like(odds)
    total = taken[M].sum(axis=1)
    for j in range(M - 1, -1, -1):
        before = remaining.copy()
        for i, sets in enumerate(without):
            then = odds[:, i, j, None] * remaining[:, sets | 1 << i]
            shares[:, i, j] = (taken[j][:, sets] * then).sum(axis=1) / total
            before[:, sets] += then
        remaining = before
    return total, shares


@dataclass(frozen=True, eq=False)
class AssociationTerm:
    """The logarithm of `sum_associations`."""

    frame: Frame
    noise: float  # in σ_ε
    second: bool  # whether to give second derivatives, by differences of gradients
    failing: Floats | float = -np.inf  # (L, 1) log odds that sensors fail

    def linearise(self, poses: Floats) -> Quadratic:
        """Return models at poses (H, 4, 4), with the curvature of known labels."""
        if not self.second:
            sums = self._sum(poses)
            return Quadratic(sums.log_odds, sums.gradient, sums.information)
        frame, free = self.frame, self.frame.free
        error = self.noise * min(frame.sigmas)
        arm = float(np.linalg.norm(frame.body.means, axis=1).max())
        # steps that move ranges by a hundredth of their error keep half of the digits
        scale = 0.01 * np.repeat([error, error / max(arm, error)], 3)[free]
        steps = scale[:, None] * np.eye(6)[free]
        twists = np.vstack([np.zeros(6), steps, -steps])
        sums = self._sum(perturb(poses[:, None], twists).reshape(-1, 4, 4))
        gradients = sums.gradient.reshape(len(poses), -1, 6)
        here, ahead, behind = np.split(gradients, [1, 1 + len(steps)], axis=1)
        H = np.zeros((len(poses), 6, 6))
        H[:, free] = (behind - ahead) / (2 * scale[:, None])
        pose_rows = slice(None, None, len(twists))
        H = (H + H.swapaxes(1, 2)) / 2
        return Quadratic(sums.log_odds[pose_rows], here[:, 0], sums.information[pose_rows], H)

    def _sum(self, poses: Floats) -> AssociationSum:
        frame = self.frame
        detection = frame.rules.judgement.detection
        arguments = frame.views, frame.body, poses, self.noise, detection, self.failing
        return sum_associations(*arguments)


@dataclass(frozen=True, eq=False)
class ExpectedTerm:
    """The log density of poses by the likeliest prediction for each, or of being elsewhere."""

    frame: Frame

    def linearise(self, poses: Floats) -> Quadratic:
        """Return second-order models at poses (H, 4, 4)."""
        frame, nothing = self.frame, np.zeros((len(poses), 6, 6))
        surprise = frame.rules.motion.surprise_after(frame.track.misses)
        terms = [Quadratic(np.full(len(poses), frame.elsewhere), nothing[..., 0], nothing, nothing)]
        for branch in frame.predictions:
            if branch.spread is None:  # a step or two give no covariance
                continue
            nearest = nearest_alike(poses, frame.body, branch.T_world_object)
            prior = NormalPrior(branch.T_world_object, branch.uncertainty, frame.free)
            term = prior.linearise(nearest)
            peak = branch.log_belief(surprise) + branch.log_peak(frame.free)
            terms.append(term._replace(value=term.value + peak))
        chosen, rows = np.argmax([term.value for term in terms], axis=0), np.arange(len(poses))
        return Quadratic._make(np.stack(parts)[chosen, rows] for parts in zip(*terms, strict=True))


class AssociationLikelihood:
    """The sum over associations of single ranges with a small body, and the track as a prior."""

    knows_detections = False

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        known = frame.track.residuals.of(RANGES)[:, 0]
        self._noise = noise_ratio(known, frame.rules.ranges)  # in σ_ε
        # log odds that a sensor fails of which nothing is known, and (L, 1) by the frames before
        self._unknown = float(logit(frame.rules.acceptance.mistaken))
        failing = frame.track.failing
        self._failing = np.array([[failing.get(v.name, self._unknown)] for v in frame.views])

    def fits(self, starts: Iterable[Start]) -> Iterator[tuple[Start, Fit]]:
        """Climb the posterior from all starts at once, and yield the ends, the best first.

        Ends at one place are given once; those too far behind the best are left out.
        """
        all_starts = list(starts)
        if not all_starts:
            return
        frame, (ends, values, levels) = self.frame, self._climb(all_starts)
        order = np.argsort(-values, kind="stable")
        cell = 0.1 * min(frame.sigmas) / frame.body.radius
        for k in order[distinct_poses(frame.body, ends[order], cell, whole=True)]:
            if values[k] > values[order[0]] - frame.rules.ranges.behind:
                widths = np.outer(levels[k], frame.sigmas).tolist()
                yield all_starts[k], Fit(ends[k], blurs_by_view(frame.views, widths))

    def fit(self, start: Start) -> Fit:
        """Climb the posterior, first with range errors as large as the start's uncertainty."""
        return next(self.fits([start]))[1]

    def _climb(self, starts: Sequence[Start]) -> tuple[Floats, Floats, list[list[float]]]:
        """Return ends of starts (H, 4, 4), their log densities, and the errors used in σ_ε."""
        frame = self.frame
        poses = np.array([start.T_world_object for start in starts])
        zero = np.zeros(6)
        wide = [zero if start.uncertainty is None else start.uncertainty for start in starts]
        blurs = widest_blurs(
            frame.views, frame.body, poses, np.where(frame.free, wide, 0.0), frame.rules.fit
        )
        begins = (blurs / frame.sigmas).max(axis=1)
        widest = float(begins.max())
        levels = [widest**share for share in narrowing(widest, frame.rules.fit)]
        widths = [level for level in levels if level > self._noise]
        few, many = (NewtonOptions(n, tolerance=1e-7) for n in (_STEPS, 30))
        through = begins[:, None] >= np.array(widths) * (1 - 1e-9)  # (H, W)
        for width, chosen in zip(widths, through.T, strict=True):
            term = self._posterior(width, second=False)
            poses[chosen] = ascend(term, poses[chosen], perturb, frame.free, few).states
        term = self._posterior(self._noise, second=False)
        end = ascend(term, poses, perturb, frame.free, many)
        used = [[*compress(widths, chosen), self._noise] for chosen in through.tolist()]
        return frame.oriented(end.states), end.values, used

    def judge(self, fit: Fit, start: Start) -> ScoredPose:
        """Judge a pose by the sum over all associations and by the track's prior."""
        frame, T, rules = self.frame, fit.T_world_object, self.frame.rules
        model, before = rules.judgement, frame.track.residuals
        arguments = frame.views, frame.body, T[None], self._noise, model.detection
        sums = sum_associations(*arguments, self._failing)
        shown = np.maximum(self._failing - sums.by_sensor, self._unknown)[:, 0].tolist()
        count = int(frame.free.sum())
        degrees = max(float(sums.met[0]) - count, 0.0)
        squares = float(sums.squares[0]) if degrees else 0.0
        noise = model.noise.memory * before.of(RANGES) + [[squares], [degrees]]
        covariance, volume = self._covariance(T, sums)
        # right poses meet all features, off by the noise less the degrees that the fit takes
        residual_degrees = np.maximum(sums.reached - count, 0.0)
        ahead = float((sums.most - residual_degrees / 2 - sums.log_odds)[0])
        expected = float(frame.log_densities(T[None])[0]) - frame.elsewhere
        return replace(
            judge(frame.finest, T, frame.free, model),
            covariance=covariance,
            log_evidence=float(sums.log_odds[0]) + frame.prior(T)[0] + volume,
            noise=before.followed(RANGES, noise, before.moments, before.biases, before.fields),
            spread=np.sqrt(np.diag(covariance)),
            elsewhere=float(np.logaddexp(frame.track.elsewhere, -expected)) + ahead,
            failing=dict(zip([view.name for view in frame.views], shown, strict=True)),
        )

    def _covariance(self, T: Floats, sums: AssociationSum) -> tuple[Floats, float]:
        """Return the covariance (6, 6), widened for likely alternatives, and the log volume."""
        frame, free, rules = self.frame, self.frame.free, self.frame.rules
        inner, known = np.ix_(free, free), frame.track.residuals.of(RANGES)
        # a direction that the ranges leave open is as uncertain as without any
        information = self._definite(self._posterior(self._noise, second=True).linearise(T[None]))
        information += np.diag(1 / frame.flat_prior[1][free] ** 2)
        C = np.linalg.inv(information)
        volume = 0.5 * float(np.linalg.slogdet(2 * np.pi * C)[1])
        degrees = rules.ranges.stated_degrees + float(known[1, 0])
        C *= rules.judgement.noise.enlargement(degrees)
        missed = 1 - rules.acceptance.confidence
        limit, weights = float(chdtri(len(C), missed)), np.linalg.inv(C)
        twists, likely = self._alternatives(T, sums, information)
        for twist in twists[likely > missed]:
            pull = weights @ twist
            squares = float(twist @ pull)
            # the ellipsoid contains alternatives likelier than that an ok pose is wrong
            if squares > limit:
                wider = 1 / limit - 1 / squares
                C += wider * np.outer(twist, twist)
                weights -= wider / (1 + wider * squares) * np.outer(pull, pull)
        covariance = np.zeros((6, 6))
        covariance[inner] = C
        return covariance, volume

    def _alternatives(self, T: Floats, sums: AssociationSum, A: Floats) -> tuple[Floats, Floats]:
        """Return twists (K, k) to the pose if one detection is false, and the probability of that.

        One least-squares step without the detection, from the information A (k, k) at the pose.
        """
        free, pairs = self.frame.free, sums.weights[:, 0].swapaxes(1, 2)  # (L, M, n)
        met, J = pairs.sum(axis=2) > 0, sums.J[:, 0][..., free]  # (L, n, k)
        pulls = (sums.pulls[:, 0].swapaxes(1, 2) @ J)[met]
        remaining = A - np.einsum("ljn,lnk,lnq->ljkq", pairs, J, J)[met]
        are_fixed = np.linalg.eigvalsh(remaining)[:, 0] > 0
        pulls, remaining = pulls[are_fixed], remaining[are_fixed]
        twists = np.zeros((len(pulls) + 1, 6))  # the first is the pose itself
        twists[1:, free] = -np.linalg.solve(remaining, pulls[..., None])[..., 0]
        posterior = self._posterior(self._noise, second=False)
        values = posterior.linearise(perturb(T[None], twists)).value
        log_volume = 0.5 * (np.linalg.slogdet(A)[1] - np.linalg.slogdet(remaining)[1])
        return twists[1:, free], expit(values[1:] - values[0] + log_volume)

    def density(self, fit: Fit, start: Start, other_matches: Matches) -> float:
        """Return the log density as `MatchedLikelihood`; clutter is common already."""
        return self.judge(fit, start).log_density

    def _posterior(self, noise: float, *, second: bool) -> Sum:
        """Return the posterior for ranges with errors of `noise` σ_ε, and the track's prior."""
        term = AssociationTerm(self.frame, noise, second, self._failing)
        return Sum((term, ExpectedTerm(self.frame)))

    def _definite(self, model: Quadratic) -> Floats:
        """Return minus the Hessian (k, k), with small positive values where it is not definite."""
        assert model.hessian is not None
        free, least = self.frame.free, self.frame.rules.ranges.min_information
        diagonal = np.diagonal(model.curvature[0])[free]
        scale = 1 / np.sqrt(np.maximum(diagonal, np.finfo(np.float64).eps))
        hessian = model.hessian[0][np.ix_(free, free)]
        values, vectors = np.linalg.eigh(hessian * scale * scale[:, None])
        # bounded below, in the original units
        return np.asarray(
            (vectors * np.maximum(values, least)) @ vectors.T / np.outer(scale, scale)
        )
