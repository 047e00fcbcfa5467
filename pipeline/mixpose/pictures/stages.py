"""Draw the stages of one camera's frame: features, threshold, densities, pose.

The densities are those of the fit, g and C, per blur: g is the observed density g0 ∗ ε, and C is g
blurred once more, which the matched objective looks up.  Objectives that draw samples look g up on
a grid around these.  Panels of one kind share a scale, shown by a bar below: it is logarithmic, as
a peak falls with the square of the blur.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mixpose.body import Body
from mixpose.extraction.corners import CORNERS, saddle_strength
from mixpose.extraction.laplacian import spot_strength
from mixpose.extraction.threshold import feature_values
from mixpose.fit import EstimatorOptions
from mixpose.objective import View, matched_objective, region_of_interest
from mixpose.objective.paper import sampled_terms
from mixpose.pictures import canvas, overlay
from mixpose.pictures.canvas import WHITE, Colour, Picture, Size
from mixpose.pictures.finding import Finding
from mixpose.pictures.levels import Light
from mixpose.pictures.overlay import Part
from mixpose.pictures.scene import backdrop, cut_out
from mixpose.records import Estimate, Floats, GridPattern, PointPattern
from mixpose.rigid import transform

DensityAt: TypeAlias = Callable[[Floats], NDArray[Any]]  # values (...,) at places (..., 2)

ABOVE: Colour = (0, 140, 255)
_DIMMED = 0.45
_MARK_PX = 9.0
_MAGNIFIERS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_ELLIPSE_PX = 20.0  # larger half-axis of an ellipse that is well visible
_AROUND = 0.35  # margin around the body, by its extent
_LEAST_AROUND_PX = 25.0

_STEPS_PER_SIGMA = 1.5  # places per σ at which a density is looked up
_FINEST = 4  # most such places along each side of a pixel
_AT_ONCE = 2**20  # places at a time: 16 MB of coordinates
_SHOWN = 1e-3  # of the lowest peak: smaller values are black
_BAR_LINES = 1.6  # height of a bar, in lines of captions
# in widest blurs: peaks of C are √2 wider, and are visible up to √(2 ln 1/_SHOWN) deviations
_MARGIN = 5.3


def features_picture(finding: Finding, room: Size) -> Picture:
    """Draw the frame with crosses at all detections."""
    picture, part = backdrop(finding.setup, finding.frame, room)
    _mark(picture, part, finding)
    is_grid, count = finding.points is None, finding.count
    text = f"light as of {count:.1f} points" if is_grid else f"{count:.0f} found"
    return titled(picture, f"{finding.name}: {text}")


def threshold_picture(finding: Finding, room: Size) -> Picture:
    """Draw the basis of the extraction: pixels above the threshold, grey values or the response."""
    picture, part = backdrop(finding.setup, finding.frame, room)
    options = finding.setup.extract
    data = None if finding.frame is None else finding.frame.data
    if data is None or isinstance(data, PointPattern | GridPattern):
        return titled(picture, "detections: no threshold")
    size = picture.shape[1], picture.shape[0]
    if options.method == "corners":
        blurred = cv2.GaussianBlur(data.astype(np.float32), (0, 0), CORNERS.blur)
        values, title = np.sqrt(np.maximum(saddle_strength(blurred), 0)), "strength of saddles"
    elif options.method == "log":
        values, title = np.maximum(spot_strength(data, options), 0), "height of spots"
    elif options.method == "intensity":
        values = feature_values(data, options, (0, 0, data.shape[1], data.shape[0]))
        title = "grey values above the threshold"
    elif options.method == "blobs":
        picture = np.asarray(np.round(_DIMMED * picture), dtype=np.uint8)
        # a pixel of the picture is marked if any pixel of the frame in it is
        behind = np.ones([max(int(np.ceil(1 / part.zoom)), 1)] * 2, np.uint8)
        mask = cv2.dilate(Light(data, options).above, behind)
        picture[cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0] = ABOVE
        title = f"{'above' if options.polarity == 'bright' else 'below'} the threshold"
    else:
        return titled(picture, f"{options.method}: its own threshold")
    if options.method != "blobs":
        picture = canvas.displayable(cv2.resize(values, size, interpolation=cv2.INTER_AREA))
    if options.method != "intensity":
        _mark(picture, part, finding)
    return titled(picture, title)


def pose_picture(finding: Finding, body: Body, estimate: Estimate, room: Size) -> Picture:
    """Draw the part of the frame around the body, enlarged, with the pose."""
    T = estimate.T_world_object
    if finding.view is None or T is None:
        picture, _ = backdrop(finding.setup, finding.frame, room)
        return overlay.draw_pose(picture, finding.setup.sensor, body, None, None, estimate.status)
    part = fitted(shown_box(finding.view, body, T, None), room)
    whole, _ = backdrop(finding.setup, finding.frame, None)
    cut = cut_out(whole, part, room, cv2.INTER_NEAREST if part.zoom > 3 else cv2.INTER_LINEAR)
    factor, note = _magnifier(finding, body, estimate, part.zoom, canvas.stroke(cut))
    posed = body, T, estimate.covariance, estimate.status, estimate.frame
    sensor, points = finding.setup.sensor, finding.points
    drawn = overlay.draw_pose(cut, sensor, *posed, part=part, detections=points, magnified=factor)
    if note:
        place = canvas.caption_place(drawn)[0], drawn.shape[0] - 8
        canvas.words(drawn, note, place, WHITE, size=0.8)
    return drawn


def _magnifier(
    finding: Finding, body: Body, estimate: Estimate, zoom: float, scale: float
) -> tuple[int, str]:
    """Choose a round factor that makes ellipses visible, and describe them."""
    T, covariance = estimate.T_world_object, estimate.covariance
    if T is None or covariance is None or not np.isfinite(covariance).all():
        return 1, ""
    sensor = finding.setup.sensor
    y, _, seen = overlay.projected_features(sensor, body, T)
    spreads = overlay.projected_covariances(sensor, body, T, covariance)[seen]
    if not len(spreads):
        return 1, ""
    largest = [np.linalg.norm(overlay.ellipse_95(spread), axis=1).max() for spread in spreads]
    room = min(_ELLIPSE_PX * scale, 0.4 * zoom * overlay.median_gap(y[seen]))
    allowed = room / max(zoom * float(np.median(largest)), 1e-12)
    factor = max((n for n in _MAGNIFIERS if n <= allowed), default=1)
    enlarged = f", drawn {factor} times as large" if factor > 1 else ""
    return factor, f"95 % within {max(largest):.2g} px{enlarged}"


def shown_box(
    view: View, body: Body, T: Floats | None, margin: float | None
) -> tuple[Floats, Floats]:
    """Return the corners of a camera's image around the body, else around all detections."""
    y = np.zeros((0, 2))
    if T is not None:
        y, seen = view.sensor.project(transform(T, body.nodes.points))
        y = y[seen]
    if not len(y):
        y = np.stack(view.observation.extent) if not view.observation.is_empty else y
    if not len(y):
        return np.zeros(2), np.array([639.0, 479.0])
    if margin is None:
        margin = max(_AROUND * float(np.ptp(y, axis=0).max()), _LEAST_AROUND_PX)
    return region_of_interest(view.sensor, y, margin)


