"""The scene in space: sensors with their fields of view, bodies, trails, and covariances.

Lengths are those of the session times a factor, so that any scene has a size of some units, as the
browser's camera expects.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import viser
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import pdist, squareform
from scipy.spatial.transform import Rotation

from mixpose import rigid
from mixpose.body import Body
from mixpose.pictures.overlay import BODY_COLOURS, STATUS_COLOURS
from mixpose.pictures.scene import with_bodies
from mixpose.records import Estimate, Floats
from mixpose.sensors import Rays, Sensor
from mixpose.session import SensorSetup, Session
from mixpose.viewing.moment import PACE, Moment, Row, ShownFrame

_SIZE = 4.0  # of the scene, in units of the page
_BODY_RADII = 4.0  # smallest size of a scene, in radii of the largest body
_EYE_DEG = (40.0, 30.0)  # to the side of and above the line from the bodies to their sensors
_FOV_DEG = 50.0  # vertical
_ASPECT = 0.65  # width over height of the part of the view that any window shows
_FILLED = 0.95  # share of this part that the scene fills
_SMALL = 0.7  # size of letters over the usual one
_GREY = (150, 150, 150)
_GRID = {"cell_color": (50, 50, 50), "section_color": (80, 80, 80)}
_LINE = {"thickness": 2.0, "thickness_units": "screen"}  # px
_MARKERS = {"point_shape": "circle", "precision": "float32"}
_POWERS = (1, 10, 100, 1000, 10000)
_SEEN_SHARE = 0.1  # of a body's radius: an ellipsoid of this size is visible
_ALONG_EDGE = 8  # rays along an edge of an image, as lenses bend edges
_LENGTH = 0.12  # of lines of sight, over the size of the scene
_SHARES = (1 - 1e-6, *np.linspace(0.95, 0.05, 19).tolist())  # the very edge may round to outside
_UPRIGHT = np.cos(np.deg2rad(30.0))  # a world axis within this angle of the images' up is up

MAGNIFICATIONS = tuple(f"× {power}" for power in _POWERS)
"""Magnifications of ellipsoids to choose from, in words."""


@dataclass(frozen=True)
class _BodyNodes:
    """The drawn parts of one body."""

    pose: viser.FrameHandle
    markers: viser.PointCloudHandle
    trail: viser.LineSegmentsHandle
    ellipsoid: viser.IcosphereHandle


class Scene:
    """The scene of a run."""

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._server = server
        self._session = session
        self._scale = 0.0  # units of the page per length; 0: nothing is drawn yet
        self._has_pose = False
        self._nodes: list[_BodyNodes] = []
        self._rows: deque[Row] = deque(maxlen=PACE.trail)
        self.magnification = 1

    def add(self, moment: Moment) -> None:
        """Draw a frame."""
        self._rows.extend(moment.rows)
        posed = with_bodies(self._session, moment.estimates)
        has_pose = any(estimate.T_world_object is not None for _, estimate in posed)
        if not self._scale or (has_pose and not self._has_pose):
            self._has_pose = has_pose
            self._begin(moment, posed)
        for k, (nodes, (_, estimate)) in enumerate(zip(self._nodes, posed, strict=True)):
            T = estimate.T_world_object
            nodes.pose.visible = T is not None
            if T is not None:
                nodes.pose.position, nodes.pose.wxyz = self._scale * T[:3, 3], _wxyz(T)
                if len(posed) == 1:
                    nodes.markers.colors = np.array(_rgb(STATUS_COLOURS[estimate.status]), np.uint8)
            places = pairwise(row.places[k] for row in self._rows)
            trail = [(a, b) for a, b in places if a is not None and b is not None]
            nodes.trail.points = self._scale * np.array(trail, dtype=np.float64).reshape(-1, 2, 3)
        self.draw_ellipsoids(moment.estimates)

    def draw_ellipsoids(self, estimates: Sequence[Estimate]) -> None:
        """Draw the 95 % ellipsoids of positions, enlarged by `magnification`."""
        for nodes, estimate in zip(self._nodes, estimates, strict=True):
            C, T = estimate.covariance, estimate.T_world_object
            is_known = C is not None and bool(np.isfinite(C).all())
            nodes.ellipsoid.visible = is_known
            if is_known and C is not None and T is not None:
                half_axes, axes = rigid.position_ellipsoid_95(C)
                size = self.magnification * self._scale * half_axes
                nodes.ellipsoid.scale = tuple(np.maximum(size, 1e-6).tolist())
                nodes.ellipsoid.position = self._scale * T[:3, 3]
                nodes.ellipsoid.wxyz = _wxyz(rigid.from_parts(axes, np.zeros(3)))

    def _begin(self, moment: Moment, posed: Sequence[tuple[Body, Estimate]]) -> None:
        """Draw all that does not move, and point the browser's camera at it."""
        outlines = outlines_of(self._session, moment.sensors)
        radius = max(body.radius for body, _ in posed)
        poses = [estimate.T_world_object for _, estimate in posed]
        bodies = [T[:3, 3] for T in poses if T is not None]
        corners = np.array([place for outline in outlines for place in outline.places])
        all_places = np.concatenate([corners.reshape(-1, 3), np.reshape(bodies, (-1, 3))])
        size = max(float(pdist(all_places).max(initial=0.0)), _BODY_RADII * radius)
        self._scale = _SIZE / size
        up = up_of(self._session)
        for k, outline in enumerate(outlines):
            self._draw_sensor(k, outline, size)
        self._draw_ground(all_places, up, radius)
        self._nodes = [self._draw_body(k, *pair) for k, pair in enumerate(posed)]
        self.magnification = self._seen(posed)
        shown = np.array(bodies) if bodies else all_places.mean(axis=0, keepdims=True)
        self._look(shown, radius, corners.reshape(-1, 3), up)

    def _seen(self, posed: Sequence[tuple[Body, Estimate]]) -> int:
        """Return the least magnification at which the ellipsoid of a body is visible."""
        for body, estimate in posed:
            if estimate.covariance is not None and np.isfinite(estimate.covariance).all():
                largest = float(rigid.position_ellipsoid_95(estimate.covariance)[0][-1])
                visible = [p for p in _POWERS if p * largest >= _SEEN_SHARE * body.radius]
                return visible[0] if visible else _POWERS[-1]
        return 1

    def _draw_sensor(self, k: int, outline: Outline, size: float) -> None:
        scene, node = self._server.scene, f"/sensors/{k}"
        segments = self._scale * outline.segments(size)
        if len(segments):
            scene.add_line_segments(node, segments, _GREY, **_LINE)
        middle = self._scale * outline.places.mean(axis=0)
        scene.add_icosphere(f"{node}/place", 0.02, _GREY, position=self._scale * outline.places[0])
        scene.add_label(f"{node}/name", outline.name, position=middle, font_screen_scale=_SMALL)

    def _draw_body(self, k: int, body: Body, estimate: Estimate) -> _BodyNodes:
        scene, scale, node = self._server.scene, self._scale, f"/bodies/{k}"
        colour = _rgb(BODY_COLOURS[k % len(BODY_COLOURS)])
        length = 0.5 * scale * body.radius
        pose = scene.add_frame(node, axes_length=length, axes_radius=0.03 * length, visible=False)
        points, size = scale * body.means, 0.12 * length
        markers = scene.add_point_cloud(
            f"{node}/markers", points, colour, point_size=size, **_MARKERS
        )
        # the shortest segments that link all features
        a, b = minimum_spanning_tree(squareform(pdist(body.means))).nonzero()
        if len(a):
            edges = scale * np.stack([body.means[a], body.means[b]], axis=1)
            scene.add_line_segments(f"{node}/shape", edges, colour, **_LINE)
        if len(self._session.labels) > 1:
            scene.add_label(f"{node}/name", estimate.label, font_screen_scale=_SMALL)
        trail = scene.add_line_segments(f"/trails/{k}", np.zeros((0, 2, 3)), colour, **_LINE)
        ellipsoid = scene.add_icosphere(
            f"/covariance/{k}", 1.0, (255, 255, 255), opacity=0.4, visible=False, cast_shadow=False
        )
        return _BodyNodes(pose, markers, trail, ellipsoid)

    def _draw_ground(self, places: Floats, up: Floats, radius: float) -> None:
        """Draw the world's axes, and below the scene a grid with cells of about a tenth of it."""
        self._server.scene.set_up_direction(tuple(up.tolist()))
        length = self._scale * radius
        self._server.scene.add_frame("/world", axes_length=length, axes_radius=0.02 * length)
        middle, lowest = places.mean(axis=0), float((places @ up).min())
        below = middle + (lowest - radius - middle @ up) * up
        largest = 0.1 * _SIZE / self._scale  # rounded down to 1, 2 or 5 times a power of ten
        power = 10.0 ** np.floor(np.log10(largest))
        cell = self._scale * float(power * max(k for k in (1, 2, 5) if k * power <= largest))
        turn, _ = Rotation.align_vectors([up], [[0.0, 0.0, 1.0]])
        self._server.scene.add_grid(
            "/grid",
            width=40 * cell,
            height=40 * cell,
            cell_size=cell,
            section_size=5 * cell,
            wxyz=tuple(np.roll(turn.as_quat(), 1).tolist()),
            position=self._scale * below,
            **_GRID,
        )

    def _look(self, bodies: Floats, radius: float, sensors: Floats, up: Floats) -> None:
        """Point the browser's camera at the whole scene, from beside and above the sensors."""
        away = sensors.mean(axis=0) - bodies.mean(axis=0) if len(sensors) else np.zeros(3)
        away -= (away @ up) * up
        if np.linalg.norm(away) < 1e-6 * _SIZE / self._scale:
            away = np.eye(3)[int(np.argmin(np.abs(up)))]
            away -= (away @ up) * up
        away /= np.linalg.norm(away)
        sideways, upward = np.deg2rad(_EYE_DEG)
        away = rigid.rotation_matrix(sideways * up) @ away
        away = np.cos(upward) * away + np.sin(upward) * up
        everything = np.concatenate([sensors, bodies, bodies - radius, bodies + radius])
        middle = (everything.min(axis=0) + everything.max(axis=0)) / 2
        aim = self._scale * middle
        # the eye moves back until all places are in view
        right = np.cross(up, away)
        right /= np.linalg.norm(right)
        half = _FILLED * np.tan(np.deg2rad(_FOV_DEG) / 2)
        places = everything - middle
        across = np.abs(places @ right) / (_ASPECT * half)
        upwards = np.abs(places @ np.cross(away, right)) / half
        eye = aim + self._scale * float((places @ away + np.maximum(across, upwards)).max()) * away
        cameras = [client.camera for client in self._server.get_clients().values()]
        for camera in (self._server.initial_camera, *cameras):
            camera.fov = np.deg2rad(_FOV_DEG)
            if isinstance(camera, viser.CameraHandle):
                camera.up_direction = up
            else:
                camera.up = up
            camera.position = eye
            camera.look_at = aim


