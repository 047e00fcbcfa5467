"""Bodies of a recording, one after the other: what moves rigidly, and all that goes along."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mixpose.calibration.task import Progress, silent
from mixpose.learning.placing import FEWEST, Placement, Shape, placements, wide_triples
from mixpose.learning.points import Cloud
from mixpose.learning.rules import LearningRules
from mixpose.learning.seeds import Seed, seeds
from mixpose.learning.still import gathered_places
from mixpose.records import Floats
from mixpose.rigid import inverse, rotation_angle_deg, transform

_OF_COPY = 0.6  # of the points of a shape that another one of it must show
_SURER = 0.15  # of a point's reach: errors that many frames have in common
_DECOYS = (0.8, 0.87, 0.93, 1.08, 1.16, 1.25)  # sizes of shapes that are not there
_TRIED = 8  # seeds that may fail one after the other


@dataclass(frozen=True, eq=False)
class Found:
    """A body, and where it is in which frames.

    Attributes
    ----------
    shape : Shape
        In a frame of its own.
    places : tuple of (int, Placement)
        With the index of the cloud; of congruent bodies several of one.
    count : int
        Congruent bodies that are seen at a time.
    """

    shape: Shape
    places: tuple[tuple[int, Placement], ...]
    count: int = 1

    @property
    def poses(self) -> Floats:
        """Poses (K, 4, 4) of all placements."""
        return np.array([one.T_world_shape for _, one in self.places]).reshape(-1, 4, 4)


def find_bodies(
    clouds: Sequence[Cloud],
    rules: LearningRules,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> list[Found]:
    """Find what moves rigidly in clouds without what stands still; most points seen first.

    Parameters
    ----------
    clouds : sequence of Cloud
    rules : LearningRules
    rng : Generator
    progress : callable
    """
    left, found = list(clouds), list[Found]()
    while len(found) < rules.most_bodies:
        progress("looking for bodies", len(found), rules.most_bodies)
        body = _next(left, rules, rng)
        if body is None:
            break
        found.append(body)
        left = _without(left, body)
    moving = [each for each in found if moves(each, rules)]
    return sorted(moving, key=lambda each: -sum(one.count for _, one in each.places))


def moves(body: Found, rules: LearningRules) -> bool:
    """Whether a body is elsewhere in some frames than in others."""
    seen = transform(body.poses, body.shape.points)
    away = np.linalg.norm(seen - np.median(seen, axis=0), axis=2).max(axis=1)
    reach = 2 * rules.gate * float(body.shape.reach.max() / _SURER)
    return bool((away > reach).sum() >= rules.least_frames)


def _next(
    clouds: Sequence[Cloud], rules: LearningRules, rng: np.random.Generator
) -> Found | None:
    """The most evident body of what is left."""
    for seed in seeds(clouds, rules, rng)[:_TRIED]:
        body = _grown(seed, clouds, rules)
        if body is not None and not _is_chance(body, clouds, rules):
            return _with_copies(body, clouds, rules)
    return None


def least_met(points: int) -> int:
    """Points of a shape that must be met, so that no other points lie like them by chance."""
    return FEWEST if points <= FEWEST + 1 else FEWEST + 1


def _placed(
    shape: Shape, clouds: Sequence[Cloud], rules: LearningRules, most: int = 1
) -> list[tuple[int, Placement]]:
    bases = wide_triples(shape.points, shape.reach, rules.bases)
    least = least_met(len(shape))
    return [
        (k, one)
        for k, cloud in enumerate(clouds)
        for one in placements(shape, bases, cloud, rules, most, least)
    ]


def _grown(seed: Seed, clouds: Sequence[Cloud], rules: LearningRules) -> Found | None:
    """Find a shape in all frames, and in these all that goes along."""
    shape = seed.shape
    for _ in range(rules.rounds):
        places = _placed(shape, clouds, rules)
        if len(places) < rules.least_frames:
            return None
        shape = averaged(shape, places, clouds, rules)
        before = len(shape)
        shape = with_hidden(shape, places, clouds, rules)
        if len(shape) < FEWEST:
            return None
        if len(shape) == before:
            break
    places = _placed(shape, clouds, rules)
    shape = averaged(shape, places, clouds, rules) if places else shape
    if len(shape) < FEWEST or not wide_triples(shape.points, shape.reach, 1):
        return None
    places = _placed(shape, clouds, rules)
    if len(places) < rules.least_frames:
        return None
    return Found(shape, tuple(places))


def averaged(
    shape: Shape,
    places: Sequence[tuple[int, Placement]],
    clouds: Sequence[Cloud],
    rules: LearningRules,
) -> Shape:
    """The shape as its frames show it on average, without points that few of them show."""
    weight, total = np.zeros(len(shape)), np.zeros((len(shape), 3))
    counts, reach = np.zeros(len(shape)), np.zeros(len(shape))
    for k, one in places:
        own = np.flatnonzero(one.met >= 0)
        there = one.met[own]
        w = 1 / clouds[k].reach[there] ** 2
        total[own] += w[:, None] * transform(
            inverse(one.T_world_shape), clouds[k].points[there]
        )
        weight[own] += w
        counts[own] += 1
        reach[own] += clouds[k].reach[there]
    kept = counts >= max(rules.least_frames, rules.least_share * len(places))
    middle = total[kept] / weight[kept, None]
    return Shape(middle, _reach_of(reach[kept] / counts[kept], counts[kept]))


def _reach_of(reach: Floats, counts: Floats) -> Floats:
    return np.asarray(reach * np.maximum(1 / np.sqrt(counts), _SURER))


def with_hidden(
    shape: Shape,
    places: Sequence[tuple[int, Placement]],
    clouds: Sequence[Cloud],
    rules: LearningRules,
) -> Shape:
    """The shape with points that are at one place of it in many frames."""
    points, reach, frame = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0, dtype=np.intp)]
    for n, (k, one) in enumerate(places):
        cloud = clouds[k]
        free = cloud.without(cloud.detections[one.met[one.met >= 0]])
        own = transform(inverse(one.T_world_shape), free.points)
        points.append(own)
        reach.append(rules.gate * free.reach * _lever(shape, own, one.count))
        frame.append(np.full(len(own), n))
    least = max(rules.least_frames, rules.least_share * len(places))
    stacked, reaches = np.concatenate(points), np.concatenate(reach)
    more = gathered_places(stacked, reaches, np.concatenate(frame), least, rules)
    if not more:
        return shape
    added = [np.median(reaches[there]) / rules.gate for _, there in more]
    counts = np.array([len(there) for _, there in more], dtype=np.float64)
    return Shape(
        np.concatenate([shape.points, [place for place, _ in more]]),
        np.concatenate([shape.reach, _reach_of(np.array(added), counts)]),
    )


def _lever(shape: Shape, points: Floats, met: int) -> Floats:
    """By how much errors of a pose make points (n, 3) err more than by themselves."""
    middle = shape.points.mean(axis=0)
    radius = np.sqrt(((shape.points - middle) ** 2).sum(axis=1).mean())
    away = np.linalg.norm(points - middle, axis=1) / radius
    return np.asarray(np.sqrt(1 + (1 + away**2) / met))


def _is_chance(body: Found, clouds: Sequence[Cloud], rules: LearningRules) -> bool:
    """Whether shapes of other sizes, which are not there, are found about as often."""
    if len(body.shape) > FEWEST + 1:
        return False
    middle = body.shape.points.mean(axis=0)
    counts = []
    for size in _DECOYS:
        shape = Shape(middle + size * (body.shape.points - middle), body.shape.reach)
        counts.append(len(_placed(shape, clouds, rules)))
    return len(body.places) < rules.least_frames + rules.by_chance * float(np.mean(counts))


def _with_copies(body: Found, clouds: Sequence[Cloud], rules: LearningRules) -> Found:
    """All bodies of a shape, where there are several."""
    shape, most = body.shape, 2
    if not _copies(body, clouds, rules):
        return body
    most = rules.most_bodies
    least = max(FEWEST, int(np.ceil(_OF_COPY * len(shape))))
    places = [each for each in _placed(shape, clouds, rules, most) if each[1].count >= least]
    per_frame = np.bincount([k for k, _ in places], minlength=len(clouds))
    often = [n for n in range(1, most + 1) if (per_frame >= n).sum() >= _often(per_frame, rules)]
    return Found(averaged(shape, places, clouds, rules), tuple(places), max(often, default=1))


def _often(per_frame: Floats, rules: LearningRules) -> float:
    return max(rules.least_frames, 2 * rules.least_share * float((per_frame > 0).sum()))


def _copies(body: Found, clouds: Sequence[Cloud], rules: LearningRules) -> bool:
    """Whether a second body of the same shape is seen in some frames beside the first."""
    again = _placed(body.shape, _without(clouds, body), rules)
    least = max(FEWEST, int(np.ceil(_OF_COPY * len(body.shape))))
    twice = sum(one.count >= least for _, one in again)
    return twice >= max(rules.least_frames, 2 * rules.least_share * len(body.places))


def _without(clouds: Sequence[Cloud], body: Found) -> list[Cloud]:
    """Clouds without the points of a body, and without ghosts that its detections make."""
    left = list(clouds)
    for k, one in body.places:
        own = clouds[k].detections[one.met[one.met >= 0]]
        left[k] = left[k].without(own)
    return left


def turned_deg(body: Found) -> float:
    """Degrees by which a body turned at most, from its pose in the middle of the frames."""
    poses = body.poses
    return float(rotation_angle_deg(poses[len(poses) // 2], poses).max())