def fitted(box: tuple[Floats, Floats], room: Size) -> Part:
    """Return the part of a sensor that shows a box of its coordinates as large as a room allows."""
    extent = np.maximum(box[1] - box[0] + 1, 1)
    zoom = float(min(room[0] / extent[0], room[1] / extent[1]))
    # the box is in the middle of the room, which may show more
    corner = np.floor(box[0] - (np.array(room) / zoom - extent) / 2)
    return Part(zoom, (float(corner[0]), float(corner[1])))


def _mark(picture: Picture, part: Part, finding: Finding) -> None:
    """Draw crosses at detections, whose arms begin outside of small spots."""
    points = finding.points
    if points is None or not len(points):
        return
    thin, zoom = canvas.stroke(picture), part.zoom
    gaps = cKDTree(points).query(points, k=2)[0][:, 1]  # infinite for a single detection
    reach = min(_MARK_PX * thin, max(0.45 * zoom * float(np.median(gaps)), 3.0))
    pattern = None if finding.view is None else finding.view.observation.pattern
    radii = pattern.radii if isinstance(pattern, PointPattern) else np.zeros(len(points))
    # radius at half height plus 3 px, or 1 px if unknown, plus half of a line
    spots = zoom * (1.1 * radii + np.where(radii > 0, 3.0, 1.0)) + 1.5 * thin
    for place, spot, gap in zip(part.places(points), spots, zoom * gaps, strict=True):
        inner = spot if reach / 3 < spot < reach else reach / 3
        outer = min(inner + 2 * reach / 3, max(gap - spot, inner + 2.0))
        canvas.cross(picture, place, inner, outer, overlay.MEASURED)


