"""Bodies of a recording, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mixpose.calibration.task import Progress, silent
from mixpose.learning.growing import Found, averaged, grown, placed, poses_apart
from mixpose.learning.placing import FEWEST, Shape
from mixpose.learning.points import Cloud
from mixpose.learning.rules import LearningRules
from mixpose.learning.seeds import seeds

_OF_COPY = 0.6  # of the points of a shape that another one of it must show
_DECOYS = (0.8, 0.87, 0.93, 1.08, 1.16, 1.25)  # sizes of shapes that are not there
_TRIED = 8  # seeds that may fail one after the other


def find_bodies(
    clouds: Sequence[Cloud],
    rules: LearningRules,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> list[Found]:
    """Find what moves rigidly in clouds without what stands still; most points seen first.

    Returns
    -------
    list of Found
        Which points they meet is told by `Cloud.rows`.
    """
    left, found = list(clouds), list[Found]()
    while len(found) < rules.most_bodies:
        progress("looking for bodies", len(found), rules.most_bodies)
        body = _next(left, rules, rng)
        if body is None:
            break
        found.append(_of_all(body, left))
        left = _without(left, body, rules)
    return sorted(found, key=lambda each: -each.met)


def _of_all(body: Found, clouds: Sequence[Cloud]) -> Found:
    """The body with points numbered as they were before any were left out."""
    places = tuple(
        (k, replace(one, met=np.where(one.met >= 0, clouds[k].rows[one.met], -1)))
        for k, one in body.places
    )
    return replace(body, places=places)


def _next(clouds: Sequence[Cloud], rules: LearningRules, rng: np.random.Generator) -> Found | None:
    """The most evident body of what is left."""
    for loose in rules.looser[:2]:
        looser = [cloud.loosened(loose) for cloud in clouds]
        for seed in seeds(looser, rules, rng)[:_TRIED]:
            body = _loose_enough(seed.shape, loose, clouds, rules)
            if body is not None:
                return body
    return None


def _loose_enough(
    shape: Shape, least: float, clouds: Sequence[Cloud], rules: LearningRules
) -> Found | None:
    """The body of a shape, as rigid as it can be without losing points in many frames."""
    best: Found | None = None
    for loose in rules.looser[rules.looser.index(least) :]:
        looser = [cloud.loosened(loose) for cloud in clouds]
        body = grown(shape, looser, rules)
        if body is None or _is_chance(body, looser, rules):
            break
        if best is not None and len(body.places) < rules.worth * len(best.places):
            break
        best = replace(_with_copies(body, looser, rules), loose=loose)
    return best


def _is_chance(body: Found, clouds: Sequence[Cloud], rules: LearningRules) -> bool:
    """Whether shapes of other sizes, which are not there, are found about as often."""
    if len(body.shape) > FEWEST + 1:
        return False
    middle = body.shape.points.mean(axis=0)
    counts = []
    for size in _DECOYS:
        shape = Shape(middle + size * (body.shape.points - middle), body.shape.reach)
        counts.append(len(placed(shape, clouds, rules)))
    expected = float(np.mean(counts))
    # the best of very many shapes recurs more often than one of them
    most = rules.by_chance * (expected + np.sqrt(expected))
    return bool(len(body.places) < 2 * rules.least_frames + most)


def _with_copies(body: Found, clouds: Sequence[Cloud], rules: LearningRules) -> Found:
    """All bodies of a shape, where others are seen beside the first in some frames."""
    least = max(FEWEST, int(np.ceil(_OF_COPY * len(body.shape))))
    again = placed(body.shape, _left(clouds, body), rules, least=least)
    if len(again) < _often(len(body.places), rules):
        return body
    places = placed(body.shape, clouds, rules, rules.most_bodies, least)
    per_frame = np.bincount([k for k, _ in places], minlength=len(clouds))
    often = _often(int((per_frame > 0).sum()), rules)
    count = max(n for n in range(1, rules.most_bodies) if n == 1 or (per_frame >= n).sum() >= often)
    shape = averaged(body.shape, places, clouds, rules)
    return Found(shape, tuple(places), poses_apart(shape, places, clouds, rules), count)


def _often(frames: int, rules: LearningRules) -> float:
    """Frames in which something is seen that is no accident."""
    return max(rules.least_frames, 2 * rules.least_share * frames)


def _left(clouds: Sequence[Cloud], body: Found) -> list[Cloud]:
    """Clouds without the points of a body, and without ghosts that its detections make."""
    left = list(clouds)
    for k, one in body.places:
        left[k] = left[k].without(clouds[k].detections[one.met[one.met >= 0]])
    return left


def _without(clouds: Sequence[Cloud], body: Found, rules: LearningRules) -> list[Cloud]:
    """The same, also where too few points of the body are seen for a frame to count."""
    left = _left(clouds, body)
    looser = [cloud.loosened(body.loose) for cloud in left]
    rest = placed(body.shape, looser, rules, body.count, FEWEST)
    return _left(left, replace(body, places=tuple(rest)))
