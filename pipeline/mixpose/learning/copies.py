"""Decide whether a shape found twice in a frame is two bodies alike, or parts of two bodies.

Bodies that move together for a while look like one, until a part is elsewhere.  Three points of one
body may lie like three of another, as those of its mirror image do: what moves along with them is
then seen with the one or with the other, and never with both at the same time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import pdtr

from mixpose.learning.points import Cloud
from mixpose.learning.rules import RULES
from mixpose.learning.shapes import FEWEST, PlacedBody, Placements, Shape, averaged, find_placements
from mixpose.records import Floats, Indices, Mask

_OF_COPY = 0.6  # of the points of a shape that a copy of it must show
_SELDOM = 0.34  # of the expected frames: fewer show that something keeps points apart
_ACCIDENT = 3e-3  # probability of so few frames by chance; likelier cases are not acted on
_MISSED = 0.6  # times the usual share of frames: a point that is hidden together with another one
_DECOYS = (0.8, 0.87, 0.93, 1.08, 1.16, 1.25)  # sizes at which the shape is not in the recording


def with_copies(body: PlacedBody, clouds: Sequence[Cloud]) -> PlacedBody:
    """Find all bodies of a shape, if copies are seen besides the first in some frames."""
    shape, least = body.shape, _of_copy(body.shape)
    unclaimed = without_bodies(body.placements, clouds)
    if len(find_placements(shape, unclaimed, least=least)) < frames_needed(len(body.placements)):
        return _in_one_piece(body, clouds, unclaimed)
    placements = find_placements(shape, clouds, RULES.most_bodies, least)
    # hardly ever two in a frame: one body, also in frames that show fewer of its points
    if np.sum(_per_frame(placements, clouds) > 1) < frames_needed(len({k for k, _ in placements})):
        return _mean_body(shape, placements, clouds)
    count = _count(shape, placements, clouds)
    is_exclusive = _are_exclusive(shape, placements, count)
    is_foreign = _are_foreign(shape, placements, is_exclusive)
    if is_foreign.any():
        shape = shape.part(~is_foreign)
        placements = find_placements(shape, clouds, RULES.most_bodies, _of_copy(shape))
        count = _count(shape, placements, clouds)
    while count > 1 and _are_exclusive(shape, placements, count).any():
        count -= 1
    if count == 1:
        placements = find_placements(shape, clouds)
    return _mean_body(shape, placements, clouds, count)


def _mean_body(
    shape: Shape, placements: Placements, clouds: Sequence[Cloud], count: int = 1
) -> PlacedBody:
    """Return `count` bodies of the mean shape, whose placements meet the points that are kept."""
    mean, is_kept = averaged(shape, placements, clouds)
    met = [(k, replace(placement, met=placement.met[is_kept])) for k, placement in placements]
    return PlacedBody(mean, tuple([(k, p) for k, p in met if p.count >= FEWEST]), count)


def is_chance(body: PlacedBody, clouds: Sequence[Cloud]) -> bool:
    """Test whether shapes of other sizes, which do not exist, are found about as often."""
    if len(body.shape) > FEWEST + 1:
        return False
    centre = body.shape.points.mean(axis=0)
    offsets, sigma = body.shape.points - centre, body.shape.sigma
    decoys = [Shape(centre + size * offsets, sigma) for size in _DECOYS]
    counts = [len(find_placements(decoy, clouds)) for decoy in decoys]
    expected = float(np.mean(counts))
    # the best of very many shapes recurs more often by chance than any single one
    most = RULES.by_chance * (expected + np.sqrt(expected))
    return bool(len(body.placements) < 2 * RULES.least_frames + most)


def without_bodies(placements: Placements, clouds: Sequence[Cloud]) -> list[Cloud]:
    """Return clouds without the points of bodies, and without ghosts of their detections."""
    unclaimed = list(clouds)
    for k, placement in placements:
        unclaimed[k] = unclaimed[k].without(clouds[k].detections[placement.cloud_rows])
    return unclaimed


def frames_needed(frames: int) -> float:
    """Return how many of some frames must show a thing so that it is not there by accident."""
    return max(RULES.least_frames, 2 * RULES.least_share * frames)


def _in_one_piece(
    body: PlacedBody, clouds: Sequence[Cloud], unclaimed: Sequence[Cloud]
) -> PlacedBody:
    """Return a body without points that are missed together and are then seen elsewhere."""
    seen = np.array([placement.met >= 0 for _, placement in body.placements])
    has_rarest = seen[:, seen.sum(axis=0).argmin()]
    if has_rarest.all():
        return body
    is_apart = seen[~has_rarest].mean(axis=0) < _MISSED * seen[has_rarest].mean(axis=0)
    part, remainder = body.shape.part(is_apart), body.shape.part(~is_apart)
    if min(len(part), len(remainder)) < FEWEST:
        return body
    elsewhere = PlacedBody(part, tuple(find_placements(part, unclaimed)))
    is_seldom = len(elsewhere.placements) < frames_needed(len(body.placements))
    if is_seldom or is_chance(elsewhere, unclaimed):
        return body
    return PlacedBody(remainder, tuple(find_placements(remainder, clouds)))


def _of_copy(shape: Shape) -> int:
    return max(FEWEST, int(np.ceil(_OF_COPY * len(shape))))


def _count(shape: Shape, placements: Placements, clouds: Sequence[Cloud]) -> int:
    """Return how many placements there are at the same time in enough frames."""
    # half as often each must meet more than the three points that a mirror image has in common
    full = [(k, p) for k, p in placements if p.count > min(FEWEST, len(shape) - 1)]
    per_frame, full_per_frame = _per_frame(placements, clouds), _per_frame(full, clouds)
    often = frames_needed(int((per_frame > 0).sum()))
    count = 1
    while (per_frame > count).sum() >= often and (full_per_frame > count).sum() >= often / 2:
        count += 1
    return count


def _per_frame(placements: Placements, clouds: Sequence[Cloud]) -> Indices:
    return np.bincount([k for k, _ in placements], minlength=len(clouds))


def _are_exclusive(shape: Shape, placements: Placements, count: int) -> Mask:
    """Test which points (N,) are hardly ever met by all `count` copies in a frame."""
    frames: dict[int, list[Mask]] = {}
    for k, placement in placements:
        frames.setdefault(k, []).append(placement.met >= 0)
    met = [masks[:count] for masks in frames.values() if len(masks) >= count]
    seen = np.array(met, dtype=np.bool_).reshape(-1, count, len(shape))
    expected = len(seen) * _share(seen.reshape(-1, len(shape))) ** count
    all_show = seen.all(axis=1).sum(axis=0)
    return np.asarray((pdtr(all_show, expected) < _ACCIDENT) & (all_show < _SELDOM * expected))


def _are_foreign(shape: Shape, placements: Placements, is_exclusive: Mask) -> Mask:
    """Test which exclusive points (N,) are hardly ever seen with another one that is seen more."""
    seen = np.array([placement.met >= 0 for _, placement in placements], dtype=np.float64)
    together = seen.T @ seen
    share, is_foreign = _share(seen), np.zeros(len(shape), dtype=np.bool_)
    is_apart = together < _SELDOM * len(seen) * np.outer(share, share)
    for k in np.argsort(-share, kind="stable"):
        rivals = is_apart[k] & is_exclusive & ~is_foreign & (share > share[k])
        is_foreign[k] = is_exclusive[k] and bool(rivals.any())
    return is_foreign


def _share(seen: Mask | Floats) -> Floats:
    return np.asarray(seen.mean(axis=0) if len(seen) else np.zeros(seen.shape[1]))
