"""Whether a shape that is found twice in a frame is two bodies alike, or parts of two bodies.

Bodies that move along with each other for a while look like one, until a part of it is elsewhere.
Three points of one body may lie like three of another, as those of its mirror image do: what goes
along with them is there with the one or with the other, and never with both at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import pdtr

from mixpose.learning.points import Cloud
from mixpose.learning.rules import RULES
from mixpose.learning.shapes import FEWEST, Found, Placement, Places, Shape, averaged, placed
from mixpose.records import Floats, Indices, Mask

_OF_COPY = 0.6  # of the points of a shape that another one of it must show
_SELDOM = 0.34  # of the times that are to be expected: something keeps the points apart
_ACCIDENT = 3e-3  # chance of so few times: more is no accident to go by
_MISSED = 0.6  # as often as else: a point that goes missing along with another one
_DECOYS = (0.8, 0.87, 0.93, 1.08, 1.16, 1.25)  # sizes of shapes that are not there


def with_copies(body: Found, clouds: Sequence[Cloud]) -> Found:
    """All bodies of a shape, where others are seen beside the first in some frames."""
    shape, least, left = body.shape, _of_copy(body.shape), left_by(body.places, clouds)
    if len(placed(shape, left, least=least)) < seen_often(len(body.places)):
        return _in_one_piece(body, clouds, left)
    places = placed(shape, clouds, RULES.most_bodies, least)
    # seldom two at a time: the one body, also where it shows fewer points
    if np.sum(_per_frame(places, clouds) > 1) < seen_often(len({k for k, _ in places})):
        return _averaged(shape, places, clouds)
    count = _count(shape, places, clouds)
    strange = _is_strange(shape, places, count)
    others = _never_with(shape, places, strange)
    if others.any():
        shape = _part(shape, ~others)
        places = placed(shape, clouds, RULES.most_bodies, _of_copy(shape))
        count = _count(shape, places, clouds)
    while count > 1 and _is_strange(shape, places, count).any():
        count -= 1
    if count == 1:
        places = placed(shape, clouds)
    return _averaged(shape, places, clouds, count)


def _averaged(shape: Shape, places: Places, clouds: Sequence[Cloud], count: int = 1) -> Found:
    """So many bodies of the shape that places show on average, met at the points that are left."""
    mean, kept = averaged(shape, places, clouds)
    left = [(k, replace(one, met=one.met[kept])) for k, one in places]
    return Found(mean, tuple([(k, one) for k, one in left if one.count >= FEWEST]), count)


def is_chance(body: Found, clouds: Sequence[Cloud]) -> bool:
    """Whether shapes of other sizes, which are not there, are found about as often."""
    if len(body.shape) > FEWEST + 1:
        return False
    middle = body.shape.points.mean(axis=0)
    counts = []
    for size in _DECOYS:
        shape = Shape(middle + size * (body.shape.points - middle), body.shape.reach)
        counts.append(len(placed(shape, clouds)))
    expected = float(np.mean(counts))
    # the best of very many shapes recurs more often than one of them
    most = RULES.by_chance * (expected + np.sqrt(expected))
    return bool(len(body.places) < 2 * RULES.least_frames + most)


def left_by(places: Places, clouds: Sequence[Cloud]) -> list[Cloud]:
    """Clouds without the points of bodies, and without ghosts that their detections make."""
    left = list(clouds)
    for k, one in places:
        left[k] = left[k].without(clouds[k].detections[one.there])
    return left


def seen_often(frames: int) -> float:
    """Frames in which something is seen that is no accident."""
    return max(RULES.least_frames, 2 * RULES.least_share * frames)


def _in_one_piece(body: Found, clouds: Sequence[Cloud], left: Sequence[Cloud]) -> Found:
    """A body without what moves apart from it: points missed together that are elsewhere then."""
    seen = np.array([one.met >= 0 for _, one in body.places])
    least = seen[:, seen.sum(axis=0).argmin()]
    if least.all():
        return body
    apart = seen[~least].mean(axis=0) < _MISSED * seen[least].mean(axis=0)
    part, rest = _part(body.shape, apart), _part(body.shape, ~apart)
    if min(len(part), len(rest)) < FEWEST:
        return body
    elsewhere = Found(part, tuple(placed(part, left)))
    is_seldom = len(elsewhere.places) < seen_often(len(body.places))
    if is_seldom or is_chance(elsewhere, left):
        return body
    return Found(rest, tuple(placed(rest, clouds)))


def _part(shape: Shape, some: Mask) -> Shape:
    return Shape(shape.points[some], shape.reach[some])


def _of_copy(shape: Shape) -> int:
    return max(FEWEST, int(np.ceil(_OF_COPY * len(shape))))


def _count(shape: Shape, places: Places, clouds: Sequence[Cloud]) -> int:
    """How many placements there are at a time, in enough frames."""
    # in some of them all must show more than the three points that a mirror image has alike
    full = [(k, one) for k, one in places if one.count > min(FEWEST, len(shape) - 1)]
    per_frame, full_per_frame = _per_frame(places, clouds), _per_frame(full, clouds)
    often = seen_often(int((per_frame > 0).sum()))
    count = 1
    while (per_frame > count).sum() >= often and (full_per_frame > count).sum() >= often / 2:
        count += 1
    return count


def _per_frame(places: Places, clouds: Sequence[Cloud]) -> Indices:
    return np.bincount([k for k, _ in places], minlength=len(clouds))


def _is_strange(shape: Shape, places: Places, count: int) -> Mask:
    """Which points (N,) so many bodies alike would show all at a time, and hardly ever do."""
    frames: dict[int, list[Placement]] = {}
    for k, one in places:
        frames.setdefault(k, []).append(one)
    full = [[one.met >= 0 for one in own[:count]] for own in frames.values() if len(own) >= count]
    seen = np.array(full, dtype=np.bool_).reshape(-1, count, len(shape))
    expected = len(seen) * _share(seen.reshape(-1, len(shape))) ** count
    all_show = seen.all(axis=1).sum(axis=0)
    strange = (pdtr(all_show, expected) < _ACCIDENT) & (all_show < _SELDOM * expected)
    return np.asarray(strange)


def _never_with(shape: Shape, places: Places, strange: Mask) -> Mask:
    """Which of strange points (N,) are hardly ever seen with another one that is seen more."""
    seen = np.array([one.met >= 0 for _, one in places], dtype=np.float64)
    together = seen.T @ seen
    share, dropped = _share(seen), np.zeros(len(shape), dtype=np.bool_)
    apart = together < _SELDOM * len(seen) * np.outer(share, share)
    for k in np.argsort(-share, kind="stable"):
        dropped[k] = strange[k] and bool((apart[k] & strange & ~dropped & (share > share[k])).any())
    return dropped


def _share(seen: Mask | Floats) -> Floats:
    return np.asarray(seen.mean(axis=0) if len(seen) else np.zeros(seen.shape[1]))
