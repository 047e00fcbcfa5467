"""What one frame says of a pose: how to fit it near a start, and how to judge it.

Chosen once per frame: matched densities, or, for single ranges of small bodies, the likelihood
over all associations of ranges and features.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.density import Noise, errors_seen, sums_of
from mixpose.fit import Climbed, EstimatorOptions, Fit, NormalPrior, fit_near, free_mask
from mixpose.judgement import (
    Association,
    Case,
    Judged,
    Prior,
    associate,
    flat_prior,
    joined_offsets,
    judge,
    nearest_alike,
)
from mixpose.objective import MatchedObjective, View, in_image, matched_objective, project_body
from mixpose.optimise import Ascent
from mixpose.records import SensorReport
from mixpose.rigid import twist_between
from mixpose.search import SearchReport, SearchState
from mixpose.sensors import Motion
from mixpose.tracking.association_likelihood import are_associated
from mixpose.tracking.companion import either
from mixpose.tracking.course import Expected, unknown
from mixpose.tracking.delays import Offsets, is_timed, offsets_of, seen_in_motion, unsure_by
from mixpose.tracking.in_motion import fit_in_motion, with_motion_unknown
from mixpose.tracking.range_posterior import Posterior, judge_ranges, noise_ratio
from mixpose.tracking.rules import Rules
from mixpose.tracking.track import Prediction, Track, nearest_branch, prior_of

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Start:
    """Where a fit begins.

    Attributes
    ----------
    T_world_object : (4, 4) float64
    uncertainty : (6,) float64 or None
        Standard deviations; None: the pose is there already.
    prediction : Prediction or None
        That it comes from.
    left_out : mapping of str to str
        Sensors that are not to take part, and why.
    T_moved : (4, 4) float64 or None
        A pose that has moved as this one must have, and was as likely before the frame.
    blur : float
        In σ_ε, that the fit begins at.
    """

    T_world_object: Floats
    uncertainty: Floats | None = None
    prediction: Prediction | None = None
    left_out: Mapping[str, str] = field(default_factory=dict)
    T_moved: Floats | None = None
    blur: float = 1.0


class Likelihood(Protocol):
    """What one frame says of a pose."""

    @property
    def knows_detections(self) -> bool:
        """Whether each feature's detection is known, so that one may be left out."""
        ...

    def fit(self, start: Start) -> Fit:
        """Climb to the most likely pose near a start."""
        ...

    def judge(self, fit: Fit, start: Start) -> Judged:
        """Judge a pose that was climbed to from a start."""
        ...


@dataclass
class SearchLog:
    """What the search of a frame cost, and where it goes on in the next."""

    state: SearchState = SearchState()
    report: SearchReport | None = None


class Begun(NamedTuple):
    """What is known of the fit from the first prediction.

    Attributes
    ----------
    objective : MatchedObjective
        At σ_ε.
    ascent : Ascent or None
        On it; None if it leads nowhere.
    fit : Fit or None
        That it led to, where it was climbed with others'.
    judged : Judged or None
        The pose of that fit.
    """

    objective: MatchedObjective
    ascent: Ascent[Floats] | None = None
    fit: Fit | None = None
    judged: Judged | None = None


