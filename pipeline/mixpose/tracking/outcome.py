"""What becomes of a verdict: the frame's estimate, and the track after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import expit

from mixpose.judgement import APART, ScoredPose, Verdict
from mixpose.matching import Matches
from mixpose.objective import View
from mixpose.records import Estimate, Hypothesis, Offsets, SensorReport
from mixpose.tracking.doubt import is_known
from mixpose.tracking.in_motion import is_timed
from mixpose.tracking.likelihood import FrameData
from mixpose.tracking.track import Found, SensorTally, Track, follow


def estimate_of(
    data: FrameData,
    views: Sequence[View],
    verdict: Verdict,
    shown: ScoredPose | None,
    *,
    after: Track,
    instance: int | None,
) -> Estimate:
    """The estimate of a frame, with reports of the pose that is shown, believed or not."""
    body, best = data.body, verdict.best
    reports = {view.name: SensorReport(False) for view in views}
    reports |= shown.sensors if shown else {}
    are_points = shown is not None and len(body.nodes.points) == len(body)
    if shown is not None and are_points:
        used = shown.used
        lengths = (used.sigmas[:, None] * np.sqrt(used.squared)).tolist()
        for name, row, k, in_view in zip(used.names, lengths, used.shares > 0, used.weights > 0):
            residuals = {body.labels[i]: row[i] if k[i] else None for i in np.flatnonzero(in_view)}
            reports[name] = replace(reports[name], residuals=residuals)
    rivals = verdict.kept if verdict.status == "ambiguous" else ()
    return Estimate(
        frame=data.frame,
        time_s=data.time_s,
        object=body.name,
        status=verdict.status,
        T_world_object=best.T_world_object if best else None,
        covariance=best.covariance if best else None,
        score=shown.score if shown else 0.0,
        sensors=reports,
        hypotheses=tuple([Hypothesis(one.T_world_object, weight) for one, weight in rivals]),
        instance=instance,
        proposer=best.proposer if best else "",
        blurs=best.blurs if best else (),
        guesses=data.log.report,
        delays=after.delays.seconds(),
        doubt=verdict.doubt,
        measured=partial(_offsets, shown.used) if shown is not None and are_points else dict,
    )


def _offsets(used: Matches) -> dict[str, Offsets]:
    """By how much each sensor met the features of a body whose features are points."""
    offsets = {}
    for k, (name, m, sigma) in enumerate(zip(used.names, used.dimensions, used.sigmas.tolist())):
        features = np.flatnonzero(used.weights[k])
        offsets[name] = Offsets(
            features,
            used.shares[k, features] > 0,
            sigma * used.offsets[k, features, :m],
            sigma * used.J[k, features, :m, :3],
        )
    return offsets


def followed(data: FrameData, verdict: Verdict) -> Track:
    """The track after a frame."""
    track, best, is_ok = data.track, verdict.best, verdict.status == "ok"
    if best is None:
        clutter = track.clutter.learnt(data.views, data.rules.static)
        return replace(track.missed(data.log.state, clutter), doubted=True)
    found = []
    for one, weight in verdict.kept:
        # what may be mere clutter counts as little in the next frame
        belief = weight * float(expit(one.log_evidence))
        momentary = np.diagonal(one.covariance - one.persistent)
        deviation = np.sqrt(momentary) if is_timed(data.views) else None
        spread = one.spread if data.options.fuse else None
        found.append(Found(one.T_world_object, belief, spread, deviation))
    used = best.used
    met, in_view = (np.count_nonzero(one, axis=1) for one in (used.shares, used.weights))
    tallies = dict(zip(used.names, map(SensorTally, met.tolist(), in_view.tolist())))
    least = data.rules.acceptance.agreeing
    # sensors whose delays are not known contradict each other until they are
    late = verdict.doubt == APART and any(view.unsure is not None for view in data.views)
    return replace(
        follow(data, found),
        residuals=best.noise if is_ok else track.residuals,
        tallies=tallies,
        delays=track.delays.joined(data, best) if is_ok or late else track.delays,
        agreed=track.agreed or sum(one.is_met(least) for one in tallies.values()) > 1,
        known=is_known(data, best),
        believed=track.believed + is_ok,
        doubted=not is_ok,
    )
