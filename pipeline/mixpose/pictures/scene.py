"""Draw all sensors of one moment in one picture, with the poses: a frame of an overlay.

Bodies that are small in the frame of a camera are repeated, enlarged, in a corner of its picture.
The frame of a range sensor is a strip: its measurements and the expected ranges of features.
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
from mixpose.rigid import CHI2_95
from mixpose.sensors import Sensor
from mixpose.session import SensorSetup, Session

LARGEST = (1920, 1080)
_MOST_ENLARGED = 2
_BLANK_SIZE = (640, 480)
_DETECTION_PX = 2.5

Posed: TypeAlias = Sequence[tuple[Body, Estimate]]
Box: TypeAlias = tuple[Floats, float]  # a square, px: place (2,) of the upper left pixel, and side

_SMALL = 0.25  # of the shorter side of a picture: smaller boxes are repeated, enlarged
_SIDE = 0.4  # side of the inset, by the shorter side of the picture
_ROOM = 0.3  # margin on all sides of the features, by their extent
_LEAST_PX = 24.0  # of the sensor: smallest side of a box

BACKGROUND = 24  # grey level
STRIP_SIZE = (960, 130)
_MARGIN_PX = 16  # of a strip
_TOP, _BASE = 0.42, 0.8  # of the height: between them the measurement, above it the pose
_TICKS = 8


def draw_scene(session: Session, frame_set: FrameSet, *estimates: Estimate) -> Picture:
    """Draw the frames of all sensors with the poses estimated from them, one of each body.

    Cameras are side by side, range sensors are strips below them; several bodies have different
    colours. Frames of constant size give pictures of constant size.
    """
    posed = with_bodies(session, estimates)
    cameras = [setup for setup in session.sensors if setup.sensor.dimension == 2]
    strips = [setup for setup in session.sensors if setup.sensor.dimension == 1]
    rows: list[Picture] = []
    if cameras:
        columns, room = canvas.columns_for(len(cameras)), room_for(len(cameras))
        panels = [_panel(posed, setup, frame_set.frames.get(setup.name), room) for setup in cameras]
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
    """Draw a camera's frame with the poses; if small in it, repeat them enlarged in a corner."""
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
    """Draw the detections of a camera that gives detections instead of images."""
    if isinstance(data, PointPattern):
        for place in part.places(data.points):
            canvas.ring(picture, place, _DETECTION_PX * canvas.stroke(picture), overlay.MEASURED)


def with_bodies(session: Session, estimates: Sequence[Estimate]) -> list[tuple[Body, Estimate]]:
    """Pair estimates with their bodies."""
    bodies = {setup.body.name: setup.body for setup in session.objects}
    return [(bodies.get(estimate.object, session.body), estimate) for estimate in estimates]


def room_for(cameras: int) -> Size:
    """Return width and height in px per camera in a picture of so many."""
    columns = canvas.columns_for(cameras)
    return LARGEST[0] // columns, LARGEST[1] // -(-cameras // columns)


def backdrop(setup: SensorSetup, frame: RawFrame | None, room: Size | None) -> tuple[Picture, Part]:
    """Return a camera's frame as a picture that fits into a room, and the part that it shows.

    Without a room it keeps its size. Detections instead of images are rings on a dark ground.
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
    """Resize an image to fit into a room; also return the factor."""
    zoom = _zoom((image.shape[1], image.shape[0]), room)
    if zoom == 1:
        return image, 1.0
    size = max(round(image.shape[1] * zoom), 1), max(round(image.shape[0] * zoom), 1)
    interpolation = cv2.INTER_AREA if zoom < 1 else cv2.INTER_NEAREST
    return cast(Image, cv2.resize(image, size, interpolation=interpolation)), zoom


def _zoom(size: Size, room: Size | None) -> float:
    """Return the factor to fit into a room; small pictures grow by a whole factor, 2 at most."""
    if room is None:
        return 1.0
    zoom = min(room[0] / size[0], room[1] / size[1])
    return zoom if zoom < 1 else float(min(int(zoom), _MOST_ENLARGED))


def with_sizes(session: Session, frame_set: FrameSet) -> Session:
    """Set missing resolutions of cameras by a frame, lest sizes of pictures vary by detections."""

    def sized(setup: SensorSetup) -> SensorSetup:
        frame = frame_set.frames.get(setup.name)
        data = None if frame is None else frame.data
        if setup.resolution or setup.sensor.dimension != 2 or isinstance(data, np.ndarray):
            return setup
        return replace(setup, resolution=_size_of(data))

    return replace(session, sensors=tuple(map(sized, session.sensors)))


def _size_of(data: Pattern | None) -> Size:
    """Return a size that contains detections of a camera without a resolution."""
    if not isinstance(data, PointPattern) or not len(data.points):
        return _BLANK_SIZE
    width, height = np.ceil(1.1 * data.points.max(axis=0)).astype(int)
    return max(int(width), _BLANK_SIZE[0]), max(int(height), _BLANK_SIZE[1])


def draw_camera(
    posed: Posed,
    setup: SensorSetup,
    picture: Picture,
    part: Part,
    detections: Floats | None = None,
    *,
    named: bool = True,
    captioned: bool = True,
) -> Picture:
    """Draw the bodies of a moment, and `detections` (M, 2), on a frame of `backdrop`."""
    several = len(posed) > 1
    colours = overlay.BODY_COLOURS if several else (overlay.STATUS_COLOURS[posed[0][1].status],)
    for k, (body, estimate) in enumerate(posed):
        picture = overlay.draw_pose(
            picture, setup.sensor, body, estimate.T_world_object, estimate.covariance,
            part=part, colour=colours[k % len(colours)], named=named,
            detections=None if k else detections,
        )  # fmt: skip
    first = posed[0][1]
    if captioned and several:
        statuses = [(estimate.label, estimate.status) for _, estimate in posed]
        overlay.legend(picture, statuses, first.frame)
    elif captioned:
        overlay.caption(picture, first.status, first.frame)
    return picture


def draw_strips(posed: Posed, setup: SensorSetup, frame: RawFrame | None) -> list[Picture]:
    """Draw a strip per body: the measurements of a range sensor and the body's expected ranges."""
    data = None if frame is None else frame.data
    pattern = data if isinstance(data, PointPattern | GridPattern) else None
    name, several = setup.name, len(posed) > 1
    names = [f"{name}, {estimate.label}" if several else name for _, estimate in posed]
    rows = zip(names, posed, strict=True)
    return [draw_ranges(title, pattern, setup.sensor, *pair) for title, pair in rows]


