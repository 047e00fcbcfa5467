"""Outlines of connected regions above a level, and what they enclose."""

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
from mixpose.extraction.conics import Ellipses, no_ellipses
from mixpose.extraction.threshold import Foreground, above

# (n, 1, 2) int32: the outermost pixels (u, v) of a connected region, in order, as in OpenCV.
Contour: TypeAlias = NDArray[np.integer[Any] | np.floating[Any]]

# Upright box about a contour: first column, first row, width, height.
Box: TypeAlias = Sequence[int]

# Rows without signal are left out where the others are at most this share.
MOST_ROWS_SHARE = 0.5

CONTOUR_SAMPLES = 64

_AT_ONCE = 256  # contours that are compared with all others at once

# Largest width of a waist by the way along the outline: a disk that is cut off at half its radius
# or less from its middle has 1.73 / 4.2 at most.
_WAIST = 0.45

_MOMENTS = itemgetter("m00", "m10", "m01", "mu20", "mu02", "mu11")

# Share of the area of the ellipse of its moments, from which a region may be that ellipse.
OVAL = 0.985


@dataclass(frozen=True)
class ContourRules:
    """Which outlines may be parts of one rim."""

    gap: float = constant(0.1, "of their length, the largest gap between parts of a broken rim")
    gap_px: float = constant(2.0, "px more: a pixel lost on each side")


CONTOURS = ContourRules()


