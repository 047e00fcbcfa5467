"""From frame to frame: predict, estimate, judge.

A tracker is a value: `advance` takes a track and a frame and returns the next track with the
estimate.  While lost it keeps the last pose that it trusted, looks around it ever more widely,
and invents nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.estimation.assessment import LEAST_COVERAGE, Assessment, assess
from mixpose.estimation.local import fit_near, free_mask
from mixpose.estimation.multistart import NARROWING, candidates
from mixpose.estimation.options import EstimatorOptions
from mixpose.objective import View
from mixpose.records import Estimate, SensorReport
from mixpose.rigid import perturb, twist_between

Floats: TypeAlias = NDArray[np.float64]

START_ROTATION_DEG = 5.0
START_DISTANCE_SHARE = 0.1  # of the body's radius
CONVINCING = 0.75
"""Share of the body that must be met for the first descent to be taken without looking further."""

_COASTING = 3  # frames for which the velocity is believed without a pose
_STEADY_ROTATION_DEG = 1.0
_STEADY_DISTANCE_SHARE = 0.03
_WIDENING = 1.5  # per frame without a pose
_WIDEST = 4.0


@dataclass(frozen=True)
class Track:
    """What is known between two frames.

    Attributes
    ----------
    T_world_object : (4, 4) float64
        The last pose that was trusted, or the start.
    uncertainty : (6,) float64
        Standard deviations of the next pose about the prediction.
    frame : int or None
        Where the last trusted pose was seen; None before the first.
    time_s : float or None
    velocity : (6,) float64
        Twist per unit of the clock: seconds where the frames have times, else frames.
    misses : int
        Frames since the last trusted pose.
    """

    T_world_object: Floats
    uncertainty: Floats
    frame: int | None = None
    time_s: float | None = None
    velocity: Floats | None = None
    misses: int = 0


@dataclass(frozen=True)
class Tracker:
    """Everything that stays the same from frame to frame."""

    body: Body
    options: EstimatorOptions
    samples: Floats
    start_uncertainty: Floats

    @classmethod
    def create(
        cls,
        body: Body,
        options: EstimatorOptions,
        *,
        rotation_deg: float | None = None,
        distance: float | None = None,
    ) -> Tracker:
        """Prepare tracking of a body.

        Parameters
        ----------
        body : Body
        options : EstimatorOptions
        rotation_deg, distance : float or None
            Half-widths of where to look around the start; None: 5° and a tenth of the radius.
        """
        turn = np.radians(START_ROTATION_DEG if rotation_deg is None else rotation_deg)
        shift = START_DISTANCE_SHARE * body.radius if distance is None else distance
        samples = body.sample(options.samples, seed=options.seed)
        return cls(body, options, samples, np.repeat([shift, turn], 3))

    def begin(self, T_start: Floats) -> Track:
        """The track before the first frame."""
        return Track(np.asarray(T_start, dtype=np.float64), self.start_uncertainty)

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
        free = free_mask(self.options)
        usable = [view for view in views if not view.observation.is_empty]
        unused = {view.name: SensorReport(False) for view in views if view.observation.is_empty}
        best = self._best(track, frame, time_s, usable) if usable else None
        reports = dict(unused) if best is None else {**best[1].sensors, **unused}
        ordered = {view.name: reports[view.name] for view in views}
        if best is None or not self._trusted(best[1], free):
            lost = self._lost(frame, time_s, ordered, best)
            return replace(track, misses=track.misses + 1), lost
        T, judged = best
        estimate = Estimate(
            frame, time_s, self.body.name, "ok", T, judged.covariance, judged.score, ordered
        )
        return self._follow(track, frame, time_s, T), estimate

    def _best(
        self, track: Track, frame: int, time_s: float | None, views: Sequence[View]
    ) -> tuple[Floats, Assessment] | None:
        """The pose that meets most of the body, looking ever wider until one convinces."""
        free = free_mask(self.options)
        best: tuple[Floats, Assessment] | None = None
        for T_guess, uncertainty in self._guesses(track, frame, time_s, views):
            fit = fit_near(views, self.body, T_guess, uncertainty, self.options, self.samples)
            judged = assess(views, self.body, fit.T_world_object, free)
            if best is None or judged.coverage > best[1].coverage:
                best = fit.T_world_object, judged
            if judged.coverage >= CONVINCING and self._trusted(judged, free):
                break
        return best

    def _guesses(
        self, track: Track, frame: int, time_s: float | None, views: Sequence[View]
    ) -> Iterator[tuple[Floats, Floats]]:
        """Where to look, in order: the prediction, then ever wider about the last pose."""
        wide = self.start_uncertainty * min(_WIDENING**track.misses, _WIDEST)
        T_expected = track.T_world_object
        if track.frame is not None and track.misses <= _COASTING:
            elapsed = _elapsed(track, frame, time_s)
            velocity = np.zeros(6) if track.velocity is None else track.velocity
            T_expected = perturb(track.T_world_object, velocity * elapsed)
            yield T_expected, track.uncertainty
        yield track.T_world_object, wide
        free_wide = np.where(free_mask(self.options), wide, 0.0)
        for T in candidates(views, self.body, T_expected, free_wide, seed=self.options.seed):
            yield T, free_wide / NARROWING

    def _trusted(self, judged: Assessment, free: NDArray[np.bool_]) -> bool:
        enough = judged.measurements >= int(free.sum())
        return enough and judged.coverage >= LEAST_COVERAGE

    def _lost(
        self,
        frame: int,
        time_s: float | None,
        reports: Mapping[str, SensorReport],
        best: tuple[Floats, Assessment] | None,
    ) -> Estimate:
        score = 0.0 if best is None else best[1].score
        return Estimate(frame, time_s, self.body.name, "lost", None, None, score, reports)

    def _follow(self, track: Track, frame: int, time_s: float | None, T: Floats) -> Track:
        """The track after a trusted pose."""
        velocity, uncertainty = None, self.start_uncertainty
        if track.frame is not None:
            elapsed = _elapsed(track, frame, time_s)
            moved = twist_between(track.T_world_object, T)
            velocity = moved / elapsed if elapsed > 0 and track.misses == 0 else None
            steady = np.repeat(
                [_STEADY_DISTANCE_SHARE * self.body.radius, np.radians(_STEADY_ROTATION_DEG)], 3
            )
            half = np.repeat([np.abs(moved[:3]).max(), np.abs(moved[3:]).max()], 3) / 2
            uncertainty = np.maximum(half, steady)
        return Track(T, uncertainty, frame, time_s, velocity)


def _elapsed(track: Track, frame: int, time_s: float | None) -> float:
    """Time since the last trusted pose: seconds where both frames have times, else frames."""
    if time_s is not None and track.time_s is not None:
        return time_s - track.time_s
    return float(frame - (track.frame or 0))
