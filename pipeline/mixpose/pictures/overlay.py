"""Draw a pose on the frame of a camera: features, their uncertainty, the object's axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from mixpose.body import Body
from mixpose.objective import pose_jacobian
from mixpose.pictures import canvas
from mixpose.pictures.canvas import GREY, WHITE, Colour, Picture
from mixpose.records import Floats, Mask, Status
from mixpose.rigid import CHI2_95, transform
from mixpose.sensors import Sensor, facing

STATUS_COLOURS: dict[Status, Colour] = {
    "ok": (90, 230, 70),
    "ambiguous": (0, 180, 255),
    "lost": (80, 80, 255),
}
MEASURED: Colour = (255, 220, 60)
AXES: tuple[tuple[str, Colour], ...] = (
    ("x", (80, 80, 255)),
    ("y", (90, 230, 70)),
    ("z", (255, 150, 60)),
)

BODY_COLOURS: tuple[Colour, ...] = (
    *((90, 230, 70), (255, 150, 60), (200, 90, 255), (60, 220, 255)),
    *((230, 230, 90), (150, 120, 255), (120, 200, 140), (255, 120, 190)),
)
"""Colours of several bodies, in turn."""

_AXIS_SHARE = 0.5  # of the body's radius
_AXIS_PIECES = 24  # per axis, as lenses bend it
_MARK_PX = 7.0
_CLEAR_SHARE = 0.3  # radius of a mark, by the distance to the next feature
_MOST_NUMBERS = 30  # features; larger bodies are drawn without numbers
_LEAST_ELLIPSE_PX = 3.0  # of the larger half-axis; smaller ones are behind the mark


@dataclass(frozen=True)
class Part:
    """The part of a sensor that a picture shows: pixels from `corner` on, `zoom` times as large."""

    zoom: float = 1.0  # pixels of the picture per pixel of the sensor
    corner: tuple[float, float] = (0.0, 0.0)  # the sensor's pixel (u, v) in the upper left

    def places(self, y: Floats) -> Floats:
        """Convert sensor coordinates (..., 2) to places on the picture."""
        return np.asarray((y - self.corner + 0.5) * self.zoom - 0.5)


WHOLE = Part()


def draw_pose(
    image_bgr: Picture,
    sensor: Sensor,
    body: Body,
    T_world_object: Floats | None,
    covariance: Floats | None = None,
    status: Status | None = None,
    frame: int | None = None,
    *,
    part: Part = WHOLE,
    detections: Floats | None = None,
    magnified: float = 1.0,
    colour: Colour | None = None,
    named: bool = True,
) -> Picture:
    """Draw a pose on a camera's frame (H, W, 3), of uint8, and return a new picture.

    The frame is as of `mixpose.pictures.displayable`; `part` is the part of the sensor that it
    shows, if cut or resized. Without a pose (4, 4) none is drawn, as for a lost frame. The
    covariance (6, 6), in the order of `mixpose.rigid`, gives 95 % ellipses of the features' places,
    `magnified` by a factor; those too small to be seen are left out. Status and number of the frame
    are written in the corner; `colour` is of the features, by default that of the status.
    `detections` (M, 2), in pixels of the sensor, are marked; names of features if they are `named`.
    """
    picture = np.ascontiguousarray(image_bgr).copy()
    pose, radius = None, _MARK_PX * canvas.stroke(picture)
    if T_world_object is not None:
        pose = _DrawnPose(picture, sensor, body, T_world_object, part)
        radius = pose.radius
    for place in part.places(detections) if detections is not None else ():
        canvas.cross(picture, place, 1.4 * radius, 2.2 * radius, MEASURED)
    if pose is not None:
        pose.draw_ellipses(covariance, magnified)
        pose.draw_axes()  # first, so that features and names stay on top
        pose.draw_features(colour or STATUS_COLOURS[status or "ok"], named=named)
    caption(picture, status, frame)
    return picture


def projected_features(
    sensor: Sensor, body: Body, T_world_object: Floats
) -> tuple[Floats, Mask, Mask]:
    """Project features: places (N, m), which can be measured, and which face the sensor as well."""
    points = transform(T_world_object, body.means)
    y, inside = sensor.project(points)
    faced = facing(sensor, T_world_object, points, body.normals, body.edge_on)
    return y, inside, inside & faced


def projected_covariances(
    sensor: Sensor, body: Body, T_world_object: Floats, covariance: Floats
) -> Floats:
    """Propagate the covariance (6, 6) of a pose to those (N, m, m) of projected features."""
    _, by_world, _ = sensor.linearise(transform(T_world_object, body.means))
    J = pose_jacobian(by_world, body.means @ T_world_object[:3, :3].T)
    return np.asarray(J @ covariance @ np.swapaxes(J, -1, -2))


def ellipse_95(covariance: Floats) -> Floats:
    """Return points (n, 2) of the 95 % ellipse, about the origin, of a covariance (2, 2)."""
    values, vectors = np.linalg.eigh(covariance)
    turn = np.linspace(0, 2 * np.pi, 65)[:-1]
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    return np.asarray((circle * np.sqrt(CHI2_95[2] * np.maximum(values, 0))) @ vectors.T)


def median_gap(y: Floats) -> float:
    """Return the median distance of places (n, 2) to their nearest neighbours; infinite for one."""
    return float(np.median(cKDTree(y).query(y, k=2)[0][:, 1])) if len(y) else np.inf


@dataclass(frozen=True)
class _DrawnPose:
    """A pose that is drawn on the picture of a part of a sensor."""

    picture: Picture
    sensor: Sensor
    body: Body
    T: Floats
    part: Part

    @cached_property
    def features(self) -> tuple[Floats, Mask, Mask]:
        """Projected features in sensor coordinates, as of `projected_features`."""
        return projected_features(self.sensor, self.body, self.T)

    @cached_property
    def radius(self) -> float:
        """Radius in px of the rings of features: visible, and clear of neighbours."""
        y, _, seen = self.features
        usual = _MARK_PX * canvas.stroke(self.picture)
        return min(usual, max(_CLEAR_SHARE * self.part.zoom * median_gap(y[seen]), 3.0))

    def _project(self, points: Floats) -> tuple[Floats, Mask]:
        """Project points (n, 3) of the body to the picture: places, and a mask of those in view."""
        y, inside = self.sensor.project(transform(self.T, points))
        return self.part.places(y), inside

    def draw_features(self, colour: Colour, *, named: bool) -> None:
        """Draw rings and names of features, lines for segments; smaller rings if turned away."""
        nodes, inside = self._project(self.body.nodes.points)
        for feature in np.flatnonzero(np.bincount(self.body.nodes.feature) > 1):
            along = inside & (self.body.nodes.feature == feature)
            canvas.polyline(self.picture, nodes[along], colour)
        y, inside, seen = self.features
        for i, place in enumerate(self.part.places(y)):
            if not inside[i]:
                continue
            if not seen[i]:  # turned away
                canvas.ring(self.picture, place, self.radius / 2, GREY)
                continue
            canvas.ring(self.picture, place, self.radius, colour)
            if named and len(self.body) <= _MOST_NUMBERS:
                text_place = (place[0] + 1.2 * self.radius, place[1] - 0.9 * self.radius)
                canvas.words(self.picture, self.body.labels[i], text_place, colour, size=0.8)

    def draw_ellipses(self, covariance: Floats | None, magnified: float) -> None:
        """Draw the 95 % ellipses of features in view that are large enough to be seen."""
        if covariance is None or not np.isfinite(covariance).all():
            return
        y, _, seen = self.features
        spreads = projected_covariances(self.sensor, self.body, self.T, covariance)
        least = _LEAST_ELLIPSE_PX * canvas.stroke(self.picture)
        for place, spread in zip(self.part.places(y)[seen], spreads[seen], strict=True):
            outline = magnified * self.part.zoom * ellipse_95(spread)
            if np.linalg.norm(outline, axis=1).max() >= least:
                canvas.polyline(self.picture, place + outline, WHITE, closed=True)

    def draw_axes(self) -> None:
        """Draw the object's axes at its origin, or at the centre of the features if out of view."""
        origin = np.zeros((1, 3))
        if not self._project(origin)[1].all():
            origin = self.body.means.mean(axis=0, keepdims=True)
        (start,), in_view = self._project(origin)
        if not in_view.all():
            return
        # the axes leave out a feature at the origin
        y, _, seen = self.features
        away = np.linalg.norm(self.part.places(y[seen]) - start, axis=1)
        clear = 1.3 * self.radius if away.min(initial=np.inf) < self.radius else 0.0
        along = np.linspace(0.0, _AXIS_SHARE * self.body.radius, _AXIS_PIECES)[:, None]
        height = canvas.line_height(self.picture)
        for k, (name, colour) in enumerate(AXES):
            line, inside = self._project(origin + along * np.eye(3)[k])
            line = line[: len(inside) if inside.all() else int(np.argmin(inside))]
            line = line[np.linalg.norm(line - start, axis=1) >= clear]
            if len(line) < 2:
                continue
            canvas.polyline(self.picture, line, colour, width=2)
            length = float(np.linalg.norm(line[-1] - start))
            if length < 1.5 * height:
                continue  # letters would hide a short axis
            # centre of the letter, beyond the end of its axis
            u, v = line[-1] + 0.55 * height * (line[-1] - start) / length
            text_u = u - canvas.width_of(self.picture, name, size=0.9) / 2
            canvas.words(self.picture, name, (text_u, v + 0.2 * height), colour, size=0.9)


def caption(picture: Picture, status: Status | None, frame: int | None) -> None:
    """Write number and status of a frame into the upper left corner, in place."""
    u, v = canvas.caption_place(picture)
    if frame is not None:
        u = canvas.words(picture, f"frame {frame}  ", (u, v), WHITE)
        u += 0.3 * canvas.line_height(picture)
    if status is not None:
        canvas.words(picture, status, (u, v), STATUS_COLOURS[status])


def legend(picture: Picture, bodies: Sequence[tuple[str, Status]], frame: int) -> None:
    """Write the number of a frame, and bodies with their status, each in its colour, in place."""
    canvas.words(picture, f"frame {frame}", canvas.caption_place(picture), WHITE)
    for k, (label, status) in enumerate(bodies):
        colour = BODY_COLOURS[k % len(BODY_COLOURS)] if status != "lost" else GREY
        canvas.words(picture, f"{label} {status}", canvas.caption_place(picture, k + 2), colour)
