"""One frame of one body: its views, what the track knows before it, and the track after it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, reduce
from typing import Any

import numpy as np

from mixpose.body import Body
from mixpose.fit import EstimatorOptions, Fit, free_mask
from mixpose.judgement import Prior, ScoredPose, convinces, flat_prior, is_sure, nearest_alike
from mixpose.matching import Matches, NoiseEstimate, log_likelihood, pooled
from mixpose.objective import MatchedObjective, View, in_image, matched_objective, project_body
from mixpose.records import Floats, Mask, replace
from mixpose.rigid import transform, twist_between
from mixpose.search import SearchReport, SearchState
from mixpose.sensors import Motion, in_motion
from mixpose.tracking.motion import ExpectedVelocity, at_rest
from mixpose.tracking.rules import Rules
from mixpose.tracking.track import Branch, Track, log_densities, mixed_prior, places_of


@dataclass(frozen=True)
class Start:
    """The start of a fit."""

    T_world_object: Floats  # (4, 4)
    uncertainty: Floats | None = None  # (6,), standard deviations; None: not fitted, only judged
    prediction: Branch | None = None  # the branch that this start comes from
    left_out: Mapping[str, str] = field(default_factory=dict)  # sensors, and the reason of each
    T_moved: Floats | None = None  # the pose whose motion prior this one gets
    blur: float = 1.0  # at which the fit begins, in σ_ε
    matches: Matches | None = None  # at the pose, where it is not fitted
    noise: NoiseEstimate | None = None  # estimated from `matches`, if known
    least: float = -math.inf  # log likelihood at σ_ε from which narrower blurs are fitted


@dataclass(frozen=True, eq=False)
class Setup:
    """A body and its estimation settings, which stay the same from frame to frame."""

    body: Body
    options: EstimatorOptions
    samples: Floats  # (N, R, 3) of the body, for the objectives that integrate by sampling
    start_uncertainty: Floats  # (6,)
    rules: Rules

    @cached_property
    def free(self) -> Mask:
        """Return which of the six directions are estimated."""
        return free_mask(self.options)


@dataclass(frozen=True, eq=False)
class Frame(Setup):
    """The views of one frame, and what is known before it."""

    views: Sequence[View]
    track: Track
    predictions: Sequence[Branch]
    T_reference: Floats | None  # (4, 4), chooses among poses that look the same
    frame: int
    time_s: float | None
    precomputed: MatchedObjective | None = None  # `finest`, if it is drawn already
    starts: Sequence[Start] = ()  # replace predictions where several bodies are fitted together
    joint_fit: tuple[Start, Fit, ScoredPose] | None = None  # of the first start with all bodies
    # cost of each search of this frame and its state for the next; proposers append to it
    searches: list[tuple[SearchReport, SearchState]] = field(default_factory=list)
    static_views: Sequence[View] = ()  # sensors at rest, where `views` are moved to the common time
    unweighed: Sequence[View] = ()  # sensors at rest, before spots were weighed by size
    companion_prediction: Branch | None = None  # by the pose of another body
    sensors: Sequence[str] = ()  # all with a frame, also those that saw nothing

    @property
    def has_triangulated_start(self) -> bool:
        """Test whether a start comes from triangulated points instead of a prediction."""
        return any(start.prediction is None for start in self.starts)

    def is_found_by(self, ranked: Sequence[ScoredPose]) -> bool:
        """Test whether the most evident pose is such that the body is sought nowhere else.

        Among all triangulated points that are its features, a sure pose suffices.
        """
        accepts = is_sure if self.has_triangulated_start else convinces
        return bool(ranked) and accepts(ranked[0], self.free, self.rules.acceptance)

    @cached_property
    def is_timed(self) -> bool:
        """Test whether any view is seen at another moment than the common time."""
        return any(view.delay or view.readout or view.unsure is not None for view in self.views)

    @property
    def sigmas(self) -> list[float]:
        """Return σ_ε of each view."""
        return [view.observation.sigma for view in self.views]

    @property
    def noise(self) -> Floats:
        """Return the remembered noise of each view: squares in σ_ε², degrees of freedom (2, L)."""
        return self.rules.judgement.noise.memory * self.track.residuals.of(
            [view.name for view in self.views]
        )

    @cached_property
    def variances(self) -> Floats:
        """Return the noise variance of each view (L,) in σ_ε², by the frames before."""
        errors = self.rules.judgement.noise.errors
        return pooled(self.noise, errors, errors.typical_degrees)

    @property
    def close_uncertainty(self) -> Floats:
        """Return the standard deviations (6,) of starts that were searched for, and of rivals."""
        return self.start_uncertainty / self.rules.proposals.narrowing**2

    @cached_property
    def flat_prior(self) -> Prior:
        """Return the prior of a pose of which nothing is known."""
        return flat_prior(self.body, self.free, self.rules.judgement.detection)

    @cached_property
    def finest(self) -> MatchedObjective:
        """Return the matched objective at σ_ε."""
        return self.precomputed or matched_objective(self.views, self.body, self.sigmas)

    def prior(self, T_world_object: Floats) -> Prior:
        """Return the prior of a pose, by its own track and a companion."""
        misses, rules, key = self.track.misses, self.rules.motion, T_world_object.tobytes()
        if key not in self._priors:
            mixture = self._prior(T_world_object, self.predictions, misses)
            if self.companion_prediction is not None:
                companion = self._prior(T_world_object, [self.companion_prediction], 0)
                mixture = mixed_prior(mixture, companion, misses, rules)
            self._priors[key] = mixture
        return self._priors[key]

    @cached_property
    def _priors(self) -> dict[bytes, Prior]:
        """Return the cache of `prior`."""
        return {}

    def _prior(self, T_world_object: Floats, branches: Sequence[Branch], misses: int) -> Prior:
        """Return the prior of a pose as a mixture of predictions and of a pose anywhere."""
        anywhere, rules = self.flat_prior, self.rules.motion
        if not branches:
            return anywhere
        surprise = rules.surprise_after(misses)
        terms, spreads = [math.log(surprise) + anywhere[0]], [anywhere[1]]
        for branch in branches:
            T = nearest_alike(T_world_object, self.body, branch.T_world_object)
            near = float(branch.log_density(T, self.free, rules))
            terms.append(branch.log_belief(surprise) + near)
            spreads.append(branch.uncertainty)
        # directions that the data leave open get the uncertainty of the likeliest term
        return float(reduce(np.logaddexp, terms)), spreads[terms.index(max(terms))]

    def is_expected(self, T_world_object: Floats) -> bool:
        """Test whether the prior of a pose is at least a thousandth of the best prediction's."""
        if not self.predictions:
            return True
        behind = self.prior(self.predictions[0].T_world_object)[0] - self.prior(T_world_object)[0]
        return behind < -self.rules.acceptance.log_doubt

    def rival(
        self,
        best: ScoredPose,
        T_world_object: Floats,
        wide: Floats,
        *,
        ahead: float | None = None,
        **known: Any,
    ) -> Start:
        """Return a start for a rival of the best pose, with its least likelihood.

        It has to be `ahead` by so many nats to matter; None: as far behind as makes no odds.
        """
        errors, count = self.rules.judgement.noise.errors, int(np.count_nonzero(self.free))
        expected = log_likelihood(errors.blur * np.sqrt(best.variances), best.used, count, errors)
        # narrow blurs gain up to half of it
        gained = self.rules.look_alikes.behind / 2
        least = float(expected) - gained + (-gained if ahead is None else ahead)
        return Start(T_world_object, wide, least=least, **known)

    @property
    def elsewhere(self) -> float:
        """Return the log density of a pose where its own track does not expect the body."""
        surprise = self.rules.motion.surprise_after(self.track.misses)
        return self.flat_prior[0] + (math.log(surprise) if self.predictions else 0.0)

    def oriented(self, T_world_object: Floats) -> Floats:
        """Return the pose nearest to the reference among those that look the same.

        Without a reference, and if these differ a little: the pose itself, which is met best.
        """
        if self.T_reference is None and self.body.asymmetry:
            return T_world_object
        return nearest_alike(T_world_object, self.body, self.T_reference)

    def log_densities(self, poses: Floats) -> Floats:
        """Return log densities (K,) of poses (K, 4, 4) by the predictions, or elsewhere."""
        return np.asarray(log_densities_by([self], poses)[0])

    def feature_distances(self, T_world_object: Floats) -> list[Floats]:
        """Return how far the features (N,) of each prediction are from those at a pose.

        Of poses that look the same the one nearest to the prediction counts.
        """
        body, distances = self.body, list[Floats]()
        for branch in self.predictions:
            T = nearest_alike(T_world_object, body, branch.T_world_object)
            here, expected = (transform(P, body.means) for P in (T, branch.T_world_object))
            distances.append(np.linalg.norm(expected - here, axis=1))
        return distances

    def log_odds_other_at(self, T_world_object: Floats) -> float | None:
        """Return log odds that another thing is at a pose, by its branch; None if none was seen."""
        if all(branch.log_odds_other is None for branch in self.predictions):
            return None
        predecessor = self.predecessor(T_world_object)
        return predecessor.log_odds_other if predecessor else None

    def predecessor(self, T_world_object: Floats) -> Branch | None:
        """Return the prediction that a pose goes on from: the nearest of those that it overlaps."""
        distances = self.feature_distances(T_world_object)
        near = [k for k, off in enumerate(distances) if off.min() <= self.body.radius]
        return self.predictions[min(near, key=lambda k: distances[k].mean())] if near else None

    @property
    def was_lost(self) -> bool:
        """Test whether a body seen before is missing for so long that no velocity is believed."""
        return bool(self.predictions) and self.track.misses > self.rules.motion.coasting

    def without(self, names: Mapping[str, str]) -> Frame:
        """Return the frame without some sensors."""
        return self.changed(
            views=[view for view in self.views if view.name not in names],
            static_views=[view for view in self.static_views if view.name not in names],
        )

    def with_body(self, body: Body) -> Frame:
        """Return the frame for another body with as many features; nothing is fitted yet."""
        frame = self.changed(body=body)
        if self.precomputed is not None:  # its densities may contain detections of other bodies
            return frame
        # another body has the same densities
        projection = project_body(self.finest.projection.sensors, body)
        return replace(frame, precomputed=replace(self.finest, projection=projection))

    def changed(self, **changes: Any) -> Frame:
        """Return the frame with other views or another body; nothing is drawn or fitted yet."""
        if "views" in changes:
            changes.setdefault("unweighed", ())
        return replace(self, precomputed=None, joint_fit=None, **changes)

    def alone(self, **changes: Any) -> Frame:
        """Return the frame with nothing from the frames before but noise, for a quick search."""
        return self.changed(
            predictions=(),
            companion_prediction=None,
            searches=[],
            track=Track(residuals=self.track.residuals),
            options=replace(self.options, search="live"),
            **changes,
        )

    def in_motion(self, motion: Motion) -> Frame:
        """Return the frame with sensors moved to the common time, for a body with this motion."""
        resting = self.static_views or self.views
        views = tuple(
            replace(view, sensor=in_motion(view.sensor, motion, view.delay, view.readout))
            for view in resting
        )
        projection = project_body(tuple(view.sensor for view in views), self.body)
        # densities do not move with the sensors
        return replace(
            self,
            views=views,
            static_views=resting,
            precomputed=replace(self.finest, views=views, projection=projection),
        )

    def expected_velocity(self, T_world_object: Floats, *, seen: bool = True) -> ExpectedVelocity:
        """Return the velocity expected at a pose; if that was `seen`, by its displacement too."""
        elapsed, rules = self.track.seconds_until(self.time_s), self.rules.motion
        # nothing seen before: at rest, within what hands can do
        resting = at_rest(self.body, rules)
        branch = self.track.nearest(T_world_object, self.body)
        if branch is None or not elapsed:
            return resting
        moved = twist_between(
            branch.T_world_object, nearest_alike(T_world_object, self.body, branch.T_world_object)
        )
        if branch.motion_filter is None and branch.velocity is not None:  # by the last two steps
            velocity = moved / elapsed + (moved / elapsed - branch.velocity) / 2
            return resting._replace(velocity=velocity, gain=np.full(6, 1.5 / elapsed))
        if branch.motion_filter is None or elapsed > rules.longest_s:
            return resting
        return branch.motion_filter.expected(moved if seen else None, elapsed)


