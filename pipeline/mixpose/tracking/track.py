"""The state of tracking between two frames: where the body may be, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from scipy.special import gammaln

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement import (
    LEAST_BELIEF,
    ClutterRates,
    Mistake,
    Prior,
    RememberedNoise,
    Shape,
    nearest_alike,
)
from mixpose.objective import View
from mixpose.records import DelayEstimate, Floats, Mask, replace
from mixpose.rigid import inverse, perturb, twist_between
from mixpose.search import SearchState
from mixpose.tracking.motion import Distances, MotionFilter, MotionRules, RandomWalk, per_kind
from mixpose.tracking.sizes import Sizes
from mixpose.tracking.static_clutter import StaticClutter


@dataclass(frozen=True)
class Branch:
    """One place where the body may be, after a frame or as predicted for the next."""

    T_world_object: Floats  # (4, 4)
    weight: float = 1.0  # probability of this branch among its rivals
    # (6,), standard deviations of the next pose about the prediction
    uncertainty: Floats = field(default_factory=lambda: np.zeros(6))
    velocity: Floats | None = None  # (6,), twist per second where frames have times, else per frame
    # (6,), of the pose itself, if as uncertain as its motion: the next frame takes the pose
    # as a prior, and no velocity is believed
    spread: Floats | None = None
    # (6, 6), covariance of the pose by what its frame leaves open
    left_open: Floats = field(default_factory=lambda: np.zeros((6, 6)))
    # (6,), standard deviations of the pose itself, but for persistent errors
    deviation: Floats = field(default_factory=lambda: np.zeros(6))
    motion_filter: MotionFilter | None = None  # then gives the velocity at a moment
    log_odds_other: float | None = None  # of another thing here, if one was seen beside the body

    def log_belief(self, surprise: float) -> float:
        """Return the log probability of this branch, if a `surprise` is elsewhere."""
        return math.log(max((1 - surprise) * self.weight, LEAST_BELIEF))

    def log_peak(self, free: Mask) -> float:
        """Return the log of the largest normal density, where the pose before is a prior."""
        return -float(np.log(math.sqrt(2 * math.pi) * self.uncertainty[free]).sum())

    def log_density(self, T_world_object: Floats, free: Mask, rules: MotionRules) -> Floats:
        """Return log densities of poses (..., 4, 4) by this prediction, in the free directions."""
        twists = twist_between(self.T_world_object, T_world_object)
        if self.spread is None:
            return _log_students(twists, self.uncertainty, free, rules)
        off = np.divide(twists, self.uncertainty, out=np.zeros(twists.shape), where=free)
        return np.asarray(self.log_peak(free) - 0.5 * np.vecdot(off, off))


def log_densities(
    branches: Sequence[Branch], poses: Floats, free: Mask, rules: MotionRules
) -> Floats:
    """Return log densities (B, K) of poses (B, K, 4, 4) by predictions, as `Branch.log_density`."""
    if not branches or any(branch.spread is not None for branch in branches):
        logs = [branch.log_density(T, free, rules) for branch, T in zip(branches, poses)]
        return np.reshape(logs, poses.shape[:2])
    uncertainties = np.array([branch.uncertainty for branch in branches])[:, None]
    return _log_students(twist_between(places_of(branches), poses), uncertainties, free, rules)


def places_of(branches: Sequence[Branch]) -> Floats:
    """Return the poses of predictions (B, 1, 4, 4)."""
    return np.reshape([branch.T_world_object for branch in branches], (-1, 1, 4, 4))


def _log_students(twists: Floats, uncertainty: Floats, free: Mask, rules: MotionRules) -> Floats:
    """Return log densities of twists (..., 6) by uncertainties (..., 6), of Student's kind.

    An uncertainty from a step or two, alike in directions of a kind, makes errors Student's.
    """
    off = np.divide(twists, uncertainty, out=np.zeros(twists.shape), where=free)
    off = off.reshape(*off.shape[:-1], 2, 3)  # of shifts and of turns
    exponents, peak = _student(tuple(free.tolist()), rules.known_from)
    tails = np.log1p(np.vecdot(off, off) / rules.known_from) @ exponents
    return np.asarray(peak - tails - np.log(uncertainty[..., free]).sum(axis=-1))


@lru_cache(maxsize=16)
def _student(free: tuple[bool, ...], n: float) -> tuple[Floats, float]:
    """Return exponents (2,) of Student's densities of shifts and of turns, and their log peak."""
    p = np.array([sum(free[:3]), sum(free[3:])])
    peak = float((gammaln((n + p) / 2) - gammaln(n / 2)).sum())
    return 0.5 * (n + p), peak - 0.5 * sum(free) * math.log(n * math.pi)