def titled(picture: Picture, title: str) -> Picture:
    """Write a caption into the upper left corner of a picture, in place, and return it."""
    canvas.words(picture, title, canvas.caption_place(picture), WHITE, size=0.9)
    return picture


@dataclass(frozen=True)
class Panel:
    """Values of a density on the pixels of a picture."""

    title: str
    values: Floats  # (H, W) in 1/px², largest in a pixel


def densities_picture(
    view: View,
    body: Body,
    T: Floats | None,
    sigmas: Sequence[float],
    options: EstimatorOptions,
    room: Size,
) -> Picture:
    """Draw a row of g at the blurs of a fit, and a row of C, with their scales below.

    `sigmas` are standard deviations of a feature in px, in the order of the fit, the last σ_ε or
    less. Panels of a size `room` show the surroundings of the body, or, without a pose, those of
    all detections.
    """
    box = shown_box(view, body, T, _MARGIN * max(sigmas))
    part = fitted(box, room)
    rows = []
    for panels in panels_of(view, body, T, sigmas, options, part, room):
        peaks = [float(panel.values.max()) for panel in panels]
        top = max(peaks) or 1.0  # without detections around the body all is black
        bottom = _SHOWN * min((peak for peak in peaks if peak > 0), default=top)
        drawn = []
        for panel in panels:
            picture = _coloured(panel.values, bottom, top)
            above = round(1.5 * canvas.line_height(picture)), picture.shape[1], 3
            head = titled(np.zeros(above, np.uint8), panel.title)
            drawn.append(np.concatenate([head, picture]))
        row = canvas.in_grid(drawn, len(drawn))
        rows += [row, _bar(row.shape[1], drawn[0], bottom, top)]
    return canvas.stacked(rows)


