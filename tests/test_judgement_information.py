"""What frames tell of a pose: determinants of what they fix, and of what they leave open."""

from __future__ import annotations

import numpy as np
import pytest

from mixpose.judgement.information import log_determinants


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
