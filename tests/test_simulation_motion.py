"""The simulated motion: smooth, bounded, about its central pose, and only where it is free."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rounding import rounding

from mixpose.rigid import (
    TWIST_NAMES,
    from_rotation_vector,
    is_rigid,
    rotation_angle_deg,
    transform,
    twist_between,
)
from mixpose.session import load_session
from mixpose.simulation.central_pose import motion_about
from mixpose.simulation.motion import Motion, plan_motion
from mixpose.simulation.options import SimulationOptions

TWO_CAMERAS = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras" / "session.toml"
CENTRE = from_rotation_vector([0.5, -1.0, 0.3], [100.0, 50.0, 800.0])
PIVOT = np.array([20.0, 10.0, -5.0])
TIMES = np.arange(0, 60, 0.04)


def motion(seed: int = 0, free: tuple[str, ...] = TWIST_NAMES) -> Motion:
    return plan_motion(
        CENTRE, PIVOT, translation=30.0, rotation_deg=20.0, period_s=4.0, free=free, seed=seed
    )


def test_poses_are_rigid_at_every_time() -> None:
    assert all(is_rigid(T, 1e-12) for T in motion().poses(TIMES)[::50])


def test_one_time_gives_one_pose() -> None:
    assert motion().poses(np.array(0.4)).shape == (4, 4)
    one, many = motion().poses(np.array(0.4)), motion().poses(TIMES)
    np.testing.assert_allclose(one, many[10], rtol=0, atol=rounding(many))


@pytest.mark.parametrize("seed", range(5))
def test_the_pivot_moves_within_the_amplitude_and_makes_use_of_it(seed: int) -> None:
    pivots = transform(motion(seed).poses(TIMES), PIVOT[None])[:, 0]
    away = np.abs(pivots - transform(CENTRE, PIVOT[None])[0])
    assert away.max() <= 30.0 + 1e-9
    assert (away.max(axis=0) > 20.0).all()
    assert np.linalg.norm(away, axis=1).max() <= motion(seed).reach


def test_a_body_swings_by_four_tenths_of_its_radius_where_nothing_else_is_said() -> None:
    session = load_session(TWO_CAMERAS)
    away = np.abs(motion_about(session, CENTRE, SimulationOptions(frames=1), 0).shift.at(TIMES))
    shares = away.max(axis=0) / session.body.radius
    assert (shares > 2 / 3 * 0.4).all()
    assert (shares <= 0.4 + 1e-9).all()


@pytest.mark.parametrize("seed", range(5))
def test_the_body_turns_within_the_amplitude_of_each_axis(seed: int) -> None:
    angles = rotation_angle_deg(CENTRE, motion(seed).poses(TIMES))
    assert 20.0 < angles.max() <= 20.0 * np.sqrt(3)


@pytest.mark.parametrize("seed", range(5))
def test_the_first_pose_is_near_the_central_one_but_not_on_it(seed: int) -> None:
    first = motion(seed).poses(np.array(0.0))
    assert rotation_angle_deg(CENTRE, first) == pytest.approx(0.07 * 20 * np.sqrt(3), rel=0.01)
    moved = transform(first, PIVOT[None]) - transform(CENTRE, PIVOT[None])
    assert np.linalg.norm(moved) == pytest.approx(0.07 * 30 * np.sqrt(3), rel=1e-6)


def test_the_motion_is_smooth_and_changes_its_speed() -> None:
    steps = np.diff(transform(motion().poses(TIMES), PIVOT[None])[:, 0], axis=0)
    speed = np.linalg.norm(steps, axis=1)
    assert speed.max() < 4.5  # 30 mm in sinusoids of 4 s and less, three axes, 25 frames a second
    assert speed.min() < 0.5 * speed.max()
    assert np.abs(np.diff(steps, axis=0)).max() < 0.2 * speed.max()


def test_directions_that_are_not_free_stay_as_they_are() -> None:
    poses = motion(free=("x", "y", "rz")).poses(TIMES)
    twists = twist_between(np.broadcast_to(CENTRE, poses.shape), poses)
    np.testing.assert_allclose(twists[:, [2, 3, 4]], 0, atol=1e-9)
    assert (np.abs(twists[:, [0, 1, 5]]).max(axis=0) > [20, 20, 0.2]).all()


def test_another_seed_is_another_motion() -> None:
    assert not np.allclose(motion(0).poses(TIMES), motion(1).poses(TIMES))
