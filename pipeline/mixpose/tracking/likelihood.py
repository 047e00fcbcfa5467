"""What one frame says of a pose: how to fit it near a start, and how to judge it.

Chosen once per frame: matched densities, or, for single ranges of small bodies, the likelihood
over all associations of ranges and features.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.fit import Climbed, EstimatorOptions, Fit, fit_near, free_mask
from mixpose.judgement import (
    Prior,
    ScoredPose,
    flat_prior,
    judge,
    nearest_alike,
)
from mixpose.objective import MatchedObjective, View, in_image, matched_objective, project_body
from mixpose.optimise import Ascent
from mixpose.records import Floats
from mixpose.rigid import twist_between
from mixpose.search import SearchReport, SearchState
from mixpose.sensors import Motion, in_motion
from mixpose.tracking.association_likelihood import AssociationLikelihood, are_associated
from mixpose.tracking.in_motion import fit_in_motion, is_timed, with_motion_unknown
from mixpose.tracking.motion import Expected, unknown
from mixpose.tracking.rules import Rules
from mixpose.tracking.track import Prediction, Track, either, nearest_branch


@dataclass(frozen=True)
class Start:
    """Where a fit begins."""

    T_world_object: Floats  # (4, 4)
    uncertainty: Floats | None = None  # (6,), standard deviations; None: the pose is there already
    prediction: Prediction | None = None  # that it comes from
    left_out: Mapping[str, str] = field(default_factory=dict)  # sensors, and why
    T_moved: Floats | None = None  # a pose that has moved as this must have, and was as likely
    blur: float = 1.0  # in σ_ε, that the fit begins at


@dataclass
class SearchLog:
    """What the search of a frame cost, and where it goes on in the next."""

    state: SearchState = SearchState()
    report: SearchReport | None = None


class Begun(NamedTuple):
    """What is known of the fit from the first prediction."""

    objective: MatchedObjective  # at σ_ε
    fit: Fit | None = None  # that this was climbed to with others'
    judged: ScoredPose | None = None  # the pose of that fit


@dataclass(frozen=True, eq=False)
class FrameData:
    """A frame, and what is known before it."""

    views: Sequence[View]
    body: Body
    options: EstimatorOptions
    samples: Floats
    track: Track
    predictions: Sequence[Prediction]
    T_reference: Floats | None
    start_uncertainty: Floats
    rules: Rules
    frame: int
    time_s: float | None
    begun: Begun | None = None  # where several bodies were fitted together
    log: SearchLog = field(default_factory=SearchLog)  # written by the proposer that searches
    still: FrameData | None = None  # where views are as of the common time: sensors as they stand
    beside: Prediction | None = None  # where another body lets expect one that is not where it was

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Directions that are estimated."""
        return free_mask(self.options)

    @property
    def elapsed(self) -> float | None:
        """Seconds since the last pose, where they are known."""
        return self.track.seconds_until(self.time_s)

    @cached_property
    def noise(self) -> Floats:
        """What is remembered of each view's noise: squares in σ_ε², degrees of freedom (2, L)."""
        names = [view.name for view in self.views]
        return self.rules.judgement.noise.memory * self.track.residuals.of(names)

    @property
    def close(self) -> Floats:
        """Standard deviations (6,) of a start that was searched for, or is a rival's."""
        return self.start_uncertainty / self.rules.proposals.narrowing**2

    @cached_property
    def anywhere(self) -> Prior:
        """What is known of a pose of which nothing is known."""
        return flat_prior(self.body, self.free, self.rules.judgement.detection)

    def prior(self, T_world_object: Floats) -> Prior:
        """What was known of a pose before the frame."""
        misses, rules = self.track.misses, self.rules.motion
        own = self._prior(T_world_object, self.predictions, misses)
        if self.beside is None:
            return own
        return either(own, self._prior(T_world_object, [self.beside], 0), misses, rules)

    def _prior(self, T_world_object: Floats, some: Sequence[Prediction], misses: int) -> Prior:
        """Density of a pose by predictions, or now and then anywhere."""
        anywhere, rules = self.anywhere, self.rules.motion
        if not some:
            return anywhere
        surprise = min(rules.surprise * (1 + misses), 1.0)
        terms, spreads = [np.log(surprise) + anywhere.log_density], [anywhere.spread]
        for one in some:
            T = nearest_alike(T_world_object, self.body, one.T_world_object)
            weight = max((1 - surprise) * one.weight, 1e-12)
            terms.append(np.log(weight) + one.log_density(T, self.free, rules))
            spreads.append(one.uncertainty)
        # directions that the data leave open are as uncertain as where the pose likely comes from
        return Prior(float(np.logaddexp.reduce(terms)), spreads[int(np.argmax(terms))])

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
        views = [
            replace(view, sensor=in_motion(view.sensor, motion, view.delay, view.readout))
            for view in still.views
        ]
        return replace(still, views=views, still=still)

    def expected(self, T_world_object: Floats, *, is_there: bool = True) -> Expected:
        """The velocity that the frames before let expect of a pose, or near it."""
        elapsed, rules = self.elapsed, self.rules.course
        nothing = unknown(self.body, rules)
        branch = nearest_branch(self.track, T_world_object, self.body)
        if branch is None or not elapsed:
            return nothing
        T = nearest_alike(T_world_object, self.body, branch.T_world_object)
        moved = twist_between(branch.T_world_object, T)
        if branch.course is not None and elapsed <= rules.longest_s:
            expected = branch.course.expected(moved if is_there else None, elapsed, rules)
            is_far = (np.abs(expected.velocity) > nothing.deviation).any()
            return nothing if is_far else expected
        if branch.course is not None or branch.velocity is None:
            return nothing
        # by the last two steps alone
        velocity = moved / elapsed + (moved / elapsed - branch.velocity) / 2
        return nothing._replace(velocity=velocity, gain=np.full(6, 1.5 / elapsed))

    def given(self, T_world_object: Floats) -> float:
        """How far features in view may be off by the body's spread, in σ_ε of their sensor."""
        if not self.body.spread:
            return 0.0
        at = self.finest.projection.project(T_world_object[None])
        spreads = self.body.node_spreads(T_world_object)
        each = zip(at.J[:, 0], self.finest.projection.dimensions.tolist(), strict=True)
        variances = np.array([in_image(spreads, J[:, :m]) for J, m in each]) * at.seen[:, 0]
        return float(np.sqrt((variances / np.square(self.sigmas)[:, None]).max()))


