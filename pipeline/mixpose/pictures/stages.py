"""Pictures of what happens to one camera's frame: features, threshold, pose."""

from __future__ import annotations

from typing import TypeAlias

import cv2
import numpy as np

from mixpose.body import Body
from mixpose.extraction.corners import CornerRules, saddle_strength
from mixpose.extraction.laplacian import spot_strength
from mixpose.extraction.threshold import above, feature_values, foreground
from mixpose.objective import View, region_of_interest
from mixpose.pictures import canvas, overlay
from mixpose.pictures.canvas import WHITE, Colour, Picture
from mixpose.pictures.finding import Finding
from mixpose.pictures.overlay import Part
from mixpose.pictures.scene import backdrop, cut_out
from mixpose.records import Estimate, Floats, GridPattern, PointPattern
from mixpose.rigid import transform

Size: TypeAlias = tuple[int, int]

ABOVE: Colour = (0, 140, 255)
_DIMMED = 0.45
_MARK_PX = 9.0
_MAGNIFIERS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_ELLIPSE_PX = 20.0  # larger half-axis of an ellipse that is easily seen
_AROUND = 0.35  # of the body's extent, shown around it
_LEAST_AROUND_PX = 25.0


def features_picture(finding: Finding, room: Size) -> Picture:
    """The frame with a cross at every feature found."""
    picture, part = backdrop(finding.setup, finding.frame, room)
    _mark(picture, part, finding.points)
    count = f"{finding.count:.0f}" if finding.points is not None else f"{finding.count:.1f}"
    text = f"{count} found" if finding.points is not None else f"light as of {count} points"
    return titled(picture, f"{finding.name}: {text}")


def threshold_picture(finding: Finding, room: Size) -> Picture:
    """What the extraction goes by: pixels above the threshold, grey values, or the response."""
    picture, part = backdrop(finding.setup, finding.frame, room)
    options = finding.setup.extract
    data = None if finding.frame is None else finding.frame.data
    if data is None or isinstance(data, PointPattern | GridPattern):
        return titled(picture, "detections: no threshold")
    size = picture.shape[1], picture.shape[0]
    window = 0, 0, data.shape[1], data.shape[0]
    if options.method == "corners":
        blurred = cv2.GaussianBlur(data.astype(np.float32), (0, 0), CornerRules().blur)
        values = np.sqrt(np.maximum(saddle_strength(blurred), 0))
        title = "strength of saddles"
    elif options.method == "log":
        values = np.maximum(spot_strength(data, options), 0)
        title = "height of spots"
    elif options.method == "intensity":
        values = feature_values(data, options, window)
        title = "grey values above the threshold"
    elif options.method == "blobs":
        scene = foreground(data, options, window)
        mask = above(scene.grey, scene.zero + scene.level)
        picture = np.asarray(np.round(_DIMMED * picture), dtype=np.uint8)
        # a pixel of the picture is marked if any of those behind it is
        behind = np.ones([max(int(np.ceil(1 / part.zoom)), 1)] * 2, np.uint8)
        shown = cv2.resize(cv2.dilate(mask, behind), size, None, 0, 0, cv2.INTER_NEAREST)
        picture[shown > 0] = ABOVE
        title = f"{'above' if options.polarity == 'bright' else 'below'} the threshold"
    else:
        return titled(picture, f"{options.method}: its own threshold")
    if options.method != "blobs":
        picture = canvas.displayable(cv2.resize(values, size, interpolation=cv2.INTER_AREA))
    if options.method != "intensity":
        _mark(picture, part, finding.points)
    return titled(picture, title)


def pose_picture(finding: Finding, body: Body, estimate: Estimate, room: Size) -> Picture:
    """The part of the frame around the body, enlarged, with the pose on it."""
    T = estimate.T_world_object
    if finding.view is None or T is None:
        picture, _ = backdrop(finding.setup, finding.frame, room)
        return overlay.draw_pose(picture, finding.setup.sensor, body, None, None, estimate.status)
    part = fitted(shown_box(finding.view, body, T, None), room)
    whole, _ = backdrop(finding.setup, finding.frame, None)
    cut = cut_out(whole, part, room, cv2.INTER_NEAREST if part.zoom > 3 else cv2.INTER_LINEAR)
    factor, note = _magnifier(finding, body, estimate, part.zoom, canvas.stroke(cut))
    drawn = overlay.draw_pose(
        cut,
        finding.setup.sensor,
        body,
        T,
        estimate.covariance,
        estimate.status,
        estimate.frame,
        part=part,
        found=finding.points,
        magnified=factor,
    )
    if note:
        place = canvas.caption_place(drawn)[0], drawn.shape[0] - 8
        canvas.words(drawn, note, place, WHITE, size=0.8)
    return drawn


def _magnifier(
    finding: Finding, body: Body, estimate: Estimate, zoom: float, scale: float
) -> tuple[int, str]:
    """A round factor that makes ellipses large enough to be seen, and what to say of them."""
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
    factor = max((each for each in _MAGNIFIERS if each <= allowed), default=1)
    enlarged = f", drawn {factor} times as large" if factor > 1 else ""
    return factor, f"95 % within {max(largest):.2g} px{enlarged}"


def shown_box(
    view: View, body: Body, T: Floats | None, margin: float | None
) -> tuple[Floats, Floats]:
    """The part of a camera's image around the body, or around all that was found."""
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
    """The part of a sensor with a box of its coordinates that fits into some room."""
    extent = np.maximum(box[1] - box[0] + 1, 1)
    zoom = float(min(room[0] / extent[0], room[1] / extent[1]))
    # the box in the middle; what else there is room for is shown too
    corner = np.floor(box[0] - (np.array(room) / zoom - extent) / 2)
    return Part(zoom, (float(corner[0]), float(corner[1])))


def _mark(picture: Picture, part: Part, points: Floats | None) -> None:
    if points is None or not len(points):
        return
    reach = min(
        _MARK_PX * canvas.stroke(picture), max(0.45 * part.zoom * overlay.median_gap(points), 3.0)
    )
    for place in part.places(points):
        canvas.cross(picture, place, reach / 3, reach, overlay.FOUND)


def titled(picture: Picture, title: str) -> Picture:
    """The picture, with a caption in its upper left corner."""
    canvas.words(picture, title, canvas.caption_place(picture), WHITE, size=0.9)
    return picture
