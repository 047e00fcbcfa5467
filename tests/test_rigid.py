"""Laws of rigid motions and their conventions."""

from __future__ import annotations

import numpy as np
import pytest
from rounding import rounding
from scipy.spatial.transform import Rotation

from mixpose.rigid import (
    from_orthonormal,
    from_rotation_vector,
    inverse,
    is_rigid,
    mean_motion,
    nearest_rigid,
    perturb,
    quaternion_xyzw,
    rotation_angle_deg,
    transform,
    twist_between,
    twists_at,
)

RNG = np.random.default_rng(0)
POSES = from_rotation_vector(RNG.normal(0, 1.5, (50, 3)), RNG.normal(0, 100, (50, 3)))
POINTS = RNG.normal(0, 50, (7, 3))


def test_a_motion_and_its_inverse_cancel() -> None:
    np.testing.assert_allclose(
        transform(inverse(POSES), transform(POSES, POINTS)),
        np.broadcast_to(POINTS, (50, 7, 3)),
        atol=1e-10,
    )


def test_composition_is_the_matrix_product() -> None:
    a, b = POSES[:25], POSES[25:]
    np.testing.assert_allclose(
        transform(a @ b, POINTS), transform(a, transform(b, POINTS)), atol=1e-9
    )


def test_twist_between_undoes_perturb() -> None:
    twists = RNG.uniform(-1, 1, (50, 6)) * [10, 10, 10, 1, 1, 1]
    np.testing.assert_allclose(twist_between(POSES, perturb(POSES, twists)), twists, atol=1e-9)


def test_a_twist_turns_about_world_axes_through_the_objects_origin() -> None:
    T = from_rotation_vector([0.4, 0.0, 0.0], [5.0, 6.0, 7.0])
    turned = perturb(T, np.array([0, 0, 0, 0, 0, np.pi / 2]))
    np.testing.assert_allclose(turned[:3, 3], T[:3, 3])
    about_z = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    np.testing.assert_allclose(turned[:3, :3], about_z @ T[:3, :3], atol=1e-12)


def test_quaternions_are_xyzw_with_positive_w() -> None:
    for T in POSES:
        q = quaternion_xyzw(T)
        assert q[3] >= 0
        np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), T[:3, :3], atol=1e-12)


def test_the_angle_between_poses_is_that_of_the_turn() -> None:
    twists = np.zeros((50, 6))
    twists[:, 4] = np.linspace(0, 3.1, 50)
    angles = rotation_angle_deg(POSES, perturb(POSES, twists))
    np.testing.assert_allclose(angles, np.degrees(twists[:, 4]), atol=1e-6)


def test_the_mean_motion_of_turns_either_way_is_the_middle_one() -> None:
    middle = from_rotation_vector([0.3, -0.2, 0.1], [1, 2, 3])
    twists = np.array([[0.5, 0, 0, 0, 0, 0.2], [-0.5, 0, 0, 0, 0, -0.2]])
    assert mean_motion(perturb(middle, twists)) == pytest.approx(middle, abs=1e-12)


def test_the_papers_rigid_affine_transformation_is_a_pose() -> None:
    V, w = POSES[3, :3, :3], np.array([40.0, -3.0, 7.0])
    T = from_orthonormal(V, w)
    np.testing.assert_allclose(transform(T, POINTS), (POINTS + w) @ V, atol=1e-10)
    with pytest.raises(ValueError, match="orthonormal"):
        from_orthonormal(V * 1.01, w)
    with pytest.raises(ValueError, match="orthonormal"):
        from_orthonormal(V @ np.diag([1.0, 1.0, -1.0]), w)


def test_rounded_matrices_are_mended_and_mirrors_are_refused() -> None:
    rounded = POSES[0].round(5)
    assert is_rigid(rounded)
    np.testing.assert_allclose(nearest_rigid(rounded), POSES[0], atol=2e-5)
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    assert not is_rigid(mirror)
    assert not is_rigid(np.full((4, 4), np.nan))


def test_one_pose_has_the_twist_that_it_has_among_many() -> None:
    # single poses take a way of their own, for speed; angles stay below a half-turn
    twists = np.random.default_rng(5).uniform(-1, 1, (25, 6)) * [10, 10, 10, 1.7, 1.7, 1.7]
    assert (np.linalg.norm(twists[:, 3:], axis=1) > np.pi / 2).any()  # another way again
    moved = perturb(POSES[:25], twists)
    for T, twist, T_moved in zip(POSES, twists, moved, strict=False):
        np.testing.assert_allclose(perturb(T, twist), T_moved, rtol=0, atol=rounding(T_moved))
        np.testing.assert_allclose(twist_between(T, T_moved), twist, atol=1e-9)


def test_a_twist_about_a_pose_is_another_about_the_origin_and_moves_all_points_alike() -> None:
    twists = 1e-6 * np.random.default_rng(6).normal(size=(50, 6))
    about_origin = (twists_at(-POSES[:, :3, 3]) @ twists[..., None])[..., 0]
    moved = transform(perturb(POSES, twists), np.eye(3))
    also = transform(
        perturb(np.tile(np.eye(4), (50, 1, 1)), about_origin), transform(POSES, np.eye(3))
    )
    np.testing.assert_allclose(also, moved, rtol=0, atol=1e-9)  # to first order


def test_a_shift_is_no_turn() -> None:
    moved = perturb(POSES, np.tile([30.0, -40.0, 5.0, 0.0, 0.1, 0.0], (50, 1)))
    np.testing.assert_allclose(rotation_angle_deg(POSES, moved), np.degrees(0.1), atol=1e-6)


@pytest.mark.parametrize("angle", [1e-9, 9e-6, 1e-3, 2.0, np.pi - 1e-6, np.pi])
def test_quaternions_hold_the_smallest_and_the_largest_turns(angle: float) -> None:
    turn = angle * np.array([0.6, 0.0, 0.8])
    T = from_rotation_vector(turn, np.zeros(3))
    q = quaternion_xyzw(T)
    assert q[3] >= 0
    np.testing.assert_allclose(q[:3] * np.sign(q[0]), np.sin(angle / 2) * turn / angle, atol=1e-12)
