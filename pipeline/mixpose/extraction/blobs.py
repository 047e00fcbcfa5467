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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.extraction.blob import BLOBS, Blob, deviations_of, usually_off
from mixpose.extraction.conics import Ellipses, distances, joined, none, together
from mixpose.extraction.contours import (
    Box,
    Contour,
    cut_out,
    filled_area,
    length_by_width,
    lobes,
    neighbours,
    on_border,
    outlines,
    ovals,
    pieces,
)
from mixpose.extraction.ellipse import RIMS, are_waisted, find_rims
from mixpose.extraction.options import ExtractOptions
from mixpose.extraction.shape import off_centre
from mixpose.extraction.single_spots import all_spots
from mixpose.extraction.spots import SPOTS, come_apart
from mixpose.extraction.threshold import Foreground, Window, above, foreground
from mixpose.records import Image, PointPattern


def extract_blobs(image: Image, options: ExtractOptions, window: Window) -> PointPattern:
    """Centres of the blobs in a window (u0, v0, u1, v1) of an image, not empty and inside of it.

    In pixels of the whole image, each of weight 1.
    """
    return extract_all([(image, options, window)])[0]


def extract_all(images: Sequence[tuple[Image, ExtractOptions, Window]]) -> list[PointPattern]:
    """The same of several images: it is the number of calls that takes time, not that of blobs."""
    scenes = [(foreground(image, options, window), options) for image, options, window in images]
    patterns, found = [], find_blobs(scenes)
    usual = usually_off(list(chain(*found)))
    for blobs, (_, _, window) in zip(found, images, strict=True):
        points = np.array([(blob.u, blob.v) for blob in blobs], dtype=np.float64).reshape(-1, 2)
        areas = np.array([blob.size or blob.area for blob in blobs], dtype=np.float64)
        radii = np.sqrt(areas / math.pi)
        deviations = deviations_of(blobs, usual)
        patterns.append(PointPattern(points + window[:2], np.ones(len(points)), deviations, radii))
    return patterns


@dataclass(eq=False)
class Part:
    """What is connected above a level, and what is found of it."""

    scene: Foreground
    contour: Contour
    area: float  # number of pixels that it encloses
    level: float
    limits: tuple[float, float]  # of areas; what is larger is no feature, but may carry some
    is_apart: bool = False
    # the disk that it is, or the spots where it is small
    found: list[Blob] = field(default_factory=list)
    # Itself, where it is large and no disk: taken where nothing is inside of it.
    whole: list[Blob] = field(default_factory=list)
    beside: list[Part] = field(default_factory=list)  # in its holes: taken beside it
    inner: list[list[Part]] = field(default_factory=list)  # at higher levels: taken instead of it


def find_blobs(scenes: Sequence[tuple[Foreground, ExtractOptions]]) -> list[list[Blob]]:
    """The blobs of foregrounds; limits of their area are those of the options, holes filled.

    What has no shape is taken apart at all higher levels first: then all rims are looked at
    together, and all spots.  Few are found to have none only then, with a second look.
    """
    most = [math.inf if own.max_area is None else own.max_area for _, own in scenes]
    found = [
        _parts(scene, outlines(scene), scene.level, (options.min_area, largest))
        for (scene, options), largest in zip(scenes, most, strict=True)
    ]
    parts = list(chain(*found))
    large = [part for part in parts if part.area > BLOBS.small_area]
    are_oval = ovals([part.contour for part in large])
    shapeless = [part for part, is_oval in zip(large, are_oval.sound.tolist()) if not is_oval]
    for _ in range(2):
        for part in shapeless:
            _take_apart(part, islands=True)
        rest = _without_disks([*parts, *_below(shapeless)], are_oval)
        parts, are_oval = [], none(0)
        shapeless = [part for part in rest if not part.is_apart]
    _part_lobes(list(chain(*found)))
    blobs = []
    for (scene, _), parts, largest in zip(scenes, found, most, strict=True):
        _find_spots(scene, [*parts, *_below([part for part in parts if not part.found])])
        all_of_it = _outside_disks(_blobs_of(parts))
        blobs.append([blob for blob in all_of_it if blob.area <= largest])
    return blobs