def likely_branches(branches: Sequence[Branch], confidence: float) -> list[Branch]:
    """Return branches without the unlikely ones that single ranges keep for further frames."""
    least = 1 - confidence
    return [branch for branch in branches if branch.spread is None or branch.weight >= least]


@dataclass(frozen=True)
class DelayEvidence:
    """Information about sensor delays from the frames so far, beyond the configured delays."""

    reference: str = ""  # the sensor that delays are relative to; empty before the first frame
    names: tuple[str, ...] = ()  # other sensors with estimated delays
    information: Floats = field(default_factory=lambda: np.zeros((0, 0)))  # (n, n), s⁻²
    vector: Floats = field(default_factory=lambda: np.zeros(0))  # (n,), s⁻¹
    unknown_s: float = constant(0.1, "standard deviation of a delay of which nothing is known")

    @cached_property
    def seconds(self) -> Mapping[str, DelayEstimate]:
        """Return the estimated delay of each sensor with its standard deviation."""
        inverted = np.linalg.inv(self.information + np.eye(len(self.names)) / self.unknown_s**2)
        delays, deviations = inverted @ self.vector, np.sqrt(inverted.diagonal())
        return dict(zip(self.names, map(DelayEstimate, delays.tolist(), deviations.tolist())))

    def applied(self, views: Sequence[View], time_s: float | None) -> list[View]:
        """Return views with their estimated delays; without any where the frame has no time."""
        if time_s is None:
            return [replace(view, delay=0.0, readout=0.0, unsure=None) for view in views]
        applied = list(views)
        for k, view in enumerate(views):
            if view.unsure is not None:
                delay = self.seconds.get(view.name, DelayEstimate(0.0, self.unknown_s))
                applied[k] = replace(
                    view,
                    delay=view.delay + delay.seconds,
                    unsure=delay.deviation,
                    estimated=delay.seconds,
                )
        # with a delay of ten standard deviations clocks are not the same: no delay is used then
        are_believed = all(abs(view.delay) <= 10 * self.unknown_s for view in applied)
        return applied if are_believed else [replace(view, delay=0.0) for view in applied]


@dataclass(frozen=True)
class Companion:
    """Poses of a body relative to another one, such as a limb, in frames that were sure of both."""

    T_other_object: Floats  # (4, 4), their mean
    squares: Floats  # (6,), mean squared twists from the mean, in the axes of the other body
    count: int  # of frames

    @classmethod
    def joined(
        cls, before: Companion | None, T_world_object: Floats, T_world_other: Floats, body: Body
    ) -> Companion:
        """Return the statistics with one more frame that is sure of both bodies."""
        T = inverse(T_world_other) @ T_world_object
        before = before or cls(T, np.zeros(6), 0)
        twist = twist_between(before.T_other_object, nearest_alike(T, body, before.T_other_object))
        n = before.count + 1
        squares = before.squares + (twist**2 * (1 - 1 / n) - before.squares) / n
        return cls(perturb(before.T_other_object, twist / n), squares, n)

    def expected(self, T_other: Floats, body: Body, rules: MotionRules) -> Branch:
        """Return where the body is expected beside the other one."""
        n, guess = self.count, per_kind(body.radius, rules.unknown) ** 2
        # the guess before any frame counts as `known_from` frames
        spread = (n * self.squares + rules.known_from * guess) / (n + rules.known_from)
        spread *= 1 + 1 / n
        variances = np.maximum(spread, per_kind(body.radius, rules.steady) ** 2)
        wide = variances.reshape(2, 3) @ T_other[:3, :3].T ** 2
        return Branch(T_other @ self.T_other_object, uncertainty=np.sqrt(wide.ravel()))