def outlines(scene: Foreground) -> list[Contour]:
    """Return the outermost contours of regions above the detection level.

    Rows with nothing above it are left out, except one after each other row: a frame with few
    features is then searched quickly.
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
        # No row within a contour was left out, so that all of it moves by the same shift.
        rows_removed = (rows - np.arange(rows.size)).tolist()
        for contour in contours:
            contour[:, 0, 1] += rows_removed[contour[0, 0, 1]]
    return list(contours)


def outer_contours(mask: NDArray[np.uint8], corner: tuple[int, int]) -> list[Contour]:
    """Return the outer contours of all connected parts of a mask, islands in holes included.

    `corner` is the position (u, v) of the mask's first pixel.
    """
    contours, family = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE, offset=corner)
    if not contours:
        return []
    # The last entry of a contour's family is its parent, which only holes have.
    return [c for c, relatives in zip(contours, family[0], strict=True) if relatives[3] < 0]


def filled_area(contour: Contour) -> float:
    """Count the pixels that a contour encloses, including its own and those of holes."""
    # Pick's theorem: the contour runs through the centres of the outermost pixels.
    if len(contour) == 1:
        return 1.0
    return float(cv2.contourArea(contour)) + len(contour) / 2 + 1


def length_by_width(contour: Contour) -> tuple[float, float]:
    """Return length by width and direction of the ellipse with the moments of a contour."""
    # The contour runs through the centres of the outermost pixels, half a pixel inside.
    m = cv2.moments(contour)
    if m["m00"] <= 0:  # a line
        return float(len(contour)), 0.0
    middle, x, y = (m["mu20"] + m["mu02"]) / 2, (m["mu20"] - m["mu02"]) / 2, m["mu11"]
    half = math.hypot(x, y)
    long, short = max(middle + half, 0.0), max(middle - half, 0.0)
    scale = 4 / m["m00"]
    length = (math.sqrt(scale * long) + 0.5) / (math.sqrt(scale * short) + 0.5)
    return length, math.atan2(y, x) / 2


def moment_ellipses(contours: Sequence[Contour]) -> Ellipses:
    """Return the ellipses with the moments of contours; rows without one where areas disagree.

    For most of them the fitted rims agree.
    """
    if not contours:
        return no_ellipses(0)
    rows = [_MOMENTS(cv2.moments(contour)) for contour in contours]
    area, u, v, uu, vv, uv = np.array(rows, dtype=np.float64).T
    spread = np.sqrt(np.maximum(uu * vv - uv * uv, 0.0))
    valid = (area > 0) & (area * area >= OVAL * 4 * math.pi * spread)
    area = np.where(valid, area, 1.0)
    middle, half = (uu + vv) / 2, np.hypot((uu - vv) / 2, uv)
    # the contour runs through the centres of the outermost pixels, half a pixel inside
    squares = np.maximum(np.stack([middle + half, middle - half], axis=1), 0.0) / area[:, None]
    centres = np.stack([u, v], axis=1) / area[:, None]
    return Ellipses(centres, 2 * np.sqrt(squares) + 0.5, 0.5 * np.arctan2(2 * uv, uu - vv), valid)


def lobes(contour: Contour, depth: float, min_way: float) -> list[Contour]:
    """Split the common outline of things that touch at its waists; return it if it has none.

    A waist is between two places `depth` px below the convex hull that are near to each other,
    compared with the way along the outline, which is `min_way` px at least.
    """
    if len(contour) < 4:
        return [contour]
    # OpenCV needs corners in order
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
    distances = np.linalg.norm(contour[i, 0] - contour[j, 0], axis=1)
    along = np.minimum(j - i, len(contour) - (j - i))
    ratio = np.where(along >= min_way, distances / along, np.inf)
    narrowest = int(ratio.argmin())
    if ratio[narrowest] > _WAIST:
        return [contour]
    a, b = int(i[narrowest]), int(j[narrowest])
    parts = contour[a : b + 1], np.concatenate([contour[b:], contour[: a + 1]])
    return [lobe for part in parts for lobe in lobes(part, depth, min_way)]


def cut_out(
    scene: Foreground, contour: Contour, box: Box, margin: int
) -> tuple[NDArray[np.float32], NDArray[np.uint8], tuple[int, int]]:
    """Cut out the box of a contour with a margin in px, as far as the window goes.

    Return the signal (h, w), a mask (h, w), 1 inside of the contour, and the first pixel (u, v).
    """
    patch, corner = signal_about(scene, box, margin)
    return patch, mask_of(contour, patch.shape, corner), corner


def signal_about(
    scene: Foreground, box: Box, margin: int
) -> tuple[NDArray[np.float32], tuple[int, int]]:
    """Return the signal in a box and its margin, within the window, and its first pixel (u, v)."""
    u, v, width, height = box
    u0, v0 = max(u - margin, 0), max(v - margin, 0)
    grey = scene.grey[v0 : v + height + margin, u0 : u + width + margin]
    return grey.astype(np.float32) - np.float32(scene.zero), (u0, v0)


def mask_of(contour: Contour, shape: tuple[int, ...], corner: tuple[int, int]) -> NDArray[np.uint8]:
    """Return a mask of a shape, its first pixel at a corner (u, v): 1 inside of a contour."""
    inside = np.zeros(shape, np.uint8)
    offset = (-corner[0], -corner[1])
    cv2.drawContours(inside, [contour], 0, 1, cv2.FILLED, offset=offset)
    return inside


def is_on_border(scene: Foreground, box: Box) -> bool:
    """Test whether the box of a contour reaches the border of the window, which may cut it."""
    u, v, width, height = box
    rows, columns = scene.grey.shape
    return bool(u == 0 or v == 0 or u + width == columns or v + height == rows)


def touching_groups(contours: Sequence[Contour]) -> list[list[int]]:
    """Group the indices of contours that nearly touch: they may be parts of one broken rim."""
    linked: list[set[int]] = [set() for _ in contours]
    for k, j, gap in _pairs_by_box(contours) if len(contours) > 1 else ():
        if _are_near(contours[k], contours[j], gap):
            linked[k].add(j)
    groups: list[list[int]] = []
    for k, links in enumerate(linked):
        touched = [group for group in groups if not links.isdisjoint(group)] if links else []
        groups = [group for group in groups if group not in touched] if touched else groups
        groups.append([k, *[member for group in touched for member in group]])
    return groups


def _pairs_by_box(contours: Sequence[Contour]) -> Iterator[tuple[int, int, float]]:
    """Yield pairs k > j of contours whose boxes are within their allowed gap, with that gap."""
    count = len(contours)
    boxes = np.array([cv2.boundingRect(contour) for contour in contours])
    low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
    largest = boxes[:, 2:].max(axis=1)
    for rows in np.array_split(np.arange(count), count // _AT_ONCE + 1):
        gaps_of_boxes = np.maximum(low[rows, None] - high, low - high[rows, None]).max(axis=2)
        gaps = CONTOURS.gap * np.minimum(largest[rows, None], largest) + CONTOURS.gap_px
        k, j = np.nonzero((gaps_of_boxes <= gaps) & (np.arange(count) < rows[:, None]))
        yield from zip(rows[k].tolist(), j.tolist(), gaps[k, j].tolist())


def _are_near(a: Contour, b: Contour, gap: float) -> bool:
    """Test whether two contours are within a gap of each other."""
    # A sample of points is enough: between them a contour comes closer by half a step at most.
    steps = [max(len(contour) // CONTOUR_SAMPLES, 1) for contour in (a, b)]
    offsets = a[:: steps[0]].astype(np.float32) - b[:: steps[1], 0].astype(np.float32)
    return bool((offsets**2).sum(axis=-1).min() <= (gap + max(steps) / 2) ** 2)
