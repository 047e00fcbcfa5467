"""A frame of one body: what its sensors saw, what is known before it, and the track after it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import Any

import numpy as np

from mixpose.body import Body
from mixpose.fit import EstimatorOptions, Fit, free_mask
from mixpose.judgement import (
    AcceptanceRules,
    Prior,
    ScoredPose,
    convinces,
    flat_prior,
    is_sure,
    nearest_alike,
)
from mixpose.matching import Matches, NoiseEstimate, log_likelihood, pooled
from mixpose.objective import MatchedObjective, View, in_image, matched_objective, project_body
from mixpose.records import Floats, Mask
from mixpose.rigid import inverse, transform, twist_between
from mixpose.search import SearchReport, SearchState
from mixpose.sensors import Motion, in_motion
from mixpose.tracking.motion import Course, Expected, RandomWalk, at_rest, per_kind
from mixpose.tracking.rules import Rules
from mixpose.tracking.track import Branch, Track, either


@dataclass(frozen=True)
class Start:
    """Where a fit begins."""

    T_world_object: Floats  # (4, 4)
    uncertainty: Floats | None = None  # (6,), standard deviations; None: the pose is there already
    prediction: Branch | None = None  # that it comes from
    left_out: Mapping[str, str] = field(default_factory=dict)  # sensors, and why
    T_moved: Floats | None = None  # a pose that has moved as this must have, and was as likely
    blur: float = 1.0  # in σ_ε, that the fit begins at
    matches: Matches | None = None  # that it meets, where it is there already
    noise: NoiseEstimate | None = None  # as these show it, where that is at hand
    least: float = -math.inf  # log likelihood at σ_ε with which narrower blurs are worth a fit


@dataclass(frozen=True, eq=False)
class Setup:
    """A body, and how its poses are estimated: what stays the same from frame to frame."""

    body: Body
    options: EstimatorOptions
    samples: Floats  # (N, R, 3) of the body, for the objectives that integrate by sampling
    start_uncertainty: Floats  # (6,)
    rules: Rules

    @cached_property
    def free(self) -> Mask:
        """Which of the six directions are estimated."""
        return free_mask(self.options)


@dataclass(frozen=True, eq=False)
class Frame(Setup):
    """A frame, and what is known before it."""

    views: Sequence[View]
    track: Track
    predictions: Sequence[Branch]
    T_reference: Floats | None  # (4, 4), that tells poses apart that look the same
    frame: int
    time_s: float | None
    drawn: MatchedObjective | None = None  # `finest`, where it is at hand
    starts: Sequence[Start] = ()  # instead of predictions, where bodies are looked for together
    together: tuple[Start, Fit, ScoredPose] | None = None  # fitted from the first start
    # what searches of the frame cost, and where they go on in the next; the proposer adds to it
    searches: list[tuple[SearchReport, SearchState]] = field(default_factory=list)
    still: Sequence[View] = ()  # where views are as of the common time: sensors as they stand
    unweighed: Sequence[View] = ()  # sensors as they stand, before spots were weighed by their size
    beside: Branch | None = None  # where another body lets expect one that is not where it was
    sensors: Sequence[str] = ()  # all that had a frame, also those that saw nothing

    def first_is(
        self,
        trusted: Callable[[ScoredPose, Mask, AcceptanceRules], bool],
        ranked: Sequence[ScoredPose],
    ) -> bool:
        """Whether there is a pose, and the most evident is `trusted` by the rules of acceptance."""
        return bool(ranked) and trusted(ranked[0], self.free, self.rules.acceptance)

    @property
    def is_found_at_once(self) -> bool:
        """Whether it starts where points in space put it, and not where it was expected."""
        return any(one.prediction is None for one in self.starts)

    @property
    def trusted(self) -> Callable[[ScoredPose, Mask, AcceptanceRules], bool]:
        """What a pose must be so that the body is looked for nowhere else.

        Among all points in space that are its features, sure is enough.
        """
        return is_sure if self.is_found_at_once else convinces

    @cached_property
    def is_timed(self) -> bool:
        """Whether any view is seen at another moment than the common time."""
        return any(view.delay or view.readout or view.unsure is not None for view in self.views)

    @property
    def sigmas(self) -> list[float]:
        """σ_ε of each view."""
        return [view.observation.sigma for view in self.views]

    @property
    def noise(self) -> Floats:
        """What is remembered of each view's noise: squares in σ_ε², degrees of freedom (2, L)."""
        return self.rules.judgement.noise.memory * self.track.residuals.of(
            [view.name for view in self.views]
        )

    @cached_property
    def variances(self) -> Floats:
        """Of each view's noise (L,), σ_ε², as the frames before tell it."""
        errors = self.rules.judgement.noise.errors
        return pooled(self.noise, errors, errors.typical_degrees)

    @property
    def close(self) -> Floats:
        """Standard deviations (6,) of a start that was searched for, or is a rival's."""
        return self.start_uncertainty / self.rules.proposals.narrowing**2

    @cached_property
    def anywhere(self) -> Prior:
        """What is known of a pose of which nothing is known."""
        return flat_prior(self.body, self.free, self.rules.judgement.detection)

    @cached_property
    def finest(self) -> MatchedObjective:
        """The matched objective at σ_ε."""
        return self.drawn or matched_objective(self.views, self.body, self.sigmas)

    def prior(self, T_world_object: Floats) -> Prior:
        """What was known of a pose before the frame."""
        misses, rules, asked = self.track.misses, self.rules.motion, T_world_object.tobytes()
        if asked not in self._priors:
            own = self._prior(T_world_object, self.predictions, misses)
            if self.beside is not None:
                beside = self._prior(T_world_object, [self.beside], 0)
                own = either(own, beside, misses, rules)
            self._priors[asked] = own
        return self._priors[asked]

    @cached_property
    def _priors(self) -> dict[bytes, Prior]:
        """What was known of poses that were asked for already."""
        return {}

    def _prior(self, T_world_object: Floats, some: Sequence[Branch], misses: int) -> Prior:
        """Density of a pose by predictions, or now and then anywhere."""
        anywhere, rules = self.anywhere, self.rules.motion
        if not some:
            return anywhere
        surprise = rules.surprised(misses)
        terms, spreads = [math.log(surprise) + anywhere[0]], [anywhere[1]]
        for one in some:
            T = nearest_alike(T_world_object, self.body, one.T_world_object)
            near = float(one.log_density(T, self.free, rules))
            terms.append(one.log_belief(surprise) + near)
            spreads.append(one.uncertainty)
        # directions that the data leave open are as uncertain as where the pose likely comes from
        return float(reduce(np.logaddexp, terms)), spreads[terms.index(max(terms))]

    def is_expected(self, T_world_object: Floats) -> bool:
        """Whether the frames before make a pose a thousandth as likely as the best, or more."""
        if not self.predictions:
            return True
        there = self.prior(self.predictions[0].T_world_object)[0] - self.prior(T_world_object)[0]
        return there < -self.rules.acceptance.log_doubt

    def rival(
        self,
        best: ScoredPose,
        T_world_object: Floats,
        wide: Floats,
        *,
        ahead: float | None = None,
        **rest: Any,
    ) -> Start:
        """A start of what there may be instead of a pose, as far as that leaves room for it.

        It has to be `ahead` by so many nats to matter; else as far behind as makes no odds.
        """
        errors, count = self.rules.judgement.noise.errors, int(np.count_nonzero(self.free))
        own = log_likelihood(errors.blur * np.sqrt(best.variances), best.used, count, errors)
        # half of it is what narrow blurs gain
        gained = self.rules.look_alikes.behind / 2
        least = float(own) - gained + (-gained if ahead is None else ahead)
        return Start(T_world_object, wide, least=least, **rest)

    @property
    def elsewhere(self) -> float:
        """Log density of a pose where its own track does not expect the body."""
        surprise = self.rules.motion.surprised(self.track.misses)
        return self.anywhere[0] + (math.log(surprise) if self.predictions else 0.0)

    def oriented(self, T_world_object: Floats) -> Floats:
        """Of poses that look the same the one nearest to what is known before.

        Where nothing is, and orientations differ by a little, the pose itself: the one is told that
        is met most closely.
        """
        if self.T_reference is None and self.body.asymmetry:
            return T_world_object
        return nearest_alike(T_world_object, self.body, self.T_reference)

    def expectation(self, poses: Floats) -> Floats:
        """Log densities (K,) of poses (K, 4, 4) by its own track, or that it is elsewhere."""
        logs = np.full(len(poses), self.elsewhere)
        surprise = self.rules.motion.surprised(self.track.misses)
        for one in self.predictions:
            there = nearest_alike(poses, self.body, one.T_world_object)
            near = one.log_density(there, self.free, self.rules.motion)
            logs = np.logaddexp(logs, one.log_belief(surprise) + near)
        return logs

    def gains(self, poses: Floats) -> Floats:
        """How much likelier (K,) its own track makes poses (K, 4, 4) than any other.

        One that may be another body's tells nothing of which of the two is there.
        """
        doubt = max(self.track.alike.values(), default=-math.inf)
        if doubt > self.rules.acceptance.log_doubt:
            return np.zeros(len(poses))
        return self.expectation(poses) - self.anywhere[0]

    def away_from(self, T_world_object: Floats) -> list[Floats]:
        """How far the features (N,) of each prediction are from those at a pose.

        Of poses that look the same it is the nearest to the prediction.
        """
        body, away = self.body, list[Floats]()
        for one in self.predictions:
            T = nearest_alike(T_world_object, body, one.T_world_object)
            here, there = (transform(each, body.means) for each in (T, one.T_world_object))
            away.append(np.linalg.norm(there - here, axis=1))
        return away

    def other_at(self, T_world_object: Floats) -> float | None:
        """Log odds that what is at a pose is not the body, by the prediction that it goes on from.

        None where nothing else was ever seen.
        """
        if all(one.other is None for one in self.predictions):
            return None
        before = self.before(T_world_object)
        return before.other if before else None

    def before(self, T_world_object: Floats) -> Branch | None:
        """The prediction that a pose goes on from: the nearest of those that it overlaps."""
        away = self.away_from(T_world_object)
        near = [k for k, off in enumerate(away) if off.min() <= self.body.radius]
        return self.predictions[min(near, key=lambda k: away[k].mean())] if near else None

    @property
    def was_lost(self) -> bool:
        """Whether no velocity of the body is believed any more, which was seen before."""
        return bool(self.predictions) and self.track.misses > self.rules.motion.coasting

    def without(self, names: Mapping[str, str]) -> Frame:
        """The frame without some sensors."""
        return self.seen_otherwise(
            views=[view for view in self.views if view.name not in names],
            still=[view for view in self.still if view.name not in names],
        )

    def of_body(self, body: Body) -> Frame:
        """Of another body with as many features, of which nothing is fitted yet."""
        other = self.seen_otherwise(body=body)
        if self.drawn is not None:  # perhaps with what belongs to other bodies
            return other
        # the densities are the same
        projection = project_body(self.finest.projection.sensors, body)
        return replace(other, drawn=replace(self.finest, projection=projection))

    def seen_otherwise(self, **changes: Any) -> Frame:
        """With other views or another body, of which nothing is drawn or fitted yet."""
        if "views" in changes:
            changes.setdefault("unweighed", ())
        return replace(self, drawn=None, together=None, **changes)

    def alone(self, **changes: Any) -> Frame:
        """With nothing known from the frames before it but the noise, for a quick search."""
        return self.seen_otherwise(
            predictions=(),
            beside=None,
            searches=[],
            track=Track(residuals=self.track.residuals),
            options=replace(self.options, search="live"),
            **changes,
        )

    def in_motion(self, motion: Motion) -> Frame:
        """The frame as of the common time, of a body that moves."""
        still = self.still or self.views
        views = tuple(
            replace(view, sensor=in_motion(view.sensor, motion, view.delay, view.readout))
            for view in still
        )
        projection = project_body(tuple(view.sensor for view in views), self.body)
        # densities do not move with the sensors
        return replace(
            self,
            views=views,
            still=still,
            drawn=replace(self.finest, views=views, projection=projection),
        )

    def expected(self, T_world_object: Floats, *, is_there: bool = True) -> Expected:
        """The velocity that the frames before let expect of a pose, or near it."""
        elapsed, rules = self.track.seconds_until(self.time_s), self.rules.motion
        # where nothing was seen before: rest, give or take what hands can do
        rest = at_rest(self.body, rules)
        branch = self.track.nearest(T_world_object, self.body)
        if branch is None or not elapsed:
            return rest
        moved = twist_between(
            branch.T_world_object, nearest_alike(T_world_object, self.body, branch.T_world_object)
        )
        if branch.course is None and branch.velocity is not None:  # by the last two steps alone
            velocity = moved / elapsed + (moved / elapsed - branch.velocity) / 2
            return rest._replace(velocity=velocity, gain=np.full(6, 1.5 / elapsed))
        if branch.course is None or elapsed > rules.longest_s:
            return rest
        return branch.course.expected(moved if is_there else None, elapsed)