@dataclass(frozen=True)
class Track:
    """What is known of a body between two frames."""

    branches: tuple[Branch, ...] = ()  # best first; empty where nothing is known
    frame: int | None = None  # the last with a pose; None before the first
    time_s: float | None = None  # of that frame
    misses: int = 0  # frames since then
    residuals: RememberedNoise = RememberedNoise()  # so far
    sizes: Sizes = Sizes()  # of markers, estimated from their spots
    walk: RandomWalk | None = None  # None before two uncertain poses
    # number of features that each sensor met at the last pose
    met_before: Mapping[str, int] = field(default_factory=dict)
    search: SearchState = SearchState()  # where a search with a budget continues
    delays: DelayEvidence = field(default_factory=DelayEvidence)  # of sensors
    doubted: bool = False  # whether the last frame was not ok
    # log odds, of single ranges, of a better pose not searched for so far; if high it is searched
    elsewhere: float = -math.inf
    # log odds by name that sensors fail, whose single ranges are all off or of something else
    failing: Mapping[str, float] = field(default_factory=dict)
    sensors_agreed: bool = False  # whether two sensors met most of the body in some frame
    ok_count: int = 0  # frames whose pose was ok
    gained: float = 0.0  # log evidence per met coordinate of the last ok pose
    shape: Shape | None = None  # evidence about the body's shape while no frame was ok
    is_identified: bool = False  # told apart from things with three markers alike
    # number of unclaimed detections by sensor when a search for a second pose failed
    tried: Mapping[str, int] = field(default_factory=dict)
    log_odds_twice: float = -math.inf  # that the body is in view again, beside `branches[0]`
    # mistakes in the session, by name; none for mistakes without evidence
    mistaken: Mapping[str, Mistake] = field(default_factory=dict)
    # log odds that another body, or this one turned, is followed, by reason
    confused: Mapping[str, float] = field(default_factory=dict)
    rates: ClutterRates = ClutterRates()  # of clutter, since the last frame that was not ok
    clutter: StaticClutter = StaticClutter()  # detections that did not move while the body was lost
    companions: Mapping[str, Companion] = field(default_factory=dict)  # by labels of other bodies
    distances: Distances | None = None  # between identical bodies; only at the first of them

    @cached_property
    def cached_predictions(self) -> dict[tuple[int, float | None], list[Branch]]:
        """Return the cache of predictions by frame number and time, see `predict`."""
        return {}

    def log_odds_mistaken(self, name: str) -> float:
        """Return the log odds of a mistake in the session; 0 if there is no evidence."""
        return self.mistaken[name].log_odds if name in self.mistaken else 0.0

    def seconds_until(self, time_s: float | None) -> float | None:
        """Return seconds since the last pose: None without times, 0 if the clock went back."""
        return None if time_s is None or self.time_s is None else max(time_s - self.time_s, 0.0)

    def is_timed_as(self, time_s: float | None) -> bool:
        """Test whether a frame has a time as the last pose has, or none; else no velocity holds."""
        return (time_s is None) == (self.time_s is None)

    def is_in_turn(self, frame: int, every: int) -> bool:
        """Test whether a new block of `every` frame numbers began since the last pose."""
        return self.frame is None or frame // every > self.frame // every

    def elapsed(self, frame: int, time_s: float | None) -> float:
        """Return the time since the last pose: seconds if both frames have times, else frames."""
        seconds = self.seconds_until(time_s)
        return float(frame - (self.frame or 0)) if seconds is None else seconds

    def missed(self, search: SearchState, clutter: StaticClutter) -> Track:
        """Return the track after a frame without a pose."""
        return replace(
            self, misses=self.misses + 1, search=search, clutter=clutter, rates=ClutterRates()
        )

    def nearest(self, T_world_object: Floats, body: Body) -> Branch | None:
        """Return the branch that a pose goes on from: the nearest."""
        if len(self.branches) == 1:
            return self.branches[0]
        scale = np.repeat([body.radius, 1.0], 3)
        poses = [branch.T_world_object for branch in self.branches]
        twists = [twist_between(T, nearest_alike(T_world_object, body, T)) / scale for T in poses]
        return self.branches[int(np.linalg.norm(twists, axis=1).argmin())] if twists else None


def predict(
    track: Track, body: Body, frame: int, time_s: float | None, rules: MotionRules = MotionRules()
) -> list[Branch]:
    """Predict where the branches of a track expect the body; wider the longer it was missing."""
    elapsed, is_timed = track.elapsed(frame, time_s), track.is_timed_as(time_s)
    widening = min(rules.widening**track.misses, rules.widest * (1 + track.misses / 10))
    predictions = []
    for branch in track.branches:
        T, uncertainty = branch.T_world_object, branch.uncertainty * widening
        if branch.spread is not None:
            walk = track.walk or RandomWalk.unknown(body, elapsed, rules)
            uncertainty = np.sqrt(branch.spread**2 + walk.variance(elapsed))
        elif branch.velocity is not None and track.misses <= rules.coasting and is_timed:
            T = perturb(T, branch.velocity * elapsed)
        predictions.append(replace(branch, T_world_object=T, uncertainty=uncertainty))
    return predictions


def mixed_prior(own: Prior, companion: Prior, misses: int, rules: MotionRules) -> Prior:
    """Mix the priors of a pose by its track and a companion, which counts less after misses."""
    share = rules.beside * (1 - rules.surprise) ** misses
    by_track, by_companion = own[0] + np.log(1 - share), companion[0] + np.log(share)
    uncertainty = own[1] if by_track > by_companion else companion[1]
    return float(np.logaddexp(by_track, by_companion)), uncertainty