def _parts(
    scene: Foreground, contours: Sequence[Contour], level: float, limits: tuple[float, float]
) -> list[Part]:
    """Those of the contours that are large enough."""
    # A contour of n pixels encloses less than n² of them: noise is soon done with.
    some = [contour for contour in contours if len(contour) ** 2 >= limits[0]]
    areas = [filled_area(contour) for contour in some]
    both = zip(some, areas, strict=True)
    return [Part(scene, one, area, level, limits) for one, area in both if area >= limits[0]]


def _below(parts: Sequence[Part]) -> Iterator[Part]:
    """All parts that others came apart into."""
    for part in parts:
        for layer in filter(None, (part.beside, *part.inner)):
            yield from layer
            yield from _below(layer)


def _without_disks(parts: Sequence[Part], are_oval: Ellipses) -> list[Part]:
    """The large ones that are no disks; the others know their disk.

    The ovals are of the first of them.
    """
    large = [part for part in parts if part.area > BLOBS.small_area]
    if not large:
        return []
    begun = joined([are_oval, none(len(large) - len(are_oval.sound))])
    outlined = [(part.scene, part.contour) for part in large]
    for part, disk in zip(large, _disks(outlined, begun), strict=True):
        if disk and _may_be_two(disk) and len(_lobes(part)) > 1:
            continue  # an ellipse has no waist
        if disk and disk.carries:
            part.whole = [disk]
        elif disk:
            part.found = [disk]
    return [part for part in large if not part.found]


def _may_be_two(disk: Blob) -> bool:
    """Whether a disk is long, and its rim no whole ellipse."""
    is_whole = disk.rim is not None and disk.rim.coverage >= BLOBS.whole
    return disk.length >= RIMS.long and not is_whole


def _part_lobes(parts: Sequence[Part]) -> None:
    """Give large parts without a shape, of which nothing came apart, disks that touch in them."""
    several = [
        (part, some)
        for part in [*parts, *_below(parts)]
        if part.area > BLOBS.small_area and not part.found
        if not any(one.found or one.area <= BLOBS.small_area for one in _below([part]))
        if len(some := _lobes(part)) > 1
    ]
    outlined = [(part.scene, one) for part, some in several for one in some]
    disks = iter(_disks(outlined, none(len(outlined))))
    for part, some in several:
        part.found = [disk for _, disk in zip(some, disks) if disk]


def _lobes(part: Part) -> list[Contour]:
    # around a disk of half the area, but for its waist
    return lobes(part.contour, BLOBS.waist, 4 * math.sqrt(BLOBS.small_area / 2 / math.pi))


def _find_spots(scene: Foreground, parts: Sequence[Part]) -> None:
    small = [part for part in parts if part.area <= BLOBS.small_area]
    contours = [part.contour for part in small]
    areas, levels = np.array([(part.area, part.level) for part in small]).reshape(-1, 2).T
    found = all_spots(scene, contours, areas, levels)
    for part, spots in zip(small, found, strict=True):
        shape = length_by_width(part.contour) if len(spots) == 1 else (1.0, 0.0)
        part.found = [
            Blob(one.u, one.v, part.area / len(spots), *shape, off=one.off, size=one.size)
            for one in spots
        ]


def _blobs_of(parts: Sequence[Part]) -> list[Blob]:
    """What is found of parts that are beside each other, and of what they came apart into."""
    blobs = [blob for part in parts for blob in part.found]
    shapeless = [part for part in parts if part.area > BLOBS.small_area and not part.found]
    for group in neighbours([part.contour for part in shapeless]):
        some = [shapeless[k] for k in group]
        several = [(some[0].scene, np.concatenate([part.contour for part in some]))]
        several = several if len(some) > 1 else []
        rims = [disk for disk in _disks(several, none(len(several))) if disk]
        blobs += rims
        for part in some if not rims else []:
            inner = [blob for layer in part.inner for blob in _blobs_of(layer)]
            # one alone is a highlight
            some_of = 2 if any(blob.carries for blob in part.whole) else 1
            own = inner if len(inner) >= some_of else part.whole
            blobs += _blobs_of(part.beside) + own
    return blobs


