"""All sensors of one moment in one picture, with the pose: a frame of an overlay.

What is small in a large frame of a camera stands once more and larger in a corner of its picture.
A range sensor's frame is a strip: what it measured, and where the pose has the features.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias, cast

import cv2
import numpy as np

from mixpose.body import Body
from mixpose.pictures import canvas, overlay
from mixpose.pictures.canvas import GREY, WHITE, Colour, Picture, Size
from mixpose.pictures.overlay import Part
from mixpose.records import (
    Estimate,
    Floats,
    FrameSet,
    GridPattern,
    Image,
    Pattern,
    PointPattern,
    RawFrame,
)
from mixpose.sensors import Sensor
from mixpose.session import SensorSetup, Session

LARGEST = (1920, 1080)
_MOST_ENLARGED = 2
_BLANK_SIZE = (640, 480)
_DETECTION_PX = 2.5

Posed: TypeAlias = Sequence[tuple[Body, Estimate]]
Box: TypeAlias = tuple[Floats, float]
"""A square of a sensor, px: the place (2,) of its upper left pixel, and its side."""

_SMALL = 0.25  # of the shorter side of a picture: what is smaller is drawn larger
_SIDE = 0.4  # of that side, which the inset takes
_ROOM = 0.3  # of the extent of what is small, on each side of it
_LEAST_PX = 24.0  # of the sensor, that an inset shows at least

BACKGROUND = 24  # grey level
STRIP_SIZE = (960, 130)
_MARGIN_PX = 16  # of a strip
_TOP, _BASE = 0.42, 0.8  # of the height: between them the measurement, above it the pose
_TICKS = 8


def draw_scene(session: Session, frame_set: FrameSet, *estimates: Estimate) -> Picture:
    """Draw the frames of all sensors with the poses estimated from them, one of each body.

    Cameras stand side by side, range sensors are strips below them; each of several bodies has a
    colour of its own. The picture is of the same size for every frame, as long as the frames are.
    """
    posed = with_bodies(session, estimates)
    cameras = [setup for setup in session.sensors if setup.sensor.dimension == 2]
    strips = [setup for setup in session.sensors if setup.sensor.dimension == 1]
    rows: list[Picture] = []
    if cameras:
        columns, room = canvas.columns_for(len(cameras)), room_for(len(cameras))
        panels = [_panel(posed, one, frame_set.frames.get(one.name), room) for one in cameras]
        for panel, setup in zip(panels, cameras, strict=True):
            if setup.name not in frame_set.frames:
                _name(panel, f"{setup.name}: no frame", GREY)
            elif len(cameras) > 1:
                _name(panel, setup.name, WHITE)
        rows.append(canvas.in_grid(panels, columns))
    else:
        head = np.full((36, STRIP_SIZE[0], 3), BACKGROUND, np.uint8)
        status = estimates[0].status if len(estimates) == 1 else None
        overlay.caption(head, status, estimates[0].frame)
        rows.append(head)
    for setup in strips:
        rows += draw_strips(posed, setup, frame_set.frames.get(setup.name))
    return canvas.stacked(rows)


def _panel(posed: Posed, setup: SensorSetup, frame: RawFrame | None, room: Size) -> Picture:
    """A camera's frame with its poses, and those that are small in it larger in a corner."""
    ground, part = backdrop(setup, frame, room)
    box = small_box(ground, part, posed, setup.sensor)
    if box is None:
        return draw_camera(posed, setup, ground, part)
    panel = draw_camera(posed, setup, ground, part, named=False)
    data = None if frame is None else frame.data
    side = round(_SIDE * min(panel.shape[:2]))
    larger = Part(side / box[1], (float(box[0][0]), float(box[0][1])))
    inset = np.full((side, side, 3), BACKGROUND, np.uint8)
    if isinstance(data, np.ndarray):
        inset = cut_out(canvas.displayable(data), larger, (side, side), cv2.INTER_NEAREST)
    _mark_detections(inset, data, larger)
    put_into(panel, part, draw_camera(posed, setup, inset, larger, captioned=False), box)
    return panel


