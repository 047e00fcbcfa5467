"""What frames tell together of a shape: laws."""

from __future__ import annotations

import numpy as np
import pytest
from matches import Seen, matches_of
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.judgement import NoiseModel, Shape, shape_shown
from mixpose.objective import pose_jacobian

NOISE = 0.1  # σ_ε
MODEL = NoiseModel()
POINTS = np.array([[-48.0, -20, 10], [40, -35, -25], [10, 52, -12], [5, 8, 50]])
BODY = Body("four", tuple(PointFeature(point) for point in POINTS))


def shape(turn_deg: float, seed: int, before: Shape | None = None, *, alone: float = 3.0) -> Shape:
    """Of one view along z by a camera of one σ_ε per length unit, of a body that is turned."""
    T, rng = np.eye(4), np.random.default_rng(seed)
    T[:3, :3] = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    by_world = np.tile(np.eye(3)[:2], (len(POINTS), 1, 1))
    J = pose_jacobian(by_world, POINTS @ T[:3, :3].T)
    errors = rng.normal(0, NOISE, (len(POINTS), 2))
    off = np.linalg.lstsq(J.reshape(-1, 6), errors.ravel(), rcond=None)[0]
    found = matches_of(Seen(J, offsets=errors - J @ off))
    return shape_shown(found, np.array([NOISE**2]), BODY, T, alone, MODEL, before)


def turning(step_deg: float, frames: int = 9) -> Shape:
    """Of frames in which it turns by so much in each."""
    one = shape(0.0, 0)
    for frame in range(1, frames):
        one = shape(step_deg * frame, frame, one)
    return one


def gained(one: Shape) -> float:
    """Log odds beside those of a frame by itself."""
    return one.log_odds(BODY.radius, MODEL) - 3.0


def test_one_frame_says_what_it_says_by_itself() -> None:
    assert gained(shape(0.0, 0)) == pytest.approx(0.0, abs=1e-9)


def test_one_view_fixes_what_the_pose_leaves_of_its_coordinates() -> None:
    # of 12 coordinates 8 are seen, and a camera that sees no depth leaves five of the pose
    values = np.linalg.eigvalsh(shape(0.0, 0).information)
    assert np.count_nonzero(values > 1e-4) == 3


def test_frames_from_one_side_say_little_more() -> None:
    # noise of a frame lasts: three coordinates gain ½ ln 2 each, and the noise is known better
    assert -1.5 < gained(turning(0.0)) < 2.5


def test_poses_that_err_show_no_other_side() -> None:
    # a turn errs by 0.1 / 50, 0.1°: of as much, to and fro, nobody sees a depth
    one = shape(0.0, 0)
    for frame in range(1, 9):
        one = shape(0.1 * (-1) ** frame, frame, one)
    assert gained(one) < 2.5


def test_frames_from_other_sides_say_much() -> None:
    # 16° show depths to 0.1 / sin 16°: two further coordinates of ln (70 / 0.4) = 5 each
    assert 6.0 < gained(turning(2.0)) < 25.0


def test_a_frame_that_says_more_by_itself_than_all_before_it_counts() -> None:
    doubted = shape(0.0, 1, shape(0.0, 0, alone=-8.0), alone=9.0)
    assert doubted.log_odds(BODY.radius, MODEL) == 9.0


def test_residuals_that_another_shape_has_not_speak_against_the_body() -> None:
    one, bias = turning(2.0), np.zeros(12)
    bias[2] = 10.0  # a hundred deviations of a coordinate: as if a feature stood elsewhere
    pulled = one.vector + one.information @ bias
    more = float(2 * bias @ one.vector + bias @ one.information @ bias)
    other = one._replace(vector=pulled, squares=one.squares + more)
    assert gained(other) < gained(one) - 5.0
