"""What is known between two frames: where the body may be, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.judgement import Prior, Residuals, nearest_alike
from mixpose.rigid import Floats, perturb, twist_between
from mixpose.search import SearchState
from mixpose.tracking.companion import Companion
from mixpose.tracking.delays import DelayEvidence
from mixpose.tracking.motion import Course, CourseRules, MotionRules, RandomWalk
from mixpose.tracking.static_clutter import StaticClutter


@dataclass(frozen=True)
class Branch:
    """One place where the body may be.

    Attributes
    ----------
    T_world_object : (4, 4) float64
    weight : float
        Belief in this branch among its rivals.
    velocity : (6,) float64 or None
        Twist per second where frames have times, else per frame.
    uncertainty : (6,) float64
        Standard deviations of the next pose about the prediction.
    spread : (6,) float64 or None
        Standard deviations of the pose itself, where they are as large as its motion: then the
        next frame takes it as a prior, and no velocity is believed.
    course : Course or None
        From which its velocity at a moment is known; None where nobody asks for that.
    """

    T_world_object: Floats
    weight: float
    velocity: Floats | None
    uncertainty: Floats
    spread: Floats | None = None
    course: Course | None = None


class SensorTally(NamedTuple):
    """How many features a sensor met in the last frame with a pose, and how many it should have."""

    met: int
    in_view: int


@dataclass(frozen=True)
class Track:
    """What is known between two frames.

    Attributes
    ----------
    branches : tuple of Branch
        Best first; empty where nothing is known.
    frame : int or None
        The last frame with a pose; None before the first.
    time_s : float or None
        Its time.
    misses : int
        Frames since then.
    residuals : Residuals
        So far.
    walk : RandomWalk or None
        None before two uncertain poses.
    tallies : mapping of str to SensorTally
        By sensor, of the last frame with a pose.
    search : SearchState
        Where a search with a budget goes on while nothing convinces.
    delays : DelayEvidence
        How late sensors are, as far as it was seen.
    doubted : bool
        Whether another body of the scene may have what the last pose meets.
    agreed : bool
        Whether two sensors met most of the body in some frame.
    believed : int
        Frames whose pose was ok.
    known : bool
        Whether the body was told from things that have three markers alike.
    clutter : StaticClutter
        What stayed where it was while the body was lost.
    companions : mapping of str to Companion
        Where it was beside other bodies, by their labels.
    """

    branches: tuple[Branch, ...] = ()
    frame: int | None = None
    time_s: float | None = None
    misses: int = 0
    residuals: Residuals = Residuals()
    walk: RandomWalk | None = None
    tallies: Mapping[str, SensorTally] = field(default_factory=dict)
    search: SearchState = SearchState()
    delays: DelayEvidence = field(default_factory=DelayEvidence)
    doubted: bool = False
    agreed: bool = False
    believed: int = 0
    known: bool = False
    clutter: StaticClutter = StaticClutter()
    companions: Mapping[str, Companion] = field(default_factory=dict)

    def seconds_until(self, time_s: float | None) -> float | None:
        """Seconds since the last pose; None where either has no time."""
        return None if time_s is None or self.time_s is None else time_s - self.time_s

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
    elapsed = elapsed_since(track, frame, time_s)
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


def prior_of(
    T_world_object: Floats,
    predictions: Sequence[Prediction],
    body: Body,
    free: NDArray[np.bool_],
    misses: int,
    rules: MotionRules,
    anywhere: Prior,
) -> Prior:
    """Density of a pose before its frame: the predictions, or now and then anywhere."""
    if not predictions:
        return anywhere
    surprise = min(rules.surprise * (1 + misses), 1.0)
    terms, spreads = [np.log(surprise) + anywhere.log_density], [anywhere.spread]
    for prediction in predictions:
        u = prediction.uncertainty[free]
        twist = twist_between(
            prediction.T_world_object,
            nearest_alike(T_world_object, body, prediction.T_world_object),
        )
        log_density = _log_density(twist[free] / u, rules, prediction) - np.log(u).sum()
        weight = max((1 - surprise) * prediction.weight, 1e-12)
        terms.append(np.log(weight) + log_density)
        spreads.append(prediction.uncertainty)
    # directions that the data leave open are as uncertain as where the pose most likely comes from
    return Prior(float(np.logaddexp.reduce(terms)), spreads[int(np.argmax(terms))])


def _log_density(scaled: Floats, rules: MotionRules, prediction: Prediction) -> float:
    """Of a pose so many standard deviations (k,) from a prediction, but for their product.

    How far a prediction errs is known from a step or two: errors have the distribution of Student.
    """
    if prediction.is_prior:
        return float(-0.5 * scaled @ scaled) - 0.5 * len(scaled) * math.log(2 * math.pi)
    n = rules.known_from
    peak = math.lgamma((n + 1) / 2) - math.lgamma(n / 2) - 0.5 * math.log(n * math.pi)
    return len(scaled) * peak - 0.5 * (n + 1) * float(np.log1p(scaled * scaled / n).sum())


class Found(NamedTuple):
    """A pose of a frame, its belief among its rivals, and its spread if that is to be a prior.

    `deviation` are its standard deviations (6,), None where nobody asks for velocities at moments.
    """

    T_world_object: Floats
    weight: float
    spread: Floats | None = None
    deviation: Floats | None = None


def follow(
    track: Track,
    body: Body,
    found: Sequence[Found],
    frame: int,
    time_s: float | None,
    rules: MotionRules,
    course_rules: CourseRules = CourseRules(),
) -> Track:
    """The track after a frame with poses, as far as these tell.

    Parameters
    ----------
    track : Track
        Before the frame.
    body : Body
    found : sequence of Found
        Best first.
    frame, time_s
        Of the frame.
    rules : MotionRules
    course_rules : CourseRules
    """
    elapsed = elapsed_since(track, frame, time_s)
    branches: list[Branch] = []
    walk = track.walk
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
                change = change / (1 + track.misses)
                uncertainty = np.maximum(_per_kind(change), rules.steady(body))
            if deviation is not None and before and elapsed <= course_rules.longest_s:
                course = before.followed(moved, deviation, elapsed, course_rules)
        if deviation is not None:
            course = course or Course.begun(deviation, body, course_rules)
        branches.append(Branch(T, weight, velocity, uncertainty, spread, course))
    return replace(
        track,
        branches=tuple(branches),
        frame=frame,
        time_s=time_s,
        misses=0,
        walk=walk,
        search=SearchState(),
    )


def elapsed_since(track: Track, frame: int, time_s: float | None) -> float:
    """Time since the last pose: seconds where both frames have times, else frames."""
    seconds = track.seconds_until(time_s)
    return float(frame - (track.frame or 0)) if seconds is None else seconds


def nearest_branch(track: Track, T: Floats, body: Body) -> Branch | None:
    """The branch that a pose goes on from: the nearest."""
    if not track.branches:
        return None
    away = [
        np.linalg.norm(twist_between(branch.T_world_object, T) / np.repeat([body.radius, 1.0], 3))
        for branch in track.branches
    ]
    return track.branches[int(np.argmin(away))]


def _per_kind(twist: Floats) -> Floats:
    """The largest of the lengths and the largest of the angles, for all directions alike."""
    return np.repeat([np.abs(twist[:3]).max(), np.abs(twist[3:]).max()], 3)
