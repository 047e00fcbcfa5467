"""Centres of large features: an ellipse through the edge, wherever there is an edge.

A disk stays an ellipse when part of its rim is hidden, when it has a hole, or when its light
is uneven: so the rim is looked for where it is, and what does not lie on the ellipse is left out.

`skimage.measure` beside it: `EllipseModel` fits as well, but ten times slower (0.13 to 0.013 ms of
72 points), its distances are 300 times slower (4.1 to 0.012 ms), and `ransac` triples the error
where a straight edge cuts a disk (0.17 to 0.05 px).  `find_contours` has one level for all of the
rim: a disk half in shadow is off by 0.32 px instead of 0.01, and disks behind cables or broken by
their hole are not found.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.constants import constant
from mixpose.extraction.background import Grey
from mixpose.extraction.contours import Contour
from mixpose.extraction.sampling import sample
from mixpose.records import Floats

# Directions in which the rim is looked for.
DIRECTIONS = 72

_ANGLES = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)


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
    waist: float = constant(
        0.7, "of the minor half-axis, where the waist of two spots is looked at"
    )
    dip: float = constant(0.1, "of the height, that the middle is dimmer than either half")
    ridge: float = constant(0.03, "of the height, that it is brighter than beside: two, not a ring")
    hidden_arcs: int = constant(8, "arcs, of which three that follow each other may be hidden")


@dataclass(frozen=True)
class Ellipse:
    """An ellipse in pixel coordinates; `angle` in radians turns the first half-axis from u."""

    centre: tuple[float, float]
    half_axes: tuple[float, float]
    angle: float

    @property
    def area(self) -> float:
        """Enclosed area in px."""
        return math.pi * self.half_axes[0] * self.half_axes[1]


@dataclass(frozen=True)
class Rim:
    """An ellipse found in an image.

    Attributes
    ----------
    ellipse : Ellipse
    coverage : float
        Share of the directions in which an edge lies on the ellipse.
    residual : float
        RMS distance in px of these edges from it.
    contrast : float
        Median step of the signal across the edges.
    """

    ellipse: Ellipse
    coverage: float
    residual: float
    contrast: float

    def is_good(self, rules: EllipseRules = EllipseRules()) -> bool:
        """Whether the rim is an ellipse."""
        near = self.residual <= tolerance(self.ellipse, rules) / 2
        return self.coverage >= rules.coverage and near


def find_rim(
    signal: Grey,
    outline: Contour,
    least_contrast: float,
    rules: EllipseRules = EllipseRules(),
) -> Rim | None:
    """The elliptical rim of a bright feature.

    Parameters
    ----------
    signal : (H, W) uint8, uint16 or float32
        Grey values.
    outline : (n, 1, 2) int32
        Contour of the feature, in pixels of the signal.
    least_contrast : float
        An edge is a step of the signal by at least this.
    rules : EllipseRules

    Returns
    -------
    Rim or None
        None where nothing like an ellipse is found.
    """
    # Digital straight lines, such as the chord that an occlusion leaves, have few corners in a
    # convex hull, arcs have many: the corners alone favour the true rim.
    hull = cv2.convexHull(outline)[:, 0].astype(np.float64)
    rim = _rim_near(signal, fit_ellipse(hull, rules), least_contrast, rules)
    # Once more from the better ellipse, which has all of a soft or broken rim within reach.
    return None if rim is None else _rim_near(signal, rim.ellipse, least_contrast, rules)


def _rim_near(
    signal: Grey, ellipse: Ellipse | None, least_contrast: float, rules: EllipseRules
) -> Rim | None:
    if ellipse is None:
        return None
    edges, found, steps = _edges(signal, ellipse, least_contrast, rules)
    if np.count_nonzero(found) < rules.coverage / 2 * DIRECTIONS:
        return None
    better = fit_ellipse(edges[found], rules)
    if better is None:
        return None
    distance = np.abs(distances(better, edges))
    on_rim = found & (distance <= tolerance(better, rules))
    count = np.count_nonzero(on_rim)
    if count == 0:
        return None
    near = distance[on_rim]
    residual = math.sqrt(float(near @ near) / count)
    return Rim(better, count / DIRECTIONS, residual, _median(steps[on_rim]))


def is_waisted(signal: Grey, ellipse: Ellipse, rules: EllipseRules = EllipseRules()) -> bool:
    """Whether a long ellipse is two spots that touch: dim in the middle, but not hollow."""
    a, b = ellipse.half_axes
    if max(a, b) < rules.long * min(a, b):
        return False
    directions = _turn(ellipse.angle).T * np.array([[a], [b]])
    major, minor = directions if a >= b else directions[::-1]
    along = np.stack([0 * major, major / 2, -major / 2, rules.waist * minor, -rules.waist * minor])
    middle, one, other, *sides = sample(signal, (ellipse.centre + along)[:, None])[:, 0]
    height = max(one, other) - min(sides)
    dips = min(one, other) - middle > rules.dip * height
    return bool(dips and middle - max(sides) > rules.ridge * height)


def fit_ellipse(points: Floats, rules: EllipseRules = EllipseRules()) -> Ellipse | None:
    """Ellipse through points, of which some may lie elsewhere.

    Parameters
    ----------
    points : (n, 2) float64
        Points in order along the ellipse.
    rules : EllipseRules

    Returns
    -------
    Ellipse or None
        None for less than six points, or where they are not on an ellipse.
    """
    best, best_spread = None, np.inf
    for start in _starts(points, rules):
        ellipse = _fit(start, rules)
        if ellipse is None:
            continue
        spread = _median(np.abs(distances(ellipse, points)))
        if spread < best_spread:
            best, best_spread = ellipse, spread
        if spread < rules.spread:
            break
    if best is None or best_spread > rules.spread + rules.hopeless * min(best.half_axes):
        return None
    for _ in range(3):
        if best is None:
            return None
        distance = np.abs(distances(best, points))
        near = distance <= max(rules.spread, 3.0 * _median(distance))
        best = _fit(points[near], rules)
    return best


def _median(values: Floats) -> float:
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


def tolerance(ellipse: Ellipse, rules: EllipseRules) -> float:
    """Distance in px within which an edge counts as on the ellipse."""
    minor = min(ellipse.half_axes)
    # A tenth of small ones, whose shape pixels blur; of large ones what print and lens bend.
    return max(rules.tolerance, min(0.1 * minor, 1.0), 0.02 * minor)


def _starts(points: Floats, rules: EllipseRules) -> Iterator[Floats]:
    """All points, then all but each of some arcs, one of which may be hidden."""
    yield points
    count = len(points)
    shown = count - 3 * count // rules.hidden_arcs
    around = np.concatenate([points, points])
    for k in range(rules.hidden_arcs):
        first = k * count // rules.hidden_arcs
        yield around[first : first + shown]


def _fit(points: Floats, rules: EllipseRules) -> Ellipse | None:
    if len(points) < 6:
        return None
    # Near the origin, as OpenCV works in single precision.
    middle = points.sum(axis=0) / len(points)
    (u, v), (width, height), degrees = cv2.fitEllipseAMS((points - middle).astype(np.float32))
    half_axes = (width / 2, height / 2)
    sound = math.isfinite(u + v + width + height + degrees) and min(half_axes) > 0
    if not sound or min(half_axes) < rules.oblique * max(half_axes):
        return None
    return Ellipse((u + middle[0], v + middle[1]), half_axes, math.radians(degrees))


def distances(ellipse: Ellipse, points: Floats) -> Floats:
    """Signed distances (n,) of points (n, 2) from an ellipse, outside positive.

    To first order (Sampson), which is exact enough within a few px of the rim.
    """
    axes = np.asarray(ellipse.half_axes)
    # On the ellipse |scaled| is 1; its gradient is scaled / axes / |scaled|.
    scaled = (points - ellipse.centre) @ (_turn(ellipse.angle) / axes)
    slope = scaled / axes
    square = np.einsum("ij,ij->i", scaled, scaled)
    steepness = np.sqrt(np.einsum("ij,ij->i", slope, slope)) + 1e-12
    return np.asarray((square - np.sqrt(square)) / steepness)


def _turn(angle: float) -> Floats:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def _edges(
    signal: Grey, ellipse: Ellipse, least_contrast: float, rules: EllipseRules
) -> tuple[Floats, NDArray[np.bool_], Floats]:
    """Edges along the normals of an ellipse.

    Returns
    -------
    edges : (DIRECTIONS, 2) float64
        Where the signal falls through half the height of the edge, to parts of a pixel.
    found : (DIRECTIONS,) bool
        Whether it falls by `least_contrast` there, well within reach.
    steps : (DIRECTIONS,) float64
        By how much it falls.
    """
    axes = np.asarray(ellipse.half_axes)
    turn = _turn(ellipse.angle)
    on_rim = ellipse.centre + (_CIRCLE * axes) @ turn.T
    normals = (_CIRCLE / axes) @ turn.T
    normals /= np.sqrt(np.einsum("ij,ij->i", normals, normals))[:, None]
    reach = int(np.clip(rules.reach * axes.min(), rules.min_reach, rules.max_reach))
    # Half steps, so that the fall between samples is known at the ellipse itself.
    offsets = np.arange(-reach - 1.5, reach + 2)
    places = on_rim[:, None] + normals[:, None] * offsets[:, None]
    profile = sample(signal, places)
    # The rim is near where the signal falls most over a width that optics blur an edge to...
    fall = profile[:, :-3] - profile[:, 3:]
    steepest = np.argmax(fall, axis=1)
    steps = np.take_along_axis(fall, steepest[:, None], axis=1)[:, 0]
    # ... and at half the height there, which noise moves less than the steepest place.
    column = np.arange(profile.shape[1])
    inside, outside = column <= steepest[:, None] + 1, column >= steepest[:, None] + 2
    high = np.where(inside, profile, -np.inf)
    low = np.where(outside, profile, np.inf).min(axis=1)
    half = (high.max(axis=1) + low) / 2
    below = (column > high.argmax(axis=1)[:, None]) & (profile < half[:, None])
    after = np.maximum(below.argmax(axis=1), 1)
    rows = np.arange(len(profile))
    upper, lower = profile[rows, after - 1], profile[rows, after]
    where = offsets[after - 1] + (upper - half) / np.maximum(upper - lower, 1e-12)
    found = (steps >= least_contrast) & below.any(axis=1) & (np.abs(where) <= reach)
    return on_rim + normals * where[:, None], found, steps