def _mark_detections(picture: Picture, data: object, part: Part) -> None:
    """Draw the detections of a camera that has them in place of images, if it has."""
    if isinstance(data, PointPattern):
        for place in part.places(data.points):
            canvas.ring(picture, place, _DETECTION_PX * canvas.stroke(picture), overlay.FOUND)


def with_bodies(session: Session, estimates: Sequence[Estimate]) -> list[tuple[Body, Estimate]]:
    """Estimates with the bodies that they are of."""
    bodies = {one.body.name: one.body for one in session.objects}
    return [(bodies.get(one.object, session.body), one) for one in estimates]


def room_for(cameras: int) -> Size:
    """Width and height in px that each of so many cameras has in a picture of them all."""
    columns = canvas.columns_for(cameras)
    return LARGEST[0] // columns, LARGEST[1] // -(-cameras // columns)


def backdrop(setup: SensorSetup, frame: RawFrame | None, room: Size | None) -> tuple[Picture, Part]:
    """A camera's frame as a picture that fits into some room, before anything is drawn on it.

    Without a room it keeps its size. Detections in place of images are dots on a dark ground.
    """
    data = None if frame is None else frame.data
    if data is None or isinstance(data, PointPattern | GridPattern):
        width, height = setup.resolution or _size_of(data)
        zoom = _zoom((width, height), room)
        shape = max(round(height * zoom), 1), max(round(width * zoom), 1), 3
        picture = np.full(shape, BACKGROUND, np.uint8)
        part = Part(zoom)
        _mark_detections(picture, data, part)
        return picture, part
    data, zoom = resized(data, room)
    return canvas.displayable(data), Part(zoom)


def resized(image: Image, room: Size | None) -> tuple[Image, float]:
    """An image as large as some room has it, and by how much it was enlarged."""
    zoom = _zoom((image.shape[1], image.shape[0]), room)
    if zoom == 1:
        return image, 1.0
    size = max(round(image.shape[1] * zoom), 1), max(round(image.shape[0] * zoom), 1)
    way = cv2.INTER_AREA if zoom < 1 else cv2.INTER_NEAREST
    return cast(Image, cv2.resize(image, size, interpolation=way)), zoom


def _zoom(size: Size, room: Size | None) -> float:
    """Factor by which a picture fits into some room; small ones grow a little, by whole pixels."""
    if room is None:
        return 1.0
    zoom = min(room[0] / size[0], room[1] / size[1])
    return zoom if zoom < 1 else float(min(int(zoom), _MOST_ENLARGED))


def with_sizes(session: Session, frame_set: FrameSet) -> Session:
    """A session whose cameras all have the size of a picture, as a frame shows them.

    One without a resolution, whose frames are detections, would be as large as each frame needs.
    """

    def sized(setup: SensorSetup) -> SensorSetup:
        frame = frame_set.frames.get(setup.name)
        data = None if frame is None else frame.data
        if setup.resolution or setup.sensor.dimension != 2 or isinstance(data, np.ndarray):
            return setup
        return replace(setup, resolution=_size_of(data))

    return replace(session, sensors=tuple(map(sized, session.sensors)))


def _size_of(data: Pattern | None) -> Size:
    """A size that holds detections of a camera that states no resolution."""
    if not isinstance(data, PointPattern) or not len(data.points):
        return _BLANK_SIZE
    width, height = np.ceil(1.1 * data.points.max(axis=0)).astype(int)
    return max(int(width), _BLANK_SIZE[0]), max(int(height), _BLANK_SIZE[1])


def draw_camera(
    posed: Posed,
    setup: SensorSetup,
    picture: Picture,
    part: Part,
    found: Floats | None = None,
    *,
    named: bool = True,
    captioned: bool = True,
) -> Picture:
    """Draw the bodies of a moment, and features `found` (M, 2), on a frame of `backdrop`."""
    several = len(posed) > 1
    colours = overlay.BODY_COLOURS if several else (overlay.STATUS_COLOURS[posed[0][1].status],)
    for k, (body, one) in enumerate(posed):
        picture = overlay.draw_pose(
            picture, setup.sensor, body, one.T_world_object, one.covariance,
            part=part, colour=colours[k % len(colours)], found=None if k else found, named=named,
        )  # fmt: skip
    first = posed[0][1]
    if captioned and several:
        overlay.legend(picture, [(one.label, one.status) for _, one in posed], first.frame)
    elif captioned:
        overlay.caption(picture, first.status, first.frame)
    return picture


