"""The numbers that a calibration is told with, on a terminal and on its page."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from simulated_rigs import BODY, FPS, PLACES, alone, cameras, motion, recording, task_of

from mixpose.calibration import Calibration, calibrate
from mixpose.calibration.recorded import _profile_peaks
from mixpose.calibration.result import MetDetections
from mixpose.calibration.telling import lines_of
from mixpose.fit import EstimatorOptions
from mixpose.records import GridPattern
from mixpose.report.calibration import render_calibration
from mixpose.rigid import rotation_angle_deg
from mixpose.sensors import RangeSensor

NUMBER = r"(-?[0-9.]+(?:e[-+][0-9]+)?)"


def numbers_in(found: Calibration, pattern: str) -> list[tuple[float, ...]]:
    """What the lines that begin like a pattern say, number by number."""
    matches = (re.match(pattern.replace("#", NUMBER), line) for line in lines_of(found, "mm"))
    return [tuple(map(float, match.groups())) for match in matches if match]


@pytest.fixture(scope="module")
def late() -> Calibration:
    """Two cameras, the second a little late, and the body's features free."""
    sensors = cameras(2)
    frames = recording(sensors, 16, 0.05, late=0.004)
    free = {1: ("pose", "delay")}
    return calibrate(
        task_of(sensors, frames, free=free, body_free=True), found=alone(sensors, frames)
    )


def test_delays_are_told_in_milliseconds(late: Calibration) -> None:
    ((before, after, deviation),) = numbers_in(late, r"s1 delay\s+# -> #\s+± # ms")
    assert before == 0.0
    assert after == pytest.approx(1e3 * late.after.delays[1], rel=1e-4)
    assert after == pytest.approx(4.0, abs=0.5)
    block = next(one for one in late.blocks if one.kind == "delay")
    assert deviation == pytest.approx(1e3 * late.deviations[block.start], rel=0.06)  # two digits


def test_a_pose_is_told_by_how_far_it_moved_and_how_well_that_is_known(late: Calibration) -> None:
    ((turn, turn_by, shift, shift_by),) = numbers_in(
        late, "s1 pose +turned by # ± # deg, moved by # ± # mm"
    )
    before, after = (rig.sensors[1].T_sensor_world for rig in (late.before, late.after))  # type: ignore[attr-defined]
    assert turn == pytest.approx(float(rotation_angle_deg(before, after)), rel=1e-3)
    centres = [-T[:3, :3].T @ T[:3, 3] for T in (before, after)]
    assert shift == pytest.approx(np.linalg.norm(centres[1] - centres[0]), rel=1e-4)
    block = next(one for one in late.blocks if one.kind == "pose")
    deviation = late.deviations[block.place]
    assert shift_by == pytest.approx(np.linalg.norm(deviation[:3]), rel=0.06)
    assert turn_by == pytest.approx(np.degrees(np.linalg.norm(deviation[3:])), rel=0.06)


def test_features_of_the_body_are_told_by_how_far_they_moved(late: Calibration) -> None:
    told = numbers_in(late, "body feature [0-9]+ +moved by # ± # mm")
    moved = np.linalg.norm(late.after.points - late.before.points, axis=1)
    block = next(one for one in late.blocks if one.kind == "body")
    deviations = np.linalg.norm(late.deviations[block.place].reshape(-1, 3), axis=1)
    assert len(told) == len(BODY)
    assert [one[0] for one in told] == pytest.approx(moved, rel=1e-3)
    assert [one[1] for one in told] == pytest.approx(deviations, rel=0.06)


def test_residuals_of_frames_and_features_on_the_page_are_root_mean_squares(
    late: Calibration,
) -> None:
    # of frame 3 one detection is left, which is the farthest off of all
    cut = dict(late.met)
    for index, met in late.met.items():
        kept = met.frame != 3
        kept[np.flatnonzero(~kept)[: 1 - index]] = True
        far = np.where(met.frame == 3, 50.0, 1.0)[:, None] * met.offset
        cut[index] = MetDetections(met.y[kept], far[kept], met.frame[kept], met.feature[kept])
    late = replace(late, met=cut)
    page = render_calibration(late, "two", "mm", "0")
    assert "worst: frame 3, " in page
    for word, kind, first in (("frame", "frame", 0), ("feature", "feature", 1)):
        squares = defaultdict(list)
        for index, met in late.met.items():
            for key, offset in zip(getattr(met, kind), met.offset, strict=True):
                squares[int(key) + first].append((offset @ offset) / late.noise[index] ** 2)
        means = {key: float(np.sqrt(np.mean(each))) for key, each in squares.items()}
        worst = max(means, key=means.__getitem__)
        assert f"worst: {word} {worst}, {means[worst]:.3g}" in page


def test_a_feature_on_the_page_may_be_called_by_what_would_be_a_formula(late: Calibration) -> None:
    body = late.after.body
    named = replace(late.after, body=replace(body, names=(r"$\q$", *body.labels[1:])))
    assert r">$\q$<" in render_calibration(replace(late, after=named), "two", "mm", "0")


def test_places_of_range_sensors_are_told_in_the_unit_of_the_session() -> None:
    sensors = [RangeSensor(PLACES[0])]
    frames = recording(sensors, 40, 0.1)
    poses = {k: motion(k / FPS) for k in range(40)}
    found = calibrate(task_of(sensors, frames, 5.0, free={0: ("position",)}, known=poses))
    told = numbers_in(found, "s0 position [xyz] +# -> # +± # mm")
    assert [one[0] for one in told] == [0.0, -1000.0, 0.0]
    assert [one[1] for one in told] == pytest.approx(found.after.sensors[0].position, rel=1e-4)  # type: ignore[attr-defined]
    assert [one[2] for one in told] == pytest.approx(found.deviations, rel=0.06)


def test_a_task_fuses_frames_unless_told_otherwise_as_a_session_does() -> None:
    task = task_of(cameras(2), ())
    assert task.fuse == EstimatorOptions().fuse


@pytest.mark.parametrize("place", [251.0, 251.3, 248.6])
def test_ranges_of_a_profile_are_told_between_its_bins(place: float) -> None:
    bins = 200.0 + 2.0 * np.arange(60)
    values = np.exp(-0.5 * ((bins - place) / 6.0) ** 2)[None].astype(np.float32)
    (found,) = _profile_peaks(GridPattern(values, np.array([200.0]), 2.0)).tolist()
    # a parabola through three bins of a third of its width
    assert found == pytest.approx([place], abs=0.02)
