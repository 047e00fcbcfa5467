"""Where `mixpose check` says that sensors stand, and what it suspects of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mixpose.checking.placement import expected_count, placement_lines, placement_warnings
from mixpose.rigid import from_rotation_vector, inverse
from mixpose.sensors import PinholeCamera
from mixpose.session import Session, load_session
from mixpose.session.setup import Start

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"


@pytest.fixture
def session() -> Session:
    return load_session(SYNTHETIC / "two_cameras" / "session.toml")


def with_poses(session: Session, *poses: np.ndarray) -> Session:
    setups = []
    for setup, T in zip(session.sensors, poses, strict=True):
        assert isinstance(setup.sensor, PinholeCamera)
        setups.append(replace(setup, sensor=replace(setup.sensor, T_sensor_world=T)))
    return replace(session, sensors=tuple(setups))


def camera_poses(session: Session) -> list[np.ndarray]:
    cameras = [setup.sensor for setup in session.sensors]
    return [camera.T_sensor_world for camera in cameras if isinstance(camera, PinholeCamera)]


def test_a_camera_is_said_to_stand_where_it_stands(session: Session) -> None:
    # turned by a quarter about y it looks along -x; its centre is at (900, 0, 0)
    T = from_rotation_vector([0.0, np.pi / 2, 0.0], [0.0, 0.0, 900.0])
    moved = with_poses(session, T, T)
    assert placement_lines(moved.sensors[0], "mm") == [
        "at (900, 0, 0) mm, looks along (-1, 0, 0) in the world"
    ]


def test_a_range_sensor_has_a_place_only() -> None:
    session = load_session(SYNTHETIC / "range_profiles" / "session.toml")
    assert placement_lines(session.sensors[0], "mm") == ["at (0, -1000, 0) mm in the world"]


def test_a_good_session_raises_no_suspicion(session: Session) -> None:
    assert placement_warnings(session) == []
    assert placement_warnings(replace(session, start=None)) == []


def test_two_cameras_at_one_place_are_suspicious(session: Session) -> None:
    warnings = placement_warnings(with_poses(session, *[camera_poses(session)[0]] * 2))
    assert len(warnings) == 1
    assert "'left' and 'right' stand at one place" in warnings[0]
    assert "T_sensor_world" in warnings[0]


def test_cameras_side_by_side_are_not_but_nearer_than_lenses_are(session: Session) -> None:
    T = camera_poses(session)[0]
    beside, too_near = T.copy(), T.copy()
    beside[0, 3] += 5.0
    assert placement_warnings(with_poses(session, T, beside)) == []
    too_near[0, 3] += 2.0
    (warning,) = placement_warnings(with_poses(session, T, too_near))
    assert "stand 2 mm apart, less than two lenses need: are translations in mm?" in warning


@pytest.mark.parametrize("with_start", [True, False])
def test_inverted_camera_poses_are_recognised(session: Session, with_start: bool) -> None:
    flipped = with_poses(session, *(inverse(T) for T in camera_poses(session)))
    if not with_start:
        flipped = replace(flipped, start=None)
    warnings = placement_warnings(flipped)
    assert any("inverse" in warning and "world to sensor" in warning for warning in warnings)


def test_a_body_behind_one_camera_is_told_without_a_guess(session: Session) -> None:
    left, right = camera_poses(session)
    behind = right.copy()
    behind[2, 3] *= -1
    warnings = placement_warnings(with_poses(session, left, behind))
    assert warnings == [
        "sensor 'right': the body at [start] is behind it: check T_sensor_world and [start]"
    ]


def test_a_body_beside_the_image_is_told_with_its_place(session: Session) -> None:
    assert session.start is not None
    T = session.start.T_world_object.copy()
    T[1, 3] += 700.0
    warnings = placement_warnings(replace(session, start=Start(T)))
    assert len(warnings) == 2
    assert "outside of its image of 640x512 px, at u = " in warnings[0]


def test_cameras_without_a_common_view_are_told_with_lengths_to_compare(session: Session) -> None:
    behind = camera_poses(session)[0].copy()
    behind[:3, :3] = np.diag([-1.0, 1.0, -1.0]) @ behind[:3, :3]  # turned away on the spot
    behind[:3, 3] = np.diag([-1.0, 1.0, -1.0]) @ behind[:3, 3]
    behind[2, 3] -= 900.0
    moved = replace(with_poses(session, camera_poses(session)[0], behind), start=None)
    (warning,) = placement_warnings(moved)
    assert "check T_sensor_world, and whether points of [object] and translations are in" in warning
    # the second stands 900 mm from the first; the body's features are within 107 mm of its centre
    assert warning.endswith("the body is 210 mm across, the sensors 900 mm apart")


def test_an_inverted_start_is_recognised(session: Session) -> None:
    assert session.start is not None
    left, right = camera_poses(session)
    # the world moved into the left camera, where a pose and its inverse are far from each other
    moved = with_poses(session, np.eye(4), right @ inverse(left))
    start = Start(inverse(left @ session.start.T_world_object))
    warnings = placement_warnings(replace(moved, start=start))
    assert any(warning.startswith("start.T_world_object looks inverted") for warning in warnings)


@pytest.mark.parametrize("times", [50.0, 1000.0])  # 50 times as far away it is 3.3 px wide
def test_lengths_in_two_units_are_suspicious(times: float, session: Session) -> None:
    far = [T.copy() for T in camera_poses(session)]
    for T in far:
        T[:3, 3] *= times
    warnings = placement_warnings(with_poses(session, *far))
    assert any("px wide: are points" in w and "all in mm?" in w for w in warnings)


def test_cameras_that_look_apart_are_told_with_two_lengths_to_compare(session: Session) -> None:
    back = from_rotation_vector([0.0, np.pi, 0.0], [1230.0, 0.0, 0.0])
    moved = with_poses(replace(session, start=None), np.eye(4), back)
    (warning,) = placement_warnings(moved)
    across = float(f"{2 * session.body.radius:.2g}")
    assert warning.endswith(f"the body is {across:g} mm across, the sensors 1200 mm apart")


def test_cameras_in_a_ring_about_the_worlds_origin_are_not_suspicious(session: Session) -> None:
    # each has the origin 900 mm in front of it: one translation, several places
    ring = [from_rotation_vector([0.0, angle, 0.0], [0.0, 0.0, 900.0]) for angle in (0.0, 0.7)]
    warnings = placement_warnings(with_poses(session, *ring))
    assert not [warning for warning in warnings if "at one place" in warning]


def test_a_body_shows_the_features_that_face_whoever_looks_at_one_of_them(
    session: Session,
) -> None:
    count = len(session.body)
    unknown = replace(session, start=None)
    assert expected_count(session.sensors[0], unknown) == count
    normals = np.tile([0.0, 0.0, 1.0], (count, 1))
    board = replace(unknown, body=replace(session.body, normals=normals))
    assert expected_count(session.sensors[0], board) == count  # its back shows nothing at all
    normals[: count // 2] *= -1
    two_sided = replace(unknown, body=replace(session.body, normals=normals))
    assert expected_count(session.sensors[0], two_sided) == count - count // 2


@pytest.mark.parametrize(("unit", "is_told"), [("m", True), ("cm", False), ("mm", False)])
def test_a_body_larger_than_any_is_in_another_unit(
    unit: Any, is_told: bool, session: Session
) -> None:
    """210 mm across; 210 m are a ship, 2.1 m a car."""
    found = [text for text in placement_warnings(replace(session, unit=unit)) if "across" in text]
    assert (
        found
        == ["the body 'tracker' is 210 m across: is unit = \"m\" that of points and translations?"]
        * is_told
    )
