"""Whether it is the body that was seen, or what has markers alike: another thing, a mirror image.

A body is known once more than three markers are met, which other things have in the same places,
too, and stays so while it is followed.  What looks like the body by chance does so for several
frames, and what the track expects then tells nothing.

Where features are missed, and detections about the body belong to none, its mirror image is a
rival: reflected in the plane nearest to the features met, which it leaves where they are.  Where
few are met, it is looked for everywhere, in the first frames.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body, mirror_image, thickness
from mixpose.judgement import ScoredPose, is_far_off
from mixpose.tracking.frame import Frame
from mixpose.tracking.likelihood import Start, likelihood_of
from mixpose.tracking.proposers import candidates_of, starts_at
from mixpose.tracking.track import Track

TRIANGLE = "three markers are met, which other things may have alike"
ALONE = "one sensor of several meets the body, which none of its frames was sure of by itself"
MIRRORED = "it shows the body's mirror image"

_CORNERS = 3
_FLAT = 1e-6  # thickness by width, below which no camera tells one side's markers from the other's


def is_alone(data: Frame, judged: ScoredPose, sensors: int) -> bool:
    """Whether one of some sensors with a frame meets a body that none was sure of, as this."""
    lonely = sensors > 1 and np.count_nonzero(judged.matches.met) == 1
    return lonely and is_from_doubt(data, judged)


def is_from_doubt(data: Frame, judged: ScoredPose) -> bool:
    """Whether a pose is sure for doubtful ones before it alone: it errs as they do."""
    if data.track.believed:
        return False
    gained = data.prior(judged.T_world_object).log_density - data.anywhere.log_density
    return judged.log_evidence - max(gained, 0.0) <= data.rules.acceptance.sure


def is_known(data: Frame, judged: ScoredPose) -> bool:
    """Whether a pose is the body's, by what it meets or by where it was expected."""
    if (judged.matches.dimensions == 1).any():
        return True  # ranges are no markers in space
    others = np.sort(judged.matches.met_by)[:-_CORNERS]
    # one sensor of several may meet a marker by chance
    if not len(others) or others.sum() >= max(len(data.views) / 2, 1):
        return True
    if not data.track.known or data.track.misses:
        return False
    return bool((data.prior(judged.T_world_object).spread < data.anywhere.spread).all())


def is_reflection(data: Frame, judged: ScoredPose) -> bool:
    """Whether the frame shows the body's mirror image rather than the body."""
    body, rules, seen = data.body, data.rules, judged.matches
    if "mirrored" not in rules.look_alikes.kinds or not body.is_exact or _is_flat(body):
        return False
    ahead, met = rules.acceptance.standing_out, seen.met_by
    # of these the mirror image may meet more than the body
    if np.minimum(seen.missed, seen.unmatched_nearby).sum() > 0.5:
        # one camera alone may have met a feature by chance
        sharp = met >= min(2, met.max())
        near = _numbers(sharp if sharp.sum() >= 3 else met > 0)
        there = replace(data, body=mirror_image(body, near), begun=None)
        start = Start(judged.T_world_object, data.close)
        if _meets(there, data, start) and _evidence(there, start) > judged.log_evidence + ahead:
            return True
    if not _is_by_chance(data, judged):
        return False
    # wherever it is found, and nothing known of either
    track = Track(residuals=data.track.residuals)
    # what explains more than this pose is met by the first guesses already
    options = replace(data.options, search="live")
    nothing = replace(data, predictions=(), beside=None, begun=None)
    alone = replace(nothing, track=track, searches=[], options=options)
    own = _evidence(alone, Start(judged.T_world_object))
    mirror = replace(alone, body=mirror_image(body, _numbers(met >= 0)))
    least = own - rules.search.outdone
    starts = starts_at(mirror, [one for one in candidates_of(mirror) if one.evidence > least])
    return any(_evidence(mirror, start) > own + ahead for start in starts)


def _is_flat(body: Body) -> bool:
    """Whether a turn brings the body onto its mirror image."""
    return thickness(body) < _FLAT


def _meets(mirror: Frame, data: Frame, start: Start) -> bool:
    """Whether the mirror image meets a quarter of what the body meets, where a fit begins.

    The features met lie about the plane that it is reflected in, or it is no rival: then its value
    is a hundredth of the body's, and that grows as the square of the features met.
    """
    values = [one.finest.value(start.T_world_object[None])[0] for one in (mirror, data)]
    return bool(values[0] > values[1] / 16)


def _is_by_chance(data: Frame, judged: ScoredPose) -> bool:
    """Whether features may be met by chance: few, others missed or these far off, early on."""
    rules, seen = data.rules, judged.matches
    if judged.measurements - 6 > rules.look_alikes.by_chance:
        return False
    if data.track.believed >= rules.proposals.believed or (seen.dimensions != 2).any():
        return False
    before, noise = data.track.residuals.total, rules.judgement.noise
    off = is_far_off(seen, before, rules.acceptance, noise)
    return off or bool((seen.missed > 0.5).any())


def _evidence(data: Frame, start: Start) -> float:
    likelihood = likelihood_of(data)
    return likelihood.judge(likelihood.fit(start), start).log_evidence


def _numbers(mask: NDArray[np.bool_]) -> frozenset[int]:
    return frozenset(np.flatnonzero(mask).tolist())
