"""Whether the body is in a frame twice: a mirror image on a table, or one of which nobody told.

What a pose leaves of the detections is compared with the body as if nothing were known before: a
second pose as evident as the first one says that either may be the body, whichever was followed so
far.  Frames are searched in which a sensor sees more that belongs to nothing than in those searched
in vain before, and every few frames anyway.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from mixpose.body import thickness
from mixpose.judgement import ScoredPose, is_sure
from mixpose.objective import View
from mixpose.tracking.frame import Frame, Setup, Start
from mixpose.tracking.likelihood import likelihood_of
from mixpose.tracking.proposers import candidates_of
from mixpose.tracking.track import Track

TWICE = "the body seems to be there twice: a mirror image, or a second one (`count = 2`)"
IN_A_MIRROR = "a flat body looks the same in a mirror, and the session says that there are some"


def is_flat(data: Setup) -> bool:
    """Whether a turn brings the body onto its mirror image."""
    return data.body.is_exact and thickness(data.body) < data.rules.look_alikes.alike


def second_pose(data: Frame, best: ScoredPose) -> ScoredPose | None:
    """A pose of what the best one leaves, that is sure by itself and meets as much; or None."""
    if not is_due(data, best):
        return None
    live, track = replace(data.options, search="live"), Track(residuals=data.track.residuals)
    rest = data.seen_otherwise(
        views=_rest(data, best),
        still=(),
        predictions=(),
        beside=None,
        searches=[],
        track=track,
        options=live,
    )
    rules, least = data.rules, data.rules.acceptance.convincing * best.measurements
    likelihood = likelihood_of(rest)
    for start in _starts(data, rest):
        pose = likelihood.judge(likelihood.fit(start), start)
        if is_sure(pose, data.free, rules.acceptance) and pose.measurements >= least:
            return replace(pose, proposer="second_pose")
    return None


def _starts(data: Frame, rest: Frame) -> Iterator[Start]:
    """Where a second pose may be: where one was, then what a search finds."""
    for one in data.predictions:
        yield Start(one.T_world_object, one.uncertainty)
    for candidate in candidates_of(rest)[: data.rules.proposals.seconds]:
        yield Start(candidate.T_world_object, data.close)


def are_both(a: ScoredPose, b: ScoredPose) -> bool:
    """Whether two poses are sure, and meet detections of their own."""
    if min(a.log_evidence, b.log_evidence) <= 0 or a.matches.names != b.matches.names:
        return False
    pairs = zip(a.matches.detections, b.matches.detections, strict=True)
    shared = sum(np.isin(one[one >= 0], other).sum() for one, other in pairs)
    return bool(shared < 0.5 * (a.matches.detections >= 0).sum())


def is_due(data: Frame, best: ScoredPose) -> bool:
    """Whether what a pose leaves may be the body once more, and was not searched before."""
    if any(view.observation.points is None or view.sensor.dimension != 2 for view in data.views):
        return False
    used, rules = best.matches, data.rules
    rest, met = used.count - used.met, used.met
    # as much as would convince, by as many sensors
    if np.minimum(rest, met).sum() < rules.acceptance.convincing * met.sum():
        return False
    tried = data.track.tried
    is_more = any(count > tried.get(name, 0) for name, count in counts_left(best).items())
    return is_more or data.track.doubted or data.frame % rules.proposals.static == 0


def tried_after(data: Frame, best: ScoredPose) -> Mapping[str, float]:
    """How many detections each sensor had left where a second pose was sought in vain."""
    if not is_due(data, best):
        return data.track.tried
    return {**data.track.tried, **counts_left(best)}


def counts_left(best: ScoredPose) -> dict[str, float]:
    """How many detections of each sensor a pose does not meet."""
    used = best.matches
    return dict(zip(used.names, (used.count - used.met).tolist(), strict=True))


def _rest(data: Frame, best: ScoredPose) -> list[View]:
    """What a pose leaves of the views."""
    numbers = dict(zip(best.matches.names, best.matches.detections, strict=True))
    rest = []
    for view in data.views:
        points = view.observation.points
        assert points is not None
        is_left = np.ones(len(points), dtype=np.bool_)
        if view.name in numbers:
            is_left[numbers[view.name][numbers[view.name] >= 0]] = False
        rest.append(replace(view, observation=view.observation.only(is_left)))
    return [view for view in rest if not view.observation.is_empty]
