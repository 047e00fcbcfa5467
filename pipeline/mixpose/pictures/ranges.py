"""A range sensor's frame as a strip: what it measured, and where the pose has the features."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mixpose.body import Body
from mixpose.pictures import overlay
from mixpose.pictures.canvas import GREY, WHITE, Colour, Picture, polyline, stroke, words
from mixpose.records import Floats, GridPattern, Pattern, PointPattern, Status
from mixpose.sensors import Sensor

BACKGROUND = 24  # grey level
STRIP_SIZE = (960, 130)
_MARGIN_PX = 16
_TOP, _BASE = 0.42, 0.8  # of the height: between them the measurement, above it the pose
_TICKS = 8


def draw_ranges(
    name: str,
    pattern: Pattern | None,
    sensor: Sensor,
    body: Body,
    T_world_object: Floats | None,
    covariance: Floats | None = None,
    status: Status | None = None,
    *,
    size: tuple[int, int] = STRIP_SIZE,
) -> Picture:
    """Draw what a range sensor measured, None where it has no frame, with the ranges of a pose.

    `size` is width and height in px; all else is as for `mixpose.pictures.draw_pose`.
    """
    picture = np.full((size[1], size[0], 3), BACKGROUND, np.uint8)
    expected = np.zeros(0)
    if T_world_object is not None:
        y, _, seen = overlay.projected_features(sensor, body, T_world_object)
        expected = np.where(seen, y[:, 0], np.nan)
    low, high = _span(sensor, pattern, expected, body)
    width = size[0] - 2 * _MARGIN_PX

    def across(ranges: Floats) -> Floats:
        return np.asarray(_MARGIN_PX + width * (ranges - low) / (high - low))

    _draw_scale(picture, low, high, across(_ticks(low, high)))
    text = name if pattern is not None else f"{name}: no frame"
    words(picture, text, (_MARGIN_PX, 22), WHITE if pattern is not None else GREY)
    if isinstance(pattern, GridPattern):
        ranges = pattern.origin[0] + pattern.step * np.arange(pattern.values.shape[1])
        share = np.clip(pattern.values[0] / max(float(pattern.values[0].max()), 1e-30), -0.1, 1.0)
        heights = size[1] * (_BASE - (_BASE - _TOP) * share)
        polyline(picture, np.stack([across(ranges), heights], axis=-1), overlay.FOUND)
    elif pattern is not None:
        for u in across(pattern.points[:, 0]):
            bar = np.array([[u, _TOP * size[1]], [u, _BASE * size[1]]])
            polyline(picture, bar, overlay.FOUND, width=2)
    if T_world_object is not None:
        colour = overlay.STATUS_COLOURS[status or "ok"]
        spread = half_widths_95(sensor, body, T_world_object, covariance)
        _draw_expected(
            picture, across(expected), spread * width / (high - low), body.labels, colour
        )
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


def _ticks(low: float, high: float) -> Floats:
    """Round numbers between two ends."""
    step = _round_number((high - low) / _TICKS)
    first = np.ceil(low / step - 1e-9)
    return np.asarray(step * np.arange(int(first), int(np.floor(high / step + 1e-9)) + 1))


def _draw_scale(picture: Picture, low: float, high: float, places: Floats) -> None:
    height = picture.shape[0]
    ends = np.array([[_MARGIN_PX, _BASE * height], [picture.shape[1] - _MARGIN_PX, _BASE * height]])
    polyline(picture, ends, GREY)
    for value, u in zip(_ticks(low, high), places, strict=True):
        polyline(picture, np.array([[u, _BASE * height], [u, (_BASE + 0.04) * height]]), GREY)
        words(picture, f"{value:g}", (u - 8, 0.96 * height), GREY, size=0.8)


def _draw_expected(
    picture: Picture, places: Floats, spread: Floats, labels: Sequence[str], colour: Colour
) -> None:
    """Triangles that point at the expected ranges, names above, and 95 % where wide enough."""
    height = picture.shape[0]
    tip, half = (_TOP - 0.02) * height, 5.0 * stroke(picture)
    previous = -np.inf
    for i in np.argsort(places):
        u = places[i]
        if not np.isfinite(u):
            continue
        corners = np.array([[u, tip], [u - half, tip - 1.6 * half], [u + half, tip - 1.6 * half]])
        polyline(picture, corners, colour, closed=True)
        if spread[i] > half:
            ends = np.array([[u - spread[i], tip], [u + spread[i], tip]])
            polyline(picture, ends, WHITE)
        if u - previous > 3 * half:  # else numbers would lie upon each other
            words(picture, labels[i], (u - 4, tip - 2.2 * half), colour, size=0.8)
            previous = u