@dataclass(frozen=True, eq=False)
class FrameData:
    """A frame, and what is known before it.

    `log` is written by the proposer that searches.  `elapsed` is the time since the last pose,
    seconds, None where it is not known.  Where views see the body in motion as of the common time,
    `still` is the frame with the sensors as they stand.
    `begun` is the climb from the first prediction, where several bodies were fitted together.
    `beside` is where another body lets it expect that was not seen where it was expected.
    """

    views: Sequence[View]
    body: Body
    options: EstimatorOptions
    samples: Floats
    track: Track
    predictions: Sequence[Prediction]
    T_reference: Floats | None
    start_uncertainty: Floats
    rules: Rules
    begun: Begun | None = None
    log: SearchLog = field(default_factory=SearchLog)
    elapsed: float | None = None
    still: FrameData | None = None
    beside: Prediction | None = None

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Directions that are estimated."""
        return free_mask(self.options)

    @cached_property
    def noise(self) -> list[Noise]:
        """What is remembered of each view's noise."""
        memory, known = self.rules.judgement.noise.memory, self.track.residuals.noise
        return [known.get(view.name, Noise()).faded(memory) for view in self.views]

    def prior(self, T_world_object: Floats) -> Prior:
        """What was known of a pose before the frame."""
        rules, misses = self.rules.motion, self.track.misses
        detection = self.rules.judgement.detection

        def prior(expected: Sequence[Prediction], misses: int) -> Prior:
            return prior_of(
                T_world_object, expected, self.body, self.free, misses, rules, detection
            )

        own = prior(self.predictions, misses)
        return own if self.beside is None else either(own, prior([self.beside], 0), misses, rules)

    def moves_alike(self, T_world_object: Floats) -> Floats | None:
        """The pose, where motion does not tell it from its rivals; see `Start.T_moved`."""
        return T_world_object if len(self.track.branches) > 1 else None

    @cached_property
    def finest(self) -> MatchedObjective:
        """The matched objective at σ_ε."""
        if self.still is not None:  # densities do not move with the sensors
            views = tuple(self.views)
            projection = project_body(tuple(view.sensor for view in views), self.body)
            return replace(self.still.finest, views=views, projection=projection)
        if self.begun is not None:
            return self.begun.objective
        return matched_objective(self.views, self.body, self.sigmas)

    @property
    def sigmas(self) -> list[float]:
        """σ_ε of each view."""
        return [view.observation.sigma for view in self.views]

    def without(self, names: Mapping[str, str]) -> FrameData:
        """The frame without some sensors."""
        if not names:
            return self
        views = [view for view in self.views if view.name not in names]
        still = self.still.without(names) if self.still else None
        return replace(self, views=views, still=still, begun=None)

    def in_motion(self, motion: Motion) -> FrameData:
        """The frame as of the common time, of a body that moves."""
        still = self.still or self
        return replace(still, views=seen_in_motion(still.views, motion), still=still)

    def expected(self, T_world_object: Floats, *, is_there: bool = True) -> Expected:
        """The velocity that the frames before let expect of a pose, or near it."""
        rules, track = self.rules, self.track
        nothing = unknown(self.body.radius, rules.course)
        if not self.elapsed or not track.branches or self.elapsed > rules.course.longest_s:
            return nothing
        course = nearest_branch(track, T_world_object, self.body).course
        if course is None:
            return nothing
        T = nearest_alike(T_world_object, self.body, course.T_world_object)
        expected = course.expected(T if is_there else None, self.elapsed, rules.course)
        is_far = (np.abs(expected.velocity) > nothing.deviation).any()
        return nothing if is_far else expected

    def steady(self, T_world_object: Floats) -> Expected:
        """The velocity at a pose, by the last two steps alone."""
        nothing = unknown(self.body.radius, self.rules.course)
        branch = (
            nearest_branch(self.track, T_world_object, self.body) if self.track.branches else None
        )
        if branch is None or branch.velocity is None or not self.elapsed:
            return nothing
        T = nearest_alike(T_world_object, self.body, branch.T_world_object)
        mean = twist_between(branch.T_world_object, T) / self.elapsed
        velocity = mean + (mean - branch.velocity) / 2
        return Expected(velocity, np.full(6, 1.5 / self.elapsed), nothing.deviation, np.zeros(6))

    def motion(self, T_world_object: Floats, *, is_there: bool = True) -> Motion:
        """How the body is expected to move at a pose, or near it where it need not be there."""
        expected = self.expected(T_world_object, is_there=is_there)
        return Motion(T_world_object, expected.velocity, expected.acceleration)

    def unsure(self, T_world_object: Floats, velocity: Expected) -> float:
        """How far features in view may be off by velocity and delay, in σ_ε of their sensor."""
        at, views = self.finest.projection.project(T_world_object[None]), (self.still or self).views
        dimensions = self.finest.projection.dimensions.tolist()
        each = zip(at.J, at.y, at.seen, dimensions, views, strict=True)
        return max(
            unsure_by(J[0, seen[0], :m], y[0, seen[0], :m], view, velocity)
            for J, y, seen, m, view in each
        )

    def given(self, T_world_object: Floats) -> float:
        """How far features in view may be off by the body's spread, in σ_ε of their sensor."""
        if not self.body.spread:
            return 0.0
        at = self.finest.projection.project(T_world_object[None])
        spreads = self.body.node_spreads(T_world_object)
        each = zip(at.J[:, 0], self.finest.projection.dimensions.tolist(), strict=True)
        variances = np.array([in_image(spreads, J[:, :m]) for J, m in each]) * at.seen[:, 0]
        return float(np.sqrt((variances / np.square(self.sigmas)[:, None]).max()))

    def offsets(
        self,
        T_world_object: Floats,
        velocity: Expected | None = None,
        found: Sequence[Association] | None = None,
    ) -> Offsets:
        """How far off features are met at a pose, and when they were seen.

        What is farther off than noise and an expected velocity let it be counts for little.
        """
        if found is None:
            rules = self.rules.judgement.association
            found, _ = associate(self.finest, T_world_object, rules)
        names = {view.name: k for k, view in enumerate(self.views)}
        chosen = [names[one.name] for one in found]
        views = [(self.still or self).views[k] for k in chosen]
        blurs = np.ones(len(found))
        if velocity is not None:
            known = sums_of([self.noise[k] for k in chosen])
            errors = self.rules.judgement.noise.errors
            noise = errors_seen(joined_offsets(found), int(self.free.sum()), known, errors).blurs
            pairs = zip(found, views, strict=True)
            unsure = [unsure_by(one.J, one.places, view, velocity) for one, view in pairs]
            # a pose that was climbed to at another velocity is off by as much in all sensors
            blurs = np.hypot(noise, errors.blur * max(unsure, default=0.0))
        return offsets_of(found, views, np.minimum(blurs, 1.0))


