"""Outlines of spheres and disks in a sensor, point by point, and the light within them."""

from __future__ import annotations

import numpy as np

from mixpose.body import Body
from mixpose.records import Floats
from mixpose.sensors import Sensor

CORNERS = 180  # of an outline: of a circle, half a thousandth of the radius is left out
_ROWS_PER_PIXEL = 16

_AROUND = np.linspace(0, 2 * np.pi, CORNERS, endpoint=False)
_CIRCLE = np.stack([np.cos(_AROUND), np.sin(_AROUND)], axis=-1)


def outline(
    sensor: Sensor, body: Body, feature: int, T_world_object: Floats, mirror: Floats | None = None
) -> Floats | None:
    """Where the edge (CORNERS, 2) of a sphere or disk is seen, px; None where not all of it is.

    `sensor` should have no bounds: what lies beyond an image has no place in it. Through a `mirror`
    (4, 4) that is a reflection of the world.
    """
    assert body.radii is not None, "a body of points has no outlines"
    radius = float(body.radii[feature])
    M = T_world_object if mirror is None else mirror @ T_world_object
    centre = M[:3, :3] @ body.means[feature] + M[:3, 3]
    if body.shape == "disk" and body.normals is not None:
        axis = M[:3, :3] @ body.normals[feature]
    else:
        # the circle at which lines of sight touch the sphere
        towards = sensor.towards(centre)
        distance = float(np.linalg.norm(towards))
        if distance <= radius:
            return None
        axis = towards / distance
        centre = centre + axis * radius**2 / distance
        radius *= float(np.sqrt(1 - (radius / distance) ** 2))
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    plane = np.stack([first, np.cross(axis, first)])
    y, visible = sensor.project(centre + radius * _CIRCLE @ plane)
    return y if visible.all() else None


def centroid(polygon: Floats) -> Floats:
    """Centroid (2,) of the area that a polygon (n, 2) encloses."""
    middle = polygon.mean(axis=0)
    x, y = (polygon - middle).T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    return np.asarray(
        middle + [(cross * (one + np.roll(one, -1))).sum() / (3 * cross.sum()) for one in (x, y)]
    )


def coverage(polygon: Floats, shape: tuple[int, int]) -> tuple[slice, slice, Floats]:
    """Share of every pixel that a convex polygon covers, in a box of an image of a shape (H, W).

    The corners (n, 2) are (u, v) in order, pixel centres at integers. Rows and columns of the box
    are empty where the polygon is outside of the image.
    """
    low = np.clip(np.floor(polygon.min(axis=0) + 0.5).astype(int), 0, shape[::-1])
    high = np.clip(np.ceil(polygon.max(axis=0) + 0.5).astype(int), 0, shape[::-1])
    rows, columns = slice(low[1], high[1]), slice(low[0], high[0])
    height, width = max(high[1] - low[1], 0), max(high[0] - low[0], 0)
    if not height or not width:
        return rows, columns, np.zeros((height, width))
    lines = (np.arange(height * _ROWS_PER_PIXEL) + 0.5) / _ROWS_PER_PIXEL - 0.5 + low[1]
    left, right = _spans(polygon, lines)
    edges = np.arange(width) + low[0] - 0.5
    within = np.clip(right[:, None] - edges, 0, 1) - np.clip(left[:, None] - edges, 0, 1)
    return rows, columns, within.reshape(height, _ROWS_PER_PIXEL, width).mean(axis=1)


def _spans(polygon: Floats, lines: Floats) -> tuple[Floats, Floats]:
    """Where horizontal lines v enter and leave a convex polygon; alike where they miss it."""
    top, bottom = int(polygon[:, 1].argmin()), int(polygon[:, 1].argmax())
    turned = np.roll(polygon, -top, axis=0)
    turn = (bottom - top) % len(polygon)
    sides = [turned[: turn + 1], np.concatenate([turned[turn:], turned[:1]])[::-1]]
    one, other = (np.interp(lines, side[:, 1], side[:, 0]) for side in sides)
    missed = (lines < polygon[top, 1]) | (lines > polygon[bottom, 1])
    left, right = np.minimum(one, other), np.maximum(one, other)
    return left, np.where(missed, left, right)
