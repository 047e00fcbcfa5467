"""A case: recordings with their right answers, and what a tracker makes of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from benchmarks.search_cases import NOISE_PX, Row, absent, trial
from numpy.typing import NDArray

from mixpose.fit import EstimatorOptions
from mixpose.judgement import ScoredPose
from mixpose.objective import View
from mixpose.poses.consistency import normalised_error_squared
from mixpose.records import Estimate, PointPattern
from mixpose.rigid import perturb, rotation_angle_deg, transform, twist_between
from mixpose.search import Candidate, SearchState
from mixpose.tracking import Tracker
from mixpose.tracking import frame as tracked
from mixpose.tracking.frame import Start
from mixpose.tracking.proposers import candidates_of, is_doubtful, searched, starts_at
from mixpose.tracking.rules import ProposalRules

Floats: TypeAlias = NDArray[np.float64]
Change: TypeAlias = Callable[[Tracker], Tracker]

CROWDED = Row("1 pinhole", 8, 1, 60, 0.95)
ENTERING = Row("1 pinhole", 8, 1, 0, 0.95)
LAMPS = 10  # of a room that a body comes into
FRESH = 10_000  # first seed of frames without a body


@dataclass(frozen=True)
class Frame:
    """What sensors saw of a body, and its right poses (n, 4, 4); none where it is not there."""

    number: int
    time_s: float | None
    views: list[View]
    answers: Floats


@dataclass(frozen=True)
class Recording:
    """Frames that follow each other, and a tracker for them."""

    tracker: Tracker
    frames: list[Frame]


@dataclass(frozen=True)
class Case:
    """Recordings of one kind, and how far off a right pose may be."""

    name: str
    recordings: list[Recording]
    largest_angle_deg: float
    largest_shift: float
    single_frames: bool = False


@dataclass(frozen=True)
class Outcome:
    """What a tracker said of one frame.

    Attributes
    ----------
    present, right : bool
        Whether the body was there, and whether the pose is a right one.
    status : str
    angle_deg, shift : float
        Error of the pose; the shift is that of the middle of the features.  NaN without a pose.
    squared : float
        Squared error per dimension, in standard deviations; NaN without a covariance.
    ms : float
        Of the processor.
    """

    present: bool
    right: bool
    status: str
    angle_deg: float
    shift: float
    squared: float
    ms: float


class RememberedSearch:
    """The proposer `searched`, which looks into what was searched already.

    Candidates are the same whatever is switched off, but for the rules that they are ranked by.
    """

    __name__ = searched.__name__

    def __init__(self) -> None:
        self.unspent_s = 0.0
        self._found: dict[tuple[object, ...], tuple[float, list[Candidate], object]] = {}

    def __call__(self, frame: tracked.Frame, ranked: list[ScoredPose]) -> Iterable[Start]:
        """Starts, as `searched` gives them."""
        return starts_at(frame, self._candidates(frame)) if is_doubtful(frame, ranked) else []

    def _candidates(self, data: tracked.Frame) -> list[Candidate]:
        if data.track.clutter.places or data.track.search != SearchState():
            return candidates_of(data)  # depends on the frames before
        T = None if data.T_reference is None else data.T_reference.tobytes()
        judgement = data.rules.judgement
        rules = judgement.detection, judgement.noise.errors, judgement.association
        key = (*((id(v.observation), id(v.sensor)) for v in data.views), T, rules)
        if key in self._found:
            spent, candidates, _ = self._found[key]
            self.unspent_s += spent
            return candidates
        began = time.process_time()
        candidates = candidates_of(data)
        # views are kept with it, as another may get the number of one that is gone
        self._found[key] = (time.process_time() - began, candidates, list(data.views))
        return candidates


def outcomes(case: Case, change: Change, memory: RememberedSearch) -> list[Outcome]:
    """Track all recordings of a case with something switched off."""
    found = []
    for recording in case.recordings:
        tracker = change(recording.tracker)
        proposers = tuple(memory if one is searched else one for one in tracker.proposers)
        tracker = replace(tracker, proposers=proposers)
        track = tracker.begin()
        for frame in recording.frames:
            began, before = time.process_time(), memory.unspent_s
            track, estimate = tracker.advance(track, frame.number, frame.time_s, frame.views)
            spent = time.process_time() - began + memory.unspent_s - before
            found.append(_outcome(case, recording, frame, estimate, 1e3 * spent))
    return found


def _outcome(
    case: Case, recording: Recording, frame: Frame, estimate: Estimate, ms: float
) -> Outcome:
    T, present = estimate.T_world_object, bool(len(frame.answers))
    if T is None or not present:
        return Outcome(present, False, estimate.status, np.nan, np.nan, np.nan, ms)
    angles = rotation_angle_deg(np.broadcast_to(T, frame.answers.shape), frame.answers)
    centre = recording.tracker.body.means.mean(axis=0)[None]
    shifts = np.linalg.norm(transform(frame.answers, centre) - transform(T, centre), axis=-1)[:, 0]
    # answers turned alike may lie beside each other, as those of a grid do
    near = np.flatnonzero(angles <= angles.min() + 0.5)
    k = int(near[np.argmin(shifts[near])])
    squared = np.nan
    if estimate.covariance is not None:
        away = twist_between(frame.answers[k], T)
        total, dimensions = normalised_error_squared(away, estimate.covariance)
        squared = np.nan if total is None else total / dimensions
    right = bool(angles[k] < case.largest_angle_deg and shifts[k] < case.largest_shift)
    return Outcome(present, right, estimate.status, float(angles[k]), float(shifts[k]), squared, ms)


def search_case(row: Row, trials: int) -> Case:
    """A row of the search benchmark: first frames, a third of them without a body."""
    present = [trial(row, seed) for seed in range(trials)]
    empty = [absent(row, FRESH + seed) for seed in range(-(-trials // 2))]
    recordings = []
    for one, there in [(one, True) for one in present] + [(one, False) for one in empty]:
        answers = one.T_world_object @ one.body.symmetries if there else np.zeros((0, 4, 4))
        tracker = Tracker.create(one.body, EstimatorOptions())
        recordings.append(Recording(tracker, [Frame(0, None, one.views, answers)]))
    limits = present[0].largest_angle_deg, present[0].largest_shift * present[0].distance
    return Case(row.name, recordings, *limits, single_frames=True)


def loose_start_case(trials: int) -> Case:
    """One camera, 60 false features, and a start that is up to 15 mm and 7.5° off."""
    recordings = []
    for seed in range(trials):
        one = trial(CROWDED, seed)
        rng = np.random.default_rng([seed, 2])
        off = rng.uniform(-1, 1, 6) * np.repeat([15.0, np.radians(7.5)], 3)
        start = perturb(one.T_world_object, off)
        tracker = Tracker.create(
            one.body, EstimatorOptions(), start, rotation_deg=7.5, distance=15.0
        )
        recordings.append(Recording(tracker, [Frame(0, None, one.views, one.T_world_object[None])]))
    limits = one.largest_angle_deg, one.largest_shift * one.distance
    return Case("a loose start, 60 false", recordings, *limits, single_frames=True)


def room_case(trials: int) -> Case:
    """A live search of one camera that has watched lamps for a while when the body comes in."""
    recordings = []
    for seed in range(trials):
        one, rng = trial(ENTERING, seed), np.random.default_rng([seed, 3])
        (view,) = one.views
        lamps = rng.uniform(view.sensor.lower, view.sensor.upper, (LAMPS, 2))
        frames = []
        for number in range(ProposalRules().static + 2):
            y = lamps + NOISE_PX * rng.standard_normal(lamps.shape)
            answers = np.zeros((0, 4, 4))
            if number > ProposalRules().static:
                assert isinstance(view.observation.pattern, PointPattern)
                y = np.concatenate([y, view.observation.pattern.points])
                answers = one.T_world_object[None]
            pattern = PointPattern(y, np.ones(len(y)))
            seen = replace(view, observation=replace(view.observation, pattern=pattern))
            frames.append(Frame(number, None, [seen], answers))
        tracker = Tracker.create(one.body, EstimatorOptions(search="live"))
        recordings.append(Recording(tracker, frames))
    limits = one.largest_angle_deg, one.largest_shift * one.distance
    return Case(f"enters among {LAMPS} lamps", recordings, *limits)


def all_on(tracker: Tracker) -> Tracker:
    """Nothing is switched off."""
    return tracker


def counted(outcomes: Sequence[Outcome]) -> tuple[int, int, int]:
    """Right poses, wrong ones called ok, and right ones called ok."""
    right = sum(one.right for one in outcomes)
    wrong = sum(one.status == "ok" and not one.right for one in outcomes)
    return right, wrong, sum(one.status == "ok" and one.right for one in outcomes)
