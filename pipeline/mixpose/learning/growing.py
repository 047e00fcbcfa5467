"""From a few points of one frame to a whole body: found in all frames, and all that goes along.

Frames in which a body is where it was before tell nothing new of what belongs to it: whatever rests
beside it would.  What counts are poses apart from each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from mixpose.learning.placing import FEWEST, Placement, Shape, placements, wide_triples
from mixpose.learning.points import Cloud, gathered_places
from mixpose.learning.rules import RULES
from mixpose.records import Floats, Indices, Mask
from mixpose.rigid import inverse, transform

Places: TypeAlias = Sequence[tuple[int, Placement]]
"""Placements with the index of the cloud that each is in."""

_SURER = 0.15  # of a point's reach: errors that many frames have in common


@dataclass(frozen=True, eq=False)
class Found:
    """A body, and where it is in which frames."""

    shape: Shape  # in a frame of its own
    places: tuple[tuple[int, Placement], ...]  # of congruent bodies several in a cloud
    count: int = 1  # congruent bodies that are seen at a time
    loose: float = 1.0  # times the error of triangulation that its points may be off

    @property
    def met(self) -> int:
        """Points that are met, all frames together."""
        return sum(one.count for _, one in self.places)


def least_met(points: int) -> int:
    """Points of a shape that must be met, so that no other points lie like them by chance."""
    return FEWEST if points <= FEWEST + 1 else FEWEST + 1


def placed(
    shape: Shape,
    clouds: Sequence[Cloud],
    most: int = 1,
    least: int | None = None,
    bases: int | None = None,
) -> list[tuple[int, Placement]]:
    """Where a shape is in all clouds, at most so many times in each."""
    triples = wide_triples(shape.points, shape.reach, bases or RULES.bases)
    least = least_met(len(shape)) if least is None else least
    return [
        (k, one)
        for k, cloud in enumerate(clouds)
        for one in placements(shape, triples, cloud, most, least)
    ]


def grown(shape: Shape, clouds: Sequence[Cloud]) -> Found | None:
    """Find a shape of three points or more in all frames, and in these all that goes along.

    None where it does not recur.
    """
    for turn in range(RULES.rounds):
        places = placed(shape, clouds)
        if len(places) < RULES.least_frames:
            return None
        shape, _ = averaged(shape, places, clouds)
        if len(shape) < FEWEST:
            return None
        if turn + 1 == RULES.rounds:
            break
        before = len(shape)
        shape = _with_hidden(shape, places, clouds)
        if len(shape) == before and turn:
            break
    if not len(wide_triples(shape.points, shape.reach, 1)):
        return None
    places = placed(shape, clouds)
    _, different = _poses_apart(shape, places, clouds)
    return Found(shape, tuple(places)) if different >= RULES.least_frames else None


def usual_reach(places: Places, clouds: Sequence[Cloud]) -> float:
    """By how much points that are met are off, in most placements."""
    return float(np.median([clouds[k].reach[one.there].mean() for k, one in places]))


def _poses_apart(shape: Shape, places: Places, clouds: Sequence[Cloud]) -> tuple[Indices, int]:
    """Numbers (K,) of the poses of placements, the same where no point is far, and how many."""
    if not places:
        return np.zeros(0, dtype=np.intp), 0
    points = transform(np.array([one.T_world_shape for _, one in places]), shape.points)
    far = RULES.apart * RULES.gate * usual_reach(places, clouds)
    number, count = np.full(len(points), -1, dtype=np.intp), 0
    for k in range(len(points)):
        if number[k] < 0:
            away = np.abs(points - points[k]).max(axis=(1, 2), initial=0.0)
            number[(number < 0) & (away <= far)] = count
            count += 1
    return number, count


def averaged(shape: Shape, places: Places, clouds: Sequence[Cloud]) -> tuple[Shape, Mask]:
    """The shape as its frames show it on average, without points that few of them show.

    And which of its points (N,) are left.
    """
    weight, total = np.zeros(len(shape)), np.zeros((len(shape), 3))
    counts, reach = np.zeros(len(shape)), np.zeros(len(shape))
    number, different = _poses_apart(shape, places, clouds)
    seen = np.zeros((len(shape), different), dtype=np.bool_)
    for n, (k, one) in zip(number.tolist(), places, strict=True):
        own, there = one.own, one.there
        w = 1 / clouds[k].reach[there] ** 2
        total[own] += w[:, None] * transform(inverse(one.T_world_shape), clouds[k].points[there])
        weight[own] += w
        counts[own] += 1
        reach[own] += clouds[k].reach[there]
        seen[own, n] = True
    kept = seen.sum(axis=1) >= max(RULES.least_frames, RULES.least_share * seen.shape[1])
    near = RULES.alike * RULES.gate * reach / np.maximum(counts, 1)
    kept &= only_once(shape.points, counts, near)
    middle = total[kept] / weight[kept, None]
    return Shape(middle, _reach_of(reach[kept] / counts[kept], counts[kept])), kept


def only_once(points: Floats, counts: Floats | Indices, near: Floats) -> Mask:
    """Which points (N,) are not beside one that is seen more often: that is the same one."""
    kept = np.ones(len(points), dtype=np.bool_)
    for k in np.argsort(-counts, kind="stable"):
        if kept[k]:
            beside = np.linalg.norm(points - points[k], axis=1) < near[k]
            kept[beside] = False
            kept[k] = True
    return kept


def _reach_of(reach: Floats, counts: Floats) -> Floats:
    return np.asarray(reach * np.maximum(1 / np.sqrt(counts), _SURER))


def _with_hidden(shape: Shape, places: Places, clouds: Sequence[Cloud]) -> Shape:
    """The shape with points that are at one place of it at many poses."""
    points, reach, frame = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0, dtype=np.intp)]
    number, different = _poses_apart(shape, places, clouds)
    for n, (k, one) in zip(number.tolist(), places, strict=True):
        free = clouds[k].without(clouds[k].detections[one.there])
        own = transform(inverse(one.T_world_shape), free.points)
        points.append(own)
        reach.append(RULES.gate * free.reach * _lever(shape, own, one.count))
        frame.append(np.full(len(own), n))
    least = max(RULES.least_frames, RULES.least_share * different)
    reaches = np.concatenate(reach)
    more = gathered_places(np.concatenate(points), reaches, np.concatenate(frame), least)
    if not more:
        return shape
    added = np.array([np.median(reaches[there]) / RULES.gate for _, there in more])
    counts = np.array([len(there) for _, there in more], dtype=np.float64)
    return Shape(
        np.concatenate([shape.points, [place for place, _ in more]]),
        np.concatenate([shape.reach, _reach_of(added, counts)]),
    )


def _lever(shape: Shape, points: Floats, met: int) -> Floats:
    """By how much errors of a pose make points (n, 3) err more than by themselves."""
    middle = shape.points.mean(axis=0)
    radius = np.sqrt(((shape.points - middle) ** 2).sum(axis=1).mean())
    away = np.linalg.norm(points - middle, axis=1) / radius
    return np.asarray(np.sqrt(1 + (1 + away**2) / met))
