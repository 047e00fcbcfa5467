"""What is small in a large frame, once more and larger in a corner of its picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np

from mixpose.body import Body
from mixpose.pictures.canvas import WHITE, Picture, polyline
from mixpose.pictures.overlay import Part, projected_features
from mixpose.pictures.ranges import BACKGROUND
from mixpose.records import Estimate, Floats
from mixpose.sensors import Sensor

Box: TypeAlias = tuple[Floats, float]
"""A square of a sensor, px: the place (2,) of its upper left pixel, and its side."""

_SMALL = 0.25  # of the shorter side of a picture: what is smaller is drawn larger
_SIDE = 0.4  # of that side, which the inset takes
_ROOM = 0.3  # of the extent of what is small, on each side of it
_LEAST_PX = 24.0  # of the sensor, that an inset shows at least


def small_box(
    picture: Picture, part: Part, posed: Sequence[tuple[Body, Estimate]], sensor: Sensor
) -> Box | None:
    """Around all features in view, where they are small in a picture; else None."""
    places = [np.zeros((0, 2))]
    for body, one in posed:
        if one.T_world_object is not None:
            y, _, seen = projected_features(sensor, body, one.T_world_object)
            places.append(y[seen])
    y = np.concatenate(places)
    if len(y) < 2:
        return None
    lower, upper = y.min(axis=0), y.max(axis=0)
    side = max(float((upper - lower).max()) * (1 + 2 * _ROOM), _LEAST_PX)
    is_small = side * part.zoom < _SMALL * min(picture.shape[:2])
    return ((lower + upper - side) / 2, side) if is_small else None


def enlarged(whole: Picture | None, picture: Picture, box: Box) -> tuple[Picture, Part]:
    """A box of a sensor, by a picture of all its pixels if any, as large as an inset is."""
    size = round(_SIDE * min(picture.shape[:2]))
    part = Part(size / box[1], (float(box[0][0]), float(box[0][1])))
    if whole is None:
        return np.full((size, size, 3), BACKGROUND, np.uint8), part
    # the sensor's place of the inset's first pixel, and how far the next is
    first, step = box[0] + 0.5 / part.zoom - 0.5, 1 / part.zoom
    to_sensor = np.array([[step, 0.0, first[0]], [0.0, step, first[1]]])
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(whole, to_sensor, (size, size), flags=flags), np.uint8), part


def put_into(picture: Picture, part: Part, inset: Picture, box: Box) -> None:
    """Put an inset into a corner of a picture, in place: not that of its caption, nor the box."""
    height, width = picture.shape[:2]
    side, middle = len(inset), part.places(box[0] + box[1] / 2)
    corners = np.array([[width, height], [0, height], [width, 0]]) - side * np.ones(2)
    corners = np.maximum(corners, 0)
    apart = np.linalg.norm(corners + side / 2 - middle, axis=1)
    u, v = corners[int(apart.argmax())].astype(int).tolist()
    picture[v : v + side, u : u + side] = inset
    for corner, size in ((np.array([u, v]), side - 1.0), (part.places(box[0]), part.zoom * box[1])):
        outline = size * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        polyline(picture, corner + outline, WHITE, closed=True)