def _wxyz(T: Floats) -> Floats:
    return np.roll(rigid.quaternion_xyzw(T), 1)


def _rgb(bgr: tuple[int, int, int]) -> tuple[int, int, int]:
    return bgr[2], bgr[1], bgr[0]


@dataclass(frozen=True)
class Outline:
    """A sensor in space."""

    name: str
    # (n, 3), its place; for parallel beams the corners of the image on the sensor's plane
    places: Floats
    # lines of sight around the edge of the image, in order; None for a range sensor
    border: Rays | None

    def segments(self, size: float) -> Floats:
        """Return lines (n, 2, 3) that show it in a scene of a size."""
        if self.border is None or not len(self.border):
            return np.zeros((0, 2, 3))
        starts = self.border.origins
        ends = starts + _LENGTH * size * self.border.directions
        far = np.stack([ends, np.roll(ends, -1, axis=0)], axis=1)
        along = np.stack([starts, ends], axis=1)[::_ALONG_EDGE]
        near = np.stack([starts, np.roll(starts, -1, axis=0)], axis=1)
        return np.concatenate([far, along] if self.border.central else [far, along, near])


def outlines_of(session: Session, shown: Mapping[str, ShownFrame]) -> list[Outline]:
    """Return outlines of all sensors; `shown` gives sizes of images that the session does not."""
    outlines = []
    for setup in session.sensors:
        position = getattr(setup.sensor, "position", None)
        if position is not None:
            outlines.append(Outline(setup.name, np.reshape(position, (1, 3)), None))
            continue
        rays = _border(setup.sensor, *_bounds(setup, shown.get(setup.name)))
        if rays is not None:
            places = rays.origins[:1] if rays.central else rays.origins[::_ALONG_EDGE]
            outlines.append(Outline(setup.name, places, rays))
    return outlines


