"""Locate large features by an ellipse through the edge of their rim.

A disk stays an ellipse when part of its rim is hidden, when it has a hole, or when its light is
uneven: edges are searched around the whole rim, and those that do not lie on the ellipse are left
out.  All features of an image are fitted together, as arrays with one row for each: the number of
calls takes time, not that of pixels.

Compared with `skimage.measure`: `EllipseModel` fits as well, but ten times slower than
`cv2.fitEllipseAMS`, used here; `ransac` triples the error where a straight edge cuts a disk (0.17
to 0.05 px).  `find_contours` has one level for the whole rim: a disk half in shadow is off by 0.32
px instead of 0.01, and disks behind cables or broken by their hole are not found.
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
from mixpose.extraction.conics import FEWEST, Ellipses, distances, fit_conics, rotations
from mixpose.extraction.contours import Contour
from mixpose.extraction.sampling import sample_lines
from mixpose.records import Floats, Indices, Mask, Singles

# Directions from the centre in which edges are searched.
DIRECTIONS = 72

# Times that an ellipse is fitted again to the points near it.
REFITS = 3

_ANGLES = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
_CIRCLE = np.array([np.cos(_ANGLES), np.sin(_ANGLES)])


@dataclass(frozen=True)
class EllipseRules:
    """When a rim is an ellipse."""

    reach: float = constant(0.15, "of the minor half-axis, within which edges are searched")
    min_reach: int = constant(3, "px, the least reach: an edge is as wide as optics blur it")
    max_reach: int = constant(6, "px, the largest reach: beyond it are neighbours")
    coverage: float = constant(0.6, "of the directions, that must have an edge on the ellipse")
    tolerance: float = constant(
        0.5, "px, least distance within which an edge is on the ellipse: pixels and print need it"
    )
    spread: float = constant(0.6, "px, median distance of corners of the hull from their ellipse")
    hopeless: float = constant(
        0.15, "of the minor half-axis: points with a larger median distance lie on no ellipse"
    )
    oblique: float = constant(0.15, "width by length: a disk seen at less than 9° is not located")
    long: float = constant(1.35, "length by width from which an ellipse may be two spots")
    long_coverage: float = constant(
        0.8, "of the directions, for long ellipses: the hull of two touching disks has 0.6"
    )
    waist: float = constant(
        0.7, "of the minor half-axis, where the signal beside the middle of two spots is sampled"
    )
    dip: float = constant(0.1, "of the height, by which the middle is dimmer than either spot")
    ridge: float = constant(0.03, "of the height, by which the middle is above its sides: no ring")
    lit: float = constant(
        0.3,
        "of the step at the rim, by which it may be brighter outside than at most of the rim: "
        "beside a neighbour half the height is no edge, and the centre 0.3 px off",
    )
    dark: float = constant(0.7, "of the edges, that suffice without those brighter outside")
    hidden_arcs: int = constant(8, "arcs of a rim, of which three in a row may be hidden")


RIMS = EllipseRules()


class Rim(NamedTuple):
    """An ellipse found in an image, in px; its first five fields are a row of `ellipses_of`."""

    u: float
    v: float
    half_axis: float  # in the direction of the angle, which is in radians
    other: float
    angle: float
    coverage: float  # share of the directions in which an edge lies on the ellipse
    residual: float  # RMS distance in px of these edges from it


class Rims(NamedTuple):
    """The rims of B features; rows without an ellipse where none fits."""

    ellipses: Ellipses
    coverage: Floats  # (B,) as in `Rim`
    residual: Floats  # (B,) as in `Rim`
    contrast: Floats  # (B,) median step of the signal across the edges
    shift: Floats  # (B,) px, the largest distance of an edge from the start ellipse

    def replaced(self, rows: Indices, others: Rims) -> Rims:
        """Return a copy with others in the given rows."""
        arrays = [array.copy() for array in self[1:]]
        for array, values in zip(arrays, others[1:], strict=True):
            array[rows] = values
        return Rims(self.ellipses.replaced(rows, others.ellipses), *arrays)

    def are_good(self) -> Mask:
        """Test which rims (B,) are ellipses with enough edges near them."""
        minor, major = np.sort(self.ellipses.half_axes, axis=1).T
        min_coverage = np.where(major < RIMS.long * minor, RIMS.coverage, RIMS.long_coverage)
        is_near = self.residual <= tolerance(minor) / 2
        return np.asarray(self.ellipses.is_ellipse & (self.coverage >= min_coverage) & is_near)

    def to_list(self, chosen: Indices) -> list[Rim]:
        """Return the chosen rims as a list."""
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
    """Find the elliptical rims of bright features from their outlines in signals (H, W).

    `which` (B,) is the signal of each; an edge is a step of at least `contrasts` (B,).  The search
    starts at `ovals` (B,) where these are ellipses, else at an ellipse through the outline's hull.
    """
    ellipses = _start_ellipses(outlines, ovals)
    rims, is_pending = Rims(ellipses, *np.zeros((4, len(outlines)))), ellipses.is_ellipse
    # First roughly, then from the better ellipse, within reach of all of a soft or broken rim.
    for min_share in (RIMS.coverage / 2, RIMS.coverage):
        rows = np.flatnonzero(is_pending)
        if not rows.size:
            break
        inputs = signals, which[rows], rims.ellipses.select(rows), contrasts[rows]
        rims = rims.replaced(rows, _rims_near(*inputs, min_share))
        # most rims need no second pass
        is_near = rims.are_good() & (rims.shift <= RIMS.min_reach / 2)
        is_pending = rims.ellipses.is_ellipse & ~is_near
    return rims


def _start_ellipses(outlines: Sequence[Contour], ovals: Ellipses) -> Ellipses:
    """Return the ellipses near which edges are searched: ovals, else those through hulls."""
    minor, major = np.sort(ovals.half_axes, axis=1).T
    others = np.flatnonzero(~(ovals.is_ellipse & (minor >= RIMS.oblique * major)))
    if not others.size:
        return ovals
    # Straight lines of pixels, such as the chord of an occlusion, have few corners in a convex
    # hull, arcs have many: fitting only corners favours the true rim.
    hulls = [cv2.convexHull(outlines[k])[:, 0] for k in others.tolist()]
    return ovals.replaced(others, fit_ellipses(*_padded(hulls))[0])


def _padded(points: Sequence[Contour]) -> tuple[Floats, Mask]:
    """Pad lists of points to one array (B, n, 2); return it and which entries (B, n) are filled."""
    counts = np.array([len(outline) for outline in points])
    filled = np.arange(counts.max()) < counts[:, None]
    padded = np.zeros((*filled.shape, 2))
    padded[filled] = np.concatenate(points)
    return padded, filled


def _rims_near(
    signals: Sequence[Grey], which: Indices, starts: Ellipses, contrasts: Floats, min_share: float
) -> Rims:
    """Fit rims to the edges near start ellipses, if in a share `min_share` of the directions."""
    edges, is_edge, steps, lows, offsets = _edges(signals, which, starts, contrasts)
    is_edge &= (is_edge.sum(axis=1) >= min_share * DIRECTIONS)[:, None]
    outside = lows - _medians(lows, is_edge)[:, None]
    is_dark = is_edge & (outside <= RIMS.lit * _medians(steps, is_edge)[:, None])
    enough = is_dark.sum(axis=1) >= RIMS.dark * is_edge.sum(axis=1)
    ellipses, distance = fit_ellipses(edges, np.where(enough[:, None], is_dark, is_edge))
    limits = tolerance(ellipses.half_axes.min(axis=1))
    on_rim = is_edge & (distance <= limits[:, None]) & ellipses.is_ellipse[:, None]
    count = on_rim.sum(axis=1)
    squares = np.where(on_rim, distance, 0.0) ** 2
    residual = np.sqrt(squares.sum(axis=1) / np.maximum(count, 1))
    ellipses = ellipses._replace(is_ellipse=ellipses.is_ellipse & (count > 0))
    shifts = np.where(on_rim, np.abs(offsets), 0.0).max(axis=1)
    return Rims(ellipses, count / DIRECTIONS, residual, _medians(steps, on_rim), shifts)


def are_waisted(
    signals: Sequence[Grey], which: Indices, ellipses: Ellipses, contrasts: Floats
) -> Mask:
    """Test which ellipses (B,) are two touching spots: long, dim in the middle, but no ring.

    Their height is the step `contrasts` (B,) of the signal at the rim, or larger inside.
    """
    axes, waisted = ellipses.half_axes, np.zeros(len(which), dtype=np.bool_)
    long = np.flatnonzero(axes.max(axis=1) >= RIMS.long * axes.min(axis=1))
    if not long.size:
        return waisted
    directions = rotations(ellipses.angle[long]).swapaxes(1, 2) * axes[long, :, None]
    order = np.argsort(-axes[long], axis=1, kind="stable")[..., None]
    along = np.array([[0.0, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.0, RIMS.waist], [0.0, -RIMS.waist]])
    places = ellipses.centre[long, None] + along @ np.take_along_axis(directions, order, axis=1)
    lines = places.transpose(2, 0, 1), np.zeros((2, *places.shape[:2])), np.zeros(1)
    middle, *ends = sample_lines(signals, which[long], *lines)[0].T
    (low, high), (left, right) = np.sort(ends[:2], axis=0), np.sort(ends[2:], axis=0)
    height = np.maximum(high - left, contrasts[long])
    waisted[long] = (low - middle > RIMS.dip * height) & (middle - right > RIMS.ridge * height)
    return waisted


def tolerance(minor: Any) -> Any:
    """Return the distance in px within which edges are on an ellipse of this minor half-axis."""
    # A tenth of small axes, as pixels blur the shape; a share of large ones, as print and lens do.
    return np.maximum(RIMS.tolerance, np.maximum(np.minimum(0.1 * minor, 1.0), 0.02 * minor))


def fit_ellipses(points: Floats, filled: Mask) -> tuple[Ellipses, Floats]:
    """Fit ellipses to the `filled` (B, n) of points (B, n, 2), robustly to some that lie elsewhere.

    Points follow each other along the ellipse.  There is none for less than six points, or where
    they lie on no ellipse.  Also returns the distances (B, n) of points from the ellipses.
    """
    best = fit_conics(points, filled, RIMS.oblique)
    distance, spread = _spreads(best, points, filled)
    is_used = filled.copy()
    doubtful = np.flatnonzero(~(spread < RIMS.spread) & (filled.sum(axis=1) >= FEWEST))
    if doubtful.size:
        refitted, better = _fit_without_an_arc(points[doubtful], filled[doubtful], spread[doubtful])
        best = best.replaced(doubtful[better], refitted)
        is_used[doubtful[better]] = False
        distance, spread = _spreads(best, points, filled)
    is_hopeless = spread > RIMS.spread + RIMS.hopeless * best.half_axes.min(axis=1)
    best = best._replace(is_ellipse=best.is_ellipse & ~is_hopeless)
    rows = np.flatnonzero(best.is_ellipse)
    for _ in range(REFITS):
        # fits whose points stay the same are done
        near = filled[rows] & (distance[rows] <= np.maximum(RIMS.spread, 3 * spread[rows])[:, None])
        has_changed = (near != is_used[rows]).any(axis=1)
        rows, near = rows[has_changed], near[has_changed]
        if not rows.size:
            break
        refitted = fit_conics(points[rows], near, RIMS.oblique)
        best, is_used[rows] = best.replaced(rows, refitted), near
        distance[rows], spread[rows] = _spreads(refitted, points[rows], filled[rows])
        rows = rows[refitted.is_ellipse]
    return best, distance


def _spreads(ellipses: Ellipses, points: Floats, filled: Mask) -> tuple[Floats, Floats]:
    """Return distances (B, n) of points from ellipses, and medians (B,), infinite without one."""
    distance = np.abs(distances(ellipses, points))
    return distance, np.where(ellipses.is_ellipse, _medians(distance, filled), np.inf)


def _fit_without_an_arc(points: Floats, filled: Mask, spread: Floats) -> tuple[Ellipses, Mask]:
    """Fit ellipses without the points (B, n, 2) of an arc that may be hidden.

    The arc is the first without which the ellipse is near enough to the points, else the best.
    Return only ellipses with less than the present `spread` (B,), and which rows these are.
    """
    arcs = RIMS.hidden_arcs
    counts = filled.sum(axis=1)[:, None]
    # numbers of the points along each ellipse
    rank = np.cumsum(filled, axis=1) - 1
    first = np.arange(arcs) * counts // arcs
    visible = counts - 3 * counts // arcs
    ahead = (rank[:, None] - first[:, :, None]) % counts[:, :, None]
    is_kept = filled[:, None] & (ahead < visible[:, :, None])
    repeated = np.repeat(points, arcs, axis=0)
    candidates = fit_conics(repeated, is_kept.reshape(len(repeated), -1), RIMS.oblique)
    spreads = _spreads(candidates, repeated, np.repeat(filled, arcs, axis=0))[1].reshape(-1, arcs)
    good = spreads < RIMS.spread
    chosen = np.where(good.any(axis=1), good.argmax(axis=1), spreads.argmin(axis=1))
    rows = np.arange(len(points))
    better = spreads[rows, chosen] < spread
    return candidates.select((rows * arcs + chosen)[better]), better


def _medians(values: Floats, counted: Mask) -> Floats:
    """Return medians (B,) of the `counted` of values (B, n), the upper of two."""
    ordered = np.sort(np.where(counted, values, np.inf), axis=1)
    middle = np.minimum(counted.sum(axis=1) // 2, values.shape[1] - 1)
    return np.asarray(ordered[np.arange(len(ordered)), middle])


def _edges(
    signals: Sequence[Grey], which: Indices, ellipses: Ellipses, contrasts: Floats
) -> tuple[Floats, Mask, Floats, Floats, Floats]:
    """Locate edges (B, n, 2) along the normals of ellipses, in n directions.

    At an edge the signal falls through half the edge's height.  Also returns (B, n) each: whether
    it falls by `contrasts` within reach, its step, the signal outside, and px off the ellipse.
    """
    (a, b), angle = ellipses.half_axes.T[..., None], ellipses.angle[:, None]
    (x, y), c, s = _CIRCLE, np.cos(angle), np.sin(angle)
    on_rim = np.array([c * a * x - s * b * y, s * a * x + c * b * y])
    on_rim += ellipses.centre.T[..., None]
    # unit normals of the rim
    length = np.sqrt((b * x) ** 2 + (a * y) ** 2)
    x, y = b * x / length, a * y / length
    normals = np.array([c * x - s * y, s * x + c * y])
    reach = np.clip(RIMS.reach * ellipses.half_axes.min(axis=1), RIMS.min_reach, RIMS.max_reach)
    reach = reach.astype(np.intp)
    shifts, is_edge, steps, lows = np.zeros((4, len(reach), DIRECTIONS))
    for width in sorted(set(reach.tolist())):
        rows = np.flatnonzero(reach == width)
        # The ellipse is half-way between two samples, so that falls there are seen.
        offsets = np.arange(-width - 1.5, width + 2)
        lines = on_rim[:, rows], normals[:, rows], offsets
        profiles = sample_lines(signals, which[rows], *lines)
        step, shift, below, low = _fall(profiles.reshape(len(offsets), -1), offsets)
        shape = (len(rows), DIRECTIONS)
        sure = step >= np.repeat(contrasts[rows], shape[1]).astype(np.float32)
        sure &= below & (np.abs(shift) <= width)
        for whole, part in ((steps, step), (shifts, shift), (is_edge, sure), (lows, low)):
            whole[rows] = part.reshape(shape)
    edges = np.stack(tuple(on_rim + normals * shifts), axis=2)
    return edges, is_edge > 0, steps, lows, shifts


def _fall(profiles: NDArray[np.float32], offsets: Floats) -> tuple[Singles, Floats, Mask, Singles]:
    """Return by how much profiles (k, n) fall, where, whether they do, and how low they end.

    The place is at half the height.  This goes row by row, as profiles are many and short.
    """
    # The rim is near the largest fall over three samples, as wide as optics blur an edge, ...
    steepest, (fall, *falls) = np.zeros(profiles.shape[1], np.int8), profiles[:-3] - profiles[3:]
    for k, row in enumerate(falls, 1):
        np.putmask(steepest, row > fall, k)
        np.maximum(fall, row, out=fall)
    # ... where the signal is at half height, which noise moves less than the steepest place.
    summit, high, low = np.zeros_like(steepest), profiles[0].copy(), profiles[-1].copy()
    for k, row in enumerate(profiles):
        outside = steepest + 1 < k
        inner = np.where(outside, -np.inf, row)
        np.putmask(summit, inner > high, k)
        np.maximum(high, inner, out=high)
        np.minimum(low, np.where(outside, row, np.inf), out=low)
    half, after = (high + low) / 2, np.zeros_like(steepest)
    for k in range(len(profiles) - 1, 0, -1):
        np.putmask(after, (profiles[k] < half) & (summit < k), k)
    below, rows = after > 0, np.arange(len(after))
    after = np.maximum(after, 1).astype(np.intp)
    upper, lower = profiles[after - 1, rows].astype(np.float64), profiles[after, rows]
    shifts = offsets[after - 1] + (upper - half) / np.maximum(upper - lower, 1e-12)
    return fall, shifts, below, low
