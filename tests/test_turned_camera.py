"""Two cameras of which one stands otherwise than its session says."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mixpose
from mixpose.rigid import from_rotation_vector
from mixpose.sensors import PinholeCamera
from mixpose.tracking.doubt import DISPLACED

RECORDING = Path(__file__).resolve().parents[1] / "data" / "synthetic" / "two_cameras"


def doubts(degrees: float, sensors: int) -> Counter[tuple[str, str]]:
    """Statuses with their reasons, where the last of some cameras is turned about its y axis."""
    session = mixpose.load_session(RECORDING / "session.toml")
    *others, last = session.sensors[2 - sensors :]
    assert isinstance(last.sensor, PinholeCamera)
    turn = from_rotation_vector([0.0, np.radians(degrees), 0.0], [0.0, 0.0, 0.0])
    turned = replace(last.sensor, T_sensor_world=turn @ last.sensor.T_sensor_world)
    session = replace(session, sensors=(*others, replace(last, sensor=turned)))
    return Counter((one.status, one.doubt) for one in mixpose.run(session))


@pytest.mark.parametrize(("degrees", "least"), [(1.0, 30), (0.0, 0)])
def test_where_one_of_two_cameras_is_turned_both_agree_about_poses_that_are_not_ok(
    degrees: float, least: int
) -> None:
    # the pose takes up all but a fiftieth of the turn, and is 14 mm off
    found = doubts(degrees, 2)
    assert found["ambiguous", DISPLACED] >= least
    assert found["ok", ""] <= 40 - least


def test_one_camera_has_the_world_stand_as_it_does() -> None:
    assert not any(doubt == DISPLACED for _, doubt in doubts(1.0, 1))