def up_of(session: Session) -> Floats:
    """Return the world's up (3,) by the images, an axis if one is near; z if images disagree."""
    # ranges and clouds have no image
    cameras: list[Any] = [s.sensor for s in session.sensors if s.sensor.dimension == 2]
    ups = [-camera.T_sensor_world[1, :3] for camera in cameras]
    total = np.sum(ups, axis=0) if ups else np.zeros(3)
    if np.linalg.norm(total) < 0.1 * max(len(ups), 1):
        return np.array([0.0, 0.0, 1.0])
    total /= np.linalg.norm(total)
    axis = int(np.argmax(np.abs(total)))
    if abs(total[axis]) >= _UPRIGHT:
        return np.asarray(np.sign(total[axis]) * np.eye(3)[axis])
    return np.asarray(total)


def _bounds(setup: SensorSetup, shown: ShownFrame | None) -> tuple[Floats, Floats]:
    """Return the lower and upper corner (2,) of a camera's image in px."""
    lower, upper = setup.sensor.lower, setup.sensor.upper
    if np.isfinite(lower).all() and np.isfinite(upper).all():
        return lower, upper
    image = None if shown is None or shown.frame is None else shown.frame.data
    if shown is not None and isinstance(image, np.ndarray):
        return np.zeros(2), np.array(image.shape[1::-1]) / shown.zoom - 1.0
    matrix = getattr(setup.sensor, "camera_matrix", None)
    middle = getattr(setup.sensor, "principal_point", None) if matrix is None else matrix[:2, 2]
    return np.zeros(2), 2.0 * np.asarray(middle if middle is not None else (320.0, 240.0))


def _border(sensor: Sensor, lower: Floats, upper: Floats) -> Rays | None:
    """Return rays of the edge of an image, or of the largest part that its lens model explains."""
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    steps = np.linspace(0.0, 1.0, _ALONG_EDGE + 1)[:-1, None]
    for share in _SHARES:
        (x_low, y_low), (x_high, y_high) = middle - share * half, middle + share * half
        corners = np.array([(x_low, y_low), (x_high, y_low), (x_high, y_high), (x_low, y_high)])
        sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
        edge = np.concatenate([a + steps * (b - a) for a, b in sides])
        rays = sensor.rays(edge)
        if rays is not None and len(rays) == len(edge):
            return rays
    return None
