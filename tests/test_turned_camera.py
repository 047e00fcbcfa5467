"""Two cameras of which one stands otherwise than its session says."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mixpose
from mixpose.judgement import APART
from mixpose.rigid import from_rotation_vector
from mixpose.sensors import PinholeCamera

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


@pytest.mark.parametrize(("degrees", "right"), [(1.0, 0), (0.0, 40)])
def test_where_one_of_two_cameras_is_turned_both_agree_about_poses_that_are_not_ok(
    degrees: float, right: int
) -> None:
    # the pose takes up all but a fiftieth of the turn, and is 14 mm off
    found = doubts(degrees, 2)
    assert found == Counter({("ok", ""): right} if right else {("ambiguous", APART): 40})


def test_one_camera_has_the_world_stand_as_it_does() -> None:
    assert not any(doubt == APART for _, doubt in doubts(1.0, 1))
