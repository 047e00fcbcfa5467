"""How likely one of two poses of a body is beside the other, by what tells them apart.

Errors of a session and of its detections are alike in frames that follow each other, so that what
tells two poses apart does not add up from frame to frame: of all frames the one counts that tells
most, and not their product.  Single ranges are the exception: their errors are drawn anew.

A pose may leave as many detections as another meets in their place, one step of a grid aside, or
turned.  That these lie by chance as the body's features would is far less likely than that the body
has more features than the session says.  Then they tell neither of the two, however closely they
are met: of the poses A and B, and of those detections that only one of them meets, which gain it
G_A and G_B, the odds are those of e^A (1 + π e^G_B) against e^B (1 + π e^G_A), with the share π of
sessions that are mistaken so.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mixpose.judgement import LEAST_BELIEF, ScoredPose, ahead, odds_of
from mixpose.matching import Matches
from mixpose.records import Floats
from mixpose.tracking.frame import Frame
from mixpose.tracking.track import Branch


def odds_beside(data: Frame, rival: ScoredPose, best: ScoredPose) -> float:
    """Log odds of a rival against the best pose of a frame, by the frames before as well."""
    odds = ahead(rival, best)
    if best.spread is not None:  # single ranges
        return odds
    before = _before(data, rival, best)
    now = odds - before + max(_of_more_than_told(data, rival, best), 0.0)
    if now * before > 0:  # else they contradict each other
        return math.copysign(max(abs(now), abs(before)), now)
    return now + before


def _before(data: Frame, rival: ScoredPose, best: ScoredPose) -> float:
    """Log odds of a rival by the frames before, where both poses go on from one of them."""
    if len(data.predictions) < 2:
        return 0.0
    a, b = (_expected(data, one.T_world_object) for one in (rival, best))
    return math.log(max(a.weight, LEAST_BELIEF) / max(b.weight, LEAST_BELIEF)) if a and b else 0.0


def _expected(data: Frame, T_world_object: Floats) -> Branch | None:
    """The prediction that puts features next to where a pose has them; None where none is near."""
    away = [float(off.mean()) for off in data.feature_distances(T_world_object)]
    nearest = int(np.argmin(away))
    return data.predictions[nearest] if away[nearest] <= data.body.radius else None


def _of_more_than_told(data: Frame, rival: ScoredPose, best: ScoredPose) -> float:
    """By how much likelier a rival is as the body may have more features than the session says."""
    if (by_rival := _gained_alone(data, rival, best)) <= 0:
        return 0.0
    if (by_best := _gained_alone(data, best, rival)) <= 0:
        return 0.0
    mistaken = math.log(data.rules.acceptance.mistaken)
    of_rival, of_best = np.logaddexp(0.0, [mistaken + by_rival, mistaken + by_best]).tolist()
    return float(of_best - of_rival)


def _gained_alone(data: Frame, one: ScoredPose, other: ScoredPose) -> float:
    """What a pose gains by detections that the other does not meet, where most are met by both."""
    used = one.used
    by_other = dict(zip(other.used.names, other.used.detections, strict=True))
    alone = np.array(
        [
            (own >= 0) & ~np.isin(own, by_other.get(name, ()))
            for name, own in zip(used.names, used.detections, strict=True)
        ]
    )
    if not 0 < 2 * np.count_nonzero(alone) <= np.count_nonzero(used.detections >= 0):
        return 0.0
    rest = replace(
        used,
        shares=np.where(alone, 0.0, used.shares),
        weights=np.where(alone, 0.0, used.weights),
    )
    return _odds(data, one, used) - _odds(data, one, rest)


def _odds(data: Frame, one: ScoredPose, seen: Matches) -> float:
    """Log odds of what a pose meets and misses, against clutter."""
    size, detection = np.array(2 * data.body.radius), data.rules.judgement.detection
    gained, missed, _ = odds_of(seen, one.variances, size, detection, None, data.body.surfaces)
    return float(gained + missed)
