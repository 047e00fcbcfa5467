"""Ellipsoids of poses that may be turned so far that the curvature at the pose is not all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matches import Seen, matches_of
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.judgement import Curved, with_likely_turns, with_wide_turn
from mixpose.matching import Matches
from mixpose.objective import BodyProjection, project_body
from mixpose.records import Floats, Mask
from mixpose.rigid import from_parts, from_rotation_vector, perturb, transform, twist_between
from mixpose.sensors import PinholeCamera

FREE = np.ones(6, dtype=np.bool_)
HELD = 22.46  # 99.9 % of six dimensions are within so many squared deviations
FOCAL = 800.0
CAMERA = PinholeCamera(
    np.array([[FOCAL, 0, 320], [0, FOCAL, 240], [0, 0, 1.0]]), resolution=(640, 480)
)
BOARD = Body(
    "board",
    tuple(PointFeature(np.array([x, y, 0.0])) for x in (-30, 0, 30) for y in (-20, 20)),
)
NOISE = 0.2


def fitted(T_true: Floats, seed: int) -> tuple[Floats, Matches, BodyProjection]:
    """Least squares of detections with known features, and what is met there, σ_ε = 1 px."""
    points, rng = BOARD.means, np.random.default_rng(seed)
    seen = CAMERA.project(transform(T_true, points))[0] + rng.normal(0, NOISE, (len(points), 2))
    lengths = np.repeat([30.0, 1.0], 3)

    def residuals(x: Floats) -> Floats:
        return (CAMERA.project(transform(perturb(T_true, x * lengths), points))[0] - seen).ravel()

    T = perturb(T_true, least_squares(residuals, np.zeros(6)).x * lengths)
    projection = project_body((CAMERA,), BOARD)
    at = projection.project(T[None])
    places = at.y[0, 0]
    return T, matches_of(Seen(at.J[0, 0], offsets=seen - places, places=places)), projection


def turned(
    covariance: Floats, T: Floats, seen: Matches, projection: BodyProjection, free: Mask = FREE
) -> Floats:
    """The covariance with all likely turns."""
    curved = Curved(covariance, T, seen, np.array([NOISE**2]), projection)
    return with_likely_turns([curved], free)[0]


def covariances(T: Floats, found: Matches, projection: BodyProjection) -> tuple[Floats, Floats]:
    """By the curvature at the pose, and with all likely turns."""
    J = found.J[0].reshape(-1, 6)
    plain = NOISE**2 * np.linalg.inv(J.T @ J)
    return plain, turned(plain, T, found, projection)


def squares(T_true: Floats, T: Floats, covariance: Floats) -> float:
    x = twist_between(T_true, T)
    return float(x @ np.linalg.solve(covariance, x))


@pytest.mark.parametrize(
    ("tilt_deg", "distance", "changes"),
    [(4.0, 500.0, True), (1.0, 800.0, True), (40.0, 250.0, False)],
)
def test_the_ellipsoid_of_a_board_before_one_camera_holds_it_as_often_as_it_says(
    tilt_deg: float, distance: float, changes: bool
) -> None:
    """Turned by a little to either side it looks almost the same; turned by much it does not."""
    turn = np.radians(tilt_deg) * np.array([0.6, 0.8, 0.0])
    T_true = from_rotation_vector(turn, np.array([5.0, -8.0, distance]))
    wide, plain = [], []
    for seed in range(300):
        T, found, projection = fitted(T_true, seed)
        before, after = covariances(T, found, projection)
        plain.append(squares(T_true, T, before))
        wide.append(squares(T_true, T, after))
        # it holds all that the curvature allows
        assert np.linalg.eigvalsh(after - before)[0] > -1e-9 * np.trace(before)
    inside, narrow = (np.mean(np.array(each) < HELD) for each in (wide, plain))
    assert inside >= 0.99
    assert (narrow < 0.97) == changes
    if not changes:  # and is not made wider for nothing
        assert np.mean(wide) > 0.9 * np.mean(plain)


def test_a_pose_whose_turns_are_known_is_as_sure_as_the_curvature_says() -> None:
    turn = np.radians(50) * np.array([0.6, 0.8, 0.0])
    T, found, projection = fitted(from_rotation_vector(turn, np.array([0.0, 0.0, 120.0])), 1)
    before, after = covariances(T, found, projection)
    assert np.degrees(np.sqrt(before[3:, 3:].trace())) < 0.5
    assert after is before


@pytest.mark.parametrize("larger", [0.5, 2.0, 8.0])
def test_how_well_noise_is_known_makes_no_turn_likelier(larger: float) -> None:
    """Where what is seen is linear in turns, their ellipsoid is that of the covariance."""
    turn = np.radians(50) * np.array([0.6, 0.8, 0.0])
    T, found, projection = fitted(from_rotation_vector(turn, np.array([5.0, -8.0, 2000.0])), 6)
    before = larger * covariances(T, found, projection)[0]
    assert np.sqrt(before[3:, 3:].trace()) > 0.01
    after = turned(before, T, found, projection)
    assert after[3:, 3:].trace() < 1.1 * before[3:, 3:].trace()


def test_what_no_turn_explains_makes_none_less_likely() -> None:
    """Offsets that no pose takes away are there at all turns alike."""
    T, found, projection = fitted(from_rotation_vector([0.04, 0.05, 0], [0, 0, 500.0]), 2)
    J = found.J[0].reshape(-1, 6)
    before = NOISE**2 * np.linalg.inv(J.T @ J)
    r = np.random.default_rng(5).normal(size=len(J))
    r -= J @ np.linalg.lstsq(J, r)[0]
    sizes = []
    for squared in (0.01, 18.0):  # of the 22.5 by which a likely turn may be worse
        rest = r * np.sqrt(squared * NOISE**2 / (r @ r))
        seen = replace(found, offsets=rest.reshape(found.offsets.shape))
        after = turned(before, T, seen, projection)
        sizes.append(after[3:, 3:].trace() / before[3:, 3:].trace())
    assert min(sizes) > 1.3
    assert max(sizes) < 1.5 * min(sizes)


def test_several_poses_at_once_are_turned_as_each_by_itself() -> None:
    poses, alone = list[Curved](), list[Floats]()
    for seed, tilt in enumerate((0.04, 0.7, 0.05, 0.06)):
        T, found, projection = fitted(from_rotation_vector([tilt, 0.05, 0], [0, 0, 500.0]), seed)
        before, after = covariances(T, found, projection)
        poses.append(Curved(before, T, found, np.array([NOISE**2]), projection))
        alone.append(after)
    together = with_likely_turns(poses, FREE)
    np.testing.assert_allclose(together, alone, rtol=1e-9, atol=1e-15)
    changed = [after is not pose.covariance for after, pose in zip(together, poses, strict=True)]
    assert changed == [True, False, True, True]


def test_directions_that_are_held_stay_so() -> None:
    T, found, projection = fitted(from_rotation_vector([0.04, 0.05, 0], [0, 0, 500.0]), 2)
    free = np.array([True, True, True, True, True, False])
    J = found.J[0].reshape(-1, 6)[:, free]
    before = np.zeros((6, 6))
    before[np.ix_(free, free)] = NOISE**2 * np.linalg.inv(J.T @ J)
    after = turned(before, T, found, projection, free)
    assert not after[~free].any()
    assert not after[:, ~free].any()
    assert after[3:, 3:].trace() > 1.2 * before[3:, 3:].trace()


def test_a_pose_that_nothing_fixes_is_left_as_open_as_it_is() -> None:
    T, found, projection = fitted(from_rotation_vector([0.04, 0.05, 0], [0, 0, 500.0]), 3)
    before = np.diag([1.0, 1.0, np.inf, 0.01, 0.01, np.inf])
    assert turned(before, T, found, projection) is before


def test_what_leaves_the_view_by_a_turn_is_not_as_likely() -> None:
    """A board at the edge of the image is not turned out of it, however unsure its turn is."""
    T, found, projection = fitted(from_rotation_vector([0.04, 0.05, 0], [165.0, 0, 500.0]), 4)
    J = found.J[0].reshape(-1, 6)
    before = 100 * NOISE**2 * np.linalg.inv(J.T @ J)
    after = turned(before, T, found, projection)
    assert np.isfinite(after).all()
    assert np.linalg.eigvalsh(after)[0] > 0


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
