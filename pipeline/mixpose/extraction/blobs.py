"""Bright or dark spots and disks: one point per blob, to parts of a pixel.

Small blobs are located by the centroid of their grey values (`spots`), large ones by an ellipse
through their rim (`ellipse`), even if it is broken or partly hidden, and compact things of
another shape by their outline.  A blob that the border of the window cuts is left out, unless
enough of its rim is seen: where its centre is nobody knows, and to the density a wrong point
does more harm than a missing one.

With a grey level (or "otsu") all that is above it is a blob.  With the other thresholds a blob
has to stand out: what is above the detection level but has no shape, as a lit floor, is searched
again at higher levels, so that blobs are found on it too.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.constants import constant
from mixpose.extraction.conics import distances, together
from mixpose.extraction.contours import (
    Box,
    Contour,
    ContourRules,
    cut_out,
    filled_area,
    length_by_width,
    neighbours,
    on_border,
    outlines,
    pieces,
)
from mixpose.extraction.ellipse import EllipseRules, Rim, find_rims, is_waisted
from mixpose.extraction.options import ExtractOptions
from mixpose.extraction.single_spots import all_spots
from mixpose.extraction.spots import SpotRules, come_apart
from mixpose.extraction.threshold import Foreground, ThresholdRules, Window, above, foreground
from mixpose.records import Floats, Image, PointPattern


@dataclass(frozen=True)
class BlobRules:
    """What a blob is."""

    threshold: ThresholdRules = ThresholdRules()
    contours: ContourRules = ContourRules()
    spots: SpotRules = SpotRules()
    rims: EllipseRules = EllipseRules()
    small_area: float = constant(
        100.0, "px up to which the centroid of grey values is the better centre, above it the rim"
    )
    solidity: float = constant(
        0.9, "of its convex hull, that a blob without an elliptical rim fills"
    )
    step: int = constant(3, "px, width of the rings between which the step at an outline is taken")
    level_ratio: float = constant(
        1.4, "by which the level is higher at which what has no shape is searched again"
    )
    core_ratio: float = constant(
        3.0, "peak by median from which a core may be the feature, the rest what it lights"
    )
    large: float = constant(20.0, "px: the radius from which what is seen of a rim locates a disk")
    whole: float = constant(0.97, "of the rim that is seen of whole disks")
    exact: float = constant(2.0, "of the usual residual of rims, up to which disks are whole")
    rough: float = constant(0.9, "by radius^1.5 in px: what pixels change the length by, in 1 %")
    off_centre: float = constant(1.5, "radii per length by width beyond 1: of a cut disk, in 68 %")


@dataclass(frozen=True)
class Blob:
    """One blob: centre in pixels of the window, area in px, and the rim of a disk."""

    u: float
    v: float
    area: float
    length: float = 1.0  # by width
    rim: Rim | None = None


def extract_blobs(
    image: Image, options: ExtractOptions, window: Window, rules: BlobRules = BlobRules()
) -> PointPattern:
    """Centres of the blobs in a window.

    Parameters
    ----------
    image : (H, W) uint8, uint16 or float32
    options : ExtractOptions
    window : (u0, v0, u1, v1)
        Non-empty box inside the image, u1 and v1 exclusive.
    rules : BlobRules

    Returns
    -------
    PointPattern
        Points in pixels of the whole image, each of weight 1; none where nothing is found.
    """
    blobs = find_blobs(foreground(image, options, window, rules.threshold), options, rules)
    points = np.array([(blob.u, blob.v) for blob in blobs], dtype=np.float64).reshape(-1, 2)
    return PointPattern(points + window[:2], np.ones(len(points)), deviations_of(blobs, rules))


def deviations_of(blobs: Sequence[Blob], rules: BlobRules = BlobRules()) -> Floats:
    """By how much more than others the centres of blobs (M,) may err, px: of those that are cut.

    A disk of which something is hidden, or that is merged with something, is longer than wide by as
    much as its centre is off, in radii.  So are oblique ones, but all alike, and with all of a rim.
    """
    deviations, rims = np.zeros(len(blobs)), [blob.rim for blob in blobs if blob.rim]
    residual = statistics.median_low([rim.residual for rim in rims] or [0.0])
    typical = sorted([blob.length for blob in blobs])[: (len(blobs) + 3) // 4][-1:]
    for k, blob in enumerate(blobs):
        radius, rim = math.sqrt(blob.area / math.pi), blob.rim
        if rim is None:
            longer = blob.length / typical[0] - 1 - rules.rough / radius**1.5
        elif radius < rules.large and (
            rim.coverage < rules.whole or rim.residual > rules.exact * residual
        ):
            longer = blob.length / typical[0] - 1
        else:
            continue
        deviations[k] = rules.off_centre * radius * max(longer, 0.0)
    return deviations


def find_blobs(
    scene: Foreground, options: ExtractOptions, rules: BlobRules = BlobRules()
) -> list[Blob]:
    """The blobs of a foreground.

    Parameters
    ----------
    scene : Foreground
    options : ExtractOptions
        `min_area` and `max_area` matter here: pixels above the detection level, holes filled.
    rules : BlobRules
    """
    contours = outlines(scene)
    blobs = _search(scene, contours, scene.level, options.min_area, rules, islands=True)
    largest = math.inf if options.max_area is None else options.max_area
    return [blob for blob in _outside_disks(blobs) if blob.area <= largest]


def _search(
    scene: Foreground,
    contours: Sequence[Contour],
    level: float,
    min_area: float,
    rules: BlobRules,
    *,
    islands: bool = False,
) -> list[Blob]:
    """Blobs among outer contours of what is above a level.

    With `islands`, contours in the holes of these are yet to be looked for.
    """
    blobs: list[Blob] = []
    large: list[Contour] = []
    small: list[Contour] = []
    small_areas: list[float] = []
    for contour in contours:
        # A contour of n pixels encloses less than n² of them: noise is soon done with.
        if len(contour) ** 2 < min_area or (area := filled_area(contour)) < min_area:
            continue
        if area <= rules.small_area:
            small.append(contour)
            small_areas.append(area)
        else:
            large.append(contour)
    disks = _disks(scene, large, level, rules)
    blobs += [disk for disk in disks if disk is not None]
    shapeless = [contour for contour, disk in zip(large, disks, strict=True) if disk is None]
    found = all_spots(scene, small, small_areas, level, rules.spots)
    for contour, area, spots in zip(small, small_areas, found, strict=True):
        length = length_by_width(contour) if len(spots) == 1 else 1.0
        blobs += [Blob(u, v, area / len(spots), length) for u, v in spots]
    for group in neighbours(shapeless, rules.contours):
        parts = [np.concatenate(group)] if len(group) > 1 else []
        whole = [disk for disk in _disks(scene, parts, level, rules) if disk is not None]
        blobs += whole
        if whole:
            continue
        for contour in group:
            blobs += _other(scene, contour, level, min_area, rules, islands=islands)
    return blobs


def _disks(
    scene: Foreground, contours: Sequence[Contour], level: float, rules: BlobRules
) -> list[Blob | None]:
    """Blobs whose rims are ellipses, even if part of them is hidden or out of the window."""
    rims = find_rims(scene.grey, contours, scene.level, rules.rims)
    return [
        Blob(*rim.ellipse.centre, rim.ellipse.area, rim.ellipse.length, rim)
        if rim is not None and _is_disk(scene, contour, rim, rules)
        else None
        for contour, rim in zip(contours, rims, strict=True)
    ]


def _is_disk(scene: Foreground, contour: Contour, rim: Rim, rules: BlobRules) -> bool:
    """Whether what a contour encloses is a disk with a rim."""
    if not rim.is_good(rules.rims) or is_waisted(scene.grey, rim.ellipse, rules.rims):
        return False
    if not scene.judged:
        return True
    patch, inside, _ = cut_out(scene, contour, cv2.boundingRect(contour), 0)
    return rim.contrast >= rules.spots.min_step * _brightness(scene, patch, inside)[0]


def _other(
    scene: Foreground,
    contour: Contour,
    level: float,
    min_area: float,
    rules: BlobRules,
    *,
    islands: bool,
) -> list[Blob]:
    """A large blob without an elliptical rim if it is compact, or else the blobs inside of it."""
    box = cv2.boundingRect(contour)
    patch, inside, corner = cut_out(scene, contour, box, 0)
    if scene.judged and cv2.minMaxLoc(patch, inside)[1] < scene.least_peak:
        return []
    within = [
        piece
        for piece in pieces(above(patch, level) & inside, corner)
        if tuple(cv2.boundingRect(piece)) != tuple(box)
    ]
    found = _search(scene, within, level, min_area, rules) if islands else []
    whole = [] if on_border(scene, box) else [_hull_blob(contour)]
    if not scene.judged:
        return whole + found
    cv2.drawContours(inside, within, -1, 0, cv2.FILLED, offset=(-corner[0], -corner[1]))
    typical, peak = _brightness(scene, patch, inside)
    stands_out = (
        typical >= scene.least_peak
        and cv2.contourArea(contour) >= rules.solidity * cv2.contourArea(cv2.convexHull(contour))
        and _step(scene, contour, box, rules.step) >= rules.spots.min_step * typical
    )
    inner: list[Blob] = []
    for part, higher in come_apart(scene, contour, patch, inside, level, rules.spots):
        inner += _search(scene, pieces(part, corner), higher, min_area, rules)
    higher = rules.level_ratio * level
    clear = stands_out and peak < rules.core_ratio * typical
    if not inner and not clear and higher < peak:
        brighter = pieces(above(patch, higher) & inside, corner)
        inner = _search(scene, brighter, higher, min_area, rules)
    return found + (inner or (whole if stands_out else []))


def _hull_blob(contour: Contour) -> Blob:
    """The blob of an outline, its centre that of the hull: holes may have broken the outline."""
    moments = cv2.moments(cv2.convexHull(contour))
    centre = (moments["m10"] / moments["m00"], moments["m01"] / moments["m00"])
    return Blob(*centre, filled_area(contour), length_by_width(contour))


def _brightness(
    scene: Foreground, patch: NDArray[np.float32], inside: NDArray[np.uint8]
) -> tuple[float, float]:
    """Median and maximum of what is above the detection level within a contour."""
    values = patch[(inside > 0) & (patch > scene.level)]
    if values.size == 0:
        return 0.0, 0.0
    return float(np.median(values)), float(values.max())


def _step(scene: Foreground, contour: Contour, box: Box, width: int) -> float:
    """How much brighter a blob is a little inside of its outline than a little outside."""
    patch, inside, _ = cut_out(scene, contour, box, width + 1)
    around = np.ones((2 * width + 1, 2 * width + 1), np.uint8)
    rim = inside - cv2.erode(inside, around)
    surroundings = cv2.dilate(inside, around) - inside
    return float(cv2.mean(patch, rim)[0] - cv2.mean(patch, surroundings)[0])


def _outside_disks(blobs: list[Blob]) -> list[Blob]:
    """Blobs without those inside of a larger disk: scraps of its own broken rim."""
    disks = [(blob.rim.ellipse, blob.area) for blob in blobs if blob.rim is not None]
    if not disks:
        return blobs
    rims, disk_areas = zip(*disks, strict=True)
    centres = np.array([(blob.u, blob.v) for blob in blobs], dtype=np.float64)
    areas = np.array([blob.area for blob in blobs])
    within = distances(together(list(rims)), centres) < 0
    scrap = np.any(within & (areas < np.array(disk_areas)[:, None]), axis=0)
    return [blob for blob, inner in zip(blobs, scrap.tolist(), strict=True) if not inner]