def _moved(
    parent: Branch, expected: Branch, T_world_object: Floats, frame: Frame, alike: Sequence[Floats]
) -> tuple[Floats, bool]:
    """The twist (6,) to a pose, from that before, or from a look-alike of that.

    And whether it is the latter: by where the body was expected, as now and then another one is
    taken for it; of a frame that was ok as seldom as that is wrong.
    """
    T_before, chosen = parent.T_world_object, 0
    if alike:
        like = np.concatenate([T_world_object[None], T_world_object @ np.array(alike)])
        logs = expected.log_density(like, frame.free, frame.rules.motion)
        is_unsure = frame.track.doubted or not frame.track.believed
        rules = frame.rules
        logs[1:] += math.log(rules.motion.surprise) if is_unsure else rules.acceptance.log_doubt
        if chosen := int(logs.argmax()):
            T_before = T_before @ inverse(alike[chosen - 1])
    return twist_between(T_before, T_world_object), chosen > 0


def given(frame: Frame, T_world_object: Floats) -> float:
    """How far features in view may be off by the body's spread, in σ_ε of their sensor."""
    projection = frame.finest.projection
    at = projection.project(T_world_object[None])
    # per coordinate, of which each sensor has two in J
    each = (2 / projection.dimensions)[:, None] * at.seen[:, 0]
    variances = each * in_image(frame.body.node_spreads(T_world_object), at.J[:, 0])
    return float(np.sqrt((variances / np.square(frame.sigmas)[:, None]).max()))