def draw_strips(posed: Posed, setup: SensorSetup, frame: RawFrame | None) -> list[Picture]:
    """Draw what a range sensor measured, with the ranges of each body: a strip for each."""
    data = None if frame is None else frame.data
    pattern = data if isinstance(data, PointPattern | GridPattern) else None
    names = [f"{setup.name}, {one.label}" if len(posed) > 1 else setup.name for _, one in posed]
    rows = zip(names, posed, strict=True)
    return [draw_ranges(name, pattern, setup.sensor, *each) for name, each in rows]


def _name(picture: Picture, name: str, colour: Colour) -> None:
    """Write a sensor's name below the caption."""
    canvas.words(picture, name, canvas.caption_place(picture, 1), colour, size=0.9)


def small_box(picture: Picture, part: Part, posed: Posed, sensor: Sensor) -> Box | None:
    """Around all features in view, where they are small in a picture; else None."""
    places = [np.zeros((0, 2))]
    for body, one in posed:
        if one.T_world_object is not None:
            y, _, seen = overlay.projected_features(sensor, body, one.T_world_object)
            places.append(y[seen])
    y = np.concatenate(places)
    if len(y) < 2:
        return None
    lower, upper = y.min(axis=0), y.max(axis=0)
    side = max(float((upper - lower).max()) * (1 + 2 * _ROOM), _LEAST_PX)
    is_small = side * part.zoom < _SMALL * min(picture.shape[:2])
    return ((lower + upper - side) / 2, side) if is_small else None


def cut_out(whole: Picture, part: Part, size: Size, way: int) -> Picture:
    """A part of a picture of all pixels of a sensor, in some size, resized in some way."""
    # the sensor's place of the first pixel, and how far the next is
    first, step = np.array(part.corner) + 0.5 / part.zoom - 0.5, 1 / part.zoom
    to_sensor = np.array([[step, 0.0, first[0]], [0.0, step, first[1]]])
    cut = cv2.warpAffine(whole, to_sensor, size, flags=way | cv2.WARP_INVERSE_MAP)
    return np.asarray(cut, dtype=np.uint8)


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
        canvas.polyline(picture, corner + outline, WHITE, closed=True)


def draw_ranges(
    name: str, pattern: Pattern | None, sensor: Sensor, body: Body, estimate: Estimate
) -> Picture:
    """Draw what a range sensor measured, None where it has no frame, with the ranges of a pose."""
    size, T = STRIP_SIZE, estimate.T_world_object
    picture = np.full((size[1], size[0], 3), BACKGROUND, np.uint8)
    expected = np.zeros(0)
    if T is not None:
        y, _, seen = overlay.projected_features(sensor, body, T)
        expected = np.where(seen, y[:, 0], np.nan)
    low, high = _span(sensor, pattern, expected, body)
    width = size[0] - 2 * _MARGIN_PX

    def across(ranges: Floats) -> Floats:
        return np.asarray(_MARGIN_PX + width * (ranges - low) / (high - low))

    _draw_scale(picture, low, high, across)
    text = name if pattern is not None else f"{name}: no frame"
    canvas.words(picture, text, (_MARGIN_PX, 22), WHITE if pattern is not None else GREY)
    if isinstance(pattern, GridPattern):
        ranges = pattern.origin[0] + pattern.step * np.arange(pattern.values.shape[1])
        share = np.clip(pattern.values[0] / max(float(pattern.values[0].max()), 1e-30), -0.1, 1.0)
        heights = size[1] * (_BASE - (_BASE - _TOP) * share)
        canvas.polyline(picture, np.stack([across(ranges), heights], axis=-1), overlay.FOUND)
    elif pattern is not None:
        for u in across(pattern.points[:, 0]):
            ends = (u, _TOP * size[1]), (u, _BASE * size[1])
            canvas.polyline(picture, ends, overlay.FOUND, width=2)
    if T is not None:
        colour = overlay.STATUS_COLOURS[estimate.status]
        spread = half_widths_95(sensor, body, T, estimate.covariance) * width / (high - low)
        _draw_expected(picture, across(expected), spread, body.labels, colour)
    return picture