def _disks(outlined: Sequence[tuple[Foreground, Contour]], are_oval: Ellipses) -> list[Blob | None]:
    """Blobs whose rims are ellipses, even if part of them is hidden or out of the window."""
    disks: list[Blob | None] = [None] * len(outlined)
    if not outlined:
        return disks
    of_all, contours = zip(*outlined, strict=True)
    scenes = list({id(scene): scene for scene in of_all}.values())
    numbers = {id(scene): number for number, scene in enumerate(scenes)}
    which = np.array([numbers[id(scene)] for scene in of_all])
    levels, greys = np.array([scene.level for scene in scenes]), [scene.grey for scene in scenes]
    rims = find_rims(greys, which, contours, levels[which], are_oval)
    some = np.flatnonzero(rims.are_good())
    own = rims.ellipses.select(some), rims.contrast[some]
    some = some[~are_waisted(greys, which[some], *own)]
    contrasts = rims.contrast[some]
    # mostly the brightest row of all tells, or pixel, which is quicker than the median
    doubted = contrasts < np.array([_usual_step(scene) for scene in scenes])[which[some]]
    carry = np.zeros(len(some), bool)
    for row, k in [(row, some[row]) for row in np.flatnonzero(doubted).tolist()]:
        stands_out, carry[row] = _seen_on(of_all[k], contours[k], float(contrasts[row]))
        doubted[row] = not stands_out
    some, carry = some[~doubted], carry[~doubted]
    ellipses = rims.ellipses.select(some)
    # a larger one is told by its rim
    told = np.flatnonzero(ellipses.half_axes.prod(axis=1) < BLOBS.large**2)
    beside = SPOTS.margin, SPOTS.centroid, BLOBS.beside
    off = off_centre(scenes, which[some[told]], ellipses.select(told), *beside)
    by_number = dict(zip(told.tolist(), off.tolist(), strict=True))
    areas, lengths = (part.tolist() for part in (ellipses.area, ellipses.length))
    for k, (place, rim) in enumerate(zip(some.tolist(), rims.each(some), strict=True)):
        turn = rim.angle + (0.0 if rim.half_axis > rim.other else math.pi / 2)
        shown = by_number.get(k), bool(carry[k])
        disks[place] = Blob(rim.u, rim.v, areas[k], lengths[k], turn, rim, *shown)
    return disks


def _usual_step(scene: Foreground) -> float:
    """The step at a rim with which anything in a scene is a disk."""
    return SPOTS.min_step * (scene.highest - scene.zero) if scene.judged else -math.inf


def _seen_on(scene: Foreground, contour: Contour, contrast: float) -> tuple[bool, bool]:
    """Whether what a contour with a rim encloses is a disk, by the step there, and carries more."""
    least = SPOTS.min_step
    u, v, width, height = box = cv2.boundingRect(contour)
    highest = cv2.minMaxLoc(scene.grey[v : v + height, u : u + width])[1]
    if contrast >= least * (highest - scene.zero):
        return True, False
    patch, inside, _ = cut_out(scene, contour, box, 0)
    typical, peak = _brightness(scene, patch, inside), cv2.minMaxLoc(patch, inside)[1]
    return contrast >= least * typical, peak >= BLOBS.core_ratio * typical