@dataclass(frozen=True, eq=False)
class MatchedLikelihood:
    """Matched densities of all sensors.

    `climbed` has the fits so far, by the sensors that were left out.
    """

    data: FrameData
    climbed: dict[frozenset[str], list[Climbed]] = field(default_factory=dict)

    @property
    def knows_detections(self) -> bool:
        """As `Likelihood` has it."""
        return self.data.options.objective == "matched"

    def fit(self, start: Start) -> Fit:
        """Ascend the session's objective through narrowing blurs."""
        if start.uncertainty is None:
            return Fit(start.T_world_object, 0.0, True, 0)
        data, uncertainty = self.data.without(start.left_out), start.uncertainty
        climbed = self.climbed.setdefault(frozenset(start.left_out), [])
        timed, begun = is_timed(data.views), None
        if data.begun and data.predictions and start.prediction is data.predictions[0]:
            begun = data.begun.ascent
            if data.begun.fit is not None:
                return data.begun.fit
        given = data.given(start.T_world_object) if self.knows_detections else 0.0

        def climb(seen: FrameData, T_start: Floats, beside: float = 0.0) -> Fit:
            return fit_near(
                seen.views,
                seen.body,
                T_start,
                uncertainty,
                seen.options,
                seen.samples,
                finest=seen.finest,
                begun=begun,
                climbed=None if timed else climbed,
                blur=start.blur,
                noise=seen.noise,
                beside=max(beside, given),
                errors=seen.rules.judgement.noise.errors,
                rules=seen.rules.fit,
            )

        if timed:
            return fit_in_motion(data, start.T_world_object, climb)
        return climb(data, start.T_world_object)

    def judge(self, fit: Fit, start: Start) -> Judged:
        """Judge a pose by matched densities at σ_ε, and take what is left out for missed."""
        begun = self.data.begun
        if begun is not None and fit is begun.fit and begun.judged is not None:
            return begun.judged
        data = self.data.without(start.left_out)
        T = nearest_alike(fit.T_world_object, data.body, data.T_reference)
        motion = fit.motion
        if is_timed(data.views):
            motion = motion or data.motion(T)
            data = data.in_motion(motion)
        others: list[Association] = []
        if start.left_out:
            found, _ = associate(self.data.finest, T, data.rules.judgement.association)
            others = [one for one in found if one.name in start.left_out]
        prior = data.prior(T if start.T_moved is None else start.T_moved)
        case = Case(data.finest, T, data.track.residuals, prior, others)
        judged = judge(case, data.free, data.rules.judgement)
        reports = {
            one.name: SensorReport(False, one.explained, one.rms, start.left_out[one.name])
            for one in others
        }
        if motion is not None:
            judged = with_motion_unknown(judged, data, motion)
        return replace(
            judged,
            sensors=judged.sensors | reports,
            associations=(*judged.associations, *others),
        )


@dataclass(frozen=True, eq=False)
class AssociationLikelihood:
    """All associations of single ranges with the features of a small body."""

    data: FrameData

    @property
    def knows_detections(self) -> bool:
        """As `Likelihood` has it."""
        return False

    def fit(self, start: Start) -> Fit:
        """Climb the posterior; the matched objective leads to where it begins."""
        T, data, posterior = start.T_world_object, self.data, self._posterior(start)
        if posterior.prior is None:
            T = MatchedLikelihood(data).fit(start).T_world_object
            T = nearest_alike(T, data.body, data.T_reference)
        found = posterior.climbed(T)
        return Fit(found.state, found.value, found.converged, found.iterations)

    def judge(self, fit: Fit, start: Start) -> Judged:
        """Judge a pose by the sum over all associations."""
        data, T = self.data, fit.T_world_object
        judged = judge(Case(data.finest, T), data.free, data.rules.judgement)
        anywhere = flat_prior(data.body, data.free, data.rules.judgement.detection)
        return judge_ranges(
            judged,
            self._posterior(start),
            data.track.residuals.total,
            # the posterior holds the prediction already
            replace(data.prior(T), spread=anywhere.spread),
            data.rules.judgement.noise,
            data.rules.ranges,
        )

    def _posterior(self, start: Start) -> Posterior:
        data = self.data
        noise = noise_ratio(data.track.residuals.total, data.rules.ranges)
        detection, expected, prior = data.rules.judgement.detection, start.prediction, None
        if expected and expected.is_prior:
            prior = NormalPrior(expected.T_world_object, expected.uncertainty, data.free)
        return Posterior(data.views, data.body, data.free, noise, prior, detection)


def likelihood_of(data: FrameData) -> Likelihood:
    """The likelihood for a frame."""
    ranged = data.options.objective == "matched" and are_associated(
        data.views, data.body, data.rules.ranges
    )
    return AssociationLikelihood(data) if ranged else MatchedLikelihood(data)
