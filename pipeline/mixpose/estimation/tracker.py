"""From frame to frame: predict, estimate, search where that does not convince, judge.

A tracker is a value: `advance` takes a track and a frame and returns the next track with the
estimate.  While lost it keeps what it trusted last, looks around it ever more widely and
everywhere else, and invents nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.estimation.assessment import Assessment, assess
from mixpose.estimation.flips import flipped
from mixpose.estimation.instep import in_step
from mixpose.estimation.labelling import are_labelled
from mixpose.estimation.local import FINE, fit_near, free_mask
from mixpose.estimation.multistart import NARROWING, starts_around
from mixpose.estimation.options import EstimatorOptions
from mixpose.estimation.ranging import fit_ranges, judge_ranges, noise_ratio
from mixpose.estimation.sharpening import agreed, bent, settling_step, sharpened
from mixpose.estimation.track import (
    Branch,
    Found,
    Prediction,
    Track,
    follow,
    nearest_alike,
    predict,
    prior_of,
)
from mixpose.objective import Gaze, View, gazes_of
from mixpose.records import Estimate, Hypothesis, SensorReport
from mixpose.rigid import perturb, rotation_angle_deg, twist_between
from mixpose.search import search
from mixpose.sensors import Sensor

Floats: TypeAlias = NDArray[np.float64]

START_ROTATION_DEG = 5.0
START_DISTANCE_SHARE = 0.1  # of the body's radius

SURE = 7.0
"""Log odds against clutter from which a pose is believed."""

POSSIBLE = 0.0
"""Log odds from which a pose is worth telling, if only as one of several."""

_DOUBTFUL = -4.5  # log odds from which it is, where most of the body is met
_MOST = 0.6

RIVAL = 0.01
"""Belief from which another pose makes a frame ambiguous."""

WIDEST_TURN_DEG = 15.0
"""95 % bound on the turn about any axis, above which ranges leave a frame ambiguous."""

_OPEN_TURN = np.pi / np.sqrt(3)  # rad, standard deviation of a turn of which nothing is known

CONVINCING = 0.75
"""Share of the body that must be met for the prediction to be taken without looking elsewhere."""

_LISTED = 0.001
_OUTDONE = 10.0  # log odds by which a candidate of the search may be behind to be refined
_SETTLING_STEPS = 2
_HALF = 0.5  # of a feature: less is no difference
_RECURRENT = 0.6  # share of a body met a step aside from which it may be followed there
_SAME_ROTATION_DEG = 1.0
_SAME_PEAK = 9.0  # squared distance in standard deviations of uncertain poses
_SAME_DISTANCE_SHARE = 0.02  # of the body's radius


@dataclass(frozen=True)
class Rated:
    """A pose with its assessment."""

    T_world_object: Floats
    assessment: Assessment
    spread: Floats | None = None


@dataclass(frozen=True)
class Tracker:
    """Everything that stays the same from frame to frame."""

    body: Body
    options: EstimatorOptions
    samples: Floats
    start_uncertainty: Floats
    T_start: Floats | None = None
    _gazes: dict[tuple[int, ...], list[Gaze]] = field(default_factory=dict, repr=False)

    @classmethod
    def create(
        cls,
        body: Body,
        options: EstimatorOptions,
        T_start: Floats | None = None,
        *,
        rotation_deg: float | None = None,
        distance: float | None = None,
    ) -> Tracker:
        """Prepare tracking of a body.

        Parameters
        ----------
        body : Body
        options : EstimatorOptions
        T_start : (4, 4) array or None
            Where the body is about the first frame; None: anywhere.
        rotation_deg, distance : float or None
            Half-widths of where to look around the start; None: 5° and a tenth of the radius.
        """
        turn = np.radians(START_ROTATION_DEG if rotation_deg is None else rotation_deg)
        shift = START_DISTANCE_SHARE * body.radius if distance is None else distance
        samples = body.sample(options.samples, seed=options.seed)
        return cls(body, options, samples, np.repeat([shift, turn], 3), T_start)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which of the six directions are estimated."""
        return free_mask(self.options)

    def begin(self) -> Track:
        """The track before the first frame."""
        if self.T_start is None:
            return Track()
        return Track((Branch(self.T_start, 1.0, None, self.start_uncertainty),))

    def advance(
        self, track: Track, frame: int, time_s: float | None, views: Sequence[View]
    ) -> tuple[Track, Estimate]:
        """Estimate one frame.

        Parameters
        ----------
        track : Track
        frame : int
        time_s : float or None
        views : sequence of View
            All sensors with a frame; those that saw nothing are reported and left out.

        Returns
        -------
        Track, Estimate
            The track for the next frame, and the frame's estimate without its latency.
        """
        usable = [view for view in views if not view.observation.is_empty]
        usable = in_step(usable, track, frame, time_s)
        rated = self._rated(track, frame, time_s, usable) if usable else []
        reports = {view.name: SensorReport(False) for view in views}
        best = next((one for one in rated if self._possible(one)), None)
        if rated:
            reports |= (best or rated[0]).assessment.sensors
        if best is None:
            score = rated[0].assessment.score if rated else 0.0
            lost = Estimate(frame, time_s, self.body.name, "lost", None, None, score, reports)
            return track.missed(), lost
        weights = beliefs(rated)
        # what is not possible by itself still casts doubt on the others
        rivals = [weight for one, weight in zip(rated, weights, strict=True) if one is not best]
        clear = self._sure(best) and max(rivals, default=0.0) < RIVAL
        clear = clear and self._is_turned_surely(best) and _is_determined(best)
        kept = [
            Found(one.T_world_object, w, one.spread if self.options.fuse else None)
            for one, w in zip(rated, weights, strict=True)
            if one is best or (w >= _LISTED and self._possible(one))
        ]
        estimate = Estimate(
            frame=frame,
            time_s=time_s,
            object=self.body.name,
            status="ok" if clear else "ambiguous",
            T_world_object=best.T_world_object,
            covariance=best.assessment.covariance,
            score=best.assessment.score,
            sensors=reports,
            hypotheses=() if clear else tuple(Hypothesis(T, w) for T, w, _ in kept),
        )
        noise = best.assessment.noise if clear else track.noise
        # what other bodies miss says nothing of a slip
        meetings = best.assessment.meetings if self.body.recurrence >= _RECURRENT else ()
        loose = {one.name: (one.missed, one.surplus) for one in meetings}
        return follow(track, self.body, kept, frame, time_s, noise, loose), estimate

    def _rated(
        self, track: Track, frame: int, time_s: float | None, views: Sequence[View]
    ) -> list[Rated]:
        """Distinct poses that may explain the frame, most evident first."""
        predictions = predict(track, self.body, frame, time_s)
        T_reference = predictions[0].T_world_object if predictions else self.T_start
        rated: list[Rated] = []
        ranged = self.options.objective == "matched" and are_labelled(views, self.body)

        def judge(T: Floats) -> Rated:
            T = nearest_alike(T, self.body, T_reference)
            prior = prior_of(T, predictions, self.body, self.free, track.misses)
            judged = assess(
                views,
                self.body,
                T,
                self.free,
                before=track.noise,
                prior=prior,
                gazes=self._gazes_of(views),
            )
            return Rated(T, judged)

        def consider(T: Floats) -> None:
            if ranged:
                T = nearest_alike(T, self.body, T_reference)
                self._insert(rated, self._ranged(views, T, track, predictions))
                return
            new = judge(T)
            self._insert(rated, new)
            if self.options.objective == "matched" and bent(new.assessment.meetings):
                for closer in self._looked_closer(views, new, judge):
                    self._insert(rated, closer)

        for prediction in predictions:
            T = prediction.T_world_object
            if ranged and prediction.is_prior:
                self._insert(rated, self._ranged(views, T, track, predictions, prediction))
            else:
                consider(self._fit(views, T, prediction.uncertainty))
        if not rated or not self._convinces(rated[0]) or self._has_slipped(rated[0], track):
            for T in self._elsewhere(views, predictions):
                consider(T)
        for mirrored in flipped(rated[0].T_world_object, self.body, views) if rated else ():
            consider(self._fit(views, mirrored, self.start_uncertainty / NARROWING))
        return rated

    def _looked_closer(
        self, views: Sequence[View], bent_pose: Rated, judge: Callable[[Floats], Rated]
    ) -> list[Rated]:
        """Rivals of a pose that some detection may have pulled aside."""
        T = perturb(bent_pose.T_world_object, agreed(bent_pose.assessment.meetings, self.free))
        T_sharp = sharpened(views, self.body, T, self.free, FINE)
        found = [] if T_sharp is None else [judge(T_sharp)]
        for begin in (bent_pose, judge(T)):
            settled = begin
            for _ in range(_SETTLING_STEPS):
                meetings = settled.assessment.meetings
                if any(meeting.pairs for meeting in meetings):
                    step = settling_step(meetings, self.free)
                    settled = judge(perturb(settled.T_world_object, step))
            if settled is not begin:
                found.append(settled)
        return found

    def _ranged(
        self,
        views: Sequence[View],
        T_start: Floats,
        track: Track,
        predictions: Sequence[Prediction],
        known: Prediction | None = None,
    ) -> Rated:
        """The most probable pose near a start, over all labellings of ranges."""
        found = fit_ranges(views, self.body, T_start, self.free, noise_ratio(track.noise), known)
        T = found.T_world_object
        prior = prior_of(T, predictions, self.body, self.free, track.misses)
        judged = assess(views, self.body, T, self.free, before=track.noise, prior=prior)
        judged = judge_ranges(judged, found, self.free, track.noise, prior)
        return Rated(T, judged, np.sqrt(np.diag(judged.covariance)))

    def _elsewhere(self, views: Sequence[View], predictions: Sequence[Prediction]) -> list[Floats]:
        """Poses found without a prediction: around it by many starts, and everywhere."""
        found = []
        for prediction in predictions[:1]:
            wide = np.where(
                self.free, np.maximum(prediction.uncertainty, self.start_uncertainty), 0
            )
            T = prediction.T_world_object
            for start in starts_around(views, self.body, T, wide, seed=self.options.seed):
                found.append(self._fit(views, start, wide / NARROWING))
        T_reference = predictions[0].T_world_object if predictions else self.T_start
        close = self.start_uncertainty / NARROWING**2
        candidates = search(
            views,
            self.body,
            free=self.free,
            T_reference=T_reference,
            seed=self.options.seed,
        )
        for candidate in candidates:
            T = candidate.T_world_object
            found.append(T)
            # far worse ones are rivals in name only
            if candidate.evidence > candidates[0].evidence - _OUTDONE:
                found.append(self._fit(views, T, close))
        return found

    def _fit(self, views: Sequence[View], T: Floats, uncertainty: Floats) -> Floats:
        gazes = self._gazes_of(views)
        fit = fit_near(views, self.body, T, uncertainty, self.options, self.samples, gazes)
        return fit.T_world_object

    def _gazes_of(self, views: Sequence[View]) -> list[Gaze]:
        """The views' sensors side by side."""
        sensors = [view.sensor for view in views]
        if any(view.delay for view in views):  # they are others in every frame
            return gazes_of(sensors, self.body)
        return self.gazes_of(sensors)

    def gazes_of(self, sensors: Sequence[Sensor]) -> list[Gaze]:
        """Sensors side by side, those of each dimension together; made once for the same ones."""
        # a gaze holds its sensors, so that no other can come to the same place in memory
        key = tuple(map(id, sensors))
        if key not in self._gazes:
            self._gazes[key] = gazes_of(sensors, self.body)
        return self._gazes[key]

    def _has_slipped(self, rated: Rated, track: Track) -> bool:
        """Whether a sensor misses more than in the frame before while more is seen beside the body.

        So it is where a body that looks like itself a step aside was followed to there.
        """
        for one in rated.assessment.meetings:
            missed, surplus = track.loose.get(one.name, (np.inf, np.inf))
            if one.missed > missed + _HALF and one.surplus > surplus + _HALF:
                return True
        return False

    def _sure(self, rated: Rated) -> bool:
        return self._possible(rated) and rated.assessment.log_evidence > SURE

    def _convinces(self, rated: Rated) -> bool:
        """Whether a pose near its prediction needs no other to compare with."""
        covered = rated.assessment.coverage > CONVINCING
        return covered and self._sure(rated) and self._is_turned_surely(rated)

    def _is_turned_surely(self, rated: Rated) -> bool:
        """Whether ranges leave no wide sector of turns open."""
        if rated.spread is None:
            return True
        return bool(1.96 * rated.spread[3:].max() < np.radians(WIDEST_TURN_DEG))

    def _possible(self, rated: Rated) -> bool:
        enough = rated.assessment.measurements >= int(self.free.sum())
        least = _DOUBTFUL if rated.assessment.coverage >= _MOST else POSSIBLE
        return enough and rated.assessment.log_evidence > least

    def _insert(self, rated: list[Rated], new: Rated) -> None:
        """Keep a list of distinct poses, the most evident first."""
        for k, old in enumerate(rated):
            if self._alike(old, new):
                if new.assessment.log_evidence > old.assessment.log_evidence:
                    rated[k] = new
                break
        else:
            rated.append(new)
        rated.sort(key=lambda one: -one.assessment.log_evidence)

    def _alike(self, a: Rated, b: Rated) -> bool:
        T_a = a.T_world_object
        T_b = nearest_alike(b.T_world_object, self.body, T_a)
        if a.spread is not None:
            # one peak of the likelihood, drawn to different priors
            away = twist_between(T_a, T_b)[self.free]
            inner = np.ix_(self.free, self.free)
            widest = a.assessment.covariance[inner] + b.assessment.covariance[inner]
            return bool(away @ np.linalg.solve(widest, away) < _SAME_PEAK)
        centre = np.append(self.body.means.mean(axis=0), 1.0)
        apart = float(np.linalg.norm((T_a - T_b) @ centre))
        near = apart < _SAME_DISTANCE_SHARE * self.body.radius
        return near and float(rotation_angle_deg(T_a, T_b)) < _SAME_ROTATION_DEG


def _is_determined(rated: Rated) -> bool:
    """Whether no turn is left open, as about the line that all features met lie on."""
    turns = np.linalg.eigvalsh(rated.assessment.covariance[3:, 3:])
    return bool(turns.max() < _OPEN_TURN**2)


def beliefs(rated: Sequence[Rated]) -> list[float]:
    """Share of belief of each pose among its rivals."""
    if not rated:
        return []
    logs = np.array([one.assessment.log_evidence for one in rated])
    if not np.isfinite(logs.max()):  # none meets anything
        return [1.0 / len(rated)] * len(rated)
    weights = np.exp(logs - logs.max())
    return [float(w) for w in weights / weights.sum()]