def _take_apart(part: Part, *, islands: bool = False) -> None:
    """Find what a large part without an elliptical rim is: compact, or others inside of it.

    With `islands`, what is in its holes is yet to be looked for.
    """
    part.is_apart, scene, contour, level = True, part.scene, part.contour, part.level
    box = cv2.boundingRect(contour)
    patch, inside, corner = cut_out(scene, contour, box, 0)
    if scene.judged and cv2.minMaxLoc(patch, inside)[1] < scene.least_peak:
        return
    # What is above the level becomes 2 where it is connected with the contour, 1 are islands.
    inside &= above(patch, level)
    first = contour[0, 0] - corner
    cv2.floodFill(inside, None, first.tolist(), 2, flags=8)
    if islands:
        found = pieces((inside == 1).view(np.uint8), corner)
        part.beside = _parts(scene, found, level, part.limits)
    inside >>= 1
    peak, typical = cv2.minMaxLoc(patch, inside)[1], 0.0
    hull = cv2.convexHull(contour)
    if scene.judged and cv2.contourArea(contour) >= BLOBS.solidity * cv2.contourArea(hull):
        typical = _brightness(scene, patch, inside)
    stands_out = (
        part.area <= part.limits[1]
        and 0 < typical >= scene.least_peak
        and _step(scene, contour, box, BLOBS.step) >= SPOTS.min_step * typical
    )
    if (stands_out or not scene.judged) and not on_border(scene, box):
        part.whole = part.whole or [_hull_blob(contour)]
    if scene.judged:
        apart = come_apart(scene, contour, patch, inside, level)
        has_core = peak >= BLOBS.core_ratio * typical
        # what is brighter than half of a core is not what it lights
        half = BLOBS.core_ratio / 2 * typical if has_core else 0.0
        higher = max(BLOBS.level_ratio * level, half)
        clear = stands_out and not has_core
        if not apart and not clear and higher < peak:
            apart = [(above(patch, higher) & inside, higher)]
        part.inner = [_parts(scene, pieces(mask, corner), lvl, part.limits) for mask, lvl in apart]
    for one in [one for layer in (part.beside, *part.inner) for one in layer]:
        if one.area > BLOBS.small_area:
            _take_apart(one)


def _hull_blob(contour: Contour) -> Blob:
    """The blob of an outline, its centre that of the hull: holes may have broken the outline."""
    moments = cv2.moments(cv2.convexHull(contour))
    centre = (moments["m10"] / moments["m00"], moments["m01"] / moments["m00"])
    return Blob(*centre, filled_area(contour), *length_by_width(contour))


def _brightness(scene: Foreground, patch: NDArray[np.float32], inside: NDArray[np.uint8]) -> float:
    """Median of what is above the detection level within a contour."""
    values = patch[(inside > 0) & (patch > scene.level)]
    middle = [(values.size - 1) // 2, values.size // 2]
    # as `np.median`, in a tenth of its time
    return float(np.partition(values, middle)[middle].sum() / 2) if values.size else 0.0


def _step(scene: Foreground, contour: Contour, box: Box, width: int) -> float:
    """How much brighter a blob is a little inside of its outline than a little outside."""
    patch, inside, _ = cut_out(scene, contour, box, width + 1)
    around = np.ones((2 * width + 1, 2 * width + 1), np.uint8)
    rim = inside - cv2.erode(inside, around)
    surroundings = cv2.dilate(inside, around) - inside
    return float(cv2.mean(patch, rim)[0] - cv2.mean(patch, surroundings)[0])


def _outside_disks(blobs: list[Blob]) -> list[Blob]:
    """Blobs without those inside of a larger disk: scraps of its own broken rim."""
    rims = [blob.rim[:5] for blob in blobs if blob.rim is not None]
    if not rims:
        return blobs
    centres, areas = np.array([blob[:2] for blob in blobs]), np.array([blob[2] for blob in blobs])
    disks = together(rims)
    # few have another's centre in reach
    apart, _ = cKDTree(centres).query(disks.centre, k=2)
    near = np.flatnonzero(apart[:, 1] <= disks.half_axes.max(axis=1))
    within = distances(disks.select(near), centres) < 0
    scrap = np.any(within & (areas < disks.area[near, None]), axis=0)
    return [blob for blob, inner in zip(blobs, scrap.tolist(), strict=True) if not inner]
