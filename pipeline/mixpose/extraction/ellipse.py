"""Centres of large features: an ellipse through the edge, wherever there is an edge.

A disk stays an ellipse when part of its rim is hidden, when it has a hole, or when its light
is uneven: so the rim is looked for where it is, and what does not lie on the ellipse is left out.
All features of an image are looked at together, as arrays with one row for each: it is the number
of calls that takes time, not that of pixels.

`skimage.measure` beside it: `EllipseModel` fits as well, but ten times slower than
`cv2.fitEllipseAMS`, the one here; `ransac` triples the error where a
straight edge cuts a disk (0.17 to 0.05 px).  `find_contours` has one level for all of the rim: a
disk half in shadow is off by 0.32 px instead of 0.01, and disks behind cables or broken by their
hole are not found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.constants import constant
from mixpose.extraction.background import Grey
from mixpose.extraction.conics import (
    FEWEST,
    Ellipses,
    distances,
    fit_conics,
    turns,
)
from mixpose.extraction.contours import Contour
from mixpose.extraction.sampling import sample_each
from mixpose.records import Floats, Indices, Mask, Singles

# Directions in which the rim is looked for.
DIRECTIONS = 72

# Times that an ellipse is fitted again to the points near it.
REFITS = 3

_ANGLES = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
_CIRCLE = np.array([np.cos(_ANGLES), np.sin(_ANGLES)])


@dataclass(frozen=True)
class EllipseRules:
    """When a rim is an ellipse."""

    reach: float = constant(0.15, "of the minor half-axis, how far a rim is looked for")
    min_reach: int = constant(3, "px, the least: an edge is as wide as optics blur it")
    max_reach: int = constant(6, "px, the most: beyond it are neighbours")
    coverage: float = constant(0.6, "of the directions, that have an edge on the ellipse")
    tolerance: float = constant(
        0.5, "px within which an edge is on the ellipse at least: pixels and print allow for it"
    )
    spread: float = constant(0.6, "px, median distance of corners of the hull from their ellipse")
    hopeless: float = constant(
        0.15, "of the minor half-axis: points farther from it on average are on no ellipse"
    )
    oblique: float = constant(0.15, "width by length: a disk seen at less than 9° is not located")
    long: float = constant(1.35, "length by width from which an ellipse may be two spots")
    long_coverage: float = constant(
        0.8, "of the directions, then: the hull of two disks that touch has 0.6"
    )
    waist: float = constant(
        0.7, "of the minor half-axis, where the waist of two spots is looked at"
    )
    dip: float = constant(0.1, "of the height, that the middle is dimmer than either half")
    ridge: float = constant(0.03, "of the height, that it is brighter than beside: two, not a ring")
    lit: float = constant(
        0.3,
        "of the step at the rim, by which it may be brighter outside than at most of the rim: "
        "beside a neighbour half the height is no edge, and the centre 0.3 px off",
    )
    dark: float = constant(0.7, "of the edges, that are enough without those")
    hidden_arcs: int = constant(8, "arcs, of which three that follow each other may be hidden")


RIMS = EllipseRules()


class Rim(NamedTuple):
    """An ellipse found in an image, in px, as `conics.together` takes it."""

    u: float
    v: float
    half_axis: float  # in the direction of the angle, which is in radians
    other: float
    angle: float
    coverage: float  # share of the directions in which an edge lies on the ellipse
    residual: float  # RMS distance in px of these edges from it


@dataclass(frozen=True)
class Rims:
    """Those of B features; not sound where nothing is like an ellipse."""

    ellipses: Ellipses
    coverage: Floats  # (B,) as of a `Rim`
    residual: Floats  # (B,) likewise
    contrast: Floats  # (B,) median step of the signal across the edges
    moved: Floats  # (B,) px, the largest distance of an edge from where it was looked for

    def replaced(self, rows: Indices, others: Rims) -> Rims:
        """With others in some rows."""
        numbers = [one.copy() for one in (self.coverage, self.residual, self.contrast, self.moved)]
        new = others.coverage, others.residual, others.contrast, others.moved
        for own, values in zip(numbers, new, strict=True):
            own[rows] = values
        return Rims(self.ellipses.replaced(rows, others.ellipses), *numbers)

    def are_good(self) -> Mask:
        """Which (B,) are ellipses."""
        minor, major = np.sort(self.ellipses.half_axes, axis=1).T
        least = np.where(major < RIMS.long * minor, RIMS.coverage, RIMS.long_coverage)
        near = self.residual <= tolerance(minor) / 2
        return np.asarray(self.ellipses.sound & (self.coverage >= least) & near)

    def each(self, chosen: Indices) -> list[Rim]:
        """Some of them, one by one."""
        ellipses = self.ellipses
        parts = ellipses.centre, ellipses.half_axes, ellipses.angle, self.coverage, self.residual
        table = np.column_stack([part[chosen] for part in parts])
        return [Rim(*row) for row in table.tolist()]


def find_rims(
    signals: Sequence[Grey],
    which: Indices,
    outlines: Sequence[Contour],
    contrasts: Floats,
    ovals: Ellipses,
) -> Rims:
    """The elliptical rims of bright features, by their outlines in pixels of signals (H, W).

    `which` (B,) is the signal of each; an edge is a step of at least `contrasts` (B,).  Where
    outlines are sound `ovals` (B), rims are looked for at these.
    """
    ellipses = _begun(outlines, ovals)
    rims, again = Rims(ellipses, *np.zeros((4, len(outlines)))), ellipses.sound
    # Roughly first, then from the better ellipse, which has all of a soft or broken rim in reach.
    for least in (RIMS.coverage / 2, RIMS.coverage):
        found = np.flatnonzero(again)
        if not found.size:
            break
        at = signals, which[found], rims.ellipses.select(found), contrasts[found]
        rims = rims.replaced(found, _rims_near(*at, least))
        # most are near enough at once
        is_near = rims.are_good() & (rims.moved <= RIMS.min_reach / 2)
        again = rims.ellipses.sound & ~is_near
    return rims


def _begun(outlines: Sequence[Contour], ovals: Ellipses) -> Ellipses:
    """The ellipses near which rims are looked for: ovals, else those through hulls."""
    minor, major = np.sort(ovals.half_axes, axis=1).T
    rest = np.flatnonzero(~(ovals.sound & (minor >= RIMS.oblique * major)))
    if not rest.size:
        return ovals
    # Digital straight lines, such as the chord that an occlusion leaves, have few corners in a
    # convex hull, arcs have many: the corners alone favour the true rim.
    hulls = [cv2.convexHull(outlines[k])[:, 0] for k in rest.tolist()]
    return ovals.replaced(rest, fit_ellipses(*_side_by_side(hulls))[0])


def _side_by_side(points: Sequence[Contour]) -> tuple[Floats, Mask]:
    """Lists of points as one array (B, n, 2), and which of its places (B, n) are filled."""
    counts = np.array([len(one) for one in points])
    there = np.arange(counts.max()) < counts[:, None]
    together = np.zeros((*there.shape, 2))
    together[there] = np.concatenate(points)
    return together, there


def _rims_near(
    signals: Sequence[Grey], which: Indices, others: Ellipses, contrasts: Floats, least: float
) -> Rims:
    """Rims through the edges near other ellipses.

    Those that have edges in less than a share `least` of the directions are not fitted.
    """
    edges, found, steps, lows, off = _edges(signals, which, others, contrasts)
    found &= (found.sum(axis=1) >= least * DIRECTIONS)[:, None]
    light = lows - _medians(lows, found)[:, None]
    dark = found & (light <= RIMS.lit * _medians(steps, found)[:, None])
    enough = dark.sum(axis=1) >= RIMS.dark * found.sum(axis=1)
    better, distance = fit_ellipses(edges, np.where(enough[:, None], dark, found))
    within = tolerance(better.half_axes.min(axis=1))
    on_rim = found & (distance <= within[:, None]) & better.sound[:, None]
    count = on_rim.sum(axis=1)
    squares = np.where(on_rim, distance, 0.0) ** 2
    residual = np.sqrt(squares.sum(axis=1) / np.maximum(count, 1))
    better = better._replace(sound=better.sound & (count > 0))
    moved = np.where(on_rim, np.abs(off), 0.0).max(axis=1)
    return Rims(better, count / DIRECTIONS, residual, _medians(steps, on_rim), moved)


def are_waisted(
    signals: Sequence[Grey], which: Indices, ellipses: Ellipses, contrasts: Floats
) -> Mask:
    """Which ellipses (B,) are long and two spots that touch: dim in the middle, but not hollow.

    They are as high as the signal steps at the rim by `contrasts` (B,), or higher inside.
    """
    axes, waisted = ellipses.half_axes, np.zeros(len(which), dtype=np.bool_)
    own = np.flatnonzero(axes.max(axis=1) >= RIMS.long * axes.min(axis=1))
    if not own.size:
        return waisted
    directions = turns(ellipses.angle[own]).swapaxes(1, 2) * axes[own, :, None]
    order = np.argsort(-axes[own], axis=1, kind="stable")[..., None]
    along = np.array([[0.0, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.0, RIMS.waist], [0.0, -RIMS.waist]])
    places = ellipses.centre[own, None] + along @ np.take_along_axis(directions, order, axis=1)
    lines = places.transpose(2, 0, 1), np.zeros((2, *places.shape[:2])), np.zeros(1)
    middle, *ends = sample_each(signals, which[own], *lines)[0].T
    (low, high), (left, right) = np.sort(ends[:2], axis=0), np.sort(ends[2:], axis=0)
    height = np.maximum(high - left, contrasts[own])
    waisted[own] = (low - middle > RIMS.dip * height) & (middle - right > RIMS.ridge * height)
    return waisted


def tolerance(minor: Any) -> Any:
    """Distance in px within which an edge counts as on an ellipse of this minor half-axis."""
    # A tenth of small ones, whose shape pixels blur; of large ones what print and lens bend.
    return np.maximum(RIMS.tolerance, np.maximum(np.minimum(0.1 * minor, 1.0), 0.02 * minor))


def fit_ellipses(points: Floats, there: Mask) -> tuple[Ellipses, Floats]:
    """Ellipses through those of points (B, n, 2), in order along each, that are there (B, n).

    Some may lie elsewhere.  Sound but for less than six points, or where they are on no ellipse.
    With the distances (B, n) of points from them.
    """
    best = fit_conics(points, there, RIMS.oblique)
    distance, spread = _spreads(best, points, there)
    used = there.copy()
    doubtful = np.flatnonzero(~(spread < RIMS.spread) & (there.sum(axis=1) >= FEWEST))
    if doubtful.size:
        tried, better = _without_an_arc(points[doubtful], there[doubtful], spread[doubtful])
        best = best.replaced(doubtful[better], tried)
        used[doubtful[better]] = False
        distance, spread = _spreads(best, points, there)
    hopeless = spread > RIMS.spread + RIMS.hopeless * best.half_axes.min(axis=1)
    best = best._replace(sound=best.sound & ~hopeless)
    rows = np.flatnonzero(best.sound)
    for _ in range(REFITS):
        # those whose points stay the same are done
        near = there[rows] & (distance[rows] <= np.maximum(RIMS.spread, 3 * spread[rows])[:, None])
        changed = (near != used[rows]).any(axis=1)
        rows, near = rows[changed], near[changed]
        if not rows.size:
            break
        refitted = fit_conics(points[rows], near, RIMS.oblique)
        best, used[rows] = best.replaced(rows, refitted), near
        distance[rows], spread[rows] = _spreads(refitted, points[rows], there[rows])
        rows = rows[refitted.sound]
    return best, distance


def _spreads(ellipses: Ellipses, points: Floats, there: Mask) -> tuple[Floats, Floats]:
    """Distances (B, n) of points from ellipses, and their medians (B,); infinite without one."""
    distance = np.abs(distances(ellipses, points))
    return distance, np.where(ellipses.sound, _medians(distance, there), np.inf)


def _without_an_arc(points: Floats, there: Mask, spread: Floats) -> tuple[Ellipses, Mask]:
    """Ellipses through all points but those of an arc that may be hidden.

    Of several arcs that is the first that leaves an ellipse as near to the points as asked for,
    else the nearest.  Those nearer to the points (B, n, 2) than what is there already, and which.
    """
    arcs = RIMS.hidden_arcs
    counts = there.sum(axis=1)[:, None]
    # places along each ellipse
    order = np.cumsum(there, axis=1) - 1
    first = np.arange(arcs) * counts // arcs
    shown = counts - 3 * counts // arcs
    ahead = (order[:, None] - first[:, :, None]) % counts[:, :, None]
    parts = there[:, None] & (ahead < shown[:, :, None])
    around = np.repeat(points, arcs, axis=0)
    tried = fit_conics(around, parts.reshape(len(around), -1), RIMS.oblique)
    spreads = _spreads(tried, around, np.repeat(there, arcs, axis=0))[1].reshape(-1, arcs)
    good = spreads < RIMS.spread
    chosen = np.where(good.any(axis=1), good.argmax(axis=1), spreads.argmin(axis=1))
    rows = np.arange(len(points))
    better = spreads[rows, chosen] < spread
    return tried.select((rows * arcs + chosen)[better]), better


def _medians(values: Floats, there: Mask) -> Floats:
    """Medians (B,) of those values (B, n) that are there, the upper of two."""
    ordered = np.sort(np.where(there, values, np.inf), axis=1)
    middle = np.minimum(there.sum(axis=1) // 2, values.shape[1] - 1)
    return np.asarray(ordered[np.arange(len(ordered)), middle])


def _edges(
    signals: Sequence[Grey], which: Indices, ellipses: Ellipses, contrasts: Floats
) -> tuple[Floats, Mask, Floats, Floats, Floats]:
    """Edges (B, n, 2) along the normals of ellipses, to parts of a pixel, in n directions.

    There the signal falls through half the height of the edge; whether by one of `contrasts`, well
    within reach, by how much, down to what, and how far off the ellipse in px (B, n).
    """
    (a, b), angle = ellipses.half_axes.T[..., None], ellipses.angle[:, None]
    (x, y), c, s = _CIRCLE, np.cos(angle), np.sin(angle)
    on_rim = np.array([c * a * x - s * b * y, s * a * x + c * b * y])
    on_rim += ellipses.centre.T[..., None]
    # as long as one, across the rim
    length = np.sqrt((b * x) ** 2 + (a * y) ** 2)
    x, y = b * x / length, a * y / length
    normals = np.array([c * x - s * y, s * x + c * y])
    reach = np.clip(RIMS.reach * ellipses.half_axes.min(axis=1), RIMS.min_reach, RIMS.max_reach)
    reach = reach.astype(np.intp)
    where, found, steps, lows = np.zeros((4, len(reach), DIRECTIONS))
    for whole in sorted(set(reach.tolist())):
        some = np.flatnonzero(reach == whole)
        # Half steps, so that the fall between samples is known at the ellipse itself.
        offsets = np.arange(-whole - 1.5, whole + 2)
        lines = on_rim[:, some], normals[:, some], offsets
        profiles = sample_each(signals, which[some], *lines)
        step, place, below, low = _fall(profiles.reshape(len(offsets), -1), offsets)
        shape = (len(some), DIRECTIONS)
        sure = step >= np.repeat(contrasts[some], shape[1]).astype(np.float32)
        sure &= below & (np.abs(place) <= whole)
        for whole_array, part in ((steps, step), (where, place), (found, sure), (lows, low)):
            whole_array[some] = part.reshape(shape)
    edges = np.stack(tuple(on_rim + normals * where), axis=2)
    return edges, found > 0, steps, lows, where


def _fall(profiles: NDArray[np.float32], offsets: Floats) -> tuple[Singles, Floats, Mask, Singles]:
    """Of profiles (k, n) how far each falls, where it is at half the height, whether it is.

    And how low it is outside.  Row by row, as there are many profiles and each is short.
    """
    # The rim is near where the signal falls most over a width that optics blur an edge to...
    steepest, (fall, *falls) = np.zeros(profiles.shape[1], np.int8), profiles[:-3] - profiles[3:]
    for k, one in enumerate(falls, 1):
        np.putmask(steepest, one > fall, k)
        np.maximum(fall, one, out=fall)
    # ... and at half the height there, which noise moves less than the steepest place.
    summit, high, low = np.zeros_like(steepest), profiles[0].copy(), profiles[-1].copy()
    for k, one in enumerate(profiles):
        outside = steepest + 1 < k
        inner = np.where(outside, -np.inf, one)
        np.putmask(summit, inner > high, k)
        np.maximum(high, inner, out=high)
        np.minimum(low, np.where(outside, one, np.inf), out=low)
    half, after = (high + low) / 2, np.zeros_like(steepest)
    for k in range(len(profiles) - 1, 0, -1):
        np.putmask(after, (profiles[k] < half) & (summit < k), k)
    below, rows = after > 0, np.arange(len(after))
    after = np.maximum(after, 1).astype(np.intp)
    upper, lower = profiles[after - 1, rows].astype(np.float64), profiles[after, rows]
    where = offsets[after - 1] + (upper - half) / np.maximum(upper - lower, 1e-12)
    return fall, where, below, low
