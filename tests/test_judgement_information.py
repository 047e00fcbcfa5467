"""What frames tell of a pose: determinants, and turns so wide that the origin goes along an arc."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mixpose.judgement.information import log_determinants, with_wide_turn
from mixpose.rigid import from_parts, twist_between


def test_determinants_of_what_fixes_all_directions_are_as_they_are() -> None:
    J = np.random.default_rng(0).normal(size=(3, 9, 6))
    A = J.swapaxes(1, 2) @ J
    expected = np.log(np.linalg.eigvalsh(A)).sum(axis=1)
    np.testing.assert_allclose(log_determinants(A, np.full((3, 6), 1e-9)), expected, rtol=1e-12)


@pytest.mark.parametrize("exact", [1e8, 1e10, 1e12])
def test_exact_detections_that_leave_directions_open_tell_no_pose_for_sure(exact: float) -> None:
    # as of two markers before one camera, to parts of a millionth: the determinant of the sum is
    # lost, and without it the pose would be infinitely likely
    rows = exact * np.random.default_rng(1).normal(size=(4, 6))
    before = np.array([1e-6, 1e-6, 1e-6, 0.1, 0.1, 0.1])
    A = rows.T @ rows + np.diag(before)
    (found,) = log_determinants(A[None], before[None])
    # det(RᵀR + B) = det B det(1 + R B⁻¹ Rᵀ)
    inner = np.eye(4) + rows / before @ rows.T
    expected = np.log(before).sum() + np.linalg.slogdet(inner)[1]
    # two directions are open, each as uncertain as before in some unit: never less likely than that
    ratio = np.log((before / A.diagonal()).max() / (before / A.diagonal()).min())
    assert expected - 2 * ratio - 6 <= found <= expected + 2 * ratio + 6


@pytest.mark.parametrize("deviation_deg", [0.3, 4.0, 7.5])
def test_the_ellipsoid_of_a_turn_about_a_line_of_features_holds_the_arc_of_the_origin(
    deviation_deg: float,
) -> None:
    """Features are on a line 60 mm from the origin, known to 0.1 mm; about it the body may turn."""
    rng, sigma = np.random.default_rng(4), np.radians(deviation_deg)
    axis = np.array([0.6, 0.0, 0.8])
    points = np.array([0.0, 60.0, 0.0]) + np.linspace(-80, 80, 3)[:, None] * axis
    middle, n = points.mean(axis=0), 2000
    # of the pose by small turns about the middle of the features
    lever = np.cross(axis, -middle)
    by_turn = np.concatenate([lever, axis])
    covariance = np.diag([0.1**2] * 3 + [1e-4**2] * 3) + sigma**2 * np.outer(by_turn, by_turn)
    wider = with_wide_turn(covariance, np.eye(4), points)
    R = Rotation.from_rotvec(sigma * rng.standard_normal(n)[:, None] * axis).as_matrix()
    shifts, turns = 0.1 * rng.standard_normal((n, 3)), 1e-4 * rng.standard_normal((n, 3))
    W = Rotation.from_rotvec(turns).as_matrix()
    errors = [
        twist_between(np.eye(4), from_parts(w @ r, middle - r @ middle + t))
        for r, t, w in zip(R, shifts, W, strict=True)
    ]
    off = np.array(errors)
    # 99.9 % of six dimensions are within 22.46
    inside, narrow = (
        np.mean(np.vecdot(off @ np.linalg.inv(one), off) < 22.46) for one in (wider, covariance)
    )
    assert inside > 0.995
    # without it more turns than that leave the ellipsoid along the arc
    assert (narrow < 0.97) == (deviation_deg > 1)
    if deviation_deg < 0.5:
        np.testing.assert_array_equal(wider, covariance)