@dataclass(frozen=True, eq=False)
class MatchedLikelihood:
    """Matched densities of all sensors."""

    data: FrameData
    climbed: dict[frozenset[str], list[Climbed]] = field(default_factory=dict)  # by those left out

    @property
    def knows_detections(self) -> bool:
        """Whether each feature's detection is known, so that one may be left out."""
        return self.data.options.objective == "matched"

    def fit(self, start: Start, begun: Ascent | None = None) -> Fit:
        """Ascend the session's objective through narrowing blurs; `begun` at σ_ε already."""
        if start.uncertainty is None:
            return Fit(start.T_world_object, 0.0, True, 0)
        data, uncertainty = self.data.without(start.left_out), start.uncertainty
        climbed = self.climbed.setdefault(frozenset(start.left_out), [])
        timed = is_timed(data.views)
        if data.begun and data.begun.fit and start.prediction is data.predictions[0]:
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
                association=seen.rules.judgement.association,
                rules=seen.rules.fit,
            )

        if timed:
            return fit_in_motion(data, start.T_world_object, climb)
        return climb(data, start.T_world_object)

    def judge(self, fit: Fit, start: Start) -> ScoredPose:
        """Judge a pose by matched densities at σ_ε, and take what is left out for missed."""
        begun = self.data.begun
        if begun is not None and fit is begun.fit and begun.judged is not None:
            return begun.judged
        data, motion = self.data, fit.motion
        T = nearest_alike(fit.T_world_object, data.body, data.T_reference)
        if is_timed(data.views):
            motion = motion or data.expected(T).at(T)
            data = data.in_motion(motion)
        prior = data.prior(T if start.T_moved is None else start.T_moved)
        is_seen = T is fit.T_world_object and motion is None and not start.left_out
        judged = judge(
            data.finest,
            T,
            data.free,
            data.rules.judgement,
            before=data.track.residuals,
            prior=prior,
            left_out=start.left_out,
            matches=fit.matches if is_seen else None,
            noise=fit.noise if is_seen else None,
        )
        return judged if motion is None else with_motion_unknown(judged, data, motion)


Likelihood: TypeAlias = MatchedLikelihood | AssociationLikelihood


def likelihood_of(data: FrameData) -> Likelihood:
    """The likelihood for a frame."""
    if data.options.objective == "matched" and are_associated(
        data.views, data.body, data.rules.ranges
    ):
        return AssociationLikelihood(data, MatchedLikelihood)
    return MatchedLikelihood(data)