def follow(
    frame: Frame, found: Sequence[tuple[Branch, Sequence[Floats] | None]], **known: Any
) -> Track:
    """The track after a frame with poses, the best first, and with what else is `known` by then.

    Where a pose has look-alikes, motions (4, 4) of the body, one of them may have been followed;
    None where it goes on from nothing.
    """
    track, body, rules = frame.track, frame.body, frame.rules.motion
    elapsed, walk = track.elapsed(frame.frame, frame.time_s), track.walk
    steady, branches = per_kind(body.radius, rules.steady), list[Branch]()
    is_timed = track.is_timed_as(frame.time_s)
    for there, alike in found:
        one, T, deviation = there, there.T_world_object, there.deviation
        velocity, course, uncertainty = None, None, rules.unsteady * steady
        parent = track.nearest(T, body) if track.frame is not None and elapsed > 0 else None
        if parent is not None:  # of poses that look the same, the one that it goes on from
            T = nearest_alike(T, body, parent.T_world_object)
            one = replace(one, T_world_object=T)
        if parent is not None and alike is not None:
            ahead = zip(track.branches, frame.predictions, strict=True)
            expected = next(after for before, after in ahead if before is parent)
            moved, is_other = _moved(parent, expected, T, frame, alike)
            parent = replace(parent, velocity=None, course=None) if is_other else parent
            if one.spread is not None and not branches:
                walk = walk or RandomWalk.unknown(body, elapsed, rules)
                walk = walk.joined(moved, body.radius, elapsed)
            elif one.spread is None and track.misses <= rules.coasting and is_timed:
                velocity = moved / elapsed
                last = parent.velocity
                change = moved / 2 if last is None else moved - last * elapsed
                # of one frame, where it was seen over several
                change = np.abs(change / (1 + track.misses)).reshape(2, 3)
                uncertainty = np.maximum(change.max(axis=1).repeat(3), steady)
            if deviation is not None and parent.course and elapsed <= rules.longest_s:
                course = parent.course.followed(moved, deviation, elapsed)
        if deviation is not None:
            course = course or Course.begun(deviation, body.radius, rules)
        branches.append(replace(one, velocity=velocity, uncertainty=uncertainty, course=course))
    return replace(
        track,
        branches=tuple(branches),
        frame=frame.frame,
        time_s=frame.time_s,
        misses=0,
        walk=walk,
        search=Track.search,
        **known,
    )
