"""What becomes of a verdict: the frame's estimate, and the track after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import expit

from mixpose.body import Body
from mixpose.judgement import APART, ScoredPose, Verdict
from mixpose.objective import View
from mixpose.records import Estimate, Hypothesis, Offsets, SensorReport
from mixpose.search import SearchState
from mixpose.tracking.frame import Frame, follow
from mixpose.tracking.in_motion import delays_after
from mixpose.tracking.recognition import is_known
from mixpose.tracking.track import Branch, SensorTally, Track
from mixpose.tracking.tracked_body import TrackedBody


def estimate_of(
    tracked: TrackedBody,
    data: Frame,
    views: Sequence[View],
    verdict: Verdict,
    ranked: Sequence[ScoredPose],
) -> Estimate:
    """The estimate of a frame, with reports of the best pose, believed or not."""
    body, best = tracked.body, verdict.best
    told = best or next(iter(ranked), None)
    hypotheses = [Hypothesis(one.T_world_object, weight) for one, weight in verdict.kept]
    reports = {view.name: SensorReport(False) for view in views}
    reports |= told.sensors if told else {}
    offsets = _offsets(told, body) if told else {}
    for name, one in offsets.items():
        lengths = np.linalg.norm(one.offsets, axis=1).tolist()
        labels = [body.labels[i] for i in one.features]
        by_label = zip(labels, lengths, one.met, strict=True)
        residuals = {label: length if met else None for label, length, met in by_label}
        reports[name] = replace(reports[name], residuals=residuals)
    return Estimate(
        frame=data.frame,
        time_s=data.time_s,
        object=body.name,
        status=verdict.status,
        T_world_object=best.T_world_object if best else None,
        covariance=best.covariance if best else None,
        score=told.score if told else 0.0,
        sensors=reports,
        hypotheses=tuple(hypotheses) if verdict.status == "ambiguous" else (),
        instance=tracked.instance,
        proposer=best.proposer if best else "",
        blurs=best.blurs if best else (),
        guesses=data.searches[-1][0] if data.searches else None,
        doubt=verdict.doubt,
        offsets=offsets,
    )


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


def followed(tracked: TrackedBody, data: Frame, verdict: Verdict) -> Track:
    """The track after a frame."""
    track, best, is_ok = data.track, verdict.best, verdict.status == "ok"
    if best is None:
        clutter = track.clutter.learnt(data.views, tracked.rules.static)
        state = data.searches[-1][1] if data.searches else SearchState()
        return replace(track.missed(state, clutter), doubted=True)
    found = []
    for one, weight in verdict.kept:
        # what may be mere clutter counts as little in the next frame
        belief = weight * float(expit(one.log_evidence))
        spread = one.spread if tracked.options.fuse else None
        momentary = np.diagonal(one.covariance - one.persistent)
        deviation = np.sqrt(momentary) if data.is_timed else None
        found.append(Branch(one.T_world_object, belief, spread=spread, deviation=deviation))
    used = best.used
    met, in_view = (np.count_nonzero(one, axis=1) for one in (used.shares, used.weights))
    tallies = dict(zip(used.names, map(SensorTally, met.tolist(), in_view.tolist())))
    least = tracked.rules.acceptance.agreeing
    # sensors whose delays are not known contradict each other until they are
    late = verdict.doubt == APART and any(view.unsure is not None for view in data.views)
    return replace(
        follow(data, found),
        residuals=best.noise if is_ok else track.residuals,
        tallies=tallies,
        delays=delays_after(data, best) if is_ok or late else track.delays,
        agreed=track.agreed or sum(one.is_met(least) for one in tallies.values()) > 1,
        known=is_known(data, best),
        believed=track.believed + is_ok,
        doubted=not is_ok,
    )
