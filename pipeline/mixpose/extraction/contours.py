"""Outlines of what is above a level, and what they enclose."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.constants import constant
from mixpose.extraction.conics import Ellipses, none
from mixpose.extraction.threshold import Foreground, above

# (n, 1, 2) int32: the outermost pixels of a connected area, (u, v), in order, as OpenCV has them.
Contour: TypeAlias = NDArray[np.integer[Any] | np.floating[Any]]

# Upright box about a contour: first column, first row, width, height.
Box: TypeAlias = Sequence[int]

# Rows are left out where that leaves at most this share of them.
MOST_ROWS_SHARE = 0.5

CONTOUR_SAMPLES = 64

_AT_ONCE = 256  # contours that are held against all others in one piece

# Across a waist by the way along the outline: of a disk beside it, cut off at half its radius or
# less from its middle, 1.73 / 4.2 at the most.
_WAIST = 0.45

_MOMENTS = itemgetter("m00", "m10", "m01", "mu20", "mu02", "mu11")

# Of an ellipse's area for its moments, from which it is taken for one until rims tell.
OVAL = 0.985


@dataclass(frozen=True)
class ContourRules:
    """Which outlines may be parts of one."""

    gap: float = constant(0.1, "of their length, that parts of a broken rim are apart at most")
    gap_px: float = constant(2.0, "px more: a pixel lost on each side")


CONTOURS = ContourRules()


def outlines(scene: Foreground) -> list[Contour]:
    """Outermost contours of what is above the detection level.

    Rows with nothing above it are left out, but for one where others follow: of a frame with few
    features, little is looked at twice.
    """
    level = scene.zero + scene.level
    wanted = above(scene.tops, level)
    wanted[1:] |= wanted[:-1]
    rows = np.flatnonzero(wanted)
    if rows.size > MOST_ROWS_SHARE * len(wanted):
        rows = np.arange(len(wanted))
        mask = above(scene.grey, level)
    else:
        mask = above(scene.grey[rows], level)
    contours = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    if rows.size < len(wanted):
        # Between a contour's rows none was left out, so that all of it moves alike.
        left_out = (rows - np.arange(rows.size)).tolist()
        for contour in contours:
            contour[:, 0, 1] += left_out[contour[0, 0, 1]]
    return list(contours)


def pieces(mask: NDArray[np.uint8], corner: tuple[int, int]) -> list[Contour]:
    """Outer contours of all that is connected in a mask, islands in holes included.

    `corner` is the place (u, v) of the mask's first pixel.
    """
    contours, family = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE, offset=corner)
    if not contours:
        return []
    # The last entry of a contour's family is its parent, which only holes have.
    return [c for c, relatives in zip(contours, family[0], strict=True) if relatives[3] < 0]


def filled_area(contour: Contour) -> float:
    """Number of pixels that a contour encloses, its own and those of holes included."""
    # Pick's theorem: the contour runs through the centres of the outermost pixels.
    if len(contour) == 1:
        return 1.0
    return float(cv2.contourArea(contour)) + len(contour) / 2 + 1


def length_by_width(contour: Contour) -> tuple[float, float]:
    """Of the ellipse that has the moments of a contour, and in which direction it is long."""
    # The contour runs through the centres of the outermost pixels: it is half a pixel inside.
    m = cv2.moments(contour)
    if m["m00"] <= 0:  # a line
        return float(len(contour)), 0.0
    middle, x, y = (m["mu20"] + m["mu02"]) / 2, (m["mu20"] - m["mu02"]) / 2, m["mu11"]
    half = math.hypot(x, y)
    long, short = max(middle + half, 0.0), max(middle - half, 0.0)
    scale = 4 / m["m00"]
    length = (math.sqrt(scale * long) + 0.5) / (math.sqrt(scale * short) + 0.5)
    return length, math.atan2(y, x) / 2


def ovals(contours: Sequence[Contour]) -> Ellipses:
    """The ellipses that have the moments of contours; sound where they may be those by their area.

    Of most, rims say the same.
    """
    if not contours:
        return none(0)
    rows = [_MOMENTS(cv2.moments(contour)) for contour in contours]
    area, u, v, uu, vv, uv = np.array(rows, dtype=np.float64).T
    spread = np.sqrt(np.maximum(uu * vv - uv * uv, 0.0))
    sound = (area > 0) & (area * area >= OVAL * 4 * math.pi * spread)
    area = np.where(sound, area, 1.0)
    middle, half = (uu + vv) / 2, np.hypot((uu - vv) / 2, uv)
    # the contour runs through the centres of the outermost pixels: it is half a pixel inside
    squares = np.maximum(np.stack([middle + half, middle - half], axis=1), 0.0) / area[:, None]
    centres = np.stack([u, v], axis=1) / area[:, None]
    return Ellipses(centres, 2 * np.sqrt(squares) + 0.5, 0.5 * np.arctan2(2 * uv, uu - vv), sound)


def lobes(contour: Contour, depth: float, least: float) -> list[Contour]:
    """The outlines of things that touch, as waists part their common one; one if it has none.

    A waist lies between two places that are so much deeper, px, than the convex hull, nearer to
    each other than along the outline, which is `least` px at least.
    """
    if len(contour) < 4:
        return [contour]
    # OpenCV asks for corners in their order
    corners = np.sort(cv2.convexHull(contour, returnPoints=False), axis=0)[::-1]
    defects = cv2.convexityDefects(contour, corners) if len(corners) > 3 else None
    if defects is None:
        return [contour]
    *_, places, depths = defects.reshape(-1, 4).T  # in 1/256 px
    deep = np.sort(places[depths >= 256 * depth])
    if len(deep) < 2:
        return [contour]
    first, second = np.triu_indices(len(deep), 1)
    i, j = deep[first], deep[second]
    away = np.linalg.norm(contour[i, 0] - contour[j, 0], axis=1)
    along = np.minimum(j - i, len(contour) - (j - i))
    ratio = np.where(along >= least, away / along, np.inf)
    narrowest = int(ratio.argmin())
    if ratio[narrowest] > _WAIST:
        return [contour]
    a, b = int(i[narrowest]), int(j[narrowest])
    parts = contour[a : b + 1], np.concatenate([contour[b:], contour[: a + 1]])
    return [one for part in parts for one in lobes(part, depth, least)]


def cut_out(
    scene: Foreground, contour: Contour, box: Box, margin: int
) -> tuple[NDArray[np.float32], NDArray[np.uint8], tuple[int, int]]:
    """Patch, mask and corner of the box of a contour and a margin in px, as far as the window goes.

    The signal (h, w); 1 where the contour encloses it (h, w); where the first pixel is, (u, v).
    """
    patch, corner = signal_about(scene, box, margin)
    return patch, filled(contour, patch.shape, corner), corner


def signal_about(
    scene: Foreground, box: Box, margin: int
) -> tuple[NDArray[np.float32], tuple[int, int]]:
    """Signal in a box and its margin as far as the window goes, and where its first pixel is."""
    u, v, width, height = box
    u0, v0 = max(u - margin, 0), max(v - margin, 0)
    grey = scene.grey[v0 : v + height + margin, u0 : u + width + margin]
    return grey.astype(np.float32) - np.float32(scene.zero), (u0, v0)


def filled(contour: Contour, shape: tuple[int, ...], corner: tuple[int, int]) -> NDArray[np.uint8]:
    """Mask of a shape, its first pixel at a corner (u, v): 1 where a contour encloses it."""
    inside = np.zeros(shape, np.uint8)
    offset = (-corner[0], -corner[1])
    cv2.drawContours(inside, [contour], 0, 1, cv2.FILLED, offset=offset)
    return inside


def on_border(scene: Foreground, box: Box) -> bool:
    """Whether the box of a contour reaches the border of the window, which may have cut it."""
    u, v, width, height = box
    rows, columns = scene.grey.shape
    return bool(u == 0 or v == 0 or u + width == columns or v + height == rows)


def neighbours(contours: Sequence[Contour]) -> list[list[int]]:
    """Groups of contours, by their places, that nearly touch: perhaps parts of one broken rim."""
    near: list[set[int]] = [set() for _ in contours]
    for k, j, gap in _pairs_by_box(contours) if len(contours) > 1 else ():
        if _are_near(contours[k], contours[j], gap):
            near[k].add(j)
    groups: list[list[int]] = []
    for k, others in enumerate(near):
        joined = [group for group in groups if not others.isdisjoint(group)] if others else []
        groups = [group for group in groups if group not in joined] if joined else groups
        groups.append([k, *[one for group in joined for one in group]])
    return groups


def _pairs_by_box(contours: Sequence[Contour]) -> Iterator[tuple[int, int, float]]:
    """Pairs k > j whose boxes are nearer than the gap that is small beside them; with that gap."""
    count = len(contours)
    boxes = np.array([cv2.boundingRect(contour) for contour in contours])
    low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
    largest = boxes[:, 2:].max(axis=1)
    for rows in np.array_split(np.arange(count), count // _AT_ONCE + 1):
        off = np.maximum(low[rows, None] - high, low - high[rows, None]).max(axis=2)
        gaps = CONTOURS.gap * np.minimum(largest[rows, None], largest) + CONTOURS.gap_px
        k, j = np.nonzero((off <= gaps) & (np.arange(count) < rows[:, None]))
        yield from zip(rows[k].tolist(), j.tolist(), gaps[k, j].tolist())


def _are_near(a: Contour, b: Contour, gap: float) -> bool:
    """Whether two contours are so near to each other."""
    # Some points of each are enough: between them a contour comes closer by half a step.
    steps = [max(len(contour) // CONTOUR_SAMPLES, 1) for contour in (a, b)]
    between = a[:: steps[0]].astype(np.float32) - b[:: steps[1], 0].astype(np.float32)
    return bool((between**2).sum(axis=-1).min() <= (gap + max(steps) / 2) ** 2)
