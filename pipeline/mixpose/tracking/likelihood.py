"""What one frame says of a pose: how to fit it near a start, and how to judge it.

Chosen once per frame: matched densities, or, for single ranges of small bodies, the likelihood
over all associations of ranges and features.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.density import Noise
from mixpose.fit import EstimatorOptions, Fit, fit_near, free_mask
from mixpose.judgement import Judged, Prior, associate, flat_prior, judge, nearest_alike
from mixpose.objective import MatchedObjective, SharedDensities, View, matched_objective
from mixpose.records import SensorReport
from mixpose.search import SearchState
from mixpose.tracking.association_likelihood import are_associated
from mixpose.tracking.range_posterior import Posterior, fit_ranges, judge_ranges, noise_ratio
from mixpose.tracking.rules import Rules
from mixpose.tracking.track import Prediction, Track, prior_of

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
    """

    T_world_object: Floats
    uncertainty: Floats | None = None
    prediction: Prediction | None = None
    left_out: Mapping[str, str] = field(default_factory=dict)


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
    """Where the search of a frame goes on in the next."""

    state: SearchState = SearchState()


@dataclass(frozen=True, eq=False)
class FrameData:
    """A frame, and what is known before it; `log` is written by the proposer that searches.

    `shared` are the densities of a whole scene, where the views hold what is left for this body.
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
    shared: SharedDensities | None = None
    log: SearchLog = field(default_factory=SearchLog)

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
        return prior_of(
            T_world_object,
            self.predictions,
            self.body,
            self.free,
            self.track.misses,
            self.rules.motion,
            self.rules.judgement.detection,
        )

    @cached_property
    def finest(self) -> MatchedObjective:
        """The matched objective at σ_ε."""
        sigmas = [view.observation.sigma for view in self.views]
        return matched_objective(self.views, self.body, sigmas, shared=self.shared)

    def without(self, names: Mapping[str, str]) -> FrameData:
        """The frame without some sensors."""
        if not names:
            return self
        views = [view for view in self.views if view.name not in names]
        return replace(self, views=views, shared=None)


@dataclass(frozen=True, eq=False)
class MatchedLikelihood:
    """Matched densities of all sensors."""

    data: FrameData

    @property
    def knows_detections(self) -> bool:
        """As `Likelihood` has it."""
        return self.data.options.objective == "matched"

    def fit(self, start: Start) -> Fit:
        """Ascend the session's objective through narrowing blurs."""
        if start.uncertainty is None:
            return Fit(start.T_world_object, 0.0, True, 0)
        data = self.data.without(start.left_out)
        return fit_near(
            data.views,
            data.body,
            start.T_world_object,
            start.uncertainty,
            data.options,
            data.samples,
            finest=data.finest,
            noise=data.noise,
            errors=data.rules.judgement.noise.errors,
            rules=data.rules.fit,
        )

    def judge(self, fit: Fit, start: Start) -> Judged:
        """Judge a pose by matched densities at σ_ε, and take what is left out for missed."""
        data = self.data.without(start.left_out)
        T = nearest_alike(fit.T_world_object, data.body, data.T_reference)
        rules, others = data.rules.judgement, []
        if start.left_out:
            found, _ = associate(self.data.finest, T, rules.association)
            others = [one for one in found if one.name in start.left_out]
        judged = judge(
            data.finest,
            T,
            data.free,
            before=data.track.residuals,
            prior=data.prior(T),
            unmet=others,
            rules=rules,
        )
        reports = {
            one.name: SensorReport(False, one.explained, one.rms, start.left_out[one.name])
            for one in others
        }
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
        T, data = start.T_world_object, self.data
        if _prior_of(start) is None:
            T = MatchedLikelihood(data).fit(start).T_world_object
            T = nearest_alike(T, data.body, data.T_reference)
        posterior = self._posterior(start)
        found = fit_ranges(
            data.views,
            data.body,
            T,
            data.free,
            posterior.noise,
            posterior.prior,
            posterior.detection,
        )
        return Fit(found.state, found.value, found.converged, found.iterations)

    def judge(self, fit: Fit, start: Start) -> Judged:
        """Judge a pose by the sum over all associations."""
        data, T = self.data, fit.T_world_object
        judged = judge(data.finest, T, data.free, rules=data.rules.judgement)
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
        detection = data.rules.judgement.detection
        return Posterior(data.views, data.body, data.free, noise, _prior_of(start), detection)


def _prior_of(start: Start) -> Prediction | None:
    """The prediction that a start comes from, where that is a prior."""
    return start.prediction if start.prediction and start.prediction.is_prior else None


def likelihood_of(data: FrameData) -> Likelihood:
    """The likelihood for a frame."""
    ranged = data.options.objective == "matched" and are_associated(
        data.views, data.body, data.rules.ranges
    )
    return AssociationLikelihood(data) if ranged else MatchedLikelihood(data)
