"""From frame to frame: propose, fit, judge, decide, follow.

A tracker is a value: `advance` takes a track and a frame and returns the next track with the
estimate.  While lost it keeps what it trusted last, looks around it ever more widely and
everywhere else, and invents nothing.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from mixpose.body import Body
from mixpose.fit import EstimatorOptions, Fit, free_mask
from mixpose.judgement import APART, ScoredPose, Verdict, contradict, decide, insert, is_sure
from mixpose.objective import View
from mixpose.records import Estimate, Hypothesis, Offsets, SensorReport
from mixpose.rigid import Floats, is_rigid
from mixpose.threads import one_blas_thread
from mixpose.tracking.in_motion import is_timed
from mixpose.tracking.likelihood import FrameData, Start, likelihood_of
from mixpose.tracking.motion import per_kind
from mixpose.tracking.proposers import PROPOSERS, REFINEMENTS, Proposer, Refinement
from mixpose.tracking.proposers.look_alikes import reason
from mixpose.tracking.recognition import (
    ALONE,
    MIRRORED,
    TRIANGLE,
    is_alone,
    is_known,
    is_reflection,
)
from mixpose.tracking.rules import Rules
from mixpose.tracking.track import Branch, Found, Prediction, SensorTally, Track, follow, predict


@dataclass(frozen=True)
class Tracker:
    """Everything that stays the same from frame to frame.

    Attributes
    ----------
    body : Body
    options : EstimatorOptions
    samples : (N, R, 3) float64
        Of the body, for the objectives that integrate by sampling.
    start_uncertainty : (6,) float64
    T_start : (4, 4) float64 or None
    rules : Rules
    proposers : tuple of Proposer
        In the order in which they are tried.
    refinements : tuple of Refinement
    """

    body: Body
    options: EstimatorOptions
    samples: Floats
    start_uncertainty: Floats
    T_start: Floats | None = None
    rules: Rules = Rules()
    proposers: tuple[Proposer, ...] = PROPOSERS
    refinements: tuple[Refinement, ...] = REFINEMENTS

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
        rules : Rules
        """
        motion = rules.motion
        start = per_kind(body, motion.start_distance, motion.start_rotation_deg)
        if distance is not None:
            start[:3] = distance
        if rotation_deg is not None:
            start[3:] = np.radians(rotation_deg)
        samples = body.sample(options.samples, seed=options.seed)
        return cls(body, options, samples, start, T_start, rules)

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which of the six directions are estimated."""
        return free_mask(self.options)

    def begin(self) -> Track:
        """The track before the first frame."""
        if self.T_start is None:
            return Track()
        return Track((Branch(self.T_start, 1.0, None, self.start_uncertainty),), known=True)

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
        data = self.data(track, frame, time_s, views)
        ranked = self.ranked(data)
        verdict = self.verdict(data, ranked)
        if verdict.status == "ok" and (best := verdict.best):
            alone = ALONE if is_alone(data, best, len(views)) else ""
            verdict = verdict.doubted(alone if is_known(data, best) else TRIANGLE)
        followed = self.followed(data, verdict)
        estimate = self.estimate(data, views, verdict, ranked)
        if data.log.report:
            estimate = replace(estimate, guesses=data.log.report)
        return followed, replace(estimate, delays=followed.delays.seconds())

    def verdict(self, data: FrameData, ranked: Sequence[ScoredPose]) -> Verdict:
        """The decision about a frame from all its poses, the most evident first."""
        rules = self.rules.acceptance
        verdict = decide(ranked, self.free, rules)
        best = verdict.best
        if best is None:
            return verdict
        if verdict.status != "ok":
            rivals = [one for one, _ in verdict.kept if one is not best]
            if why := reason(data, best, rivals):
                return replace(verdict, doubt=why)
        # a sure pose that has rivals may have them for a reason that can be told
        if not is_sure(best, self.free, rules):
            return verdict
        if is_reflection(data, best):
            return verdict.doubted(MIRRORED)
        before, noise = data.track.residuals.total, self.rules.judgement.noise
        apart = contradict(best, before, data.track.agreed, rules, noise)
        return verdict.doubted(APART if apart else "")

    def ranked(self, data: FrameData, *, quickly: bool = False) -> list[ScoredPose]:
        """Distinct poses that may explain a frame, most evident first: propose, fit, judge.

        `quickly`: where the body is expected only.
        """
        ranked: list[ScoredPose] = []
        if not data.views:
            return ranked
        likelihood = likelihood_of(data)
        fits: list[Fit] = []

        def consider(start: Start, name: str) -> ScoredPose | None:
            fit = likelihood.fit(start)
            if start.T_moved is None and any(fit is one for one in fits):
                return None  # judged before, and by the same prior
            fits.append(fit)
            judged = replace(likelihood.judge(fit, start), proposer=name, blurs=fit.blurs)
            insert(ranked, judged, self.body, self.free, self.rules.acceptance)
            return judged

        for propose in self.proposers[:1] if quickly else self.proposers:
            for start in propose(data, ranked):
                judged = consider(start, propose.__name__)
                if judged is None:
                    continue
                for refine in self.refinements:
                    for better in refine(data, likelihood, judged):
                        consider(better, refine.__name__)
        return ranked

    def again(
        self, data: FrameData, ranked: Sequence[ScoredPose], *, fitted: bool
    ) -> list[ScoredPose]:
        """The same poses judged by other views, and fitted to them, most evident first."""
        if not data.views:
            return []
        likelihood, close = likelihood_of(data), data.close if fitted else None
        found: list[ScoredPose] = []
        for one in ranked:
            left_out = {n: report.why for n, report in one.sensors.items() if report.why}
            start = Start(one.T_world_object, close, left_out=left_out)
            fit = likelihood.fit(start)
            blurs = fit.blurs or one.blurs
            judged = replace(likelihood.judge(fit, start), proposer=one.proposer, blurs=blurs)
            insert(found, judged, self.body, self.free, self.rules.acceptance)
        return found

    def estimate(
        self, data: FrameData, views: Sequence[View], verdict: Verdict, ranked: Sequence[ScoredPose]
    ) -> Estimate:
        """The estimate of a frame, with reports of the best pose, believed or not."""
        best = verdict.best
        told = best or next(iter(ranked), None)
        hypotheses = [Hypothesis(one.T_world_object, weight) for one, weight in verdict.kept]
        reports = {view.name: SensorReport(False) for view in views}
        reports |= told.sensors if told else {}
        offsets = _offsets(told, self.body) if told else {}
        for name, one in offsets.items():
            lengths = np.linalg.norm(one.offsets, axis=1).tolist()
            labels = [self.body.labels[i] for i in one.features]
            each = zip(labels, lengths, one.met, strict=True)
            residuals = {label: length if met else None for label, length, met in each}
            reports[name] = replace(reports[name], residuals=residuals)
        return Estimate(
            frame=data.frame,
            time_s=data.time_s,
            object=self.body.name,
            status=verdict.status,
            T_world_object=best.T_world_object if best else None,
            covariance=best.covariance if best else None,
            score=told.score if told else 0.0,
            sensors=reports,
            hypotheses=tuple(hypotheses) if verdict.status == "ambiguous" else (),
            proposer=best.proposer if best else "",
            blurs=best.blurs if best else (),
            doubt=verdict.doubt,
            offsets=offsets,
        )

    def followed(self, data: FrameData, verdict: Verdict) -> Track:
        """The track after a frame."""
        track, best, is_ok = data.track, verdict.best, verdict.status == "ok"
        if best is None:
            clutter = track.clutter.learnt(data.views, self.rules.static)
            return track.missed(data.log.state, clutter)
        found = []
        for one, weight in verdict.kept:
            # what may be mere clutter counts as little in the next frame
            belief = weight * float(expit(one.log_evidence))
            spread = one.spread if self.options.fuse else None
            momentary = np.diagonal(one.covariance - one.persistent)
            deviation = np.sqrt(momentary) if is_timed(data.views) else None
            found.append(Found(one.T_world_object, belief, spread, deviation))
        used = best.used
        met, in_view = (np.count_nonzero(one, axis=1) for one in (used.shares, used.weights))
        tallies = dict(zip(used.names, map(SensorTally, met.tolist(), in_view.tolist())))
        # sensors whose delays are not known contradict each other until they are
        late = verdict.doubt == APART and any(view.unsure is not None for view in data.views)
        return replace(
            follow(data, found),
            residuals=best.noise if is_ok else track.residuals,
            tallies=tallies,
            delays=track.delays.joined(data, best) if is_ok or late else track.delays,
            agreed=track.agreed or sum(one.is_met for one in tallies.values()) > 1,
            known=is_known(data, best),
            believed=track.believed + is_ok,
        )

    def predictions(self, track: Track, frame: int, time_s: float | None) -> list[Prediction]:
        """Where the track expects the body; arguments as of `advance`."""
        return predict(track, self.body, frame, time_s, self.rules.motion)

    def data(
        self, track: Track, frame: int, time_s: float | None, views: Sequence[View]
    ) -> FrameData:
        """A frame, and what is known before it; arguments as of `advance`."""
        views = [view for view in views if not view.observation.is_empty]
        predictions = self.predictions(track, frame, time_s)
        views = track.delays.applied(views, time_s, track.seconds_until(time_s))
        data = FrameData(
            views=views,
            body=self.body,
            options=self.options,
            samples=self.samples,
            track=track,
            predictions=predictions,
            T_reference=predictions[0].T_world_object if predictions else self.T_start,
            start_uncertainty=self.start_uncertainty,
            rules=self.rules,
            frame=frame,
            time_s=time_s,
        )
        if predictions and is_timed(views):
            T = predictions[0].T_world_object
            return data.in_motion(data.expected(T).at(T))
        return data


def _offsets(judged: ScoredPose, body: Body) -> dict[str, Offsets]:
    """By how much each sensor met the features of a body whose features are points."""
    if len(body.nodes.points) != len(body):
        return {}
    used, offsets = judged.used, {}
    for k, (name, m, sigma) in enumerate(zip(used.names, used.dimensions, used.sigmas.tolist())):
        features = np.flatnonzero(used.weights[k])
        offsets[name] = Offsets(
            features,
            used.shares[k, features] > 0,
            sigma * used.offsets[k, features, :m],
            sigma * used.J[k, features, :m, :3],
        )
    return offsets


def estimate_pose(
    views: Sequence[View],
    model: Body,
    start: Floats | None = None,
    options: EstimatorOptions | None = None,
) -> Estimate:
    """Estimate one pose.

    Parameters
    ----------
    views : sequence of View
        Sensors with what they observed.
    model : Body
    start : (4, 4) array or None
        T_world_object near the pose; without it the pose is searched for everywhere.
    options : EstimatorOptions or None

    Returns
    -------
    Estimate
        Of frame 0.

    Raises
    ------
    ValueError
        If the start is no rigid motion, or a view's features are not of its sensor's dimension.
    """
    if start is not None and not (np.shape(start) == (4, 4) and is_rigid(np.asarray(start))):
        raise ValueError("start: not a rotation and a translation as one 4x4 matrix")
    for view in views:
        found, allowed = view.observation.dimension, view.sensor.dimension
        if found != allowed:
            raise ValueError(
                f"view {view.name!r}: features of {found} coordinates; its sensor has {allowed}"
            )
    tracker = Tracker.create(model, options or EstimatorOptions(), start)
    began = time.perf_counter()
    with one_blas_thread():
        _, estimate = tracker.advance(tracker.begin(), 0, None, views)
    return replace(estimate, latency_ms=1e3 * (time.perf_counter() - began))
