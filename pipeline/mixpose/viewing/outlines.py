"""How sensors look in space: where they stand, and the pyramid or box that a camera sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mixpose.records import Floats
from mixpose.sensors import Rays, Sensor
from mixpose.session import SensorSetup, Session
from mixpose.viewing.moment import Shown

_ALONG_EDGE = 8  # rays along an edge of an image: lenses bend edges
_LENGTH = 0.12  # of the scene, that lines of sight are drawn
_SHARES = (1 - 1e-6, *np.linspace(0.95, 0.05, 19).tolist())  # the very edge rounds to outside
_UPRIGHT = np.cos(np.deg2rad(30.0))  # an axis of the world that is nearer than this is up


@dataclass(frozen=True)
class Outline:
    """A sensor in space."""

    name: str
    # (n, 3), where it stands; of parallel beams the corners of the image on the sensor's plane
    places: Floats
    # lines of sight around the edge of the image, in order; None of a range sensor
    border: Rays | None

    @property
    def middle(self) -> Floats:
        """Where its name is written."""
        return np.asarray(self.places.mean(axis=0))

    def segments(self, size: float) -> Floats:
        """Lines (n, 2, 3) to draw, in a scene of a size."""
        if self.border is None or not len(self.border):
            return np.zeros((0, 2, 3))
        starts = self.border.origins
        ends = starts + _LENGTH * size * self.border.directions
        far = np.stack([ends, np.roll(ends, -1, axis=0)], axis=1)
        along = np.stack([starts, ends], axis=1)[::_ALONG_EDGE]
        near = np.stack([starts, np.roll(starts, -1, axis=0)], axis=1)
        return np.concatenate([far, along] if self.border.central else [far, along, near])


def outlines_of(session: Session, shown: Mapping[str, Shown]) -> list[Outline]:
    """All sensors of a session in space; `shown` tells sizes of images that it does not say."""
    found = []
    for setup in session.sensors:
        position = getattr(setup.sensor, "position", None)
        if position is not None:
            found.append(Outline(setup.name, np.reshape(position, (1, 3)), None))
            continue
        rays = _border(setup.sensor, *_bounds(setup, shown.get(setup.name)))
        if rays is not None:
            places = rays.origins[:1] if rays.central else rays.origins[::_ALONG_EDGE]
            found.append(Outline(setup.name, places, rays))
    return found


def up_of(session: Session) -> Floats:
    """The world's direction (3,) that is up in the images: an axis where one nearly is; else z."""
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


def _bounds(setup: SensorSetup, shown: Shown | None) -> tuple[Floats, Floats]:
    """Corners of a camera's image in px."""
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
    """Rays of the edge of an image, or of as much amid it as its lens model explains."""
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    steps = np.linspace(0.0, 1.0, _ALONG_EDGE + 1)[:-1, None]
    for share in _SHARES:
        (left, top), (right, bottom) = middle - share * half, middle + share * half
        corners = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
        sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
        edge = np.concatenate([a + steps * (b - a) for a, b in sides])
        rays = sensor.rays(edge)
        if rays is not None and len(rays) == len(edge):
            return rays
    return None
