"""Bodies that are learnt from points in space, and points that few frames show."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from command_line import command
from moving_bodies import (
    CAMERA_MATRIX,
    RESOLUTION,
    Array,
    Scene,
    aligned_errors,
    body,
    camera,
    detections,
    motion,
)

from mixpose.body import Body, PointFeature
from mixpose.calibration import Rig, SeenFrame
from mixpose.learning import SensorSet, learn_from
from mixpose.learning.copies import _mean_body
from mixpose.learning.points import Cloud
from mixpose.learning.shapes import Placement, Shape
from mixpose.rigid import from_rotation_vector, inverse, transform
from mixpose.sensors import CloudSensor, PinholeCamera
from mixpose.session.marker_files import read_marker_file

SCENE = Scene(frames=40)
AXES = from_rotation_vector([0.4, -1.2, 0.3], [500.0, -200.0, 90.0])
NOISE = 0.1  # mm


def points_seen(bodies: list[tuple[Array, Array]], seed: int) -> list[Array]:
    """Points in space of each frame in axes of their own: hidden and false ones, and what rests."""
    rng = np.random.default_rng(seed)
    still = rng.uniform(-250, 250, (4, 3))
    frames = []
    for k in range(SCENE.frames):
        moved = [transform(T[k], points) for points, T in bodies]
        world = np.concatenate([*moved, still])
        seen = world[rng.random(len(world)) > SCENE.hidden]
        seen = np.concatenate([seen, rng.uniform(-250, 250, (3, 3))])
        points = transform(AXES, seen) + NOISE * rng.standard_normal(seen.shape)
        frames.append(rng.permutation(points))
    return frames


def eyes_of(*sensors: CloudSensor | PinholeCamera) -> SensorSet:
    names = [f"s{k}" for k in range(len(sensors))]
    nothing = Body("none", (PointFeature(np.zeros(3)),))
    return SensorSet(Rig.of(names, sensors, nothing), np.ones(len(sensors)))


def test_two_bodies_are_learnt_from_points_in_space() -> None:
    rng = np.random.default_rng(7)
    bodies = [(body(n, rng), motion(SCENE, rng)) for n in (5, 6)]
    frames = [SeenFrame(k, None, {0: one}, {}) for k, one in enumerate(points_seen(bodies, 3))]
    lesson = learn_from(frames, eyes_of(CloudSensor(AXES)))
    assert sorted(len(one.points) for one in lesson.bodies) == [5, 6]
    assert lesson.still == 4
    for found in lesson.bodies:
        (true,) = (points for points, _ in bodies if len(points) == len(found.points))
        off = np.linalg.norm(aligned_errors(found.points, true), axis=1)
        # 0.1 mm of 36 frames are 0.02 mm a coordinate
        assert off.max() < 0.07
        assert (off < 3.5 * np.linalg.norm(found.deviations, axis=1)).all()
        # one cloud shows what two cameras have to, a marker in 36 of 40 frames but for three or so
        assert found.frames.min() > 27


def test_a_camera_and_a_cloud_show_one_body_between_them() -> None:
    rng = np.random.default_rng(5)
    one, poses = body(5, rng), motion(SCENE, rng)
    T = camera(20.0)
    views = detections([(one, poses)], [T], SCENE, 2)
    clouds = points_seen([(one, poses)], 4)
    frames = [
        SeenFrame(k, None, {0: own, 1: view}, {})
        for k, (own, (view,)) in enumerate(zip(clouds, views, strict=True))
    ]
    pinhole = PinholeCamera(CAMERA_MATRIX, np.zeros(0), RESOLUTION, T)
    (found,) = learn_from(frames, eyes_of(CloudSensor(AXES), pinhole)).bodies
    assert np.linalg.norm(aligned_errors(found.points, one), axis=1).max() < 0.07
    assert min(found.met.values()) > 4.0


def test_a_table_is_learnt_from_a_session_with_a_cloud(tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    one, poses = body(4, rng), motion(SCENE, rng)
    rows = [
        f"{k},{x:.4f},{y:.4f},{z:.4f}"
        for k, points in enumerate(points_seen([(one, poses)], 6))
        for x, y, z in points.tolist()
    ]
    (tmp_path / "cloud.csv").write_text("\n".join(["frame,x,y,z", *rows]), encoding="utf-8")
    (tmp_path / "session.toml").write_text(
        'unit = "mm"\n[object]\nname = "tool"\nfile = "body.csv"\n[[sensor]]\nname = "cloud"\n'
        f'model = "cloud"\nsource = "cloud.csv"\nT_sensor_world = {AXES.tolist()}\n',
        encoding="utf-8",
    )
    done = command("learn", tmp_path / "session.toml", "-o", tmp_path / "body.csv")
    assert done.returncode == 0, done.stderr
    assert "bodies are learnt from" not in done.stderr
    found = read_marker_file(tmp_path / "body.csv", "mm")
    assert np.linalg.norm(aligned_errors(found.points, one), axis=1).max() < 0.08
    run = command("run", tmp_path / "session.toml", "-o", tmp_path / "poses.jsonl")
    # three of four markers are seen in one frame of four, and some of these are in doubt
    (ok,) = re.findall(r"40 frames: (\d+) ok", run.stderr)
    assert int(ok) > 34


@pytest.mark.parametrize("seldom", [0, 2, 4])
def test_places_of_a_shape_name_the_points_that_are_left_of_it(seldom: int) -> None:
    """A point that few frames show is left out: the others have other numbers then."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-50, 50, (5, 3))
    shape, clouds, places = Shape(points, np.full(5, 0.1)), [], []
    for k in range(20):
        T = from_rotation_vector(rng.uniform(-1, 1, 3), rng.uniform(-300, 300, 3))
        met = np.arange(5)
        if k:
            met[seldom] = -1
        seen = SeenFrame(k, None, {}, {})
        numbers = np.arange(5)
        clouds.append(Cloud(transform(T, points), np.full(5, 0.1), numbers[:, None], numbers, seen))
        places.append((k, Placement(T, met, 0.1)))
    found = _mean_body(shape, places, clouds)
    left = np.delete(np.arange(5), seldom)
    np.testing.assert_allclose(found.shape.points, points[left], atol=1e-9)
    for k, one in found.placements:
        there = transform(inverse(one.T_world_shape), clouds[k].points[one.cloud_rows])
        np.testing.assert_allclose(found.shape.points[one.shape_rows], there, atol=1e-9)
