"""What is known between two frames: where the body may be, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.judgement import Prior, RememberedNoise, nearest_alike
from mixpose.records import Floats
from mixpose.rigid import inverse, perturb, twist_between
from mixpose.search import SearchState
from mixpose.tracking.in_motion import DelayEvidence
from mixpose.tracking.motion import Course, MotionRules, RandomWalk
from mixpose.tracking.static_clutter import StaticClutter

if TYPE_CHECKING:
    from mixpose.tracking.likelihood import FrameData


@dataclass(frozen=True)
class Branch:
    """One place where the body may be.

    Where standard deviations of the pose are as large as its motion, the next frame takes it as a
    prior, and no velocity is believed.
    """

    T_world_object: Floats  # (4, 4)
    weight: float  # belief in this branch among its rivals
    velocity: Floats | None  # (6,), twist per second where frames have times, else per frame
    uncertainty: Floats  # (6,), standard deviations of the next pose about the prediction
    spread: Floats | None = None  # (6,), of the pose itself, where it is to be a prior
    course: Course | None = None  # for its velocity at a moment, where anybody asks for that


class SensorTally(NamedTuple):
    """How many features a sensor met in the last frame with a pose, and how many it should have."""

    met: int
    in_view: int

    def is_met(self, share: float) -> bool:
        """Whether it met at least a share of the body."""
        return self.met >= share * self.in_view > 0


@dataclass(frozen=True)
class Companion:
    """The poses of a body seen from another one, in frames that were sure of both.

    Limbs of a person, a tool and its tray stay near each other.  Where the one is sure and the
    other was lost, or moved as nobody expected, these tell where it may be.
    """

    T_other_object: Floats  # (4, 4), their mean
    squares: Floats  # (6,), mean squared twists from it, in the axes of the other body
    count: int  # of frames

    @classmethod
    def joined(
        cls, before: Companion | None, T_world_object: Floats, T_world_other: Floats, body: Body
    ) -> Companion:
        """What was known, and one more frame that is sure of both."""
        T = inverse(T_world_other) @ T_world_object
        if before is None:
            return cls(T, np.zeros(6), 1)
        away = twist_between(before.T_other_object, nearest_alike(T, body, before.T_other_object))
        n = before.count + 1
        squares = before.squares + (away**2 * (1 - 1 / n) - before.squares) / n
        return cls(perturb(before.T_other_object, away / n), squares, n)

    def expected(
        self, T_world_other: Floats, body: Body, rules: MotionRules
    ) -> tuple[Floats, Floats]:
        """Where the body is expected beside the other one, and standard deviations (6,) of that.

        What is guessed before anything is known counts as some frames.
        """
        n, few, guess = self.count, rules.known_from, rules.guess(body) ** 2
        spread = (n * self.squares + few * guess) / (n + few) * (1 + 1 / n)
        variances = np.maximum(spread, rules.steady(body) ** 2)
        wide = variances.reshape(2, 3) @ T_world_other[:3, :3].T ** 2
        return T_world_other @ self.T_other_object, np.sqrt(wide.ravel())


@dataclass(frozen=True)
class Track:
    """What is known between two frames."""

    branches: tuple[Branch, ...] = ()  # best first; empty where nothing is known
    frame: int | None = None  # the last with a pose; None before the first
    time_s: float | None = None  # of that frame
    misses: int = 0  # frames since then
    residuals: RememberedNoise = RememberedNoise()  # so far
    walk: RandomWalk | None = None  # None before two uncertain poses
    tallies: Mapping[str, SensorTally] = field(default_factory=dict)  # of the last pose, by sensor
    search: SearchState = SearchState()  # where one with a budget goes on while nothing convinces
    delays: DelayEvidence = field(default_factory=DelayEvidence)  # how late sensors are
    doubted: bool = False  # whether another body may have what the last pose meets
    agreed: bool = False  # whether two sensors met most of the body in some frame
    believed: int = 0  # frames whose pose was ok
    known: bool = False  # whether it was told from things that have three markers alike
    clutter: StaticClutter = StaticClutter()  # what stayed where it was while the body was lost
    companions: Mapping[str, Companion] = field(default_factory=dict)  # by labels of other bodies

    def seconds_until(self, time_s: float | None) -> float | None:
        """Seconds since the last pose; None where either has no time."""
        return None if time_s is None or self.time_s is None else time_s - self.time_s

    def elapsed(self, frame: int, time_s: float | None) -> float:
        """Time since the last pose: seconds where both frames have times, else frames."""
        seconds = self.seconds_until(time_s)
        return float(frame - (self.frame or 0)) if seconds is None else seconds

    def missed(self, search: SearchState, clutter: StaticClutter) -> Track:
        """The track after a frame without a pose."""
        return replace(self, misses=self.misses + 1, search=search, clutter=clutter)


@dataclass(frozen=True)
class Prediction:
    """Where a branch expects the body in a frame."""

    T_world_object: Floats
    uncertainty: Floats
    weight: float
    is_prior: bool = False

    def log_density(
        self, T_world_object: Floats, free: NDArray[np.bool_], rules: MotionRules
    ) -> float:
        """Of a pose before its frame, in the directions that are free.

        How far a prediction errs is known from a step or two: errors have the distribution of
        Student.
        """
        u = self.uncertainty[free]
        scaled = twist_between(self.T_world_object, T_world_object)[free] / u
        count, volume = len(u), float(np.log(u).sum())
        if self.is_prior:
            return float(-0.5 * scaled @ scaled) - 0.5 * count * math.log(2 * math.pi) - volume
        n = rules.known_from
        peak = math.lgamma((n + 1) / 2) - math.lgamma(n / 2) - 0.5 * math.log(n * math.pi)
        tails = 0.5 * (n + 1) * float(np.log1p(scaled * scaled / n).sum())
        return count * peak - tails - volume


def predict(
    track: Track,
    body: Body,
    frame: int,
    time_s: float | None,
    rules: MotionRules = MotionRules(),
) -> list[Prediction]:
    """Where the branches of a track expect the body.

    The longer nothing was seen, the wider; velocities are believed for a few frames only.
    """
    elapsed = track.elapsed(frame, time_s)
    widening = min(rules.widening**track.misses, rules.widest * (1 + track.misses / 10))
    predictions = []
    for branch in track.branches:
        T = branch.T_world_object
        if branch.spread is not None:
            walk = track.walk or RandomWalk.unknown(body, elapsed, rules)
            u = np.sqrt(branch.spread**2 + walk.variance(elapsed))
            predictions.append(Prediction(T, u, branch.weight, is_prior=True))
            continue
        if branch.velocity is not None and track.misses <= rules.coasting:
            T = perturb(T, branch.velocity * elapsed)
        predictions.append(Prediction(T, branch.uncertainty * widening, branch.weight))
    return predictions


def either(own: Prior, beside: Prior, misses: int, rules: MotionRules) -> Prior:
    """What the body's own track lets expect, or another body, of a pose.

    Either may hold, the other body the less the longer this one was away.  As both are densities
    of poses, no more of the poses made by chance are believed than without the other body.
    """
    share = rules.beside * (1 - rules.surprise) ** misses
    mine, theirs = own.log_density + np.log(1 - share), beside.log_density + np.log(share)
    spread = own.spread if mine > theirs else beside.spread
    return Prior(float(np.logaddexp(mine, theirs)), spread)


class Found(NamedTuple):
    """A pose of a frame, and how sure it is."""

    T_world_object: Floats  # (4, 4)
    weight: float  # belief among its rivals
    spread: Floats | None = None  # (6,), if that is to be a prior
    deviation: Floats | None = None  # (6,), where anybody asks for velocities at moments


def follow(data: FrameData, found: Sequence[Found]) -> Track:
    """The track after a frame with poses, the best first, as far as these tell."""
    track, body, rules, course_rules = data.track, data.body, data.rules.motion, data.rules.course
    elapsed, walk = track.elapsed(data.frame, data.time_s), track.walk
    branches: list[Branch] = []
    for T, weight, spread, deviation in found:
        velocity, course, uncertainty = None, None, rules.unsteady * rules.steady(body)
        parent = nearest_branch(track, T, body)
        before = parent.course if parent else None
        if parent is not None and track.frame is not None and elapsed > 0:
            moved = twist_between(parent.T_world_object, T)
            if spread is not None and not branches:
                walk = walk or RandomWalk.unknown(body, elapsed, rules)
                walk = walk.joined(moved, body.radius, elapsed)
            elif spread is None and track.misses <= rules.coasting:
                velocity = moved / elapsed
                last = parent.velocity
                change = moved / 2 if last is None else moved - last * elapsed
                # of one frame, where it was seen over several
                change = np.abs(change / (1 + track.misses)).reshape(2, 3)
                uncertainty = np.maximum(np.repeat(change.max(axis=1), 3), rules.steady(body))
            if deviation is not None and before and elapsed <= course_rules.longest_s:
                course = before.followed(moved, deviation, elapsed, course_rules)
        if deviation is not None:
            course = course or Course.begun(deviation, body, course_rules)
        branches.append(Branch(T, weight, velocity, uncertainty, spread, course))
    return replace(
        track,
        branches=tuple(branches),
        frame=data.frame,
        time_s=data.time_s,
        misses=0,
        walk=walk,
        search=SearchState(),
    )


def nearest_branch(track: Track, T: Floats, body: Body) -> Branch | None:
    """The branch that a pose goes on from: the nearest."""
    scale = np.repeat([body.radius, 1.0], 3)

    def away(branch: Branch) -> float:
        return float(np.linalg.norm(twist_between(branch.T_world_object, T) / scale))

    return min(track.branches, key=away, default=None)
