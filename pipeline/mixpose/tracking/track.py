"""What is known between two frames: where the body may be, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import gammaln

from mixpose.body import Body
from mixpose.constants import constant
from mixpose.judgement import (
    LEAST_BELIEF,
    ClutterRates,
    Prior,
    RememberedNoise,
    Shape,
    nearest_alike,
)
from mixpose.objective import View
from mixpose.records import DelayEstimate, Floats, Mask
from mixpose.rigid import inverse, perturb, twist_between
from mixpose.search import SearchState
from mixpose.tracking.motion import Course, Distances, MotionRules, RandomWalk, per_kind
from mixpose.tracking.sizes import Sizes
from mixpose.tracking.static_clutter import StaticClutter


@dataclass(frozen=True)
class Branch:
    """One place where the body may be, after a frame or as predicted for the next."""

    T_world_object: Floats  # (4, 4)
    weight: float = 1.0  # belief in this branch among its rivals
    # (6,), standard deviations of the next pose about the prediction
    uncertainty: Floats = field(default_factory=lambda: np.zeros(6))
    velocity: Floats | None = None  # (6,), twist per second where frames have times, else per frame
    # (6,), of the pose itself, where that is as large as its motion: the next frame takes the pose
    # as a prior, and no velocity is believed
    spread: Floats | None = None
    deviation: Floats | None = None  # (6,), the same, where anybody asks for velocities at moments
    course: Course | None = None  # for its velocity at a moment, there
    other: float | None = None  # log odds of another thing there, if it was seen beside the body

    def log_belief(self, surprise: float) -> float:
        """Logarithm of the belief that the body is here, where it is elsewhere by a `surprise`."""
        return math.log(max((1 - surprise) * self.weight, LEAST_BELIEF))

    def log_peak(self, free: Mask) -> float:
        """Logarithm of the largest normal density, where the pose before is a prior."""
        return -float(np.log(math.sqrt(2 * math.pi) * self.uncertainty[free]).sum())

    def log_density(self, T_world_object: Floats, free: Mask, rules: MotionRules) -> Floats:
        """Of poses (..., 4, 4) before the frame that this predicts, in directions that are free."""
        away = twist_between(self.T_world_object, T_world_object)
        off = np.divide(away, self.uncertainty, out=np.zeros(away.shape), where=free)
        squares = (off.reshape(*off.shape[:-1], 2, 3) ** 2).sum(axis=-1)  # of shifts, and of turns
        count, volume = int(free.sum()), float(np.log(self.uncertainty[free]).sum())
        if self.spread is not None:
            return np.asarray(self.log_peak(free) - 0.5 * squares.sum(axis=-1))
        # from a step or two, which are as wide in all directions of a kind: errors are Student's
        n, p = rules.known_from, free.reshape(2, 3).sum(axis=1)
        peak = float((gammaln((n + p) / 2) - gammaln(n / 2)).sum())
        tails = 0.5 * np.log1p(squares / n) @ (n + p)
        return np.asarray(peak - 0.5 * count * math.log(n * math.pi) - tails - volume)


def worth_telling(branches: Sequence[Branch], confidence: float) -> list[Branch]:
    """Branches without the unlikely ones that single ranges leave for further frames of ranges."""
    least = 1 - confidence
    return [one for one in branches if one.spread is None or one.weight >= least]


@dataclass(frozen=True)
class DelayEvidence:
    """What the frames so far say of how late sensors are, beyond what was told of them."""

    reference: str = ""  # the sensor against which delays are known; empty before the first frame
    names: tuple[str, ...] = ()  # the others
    information: Floats = field(default_factory=lambda: np.zeros((0, 0)))  # (n, n), s⁻²
    vector: Floats = field(default_factory=lambda: np.zeros(0))  # (n,), s⁻¹
    unknown_s: float = constant(0.1, "standard deviation of a delay of which nothing is known")

    @cached_property
    def seconds(self) -> Mapping[str, DelayEstimate]:
        """How late each sensor is, as far as it is known, and how surely."""
        inverted = np.linalg.inv(self.information + np.eye(len(self.names)) / self.unknown_s**2)
        late, deviations = inverted @ self.vector, np.sqrt(inverted.diagonal())
        return dict(zip(self.names, map(DelayEstimate, late.tolist(), deviations.tolist())))

    def applied(self, views: Sequence[View], time_s: float | None) -> list[View]:
        """Views as late as they are known to be; none is without times."""
        if time_s is None:
            return [replace(view, delay=0.0, readout=0.0, unsure=None) for view in views]
        applied = list(views)
        for k, view in enumerate(views):
            if view.unsure is not None:
                late = self.seconds.get(view.name, DelayEstimate(0.0, self.unknown_s))
                applied[k] = replace(
                    view,
                    delay=view.delay + late.seconds,
                    unsure=late.deviation,
                    estimated=late.seconds,
                )
        # a clock that differs by ten standard deviations is not the same: none is late then
        are_believed = all(abs(view.delay) <= 10 * self.unknown_s for view in applied)
        return applied if are_believed else [replace(view, delay=0.0) for view in applied]


@dataclass(frozen=True)
class Companion:
    """The poses of a body, a limb say, seen from another one, in frames that were sure of both."""

    T_other_object: Floats  # (4, 4), their mean
    squares: Floats  # (6,), mean squared twists from it, in the axes of the other body
    count: int  # of frames

    @classmethod
    def joined(
        cls, before: Companion | None, T_world_object: Floats, T_world_other: Floats, body: Body
    ) -> Companion:
        """What was known, and one more frame that is sure of both."""
        T = inverse(T_world_other) @ T_world_object
        before = before or cls(T, np.zeros(6), 0)
        away = twist_between(before.T_other_object, nearest_alike(T, body, before.T_other_object))
        n = before.count + 1
        squares = before.squares + (away**2 * (1 - 1 / n) - before.squares) / n
        return cls(perturb(before.T_other_object, away / n), squares, n)

    def expected(self, T_other: Floats, body: Body, rules: MotionRules) -> Branch:
        """Where the body is expected beside the other one."""
        n, few, guess = self.count, rules.known_from, per_kind(body.radius, rules.unknown) ** 2
        # what is guessed before anything is known counts as some frames
        spread = (n * self.squares + few * guess) / (n + few) * (1 + 1 / n)
        variances = np.maximum(spread, per_kind(body.radius, rules.steady) ** 2)
        wide = variances.reshape(2, 3) @ T_other[:3, :3].T ** 2
        return Branch(T_other @ self.T_other_object, uncertainty=np.sqrt(wide.ravel()))


@dataclass(frozen=True)
class Track:
    """What is known between two frames."""

    branches: tuple[Branch, ...] = ()  # best first; empty where nothing is known
    frame: int | None = None  # the last with a pose; None before the first
    time_s: float | None = None  # of that frame
    misses: int = 0  # frames since then
    residuals: RememberedNoise = RememberedNoise()  # so far
    sizes: Sizes = Sizes()  # of markers, as spots show them
    walk: RandomWalk | None = None  # None before two uncertain poses
    # features of the last pose that each sensor met
    met_before: Mapping[str, int] = field(default_factory=dict)
    search: SearchState = SearchState()  # where one with a budget goes on while nothing convinces
    delays: DelayEvidence = field(default_factory=DelayEvidence)  # how late sensors are
    doubted: bool = False  # whether another body may have what the last pose meets
    # log odds of a better pose, of single ranges, that nobody has looked at: where they are high it
    # is searched for
    elsewhere: float = -math.inf
    agreed: bool = False  # whether two sensors met most of the body in some frame
    believed: int = 0  # frames whose pose was ok
    gained: float = 0.0  # log evidence of the last of them per coordinate that it met
    shape: Shape | None = None  # what frames of which none was ok told of it
    known: bool = False  # whether it was told from things that have three markers alike
    # detections that sensors had left where a second pose was sought in vain
    tried: Mapping[str, int] = field(default_factory=dict)
    twice: float = -math.inf  # log odds that a second body is there, of those beside `branches[0]`
    # log odds of mistakes in the session, by name; of the others nothing is known
    mistaken: Mapping[str, float] = field(default_factory=dict)
    # log odds that what is followed is another body, or turned, by the reasons for it
    alike: Mapping[str, float] = field(default_factory=dict)
    rates: ClutterRates = ClutterRates()  # of clutter, since the last frame that was not ok
    clutter: StaticClutter = StaticClutter()  # what stayed where it was while the body was lost
    companions: Mapping[str, Companion] = field(default_factory=dict)  # by labels of other bodies
    distances: Distances | None = None  # between identical bodies, of which this is the first

    @cached_property
    def foretold(self) -> dict[tuple[int, float | None], list[Branch]]:
        """Where it expects the body in frames that were asked for already, see `predict`."""
        return {}

    def seconds_until(self, time_s: float | None) -> float | None:
        """Seconds since the last pose; None where either has no time, 0 if the clock went back."""
        return None if time_s is None or self.time_s is None else max(time_s - self.time_s, 0.0)

    def is_timed_as(self, time_s: float | None) -> bool:
        """Whether a frame has a time as the last pose, or none as that: else no velocity holds."""
        return (time_s is None) == (self.time_s is None)

    def is_in_turn(self, frame: int, every: int) -> bool:
        """Whether a frame is the first of so many numbers, whatever frames there are."""
        return self.frame is None or frame // every > self.frame // every

    def elapsed(self, frame: int, time_s: float | None) -> float:
        """Time since the last pose: seconds where both frames have times, else frames."""
        seconds = self.seconds_until(time_s)
        return float(frame - (self.frame or 0)) if seconds is None else seconds

    def missed(self, search: SearchState, clutter: StaticClutter) -> Track:
        """The track after a frame without a pose."""
        return replace(
            self, misses=self.misses + 1, search=search, clutter=clutter, rates=ClutterRates()
        )

    def nearest(self, T_world_object: Floats, body: Body) -> Branch | None:
        """The branch that a pose goes on from: the nearest."""
        if len(self.branches) == 1:
            return self.branches[0]
        scale = np.repeat([body.radius, 1.0], 3)
        places = [one.T_world_object for one in self.branches]
        away = [twist_between(T, nearest_alike(T_world_object, body, T)) / scale for T in places]
        return self.branches[int(np.linalg.norm(away, axis=1).argmin())] if away else None


def predict(
    track: Track, body: Body, frame: int, time_s: float | None, rules: MotionRules = MotionRules()
) -> list[Branch]:
    """Where the branches of a track expect the body; wider, the longer nothing was seen."""
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


def either(own: Prior, beside: Prior, misses: int, rules: MotionRules) -> Prior:
    """What a body's own track lets expect of a pose, or another body, the less the more misses."""
    share = rules.beside * (1 - rules.surprise) ** misses
    mine, theirs = own[0] + np.log(1 - share), beside[0] + np.log(share)
    return float(np.logaddexp(mine, theirs)), own[1] if mine > theirs else beside[1]