def panels_of(
    view: View,
    body: Body,
    T: Floats | None,
    sigmas: Sequence[float],
    options: EstimatorOptions,
    part: Part,
    size: Size,
) -> list[list[Panel]]:
    """Return the panels of g and those of C, of a size (width, height), for a part of the image.

    Sampled objectives climb g alone; the only C is then that at σ_ε, by which the pose is judged.
    """
    is_matched = options.objective == "matched"
    matched_sigmas = list(sigmas) if is_matched else [view.observation.sigma]
    lower = np.array(part.corner) - 1.0
    shown = lower, lower + np.array(size) / part.zoom + 2.0
    pattern = view.observation.pattern
    points = pattern.points if isinstance(pattern, PointPattern) else np.zeros((0, 2))

    def panel(what: str, sigma: float, density_at: DensityAt) -> Panel:
        values = _largest(density_at, sigma, points, part, size)
        return Panel(f"{what}, σ = {sigma:.3g} px", values)

    def g_panel(sigma: float) -> Panel:
        if is_matched or T is None:
            # exact sums, on a grid
            return panel("g", sigma, view.observation.density(sigma, shown).sample)
        # as in objectives that draw samples: around these, 0 elsewhere
        samples = body.sample(options.samples, seed=options.seed)
        terms = sampled_terms([view], samples, [sigma], T)
        if not terms:
            return panel("g sampled", sigma, lambda places: np.zeros(places.shape[:-1]))
        return panel("g sampled", sigma, lambda places: terms[0].density.sample(places)[..., 0])

    def matched_panel(sigma: float) -> Panel:
        atlas = matched_objective([view], body, [sigma]).atlas
        return panel("C = g ∗ ε", sigma, lambda places: atlas.look_up(places[None])[0, ..., 0])

    return [[*map(g_panel, sigmas)], [*map(matched_panel, matched_sigmas)]]


def _largest(density_at: DensityAt, sigma: float, points: Floats, part: Part, size: Size) -> Floats:
    """Return the largest value of a density within each pixel (H, W), lest peaks be missed.

    Values at the detections (n, 2) are included, as their peaks may be too narrow for the grid.
    """
    width, height = size
    fine = min(max(int(np.ceil(_STEPS_PER_SIGMA / (part.zoom * sigma))), 1), _FINEST)
    u, v = (
        (np.arange(fine * n) + 0.5) / (fine * part.zoom) - 0.5 + corner
        for n, corner in zip(size, part.corner, strict=True)
    )
    largest, rows = np.zeros((height, width)), max(_AT_ONCE // (fine * fine * width), 1)
    for first in range(0, height, rows):
        places = np.stack(np.meshgrid(u, v[first * fine : (first + rows) * fine]), axis=-1)
        blocks = np.asarray(density_at(places), np.float64).reshape(-1, fine, width, fine)
        largest[first : first + rows] = np.maximum(blocks.max(axis=(1, 3)), 0.0)
    column, row = np.round(part.places(points)).astype(np.intp).T
    shown = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    if shown.any():
        np.maximum.at(largest, (row[shown], column[shown]), density_at(points[shown][None])[0])
    return largest


def _coloured(values: Floats, bottom: float, top: float) -> Picture:
    """Convert densities to colours, black below `bottom` and brightest at `top`."""
    share = np.log(np.maximum(values, bottom) / bottom) / np.log(top / bottom)
    grey = np.round(255 * np.clip(share, 0, 1)).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO), dtype=np.uint8)


def _bar(width: int, panel: Picture, bottom: float, top: float) -> Picture:
    """Draw the scale of a row of panels as a bar with powers of ten."""
    line = canvas.line_height(panel)
    shares = np.linspace(0, 1, width)
    bar = np.tile(bottom * (top / bottom) ** shares, (max(round(0.4 * line), 4), 1))
    picture = np.zeros((round(_BAR_LINES * line), width, 3), np.uint8)
    picture[: len(bar)] = _coloured(bar, bottom, top)
    baseline, size = picture.shape[0] - 0.3 * line, 0.8
    largest = f"{top:.1e} / px²"
    end = width - canvas.width_of(picture, largest, size=size) - 0.3 * line
    canvas.words(picture, largest, (end, baseline), WHITE, size=size)
    free = 0.0  # u from which on words have room
    for power in np.arange(np.ceil(np.log10(bottom)), np.floor(np.log10(top)) + 1):
        u, word = width * (power - np.log10(bottom)) / np.log10(top / bottom), f"1e{power:.0f}"
        reach = canvas.width_of(picture, word, size=size) + 0.5 * line
        if free <= u < end - reach:
            picture[: len(bar), round(u) : round(u) + 2] = 255
            canvas.words(picture, word, (u, baseline), WHITE, size=size)
            free = u + reach
    return picture
