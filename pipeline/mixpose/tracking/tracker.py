"""Track one body: propose, fit and judge poses, decide and follow, frame by frame."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.special import expit

from mixpose.body import Body
from mixpose.fit import EstimatorOptions, Fit, free_mask
from mixpose.judgement import APART, ClutterRates, ScoredPose, Verdict, insert
from mixpose.objective import View
from mixpose.records import Estimate, Floats, Hypothesis, SensorReport, label_of, replace
from mixpose.rigid import from_parts
from mixpose.search import is_pointlike
from mixpose.threads import one_blas_thread
from mixpose.tracking.arguments import require_valid, start_pose
from mixpose.tracking.doubt import decide_frame, log_odds_other
from mixpose.tracking.following import follow
from mixpose.tracking.frame import Frame, Setup, Start
from mixpose.tracking.in_motion import delays_after
from mixpose.tracking.likelihood import Likelihood, likelihood_of
from mixpose.tracking.motion import per_kind
from mixpose.tracking.proposers import (
    PROPOSERS,
    Proposer,
    congruent,
    is_convincing,
    predicted,
    searched,
)
from mixpose.tracking.refinements import REFINEMENTS, Refinement
from mixpose.tracking.reporting import offsets_of, reported_covariances, residuals_of
from mixpose.tracking.rules import Rules
from mixpose.tracking.sizes import are_cut_otherwise, sizes_after, weighed_by_size
from mixpose.tracking.track import Branch, Track, predict
from mixpose.tracking.twin import SECOND_POSE, is_ok_but_for_mirrors, leftover_of, with_second


@dataclass(frozen=True, eq=False)
class Tracker(Setup):
    """The tracker of one body: how poses are sought and judged in each frame."""

    T_start: Floats | None = None  # (4, 4)
    proposers: tuple[Proposer, ...] = PROPOSERS  # in the order tried; the first gives predictions
    refinements: tuple[Refinement, ...] = REFINEMENTS
    instance: int | None = None  # number among identical bodies of the same `Body`; None: only one
    T_held: Floats | None = None  # (4, 4), another start, where directions are held
    # (3,), origin of the frame of reported poses, in the frame of `body`
    origin: Floats = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def create(
        cls,
        body: Body,
        options: EstimatorOptions,
        T_start: Floats | None = None,
        *,
        rotation_deg: float | None = None,
        distance: float | None = None,
        rules: Rules = Rules(),
        instance: int | None = None,
        T_held: Floats | None = None,
    ) -> Tracker:
        """Create a tracker that starts about T_start (4, 4), within half-widths or the rules'.

        Raises ValueError if T_start is no rotation and translation.
        """
        start = per_kind(body.radius, rules.motion.start)
        if distance is not None:
            start[:3] = distance
        if rotation_deg is not None:
            start[3:] = np.radians(rotation_deg)
        if options.confidence is not None:
            accepted = replace(rules.acceptance, confidence=options.confidence)
            rules = replace(rules, acceptance=accepted)
        return cls(
            body,
            options,
            body.sample(options.samples, seed=options.seed),
            start,
            rules,
            start_pose(T_start),
            instance=instance,
            T_held=T_held,
        )

    @classmethod
    def about_centre(
        cls,
        body: Body,
        options: EstimatorOptions,
        T_start: Floats | None = None,
        *,
        T_held: Floats | None = None,
        **known: Any,
    ) -> Tracker:
        """Create a tracker as `create`, which states motion at the middle of the features.

        Motion and its uncertainty are then the same wherever the session puts the origin.  Where
        directions are held and free turns would move the origin, the origin itself is tracked.
        """
        free = free_mask(options).reshape(2, 3)
        if any((free[1] & (np.arange(3) != held)).any() for held in np.flatnonzero(~free[0])):
            return cls.create(body, options, T_start, T_held=T_held, **known)
        centre = body.means.mean(axis=0)
        T_centre = from_parts(np.eye(3), centre)
        starts = start_pose(T_start), T_held
        T_start, T_held = (None if T is None else T @ T_centre for T in starts)
        tracker = cls.create(body.centred, options, T_start, T_held=T_held, **known)
        return replace(tracker, origin=-centre)

    @property
    def label(self) -> str:
        """Return the name of the body as one word."""
        return label_of(self.body.name, self.instance)

    def begin(self) -> Track:
        """Return the track before the first frame."""
        if self.T_start is None:
            return Track()
        return Track((Branch(self.T_start, 1.0, self.start_uncertainty),), is_identified=True)

    def advance(
        self, track: Track, frame: int, time_s: float | None, views: Sequence[View]
    ) -> tuple[Track, Estimate]:
        """Estimate one frame: return the track for the next, and the estimate without its latency.

        `views` are all sensors with a frame; those that saw nothing are reported and left out.
        """
        data = self.data(track, frame, time_s, views)
        ranked = self.explain(data)
        verdict = decide_frame(data, ranked)
        if verdict.best is not None and is_ok_but_for_mirrors(verdict):
            verdict = with_second(verdict, data, leftover_of(verdict.best, data))
        after = track_after(data, verdict)
        (covariance,) = reported_covariances([(data, verdict.best, self.origin)])
        return after, self.estimate(data, after, verdict, ranked, covariance)

    def predictions(self, track: Track, frame: int, time_s: float | None) -> list[Branch]:
        """Return where the track expects the body in a frame."""
        cache, key = track.cached_predictions, (frame, time_s)
        if key not in cache:
            cache[key] = predict(track, self.body, frame, time_s, self.rules.motion)
        return cache[key]

    def data(self, track: Track, frame: int, time_s: float | None, views: Sequence[View]) -> Frame:
        """Return the frame with what is known before it, without sensors that saw nothing."""
        seen = [view for view in views if not view.observation.is_empty]
        predictions = self.predictions(track, frame, time_s)
        reference = self.T_held if self.T_start is None else self.T_start
        seen = unweighed = track.delays.applied(seen, time_s)
        if predictions:
            T = predictions[0].T_world_object
            seen = weighed_by_size(seen, self.body, T, track.sizes, self.rules.sizes)
        data = Frame(
            self.body,
            self.options,
            self.samples,
            self.start_uncertainty,
            self.rules,
            views=seen,
            track=track,
            predictions=predictions,
            T_reference=predictions[0].T_world_object if predictions else reference,
            frame=frame,
            time_s=time_s,
            sensors=[view.name for view in views],
            unweighed=unweighed,
        )
        return _moving_at(data, predictions[0].T_world_object) if predictions else data

    def explain(self, data: Frame, *, quickly: bool = False) -> list[ScoredPose]:
        """Propose, fit and judge poses: return distinct ones, the most evident first.

        `quickly` stops where the body is not where it is expected.
        """
        likelihood, ranked, fits = likelihood_of(data), list[ScoredPose](), list[Fit]()

        def consider(start: Start, fit: Fit, proposer: str) -> ScoredPose | None:
            if start.T_moved is None and any(fit is known for known in fits):
                return None  # judged already by the same prior
            fits.append(fit)
            judged = _judge(likelihood, fit, start, proposer)
            insert(ranked, judged, data.body, data.free, data.rules.acceptance)
            return judged

        for propose in self.proposers if data.views else ():
            for start, fit in likelihood.fits(propose(data, ranked)):
                judged = consider(start, fit, propose.__name__)
                if judged and likelihood.knows_detections:
                    for refine in self.refinements:
                        for better in refine(data, likelihood, judged):
                            consider(better, likelihood.fit(better), refine.__name__)
            if quickly and not is_convincing(data, ranked):
                break
            quickly = False
        weighed = weighed_at(data, ranked[0]) if ranked else data
        if weighed is data:
            return ranked
        again = judge_again(weighed, ranked, fitted=True)
        # poses of refinements are not sought again: they stay unless the new ones are better
        is_better = again[0].log_evidence > ranked[0].log_evidence
        return again if is_better or not data.track.sizes.count else ranked

    def estimate(
        self,
        data: Frame,
        after: Track,
        verdict: Verdict,
        ranked: Sequence[ScoredPose],
        covariance: Floats | None,
    ) -> Estimate:
        """Return the estimate of a frame; reports are those of the first pose, believed or not."""
        body, best, T_origin = self.body, verdict.best, self._T_body_origin
        shown = best or next(iter(ranked), None)
        used = shown.used if shown and is_pointlike(body) else None
        reports = dict.fromkeys(data.sensors, SensorReport(False))
        reports |= shown.reports(residuals_of(used, body) if used else {}) if shown else {}
        rivals = verdict.kept if verdict.status == "ambiguous" else ()
        origin = best.proposer if best else ""
        if data.has_triangulated_start and origin == predicted.__name__:
            origin = searched.__name__
        return Estimate(
            frame=data.frame,
            time_s=data.time_s,
            object=body.name,
            status=verdict.status,
            T_world_object=best.T_world_object @ T_origin if best else None,
            covariance=covariance,
            score=shown.score if shown else 0.0,
            confidence=verdict.confidence,
            sensors=reports,
            hypotheses=tuple(
                [Hypothesis(pose.T_world_object @ T_origin, weight) for pose, weight in rivals]
            ),
            instance=self.instance,
            proposer=origin,
            blurs=best.blurs if best else (),
            guesses=data.searches[-1][0] if data.searches else None,
            delays=after.delays.seconds,
            doubt=verdict.doubt,
            measured=partial(offsets_of, used, shown.variances) if shown and used else dict,
        )

    @cached_property
    def _T_body_origin(self) -> Floats:
        """Return the frame (4, 4) of reported poses, in the frame of `body`."""
        return from_parts(np.eye(3), self.origin)


def estimate_pose(
    views: Iterable[View],
    model: Body,
    start: Floats | None = None,
    options: EstimatorOptions | None = None,
) -> Estimate:
    """Estimate one pose, as of frame 0, near a start (4, 4) or anywhere.

    Raises ValueError if there is no view, and for invalid arrays: a start or sensor that is no
    rigid motion, NaN, other shapes, features of a view that have not the dimension of its sensor.
    """
    require_valid(views := tuple(views), model)
    tracker = Tracker.about_centre(model, options or EstimatorOptions(), start)
    began = time.perf_counter()
    with one_blas_thread():
        _, estimate = tracker.advance(tracker.begin(), 0, None, views)
    return replace(estimate, latency_ms=1e3 * (time.perf_counter() - began))


def weighed_at(data: Frame, pose: ScoredPose) -> Frame:
    """Return the frame with spots weighed by size at a pose; itself if no other spot is cut then.

    By the scale of the predicted pose other spots may look cut.  Before the first ok frame the pose
    itself shows how large markers are.
    """
    sizes, rules, T = data.track.sizes, data.rules.sizes, pose.T_world_object
    if not data.unweighed or (sizes.count and not np.count_nonzero(pose.matches.extra)):
        return data
    sizes = sizes if sizes.count else sizes_after(sizes, pose, data.body, rules)
    views = weighed_by_size(data.unweighed, data.body, T, sizes, rules)
    if not are_cut_otherwise(data.views, views):
        return data
    unweighed = data.unweighed
    return _moving_at(data.changed(views=views, static_views=(), unweighed=unweighed), T)


def _moving_at(data: Frame, T_world_object: Floats) -> Frame:
    """Return the frame at the common time, for a body that moves as expected at a pose."""
    if not (data.predictions and data.is_timed):
        return data
    return data.in_motion(data.expected_velocity(T_world_object).at(T_world_object))


def _judge(
    likelihood: Likelihood,
    fit: Fit,
    start: Start,
    proposer: str,
    blurs: tuple[Mapping[str, float], ...] = (),  # of the previous fit, if there is none now
) -> ScoredPose:
    """Judge a pose fitted from a start, and note its proposer, blurs and prior."""
    return replace(
        likelihood.judge(fit, start),
        proposer=proposer,
        blurs=fit.blurs or blurs,
        T_moved=start.T_moved,
    )


def judge_again(
    data: Frame, poses: Sequence[ScoredPose], *, fitted: bool = False
) -> list[ScoredPose]:
    """Judge poses again by a frame with other detections, the most evident first.

    With `fitted` they are fitted too, but for those far behind the first.
    """
    likelihood, ranked = likelihood_of(data), list[ScoredPose]()
    behind = data.rules.look_alikes.behind
    for pose in poses if data.views else ():
        is_near = pose.log_evidence > poses[0].log_evidence - behind
        wide = data.close_uncertainty if fitted and is_near else None
        start = Start(pose.T_world_object, wide, left_out=pose.left_out, T_moved=pose.T_moved)
        judged = _judge(likelihood, likelihood.fit(start), start, pose.proposer, pose.blurs)
        insert(ranked, judged, data.body, data.free, data.rules.acceptance)
    return ranked


def track_after(data: Frame, verdict: Verdict) -> Track:
    """Return the track after a frame."""
    track, best, is_ok = data.track, verdict.best, verdict.status == "ok"
    # a pose that is likelier clutter is reported, and not followed
    if best is None or best.log_evidence < 0:
        clutter = track.clutter.learnt(data.views, data.rules.proposals.static)
        state = data.searches[-1][1] if data.searches else Track.search
        return replace(track.missed(state, clutter), doubted=True)
    branches = _branches(data, verdict, best)
    used = best.used
    met, in_view = ((values > 0).sum(axis=1) for values in (used.shares, used.weights))
    agreeing = np.count_nonzero(met >= data.rules.acceptance.agreeing * np.maximum(in_view, 1)) > 1
    # sensors contradict each other until their delays are known
    late = verdict.doubt == APART and any(view.unsure is not None for view in data.views)
    # after a doubtful frame the clutter rates begin anew
    sizes, rates = track.sizes, ClutterRates()
    if is_ok:
        rates = track.rates.followed(used, data.rules.judgement.noise.memory)
        sizes = sizes_after(sizes, best, data.body, data.rules.sizes)
    return follow(
        data,
        branches,
        residuals=best.noise if is_ok else track.residuals,
        rates=rates,
        sizes=sizes,
        met_before=dict(zip(used.names, met.tolist(), strict=True)),
        delays=delays_after(data, best) if is_ok or late else track.delays,
        sensors_agreed=track.sensors_agreed or agreeing,
        is_identified=is_ok or (track.is_identified and _is_the_same(data, best)),
        ok_count=track.ok_count + is_ok,
        elsewhere=_elsewhere_after(data, best),
        failing={**track.failing, **best.failing},
        gained=best.gained if is_ok else track.gained,
        shape=None if is_ok else verdict.shape,
        doubted=not is_ok,
        tried={**track.tried, **verdict.tried},
        log_odds_twice=track.log_odds_twice if verdict.second is None else verdict.second.log_odds,
        mistaken=track.mistaken if verdict.mistaken is None else verdict.mistaken,
    )


def _is_the_same(data: Frame, best: ScoredPose) -> bool:
    """Test whether a pose is that of the thing that was followed: not after that was lost."""
    return not data.was_lost and log_odds_other(data, best) < data.rules.acceptance.log_doubt


def _elsewhere_after(data: Frame, best: ScoredPose) -> float:
    """Return log odds of a better pose elsewhere (single ranges) after a frame and its searches."""
    if best.elsewhere is None or not data.options.fuse:
        return -math.inf
    is_searched = any(report.refined for report, _ in data.searches)
    overlooked = math.log(data.rules.ranges.overlooked) if is_searched else 0.0
    return min(best.elsewhere + overlooked, 0.0)


def _branches(
    data: Frame, verdict: Verdict, best: ScoredPose
) -> list[tuple[Branch, list[Floats] | None]]:
    """Return the poses to be followed, the best first, and motions to their look-alikes."""
    branches, fuse = list[tuple[Branch, list[Floats] | None]](), data.options.fuse
    unlikely = sorted(verdict.faint if fuse else (), key=lambda pair: -pair[1])
    for pose, weight in (*verdict.kept, *unlikely[: data.rules.ranges.modes]):
        # a pose that may be clutter counts as little in the next frame
        belief = weight * float(expit(pose.log_evidence))
        # a persistent error is that of the next frame too
        momentary = pose.covariance - pose.persistent
        spread = pose.spread if fuse else None
        T, second = pose.T_world_object, verdict.second
        other = data.log_odds_other_at(T)
        if second and pose is second.pose:
            other = -second.odds_over_best
        elif second and second.is_explained and pose is best:
            other = second.odds_over_best
        branch = Branch(
            T,
            belief,
            spread=spread,
            left_open=verdict.open_share * momentary,
            deviation=np.sqrt(np.maximum(momentary.diagonal(), 0.0)),
            log_odds_other=other,
        )
        is_new = pose.proposer == SECOND_POSE
        alike = None if is_new else [part.T_body_other for part in congruent(data, pose)]
        branches.append((branch, alike))
    return branches
