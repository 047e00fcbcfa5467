"""How likely a rival pose of a body is against the best one, by the differences between the two.

Errors of a session and of its detections are alike in consecutive frames, so that the evidence
between two poses does not add up: only the frame that tells most counts, not the product of all.
Single ranges are the exception: their errors are drawn anew.

A pose may leave as many detections as another meets in their place, one step of a grid aside, or
turned.  That these lie by chance as the body's features would is far less likely than that the body
has more features than the session says.  Then they tell neither of the two, however closely they
are met: of the poses A and B, and of those detections that only one of them meets, which gain it
G_A and G_B, the odds are those of e^A (1 + π e^G_B) against e^B (1 + π e^G_A), with the share π of
sessions that are mistaken so.
"""

from __future__ import annotations

import math

import numpy as np

from mixpose.judgement import LEAST_BELIEF, ScoredPose, ahead, odds_of
from mixpose.matching import Matches
from mixpose.records import Floats, replace
from mixpose.tracking.frame import Frame
from mixpose.tracking.track import Branch


def log_odds_against(data: Frame, rival: ScoredPose, best: ScoredPose) -> float:
    """Return log odds of a rival against the best pose of a frame, by the frames before too."""
    odds = ahead(rival, best)
    if best.spread is not None:  # single ranges
        return odds
    before = _log_odds_before(data, rival, best)
    now = odds - before + max(_gain_by_more_features(data, rival, best), 0.0)
    if now * before > 0:  # otherwise the two contradict each other
        return math.copysign(max(abs(now), abs(before)), now)
    return now + before


def _log_odds_before(data: Frame, rival: ScoredPose, best: ScoredPose) -> float:
    """Return log odds of a rival by the frames before, where both poses have a prediction."""
    if len(data.predictions) < 2:
        return 0.0
    a, b = (_expected(data, pose.T_world_object) for pose in (rival, best))
    return math.log(max(a.weight, LEAST_BELIEF) / max(b.weight, LEAST_BELIEF)) if a and b else 0.0


def _expected(data: Frame, T_world_object: Floats) -> Branch | None:
    """Return the prediction with features nearest to those at a pose; None where none is near."""
    distances = [float(off.mean()) for off in data.feature_distances(T_world_object)]
    nearest = int(np.argmin(distances))
    return data.predictions[nearest] if distances[nearest] <= data.body.radius else None


def _gain_by_more_features(data: Frame, rival: ScoredPose, best: ScoredPose) -> float:
    """Return the gain in log odds of a rival if the body may have more features than known."""
    if (by_rival := _gained_alone(data, rival, best)) <= 0:
        return 0.0
    if (by_best := _gained_alone(data, best, rival)) <= 0:
        return 0.0
    mistaken = math.log(data.rules.acceptance.mistaken)
    of_rival, of_best = np.logaddexp(0.0, [mistaken + by_rival, mistaken + by_best]).tolist()
    return float(of_best - of_rival)


def _gained_alone(data: Frame, pose: ScoredPose, other: ScoredPose) -> float:
    """Return the gain of a pose by detections that the other misses, if most are met by both."""
    used = pose.used
    by_other = dict(zip(other.used.names, other.used.detections, strict=True))
    alone = np.array(
        [
            (detections >= 0) & ~np.isin(detections, by_other.get(name, ()))
            for name, detections in zip(used.names, used.detections, strict=True)
        ]
    )
    if not 0 < 2 * np.count_nonzero(alone) <= np.count_nonzero(used.detections >= 0):
        return 0.0
    common = replace(
        used,
        shares=np.where(alone, 0.0, used.shares),
        weights=np.where(alone, 0.0, used.weights),
    )
    return _odds(data, pose, used) - _odds(data, pose, common)


def _odds(data: Frame, pose: ScoredPose, matches: Matches) -> float:
    """Return log odds of met and missed features at a pose, against clutter."""
    size, detection = np.array(2 * data.body.radius), data.rules.judgement.detection
    gained, missed, _ = odds_of(matches, pose.variances, size, detection, None, data.body.surfaces)
    return float(gained + missed)