def log_densities_by(frames: Sequence[Frame], poses: Floats) -> Floats:
    """Return log densities (F, K) of poses (K, 4, 4) of one body by what each frame expects."""
    logs = np.array([frame.elsewhere for frame in frames])[:, None].repeat(len(poses), axis=1)
    rows = [k for k, frame in enumerate(frames) for _ in frame.predictions]
    if not rows:
        return logs
    branches = [branch for frame in frames for branch in frame.predictions]
    body, free, rules = frames[0].body, frames[0].free, frames[0].rules.motion
    nearest = nearest_alike(poses, body, places_of(branches))
    near = log_densities(branches, np.broadcast_to(nearest, (len(rows), *poses.shape)), free, rules)
    for k, branch, logs_near in zip(rows, branches, near, strict=True):
        surprise = rules.surprise_after(frames[k].track.misses)
        logs[k] = np.logaddexp(logs[k], branch.log_belief(surprise) + logs_near)
    return logs


def gains_by(frames: Sequence[Frame], poses: Floats) -> Floats:
    """Return how much likelier (F, K) frames make poses (K, 4, 4) of one body than a flat prior.

    Zeros where the track may follow another body: then it does not tell the two apart.
    """
    gains = log_densities_by(frames, poses) - frames[0].flat_prior[0]
    doubts = [max(frame.track.confused.values(), default=-math.inf) for frame in frames]
    gains[np.array(doubts) > frames[0].rules.acceptance.log_doubt] = 0.0
    return np.asarray(gains)


def spread_in_image(frame: Frame, T_world_object: Floats) -> float:
    """Return the largest deviation of features in view by the body's spread, in σ_ε."""
    projection = frame.finest.projection
    images = projection.project(T_world_object[None])
    # J has two rows for every sensor; this is a variance per coordinate
    shares = (2 / projection.dimensions)[:, None] * images.seen[:, 0]
    variances = shares * in_image(frame.body.node_spreads(T_world_object), images.J[:, 0])
    return float(np.sqrt((variances / np.square(frame.sigmas)[:, None]).max()))