def _name(picture: Picture, name: str, colour: Colour) -> None:
    """Write a sensor's name below the caption."""
    canvas.words(picture, name, canvas.caption_place(picture, 1), colour, size=0.9)


def small_box(picture: Picture, part: Part, posed: Posed, sensor: Sensor) -> Box | None:
    """Return a box around all features in view if it is small in the picture, else None."""
    places = [np.zeros((0, 2))]
    for body, estimate in posed:
        if estimate.T_world_object is not None:
            y, _, seen = overlay.projected_features(sensor, body, estimate.T_world_object)
            places.append(y[seen])
    y = np.concatenate(places)
    if len(y) < 2:
        return None
    lower, upper = y.min(axis=0), y.max(axis=0)
    side = max(float((upper - lower).max()) * (1 + 2 * _ROOM), _LEAST_PX)
    is_small = side * part.zoom < _SMALL * min(picture.shape[:2])
    return ((lower + upper - side) / 2, side) if is_small else None


def cut_out(whole: Picture, part: Part, size: Size, interpolation: int) -> Picture:
    """Cut a part out of a picture of a whole sensor; resize it to a size, by an interpolation."""
    # place on the sensor of the first pixel, and distance to the next
    first, step = np.array(part.corner) + 0.5 / part.zoom - 0.5, 1 / part.zoom
    to_sensor = np.array([[step, 0.0, first[0]], [0.0, step, first[1]]])
    cut = cv2.warpAffine(whole, to_sensor, size, flags=interpolation | cv2.WARP_INVERSE_MAP)
    return np.asarray(cut, dtype=np.uint8)


def put_into(picture: Picture, part: Part, inset: Picture, box: Box) -> None:
    """Put an inset into the corner of a picture farthest from the box, in place; not upper left."""
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
    """Draw measurements of a range sensor, None without a frame, and expected ranges of a pose."""
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
        canvas.polyline(picture, np.stack([across(ranges), heights], axis=-1), overlay.MEASURED)
    elif pattern is not None:
        for u in across(pattern.points[:, 0]):
            ends = (u, _TOP * size[1]), (u, _BASE * size[1])
            canvas.polyline(picture, ends, overlay.MEASURED, width=2)
    if T is not None:
        colour = overlay.STATUS_COLOURS[estimate.status]
        spread = half_widths_95(sensor, body, T, estimate.covariance) * width / (high - low)
        _draw_expected(picture, across(expected), spread, body.labels, colour)
    return picture


def half_widths_95(
    sensor: Sensor, body: Body, T_world_object: Floats, covariance: Floats | None
) -> Floats:
    """Return half-widths (N,) of 95 % intervals of the ranges of features; 0 if not known."""
    if covariance is None or not np.isfinite(covariance).all():
        return np.zeros(len(body))
    variances = overlay.projected_covariances(sensor, body, T_world_object, covariance)[:, 0, 0]
    return np.asarray(np.sqrt(CHI2_95[1] * np.maximum(variances, 0)))


def _span(
    sensor: Sensor, pattern: Pattern | None, expected: Floats, body: Body
) -> tuple[float, float]:
    """Return the shown ranges: those of the profile, the sensor's limits, or steps around all."""
    if isinstance(pattern, GridPattern):
        low = float(pattern.origin[0])
        return low, low + pattern.step * max(pattern.values.shape[1] - 1, 1)
    low, high = float(sensor.lower[0]), float(sensor.upper[0])
    if np.isfinite(low) and np.isfinite(high) and high > low:
        return low, high
    shown = expected[np.isfinite(expected)]
    if isinstance(pattern, PointPattern):
        shown = np.append(shown, pattern.points[:, 0])
    # whole steps, so that the scale is constant while the body moves within one
    step = _round_number(4 * body.radius)
    if not shown.size:
        return 0.0, step
    margin = 0.05 * step
    first = np.floor((shown.min() - margin) / step)
    return float(step * first), float(step * np.ceil((shown.max() + margin) / step))


def _round_number(least: float) -> float:
    """Round a positive number up to 1, 2 or 5 times a power of ten."""
    unit = float(10.0 ** np.floor(np.log10(least)))
    return unit * next(factor for factor in (1, 2, 5, 10) if factor * unit >= least)


def _draw_scale(
    picture: Picture, low: float, high: float, across: Callable[[Floats], Floats]
) -> None:
    """Draw a scale with round numbers between two ranges."""
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
    """Draw triangles at expected ranges with names, and 95 % intervals if wide enough."""
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
        if u - previous > 3 * half:  # else names would overlap
            canvas.words(picture, labels[i], (u - 4, tip - 2.2 * half), colour, size=0.8)
            previous = u
