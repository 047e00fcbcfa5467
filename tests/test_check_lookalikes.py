"""Poses that look alike: found where they are, and nowhere else."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.checking import look_alikes, noise_of, with_image_sizes
from mixpose.checking.placement import typical_poses
from mixpose.extraction import ExtractOptions
from mixpose.fit import EstimatorOptions
from mixpose.records import Floats
from mixpose.rigid import from_parts, from_rotation_vector
from mixpose.sensors import PinholeCamera, RangeSensor
from mixpose.session import SensorSetup, Session
from mixpose.units import Unit

K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
ALL = np.ones(6, dtype=np.bool_)
TEE = [[0, 0, 0], [0, 45, 0], [0, -45, 0], [40, 0, 0], [10, 25, 0]]
SOLID = [[0, 0, 0], [80, 6, 10], [-55, 48, -12], [-30, -66, 25], [36, 40, 62], [22, -35, -48]]


def body_of(points: object, normals: Floats | None = None) -> Body:
    rows = np.asarray(points, dtype=np.float64)
    return Body("body", tuple(PointFeature(row) for row in rows), normals)


def camera(T_sensor_world: Floats | None = None, sigma: float = 1.5) -> SensorSetup:
    T = np.eye(4) if T_sensor_world is None else T_sensor_world
    sensor = PinholeCamera(K, resolution=(640, 480), T_sensor_world=T)
    options = ExtractOptions(sigma=sigma)
    return SensorSetup("camera", "pinhole", sensor, "*.png", None, None, options,
                       resolution=(640, 480))  # fmt: skip


def facing_camera(distance: float, tilt: float = 0.4) -> Floats:
    return from_rotation_vector([tilt, 0.1, 0.0], [5.0, -8.0, distance])


def test_a_flat_body_far_away_may_be_tilted_the_other_way() -> None:
    found = look_alikes([camera()], body_of(TEE), facing_camera(3000.0), ALL)
    assert len(found) == 1
    # both tilts are 23.6 degrees off the line of sight, in opposite directions
    assert found[0].turn_deg == pytest.approx(2 * np.degrees(np.hypot(0.4, 0.1)), abs=3.0)
    assert found[0].difference < 0.5


def test_a_body_all_around_its_cameras_is_like_nothing_else() -> None:
    """Three cameras 0.1 apart in the middle of it, as where metres are taken for millimetres."""
    setups = [camera(from_parts(np.eye(3), np.array([x, 0.0, 0.0]))) for x in (0.0, 0.1, -0.1)]
    for seed in range(3):
        R = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
        T = from_parts(R, np.array([0.0, 0.0, 1.0]))
        assert look_alikes(setups, body_of(SOLID), T, ALL) == []


def test_disks_that_look_like_nothing_else_are_no_error() -> None:
    points = np.asarray(SOLID, dtype=np.float64)
    normals = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-9)
    normals[0] = [0, 0, -1]
    dots = replace(body_of(points, normals), shape="disk", radii=np.full(len(points), 8.0))
    aside = from_parts(Rotation.from_euler("y", 60, degrees=True).as_matrix(), [-433, 0, 250])
    assert look_alikes([camera(), camera(aside)], dots, facing_camera(500.0), ALL) == []


def test_near_by_perspective_tells_the_tilts_apart() -> None:
    assert look_alikes([camera()], body_of(TEE), facing_camera(250.0), ALL) == []


def test_a_second_camera_tells_the_tilts_apart() -> None:
    aside = from_parts(Rotation.from_euler("y", 60, degrees=True).as_matrix(), [-2598, 0, 1500])
    found = look_alikes([camera(), camera(aside)], body_of(TEE), facing_camera(3000.0), ALL)
    assert found == []


def test_a_solid_body_looks_like_itself_only() -> None:
    assert look_alikes([camera()], body_of(SOLID), facing_camera(500.0), ALL) == []


@pytest.mark.parametrize(("offset", "count"), [(0.02, 3), (30.0, 0)])
def test_a_nearly_symmetric_body_is_found_out(offset: float, count: int) -> None:
    """A square pyramid with a corner moved: quarter turns about its axis, if hardly."""
    points = [[50, 0, 0], [0, 50, 0], [-50, 0, 0], [0, -50 - offset, 0], [0, 0, 60]]
    body = replace(body_of(points))
    body.__dict__["symmetries"] = np.eye(4)[None]  # as if none were exact
    found = look_alikes([camera()], body, facing_camera(400.0), ALL)
    assert len(found) == count
    for other in found:
        assert min(abs(other.turn_deg - 90), abs(other.turn_deg - 180)) < 1.0


def test_exact_symmetries_are_no_news() -> None:
    points = [[50, 0, 0], [0, 50, 0], [-50, 0, 0], [0, -50, 0], [0, 0, 60]]
    body = body_of(points)
    assert len(body.symmetries) == 4
    assert look_alikes([camera()], body, facing_camera(400.0), ALL) == []


def test_directions_that_are_held_cannot_look_alike() -> None:
    free = np.array([True, True, True, False, False, False])
    assert look_alikes([camera()], body_of(TEE), facing_camera(3000.0), free) == []
    # the tilt is about x and y: a turn about z alone has no twin
    free[5] = True
    assert look_alikes([camera()], body_of(TEE), facing_camera(3000.0), free) == []


def test_a_hundred_features_take_less_than_a_second() -> None:
    rng = np.random.default_rng(0)
    body = body_of(rng.uniform(-60, 60, (100, 3)))
    began = time.process_time()
    assert look_alikes([camera()], body, facing_camera(500.0), ALL) == []
    assert time.process_time() - began < 1.0  # what check may take for it; measured: 0.05 s


def test_typical_poses_are_in_view_at_the_distance_asked_for() -> None:
    unit: Unit = "mm"
    body = body_of(SOLID)
    session = Session(Path("x.toml"), "", unit, body, None, EstimatorOptions(), (camera(),))
    near, far = (typical_poses(session, 3, away=away) for away in (1.0, 4.0))
    assert len(near) == len(far) == 3
    middle = body.means.mean(axis=0)
    for T_near, T_far in zip(near, far, strict=True):
        depths = [(T[:3, :3] @ middle + T[:3, 3])[2] for T in (T_near, T_far)]
        assert depths[1] == pytest.approx(4 * depths[0])
        assert camera().sensor.project(body.means @ T_near[:3, :3].T + T_near[:3, 3])[1].all()


def test_centres_of_spots_are_sharper_than_sigma_and_ranges_are_not() -> None:
    ranging = RangeSensor(np.zeros(3))
    ranges = SensorSetup("r", "lateration", ranging, "r.csv", None, None, ExtractOptions(sigma=2.0))
    assert noise_of(camera(sigma=2.0)) == pytest.approx(0.4)
    assert noise_of(ranges) == 2.0


def test_images_of_unknown_size_are_taken_to_have_the_optical_axis_in_their_middle() -> None:
    axis = replace(camera(), sensor=PinholeCamera(K), resolution=None)
    session = Session(Path("x.toml"), "", "mm", body_of(SOLID), None, EstimatorOptions(), (axis,))
    # from u = -0.5 to 640.5 about cx = 320
    assert with_image_sizes(session, {}).sensors[0].resolution == (641, 481)
    assert with_image_sizes(session, {"camera": (600, 400)}).sensors[0].resolution == (600, 400)
