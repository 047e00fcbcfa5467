"""Kinds of sensors that the package does not know: what the protocol asks for is enough."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, Self

import numpy as np
import pytest
from detections import EIGHT, detect
from numpy.typing import NDArray

from mixpose.fit import EstimatorOptions
from mixpose.rigid import (
    from_parts,
    from_rotation_vector,
    inverse,
    perturb,
    rotation_angle_deg,
    transform,
    twist_between,
)
from mixpose.sensors import OUTSIDE, PinholeCamera, Rays, Sensor
from mixpose.tracking import Tracker, estimate_pose

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

TRUTH = from_rotation_vector([0.3, 0.2, -0.5], [45.0, 30.0, 5.0])


@dataclass(frozen=True, eq=False)
class AngleSensor:
    """A line camera behind a slit: measures the angle atan2(x, z) to a point, in mrad."""

    T_sensor_world: Floats
    lower: Floats = field(default_factory=lambda: np.array([-800.0]))
    upper: Floats = field(default_factory=lambda: np.array([800.0]))
    dimension: int = 1
    unit: Literal["px", "length"] = "px"

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        y, _, visible = self.linearise(points_world)
        return y, visible

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        points = transform(self.T_sensor_world, points_world)
        x, z = points[..., 0], points[..., 2]
        squared = x**2 + z**2
        y = 1000 * np.arctan2(x, z)[..., None]
        by_sensor = 1000 * np.stack([z, np.zeros_like(x), -x], axis=-1) / squared[..., None]
        J = (by_sensor @ self.T_sensor_world[:3, :3])[..., None, :]
        visible = np.asarray(((y >= self.lower) & (y <= self.upper)).all(axis=-1))
        y[~visible], J[~visible] = OUTSIDE, 0.0
        return y, J, visible

    def towards(self, points_world: Floats) -> Floats:
        return np.asarray(inverse(self.T_sensor_world)[:3, 3] - points_world)

    def rays(self, y: Floats) -> Rays | None:
        return None  # a slit leaves a plane, not a line

    def moved(self, motion: Floats) -> Self:
        return replace(self, T_sensor_world=self.T_sensor_world @ motion)


@dataclass(frozen=True, eq=False)
class ObliqueCamera:
    """A parallel projection at an angle to its own plane: (u, v) = (x + a z, y + b z) / size."""

    T_sensor_world: Floats
    slant: Floats = field(default_factory=lambda: np.array([0.4, -0.2]))
    size: float = 0.8
    with_rays: bool = True
    lower: Floats = field(default_factory=lambda: np.full(2, -500.0))
    upper: Floats = field(default_factory=lambda: np.full(2, 500.0))
    dimension: int = 2
    unit: Literal["px", "length"] = "px"

    @property
    def matrix(self) -> Floats:
        """By world coordinates (2, 3)."""
        return np.column_stack([np.eye(2), self.slant]) @ self.T_sensor_world[:3, :3] / self.size

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        y, _, visible = self.linearise(points_world)
        return y, visible

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        t = self.T_sensor_world[:3, 3]
        y = points_world @ self.matrix.T + (t[:2] + self.slant * t[2]) / self.size
        J = np.tile(self.matrix, (*y.shape[:-1], 1, 1))
        visible = np.asarray(((y >= self.lower) & (y <= self.upper)).all(axis=-1))
        y[~visible], J[~visible] = OUTSIDE, 0.0
        return y, J, visible

    @property
    def _beam(self) -> Floats:
        along = np.array([*-self.slant, 1.0])
        return np.asarray(self.T_sensor_world[:3, :3].T @ along / np.linalg.norm(along))

    def towards(self, points_world: Floats) -> Floats:
        return np.broadcast_to(-self._beam, points_world.shape)

    def rays(self, y: Floats) -> Rays | None:
        if not self.with_rays:
            return None
        on_plane = np.concatenate([self.size * y, np.zeros((len(y), 1))], axis=1)
        origins = transform(inverse(self.T_sensor_world), on_plane)
        return Rays(origins, np.tile(self._beam, (len(y), 1)), y, False, self.size, 0.0)

    def moved(self, motion: Floats) -> Self:
        return replace(self, T_sensor_world=self.T_sensor_world @ motion)


def around(angle: float, distance: float, *, upright: bool = True) -> Floats:
    """T_sensor_world of a sensor that looks at the middle from an angle, upright or on its side."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, s, 0], [0, 0, -1.0], [-s, c, 0]])
    turned = R if upright else np.array([[0, 1.0, 0], [-1, 0, 0], [0, 0, 1]]) @ R
    return from_parts(turned, [0.0, 0.0, distance])


