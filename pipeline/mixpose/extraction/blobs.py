"""Extract bright or dark spots and disks: one point per blob, to parts of a pixel.

Small blobs are located by the centroid of their grey values (`spots`), large ones by an ellipse
through their rim (`ellipse`), even if it is broken or partly hidden, and compact regions of
another shape by their outline.  A blob that the border of the window cuts is left out, unless
enough of its rim is visible: its centre is unknown, and a wrong point does more harm to the density
than a missing one.

With a grey level (or "otsu") every region above it is a blob.  With the other thresholds a blob
has to stand out: a region above the detection level without a shape, such as a lit floor, is
searched again at higher levels, so that blobs on it are found too.
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

from mixpose.extraction.blob import BLOBS, Blob, deviations_of, usual_error
from mixpose.extraction.conics import Ellipses, concatenated, distances, ellipses_of, no_ellipses
from mixpose.extraction.contours import (
    Box,
    Contour,
    cut_out,
    filled_area,
    is_on_border,
    length_by_width,
    lobes,
    moment_ellipses,
    outer_contours,
    outlines,
    touching_groups,
)
from mixpose.extraction.ellipse import RIMS, are_waisted, find_rims
from mixpose.extraction.options import ExtractOptions
from mixpose.extraction.shape import centre_errors
from mixpose.extraction.spots import SPOTS, find_spots_together, split_long
from mixpose.extraction.threshold import Foreground, Window, above, foreground
from mixpose.records import Image, PointPattern


def extract_blobs(image: Image, options: ExtractOptions, window: Window) -> PointPattern:
    """Return the centres of blobs in a window (u0, v0, u1, v1), not empty and inside the image.

    They are in pixels of the whole image, with a weight of 1 each.
    """
    return extract_all([(image, options, window)])[0]


def extract_all(images: Sequence[tuple[Image, ExtractOptions, Window]]) -> list[PointPattern]:
    """Extract the blobs of several images in fewer calls, whose number takes most of the time."""
    scenes = [(foreground(image, options, window), options) for image, options, window in images]
    patterns, blobs_of_images = [], find_blobs(scenes)
    typical_error = usual_error(list(chain(*blobs_of_images)))
    for blobs, (_, _, window) in zip(blobs_of_images, images, strict=True):
        points = np.array([(blob.u, blob.v) for blob in blobs], dtype=np.float64).reshape(-1, 2)
        areas = np.array([blob.size or blob.area for blob in blobs], dtype=np.float64)
        radii = np.sqrt(areas / math.pi)
        deviations = deviations_of(blobs, typical_error)
        patterns.append(PointPattern(points + window[:2], np.ones(len(points)), deviations, radii))
    return patterns


@dataclass(eq=False)
class Region:
    """A connected region above a level, and the blobs found in it."""

    scene: Foreground
    contour: Contour
    area: float  # number of pixels that it encloses
    level: float
    limits: tuple[float, float]  # of areas; a larger region is no feature, but may carry some
    is_split: bool = False
    # its disk, or its spots if it is small
    blobs: list[Blob] = field(default_factory=list)
    # the region as one blob, used where no blobs are found inside of it
    fallback: list[Blob] = field(default_factory=list)
    islands: list[Region] = field(default_factory=list)  # in its holes; their blobs are added
    higher: list[list[Region]] = field(default_factory=list)  # at higher levels, which replace it


def find_blobs(scenes: Sequence[tuple[Foreground, ExtractOptions]]) -> list[list[Blob]]:
    """Find the blobs of foregrounds within the limits of area of their options, holes filled.

    Regions without a shape are split at all higher levels first, so that all rims are fitted
    together, and all spots.  A second pass splits the few whose rims then prove to be no ellipses.
    """
    largest = [math.inf if options.max_area is None else options.max_area for _, options in scenes]
    by_scene = [
        _regions(scene, outlines(scene), scene.level, (options.min_area, max_area))
        for (scene, options), max_area in zip(scenes, largest, strict=True)
    ]
    regions = list(chain(*by_scene))
    large = [region for region in regions if region.area > BLOBS.small_area]
    ellipses = moment_ellipses([region.contour for region in large])
    shapeless = [large[k] for k in np.flatnonzero(~ellipses.is_ellipse).tolist()]
    for _ in range(2):
        for region in shapeless:
            _split(region, with_islands=True)
        others = _find_disks([*regions, *_descendants(shapeless)], ellipses)
        regions, ellipses = [], no_ellipses(0)
        shapeless = [region for region in others if not region.is_split]
    _split_lobes(list(chain(*by_scene)))
    blobs = []
    for (scene, _), regions, max_area in zip(scenes, by_scene, largest, strict=True):
        without_disk = [region for region in regions if not region.blobs]
        _find_spots(scene, [*regions, *_descendants(without_disk)])
        kept = _without_scraps(_blobs_of(regions))
        blobs.append([blob for blob in kept if blob.area <= max_area])
    return blobs


def _regions(
    scene: Foreground, contours: Sequence[Contour], level: float, limits: tuple[float, float]
) -> list[Region]:
    """Make regions of the contours that are large enough."""
    # A contour of n pixels encloses less than n² of them, which excludes noise quickly.
    selected = [contour for contour in contours if len(contour) ** 2 >= limits[0]]
    areas = [filled_area(contour) for contour in selected]
    pairs = [(c, area) for c, area in zip(selected, areas, strict=True) if area >= limits[0]]
    return [Region(scene, contour, area, level, limits) for contour, area in pairs]


def _descendants(regions: Sequence[Region]) -> Iterator[Region]:
    """Yield all regions that others were split into."""
    for region in regions:
        for layer in filter(None, (region.islands, *region.higher)):
            yield from layer
            yield from _descendants(layer)


def _find_disks(regions: Sequence[Region], ellipses: Ellipses) -> list[Region]:
    """Store the disks of large regions; return those without one, or with a core on their disk.

    `ellipses` are the start ellipses of the first of them.
    """
    large = [region for region in regions if region.area > BLOBS.small_area]
    if not large:
        return []
    starts = concatenated([ellipses, no_ellipses(len(large) - len(ellipses.is_ellipse))])
    outlined = [(region.scene, region.contour) for region in large]
    for region, disk in zip(large, _disks(outlined, starts), strict=True):
        if disk and _is_maybe_pair(disk) and len(_lobes(region)) > 1:
            continue  # an ellipse has no waist
        if disk and disk.has_core:
            region.fallback = [disk]
        elif disk:
            region.blobs = [disk]
    return [region for region in large if not region.blobs]


def _is_maybe_pair(disk: Blob) -> bool:
    """Test whether a disk is long and its rim no whole ellipse, as that of two spots is."""
    is_whole = disk.rim is not None and disk.rim.coverage >= BLOBS.whole
    return disk.length >= RIMS.long and not is_whole


def _split_lobes(regions: Sequence[Region]) -> None:
    """Find touching disks in large regions without a shape that no level has split."""
    lobed = [
        (region, parts)
        for region in [*regions, *_descendants(regions)]
        if region.area > BLOBS.small_area and not region.blobs
        if not any(part.blobs or part.area <= BLOBS.small_area for part in _descendants([region]))
        if len(parts := _lobes(region)) > 1
    ]
    outlined = [(region.scene, part) for region, parts in lobed for part in parts]
    disks = iter(_disks(outlined, no_ellipses(len(outlined))))
    for region, parts in lobed:
        region.blobs = [disk for _, disk in zip(parts, disks) if disk]


def _lobes(region: Region) -> list[Contour]:
    # least way along the outline: around a disk of half the area, but for its waist
    return lobes(region.contour, BLOBS.waist, 4 * math.sqrt(BLOBS.small_area / 2 / math.pi))


def _find_spots(scene: Foreground, regions: Sequence[Region]) -> None:
    small = [region for region in regions if region.area <= BLOBS.small_area]
    contours = [region.contour for region in small]
    areas, levels = np.array([(region.area, region.level) for region in small]).reshape(-1, 2).T
    found_spots = find_spots_together(scene, contours, areas, levels)
    for region, spots in zip(small, found_spots, strict=True):
        region.blobs = spots


def _blobs_of(regions: Sequence[Region]) -> list[Blob]:
    """Collect the blobs of regions of one level, and of those that they were split into."""
    blobs = [blob for region in regions for blob in region.blobs]
    shapeless = [part for part in regions if part.area > BLOBS.small_area and not part.blobs]
    for group in touching_groups([region.contour for region in shapeless]):
        members = [shapeless[k] for k in group]
        merged = [(members[0].scene, np.concatenate([region.contour for region in members]))]
        merged = merged if len(members) > 1 else []
        rims = [disk for disk in _disks(merged, no_ellipses(len(merged))) if disk]
        blobs += rims
        for region in members if not rims else []:
            inner_blobs = [blob for layer in region.higher for blob in _blobs_of(layer)]
            # a single blob is a highlight on the disk
            min_count = 2 if any(blob.has_core for blob in region.fallback) else 1
            chosen = inner_blobs if len(inner_blobs) >= min_count else region.fallback
            blobs += _blobs_of(region.islands) + chosen
    return blobs


def _disks(outlined: Sequence[tuple[Foreground, Contour]], starts: Ellipses) -> list[Blob | None]:
    """Find disks, whose rims are ellipses, even if a part is hidden or out of the window."""
    disks: list[Blob | None] = [None] * len(outlined)
    if not outlined:
        return disks
    scene_of, contours = zip(*outlined, strict=True)
    scenes = list({id(scene): scene for scene in scene_of}.values())
    numbers = {id(scene): number for number, scene in enumerate(scenes)}
    which = np.array([numbers[id(scene)] for scene in scene_of])
    levels, greys = np.array([scene.level for scene in scenes]), [scene.grey for scene in scenes]
    rims = find_rims(greys, which, contours, levels[which], starts)
    selected = np.flatnonzero(rims.are_good())
    good = rims.ellipses.select(selected), rims.contrast[selected]
    selected = selected[~are_waisted(greys, which[selected], *good)]
    contrasts = rims.contrast[selected]
    # mostly the brightest row or pixel decides, which is quicker than the median
    is_doubtful = contrasts < np.array([_clear_step(scene) for scene in scenes])[which[selected]]
    has_core = np.zeros(len(selected), bool)
    for row, k in [(row, selected[row]) for row in np.flatnonzero(is_doubtful).tolist()]:
        stands_out, has_core[row] = _check_disk(scene_of[k], contours[k], float(contrasts[row]))
        is_doubtful[row] = not stands_out
    selected, has_core = selected[~is_doubtful], has_core[~is_doubtful]
    ellipses = rims.ellipses.select(selected)
    # larger disks are located by their rim alone
    small = np.flatnonzero(ellipses.half_axes.prod(axis=1) < BLOBS.large**2)
    reach = SPOTS.margin, SPOTS.centroid, BLOBS.beside
    errors = centre_errors(scenes, which[selected[small]], ellipses.select(small), *reach)
    by_number = dict(zip(small.tolist(), errors.tolist(), strict=True))
    areas, lengths = (part.tolist() for part in (ellipses.area, ellipses.length))
    for k, (index, rim) in enumerate(zip(selected.tolist(), rims.to_list(selected), strict=True)):
        direction = rim.angle + (0.0 if rim.half_axis > rim.other else math.pi / 2)
        extras = by_number.get(k), bool(has_core[k])
        disks[index] = Blob(rim.u, rim.v, areas[k], lengths[k], direction, rim, *extras)
    return disks


def _clear_step(scene: Foreground) -> float:
    """Return the step at a rim from which any ellipse in a scene is a disk."""
    return SPOTS.min_step * (scene.highest - scene.zero) if scene.is_selective else -math.inf


def _check_disk(scene: Foreground, contour: Contour, contrast: float) -> tuple[bool, bool]:
    """Test whether an ellipse is a disk, by the step at its rim, and whether it has a core."""
    min_step = SPOTS.min_step
    u, v, width, height = box = cv2.boundingRect(contour)
    highest = cv2.minMaxLoc(scene.grey[v : v + height, u : u + width])[1]
    if contrast >= min_step * (highest - scene.zero):
        return True, False
    patch, inside, _ = cut_out(scene, contour, box, 0)
    typical, peak = _brightness(scene, patch, inside), cv2.minMaxLoc(patch, inside)[1]
    return contrast >= min_step * typical, peak >= BLOBS.core_ratio * typical


def _split(region: Region, *, with_islands: bool = False) -> None:
    """Split a large region without an elliptical rim at higher levels, or keep it as a blob.

    `with_islands` also makes regions of the islands in its holes.
    """
    region.is_split, scene, contour, level = True, region.scene, region.contour, region.level
    box = cv2.boundingRect(contour)
    patch, inside, corner = cut_out(scene, contour, box, 0)
    if scene.is_selective and cv2.minMaxLoc(patch, inside)[1] < scene.least_peak:
        return
    # Pixels above the level become 2 where they are connected with the contour; islands stay 1.
    inside &= above(patch, level)
    first = contour[0, 0] - corner
    cv2.floodFill(inside, None, first.tolist(), 2, flags=8)
    if with_islands:
        island_contours = outer_contours((inside == 1).view(np.uint8), corner)
        region.islands = _regions(scene, island_contours, level, region.limits)
    inside >>= 1
    peak, typical = cv2.minMaxLoc(patch, inside)[1], 0.0
    hull = cv2.convexHull(contour)
    if scene.is_selective and cv2.contourArea(contour) >= BLOBS.solidity * cv2.contourArea(hull):
        typical = _brightness(scene, patch, inside)
    stands_out = (
        region.area <= region.limits[1]
        and 0 < typical >= scene.least_peak
        and _step(scene, contour, box, BLOBS.step) >= SPOTS.min_step * typical
    )
    if (stands_out or not scene.is_selective) and not is_on_border(scene, box):
        region.fallback = region.fallback or [_hull_blob(contour)]
    if scene.is_selective:
        parts = split_long(scene, contour, patch, inside, level)
        has_core = peak >= BLOBS.core_ratio * typical
        # pixels brighter than half of a core are not just lit by it
        floor = BLOBS.core_ratio / 2 * typical if has_core else 0.0
        higher = max(BLOBS.level_ratio * level, floor)
        is_clear = stands_out and not has_core
        if not parts and not is_clear and higher < peak:
            parts = [(above(patch, higher) & inside, higher)]
        contours = [(outer_contours(mask, corner), part_level) for mask, part_level in parts]
        region.higher = [_regions(scene, *layer, region.limits) for layer in contours]
    for inner in chain(region.islands, *region.higher):
        if inner.area > BLOBS.small_area:
            _split(inner)


def _hull_blob(contour: Contour) -> Blob:
    """Make a blob of an outline, with the centre of its hull, as holes may break the outline."""
    moments = cv2.moments(cv2.convexHull(contour))
    centre = (moments["m10"] / moments["m00"], moments["m01"] / moments["m00"])
    return Blob(*centre, filled_area(contour), *length_by_width(contour))


def _brightness(scene: Foreground, patch: NDArray[np.float32], inside: NDArray[np.uint8]) -> float:
    """Return the median of the signal above the detection level within a contour."""
    values = patch[(inside > 0) & (patch > scene.level)]
    middle = [(values.size - 1) // 2, values.size // 2]
    # as `np.median`, in a tenth of its time
    return float(np.partition(values, middle)[middle].sum() / 2) if values.size else 0.0


def _step(scene: Foreground, contour: Contour, box: Box, width: int) -> float:
    """Return how much brighter a blob is just inside its outline than just outside."""
    patch, inside, _ = cut_out(scene, contour, box, width + 1)
    square = np.ones((2 * width + 1, 2 * width + 1), np.uint8)
    rim = inside - cv2.erode(inside, square)
    surroundings = cv2.dilate(inside, square) - inside
    return float(cv2.mean(patch, rim)[0] - cv2.mean(patch, surroundings)[0])


def _without_scraps(blobs: list[Blob]) -> list[Blob]:
    """Remove blobs inside of a larger disk, which are scraps of its broken rim."""
    rims = [blob.rim[:5] for blob in blobs if blob.rim is not None]
    if not rims:
        return blobs
    centres, areas = np.array([blob[:2] for blob in blobs]), np.array([blob[2] for blob in blobs])
    disks = ellipses_of(rims)
    # few disks have another centre in reach
    neighbour_distances, _ = cKDTree(centres).query(disks.centre, k=2)
    near = np.flatnonzero(neighbour_distances[:, 1] <= disks.half_axes.max(axis=1))
    is_inside = distances(disks.select(near), centres) < 0
    is_scrap = np.any(is_inside & (areas < disks.area[near, None]), axis=0)
    return [blob for blob, is_inner in zip(blobs, is_scrap.tolist(), strict=True) if not is_inner]