def half_widths_95(
    sensor: Sensor, body: Body, T_world_object: Floats, covariance: Floats | None
) -> Floats:
    """Half-widths (N,) of the intervals that hold a feature's range with 95 %; 0 if not known."""
    if covariance is None or not np.isfinite(covariance).all():
        return np.zeros(len(body))
    variances = overlay.projected_covariances(sensor, body, T_world_object, covariance)[:, 0, 0]
    return np.asarray(np.sqrt(overlay.CHI2_95[1] * np.maximum(variances, 0)))


def _span(
    sensor: Sensor, pattern: Pattern | None, expected: Floats, body: Body
) -> tuple[float, float]:
    """The ranges that are shown: the sensor's limits, or steps of about two bodies around all."""
    if isinstance(pattern, GridPattern):
        low = float(pattern.origin[0])
        return low, low + pattern.step * max(pattern.values.shape[1] - 1, 1)
    low, high = float(sensor.lower[0]), float(sensor.upper[0])
    if np.isfinite(low) and np.isfinite(high) and high > low:
        return low, high
    shown = expected[np.isfinite(expected)]
    if isinstance(pattern, PointPattern):
        shown = np.append(shown, pattern.points[:, 0])
    # whole steps, so that the scale stands still while the body moves within one
    step = _round_number(4 * body.radius)
    if not shown.size:
        return 0.0, step
    margin = 0.05 * step
    first = np.floor((shown.min() - margin) / step)
    return float(step * first), float(step * np.ceil((shown.max() + margin) / step))


def _round_number(least: float) -> float:
    """1, 2 or 5 times a power of ten, no less than a positive number."""
    unit = float(10.0 ** np.floor(np.log10(least)))
    return unit * next(factor for factor in (1, 2, 5, 10) if factor * unit >= least)


def _draw_scale(
    picture: Picture, low: float, high: float, across: Callable[[Floats], Floats]
) -> None:
    """A line with round numbers between two ends."""
    height, width = picture.shape[:2]
    base = _BASE * height
    canvas.polyline(picture, [(_MARGIN_PX, base), (width - _MARGIN_PX, base)], GREY)
    step = _round_number((high - low) / _TICKS)
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    ticks = np.asarray(step * np.arange(first, last + 1))
    for value, u in zip(ticks, across(ticks), strict=True):
        canvas.polyline(picture, [(u, base), (u, (_BASE + 0.04) * height)], GREY)
        canvas.words(picture, f"{value:g}", (u - 8, 0.96 * height), GREY, size=0.8)


def _draw_expected(
    picture: Picture, places: Floats, spread: Floats, labels: Sequence[str], colour: Colour
) -> None:
    """Triangles that point at the expected ranges, names above, and 95 % where wide enough."""
    height = picture.shape[0]
    tip, half = (_TOP - 0.02) * height, 5.0 * canvas.stroke(picture)
    previous = -np.inf
    for i in np.argsort(places):
        u = places[i]
        if not np.isfinite(u):
            continue
        corners = (u, tip), (u - half, tip - 1.6 * half), (u + half, tip - 1.6 * half)
        canvas.polyline(picture, corners, colour, closed=True)
        if spread[i] > half:
            canvas.polyline(picture, [(u - spread[i], tip), (u + spread[i], tip)], WHITE)
        if u - previous > 3 * half:  # else numbers would lie upon each other
            canvas.words(picture, labels[i], (u - 4, tip - 2.2 * half), colour, size=0.8)
            previous = u