def angle_sensors() -> list[AngleSensor]:
    """Four slits around the body, each across and along: six numbers and redundant ones."""
    return [
        AngleSensor(around(angle, 700.0, upright=upright))
        for angle in (0.0, 1.3, 2.9, 4.2)
        for upright in (True, False)
    ]


def oblique_cameras(*, with_rays: bool) -> list[ObliqueCamera]:
    return [ObliqueCamera(around(angle, 300.0), with_rays=with_rays) for angle in (0.0, 1.4)]


RIGS: dict[str, list[Sensor]] = {
    "angles": [*angle_sensors()],
    "oblique cameras": [*oblique_cameras(with_rays=True)],
    "oblique cameras without rays": [*oblique_cameras(with_rays=False)],
    "one of each, and a camera": [
        ObliqueCamera(around(0.0, 300.0)),
        *angle_sensors()[2:4],
        PinholeCamera(
            np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]]),
            resolution=(640, 480),
            T_sensor_world=around(2.0, 700.0),
        ),
    ],
}


@pytest.mark.parametrize("rig", RIGS)
def test_toys_obey_the_laws_of_sensors(rig: str) -> None:
    points = transform(TRUTH, EIGHT.means)
    for sensor in RIGS[rig]:
        assert isinstance(sensor, Sensor)
        _, J, visible = sensor.linearise(points)
        assert visible.all()
        for axis in range(3):
            step = 1e-3 * np.eye(3)[axis]
            numerical = (sensor.project(points + step)[0] - sensor.project(points - step)[0]) / 2e-3
            np.testing.assert_allclose(J[..., axis], numerical, atol=1e-6)
        rays = sensor.rays(sensor.project(points)[0])
        if rays is not None:
            again, _ = sensor.project(rays.origins + 500 * rays.directions)
            np.testing.assert_allclose(again, rays.pixels, atol=1e-9)


@pytest.mark.parametrize("rig", RIGS)
def test_a_body_is_followed_by_sensors_that_the_package_does_not_know(rig: str) -> None:
    tracker = Tracker.create(EIGHT, EstimatorOptions(), perturb(TRUTH, np.repeat([2.0, 0.02], 3)))
    track = tracker.begin()
    for frame in range(5):
        T = perturb(TRUTH, frame * np.array([4.0, -3.0, 2.0, 0.03, -0.02, 0.04]))
        views = detect(RIGS[rig], EIGHT, T, noise=0.1, hidden=1, seed=frame)
        track, estimate = tracker.advance(track, frame, frame / 25, views)
        assert estimate.status == "ok"
        assert estimate.T_world_object is not None
        assert estimate.covariance is not None
        # 0.1 px or mrad, at 0.7 m 0.07 to 0.1 mm, in tens of numbers
        assert rotation_angle_deg(estimate.T_world_object, T) < 0.2
        assert np.linalg.norm((estimate.T_world_object - T)[:3, 3]) < 0.2
        # what is stated is met: 22.5 is exceeded once in a thousand, and it is not far too wide,
        # where features run together in an image of one coordinate
        error = twist_between(estimate.T_world_object, T)
        assert error @ np.linalg.solve(estimate.covariance, error) < 22.5
        assert np.sqrt(np.diag(estimate.covariance)[:3]).max() < 0.5


@pytest.mark.parametrize("rig", ["oblique cameras", "oblique cameras without rays"])
def test_a_pose_is_found_everywhere_with_lines_of_sight_and_without(rig: str) -> None:
    T = from_rotation_vector([1.4, -2.0, 0.7], [60.0, 20.0, -30.0])
    estimate = estimate_pose(detect(RIGS[rig], EIGHT, T, noise=0.1), EIGHT)
    assert estimate.T_world_object is not None
    assert rotation_angle_deg(estimate.T_world_object, T) < 0.3
    assert estimate.status == "ok"


def test_sensors_out_of_step_are_moved_whatever_their_kind() -> None:
    velocity = np.array([300.0, -200.0, 250.0, 0.8, -0.5, 0.6])  # per second
    late, interval = 0.012, 0.033
    first, second = oblique_cameras(with_rays=True)
    tracker = Tracker.create(EIGHT, EstimatorOptions(), TRUTH)
    track = tracker.begin()
    for frame in range(12):
        time_s = frame * interval
        T, T_late = (perturb(TRUTH, velocity * t) for t in (time_s, time_s + late))
        views = [
            *detect([first], EIGHT, T, seed=frame),
            replace(detect([second], EIGHT, T_late, seed=frame)[0], name="1", delay=late),
        ]
        track, estimate = tracker.advance(track, frame, time_s, views)
    assert estimate.T_world_object is not None
    # in 12 ms the body moves 5 mm and turns 0.8 degrees
    assert rotation_angle_deg(estimate.T_world_object, T) < 0.02
    assert np.linalg.norm((estimate.T_world_object - T)[:3, 3]) < 0.03
