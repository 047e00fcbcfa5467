"""What a calibration holds may be off, and what it found may stand elsewhere: both are told."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from simulated_rigs import (
    BODY,
    FPS,
    NO_FRAME_HELD_BACK,
    PLACES,
    POINTS,
    alone,
    bumped,
    cameras,
    motion,
    recording,
    task_of,
)

from mixpose.calibration import calibrate
from mixpose.calibration.task import NOTHING, Hypotheses, Known, SeenFrame
from mixpose.calibration.telling import check_lines, doubts_of, lines_of
from mixpose.calibration.words import error_of_held
from mixpose.rigid import from_rotation_vector, inverse, rotation_angle_deg
from mixpose.sensors import CalibrationError, RangeSensor

POSES = {k: motion(k / FPS) for k in range(40)}


def places(found: Any) -> np.ndarray:
    return np.concatenate([s.position for s in found.after.sensors])


def test_deviations_know_of_a_bias_that_is_held_and_may_be_off() -> None:
    sensors = [RangeSensor(PLACES[0])]
    frames = recording(sensors, 40, 0.1)
    task = task_of(sensors, frames, 5.0, free={0: ("position",)}, known=POSES)
    plain = calibrate(task, NO_FRAME_HELD_BACK)
    stated = calibrate(
        replace(task, errors={0: CalibrationError(range_bias=1.0)}), NO_FRAME_HELD_BACK
    )
    off = calibrate(
        replace(task, rig=task.rig.exchanged(0, RangeSensor(PLACES[0], range_bias=1))),
        NO_FRAME_HELD_BACK,
    )
    # to first order the place moves by what a bias of one standard deviation moves it
    added = np.sqrt(stated.deviations**2 - plain.deviations**2)
    assert added == pytest.approx(np.abs(places(off) - places(plain)), rel=0.02, abs=1e-3)
    assert stated.deviations[1] > 100 * plain.deviations[1]
    np.testing.assert_allclose(places(stated), places(plain), atol=1e-9)


def test_a_turn_that_is_held_makes_the_other_camera_as_uncertain() -> None:
    sensors = cameras(2)
    frames = recording(sensors, 12, 0.02)
    task = replace(task_of(sensors, frames), errors={0: CalibrationError(rotation_deg=0.2)})
    found = calibrate(task, NO_FRAME_HELD_BACK, found=alone(sensors, frames))
    turn = np.degrees(np.sqrt((found.deviations[3:] ** 2).sum()))
    # the second turns with the first: 0.2 degrees about each of three axes
    assert turn == pytest.approx(0.2 * np.sqrt(3), rel=0.02)


def test_what_is_free_is_no_longer_as_uncertain_as_was_stated() -> None:
    error = CalibrationError(focal=1e-3, rotation_deg=0.1, position=2.0)
    assert error_of_held(error, ("pose", "delay")) == CalibrationError(focal=1e-3)
    assert error_of_held(error, ("focal",)) == replace(error, focal=0.0)


def test_a_direction_that_a_bias_hides_is_named_and_stays() -> None:
    sensors = [RangeSensor(PLACES[0])]
    frames = recording(sensors, 40, 0.1)
    task = task_of(sensors, frames, 5.0, free={0: ("position",)}, known=POSES)
    found = calibrate(
        replace(task, errors={0: CalibrationError(range_bias=900.0)}), NO_FRAME_HELD_BACK
    )
    # the sensor stands 1 m away along y: a quarter of that is no knowledge of it
    assert found.refused
    assert all(text.startswith("s0:position y") for text in found.refused)


def test_biases_that_are_held_as_exact_are_told_with_what_they_would_do() -> None:
    sensors = [RangeSensor(p) for p in PLACES]
    frames = recording(sensors, 20, 0.1)
    free = dict.fromkeys(range(3), ("position",))
    found = calibrate(task_of(sensors, frames, 5.0, free=free, known=POSES), NO_FRAME_HELD_BACK)
    told = [line for line in lines_of(found, "mm") if line.startswith("held")]
    assert len(told) == 1
    # a bias of 5 mm moves a sensor about 5 mm along its line of sight, or more across
    assert 5 <= np.sqrt(found.of_biases.diagonal().max()) < 30


def test_lenses_that_are_held_as_exact_are_told_with_what_they_would_do() -> None:
    sensors = cameras(2)
    frames = recording(sensors, 16, 0.05)
    found = calibrate(task_of(sensors, frames, 1.0, free={1: ("pose",)}), NO_FRAME_HELD_BACK)
    told, of_size = [line for line in lines_of(found, "mm") if line.startswith("held")]
    # 820 mm from the middle and 1.4 radians from each other they are 1057 mm apart
    assert "size of the body, as exact; 1 % of it moves sensors by up to 11 mm" in of_size
    assert "0.1 % of the focal length and by 1 px of the principal point" in told
    # a pixel turns a line of sight by a thousandth, which is a millimetre of a metre or more
    assert 0.5 < np.sqrt(found.of_lenses.diagonal().max()) < 5
    freed = task_of(sensors, frames, 1.0, free=dict.fromkeys(range(2), ("pose", "focal")))
    assert not calibrate(freed, NO_FRAME_HELD_BACK).of_lenses.any()


def test_of_three_cameras_two_of_which_were_bumped_none_is_named() -> None:
    sensors = cameras(3)
    frames = recording(sensors, 14, 0.05)
    task = bumped(bumped(task_of(sensors, frames), 0, 0.5, 4.0), 2, 0.8, 9.0)
    found = calibrate(task, NO_FRAME_HELD_BACK, found=alone(sensors, frames))
    *lines, last = check_lines(found, "mm")
    assert last.endswith("of 3 sensors most of which disagree no one can tell which moved")
    assert not any("MOVED" in line for line in lines)


def test_cameras_without_a_common_view_do_not_say_which_of_two_others_moved() -> None:
    sensors = cameras(5)
    frames = recording(sensors, 14, 0.05)
    frames = tuple(replace(f, points={k: y for k, y in f.points.items() if k < 2}) for f in frames)
    task = bumped(task_of(sensors, frames), 1, 0.8, 9.0)
    found = calibrate(task, NO_FRAME_HELD_BACK, found=alone(sensors, frames))
    assert found.unlinked == (2, 3, 4)
    *lines, last = check_lines(found, "mm")
    assert last.endswith("of two sensors no one can tell which moved")
    assert not any("MOVED" in line for line in lines)


def test_a_camera_that_meets_nothing_as_it_stood_has_moved() -> None:
    sensors = cameras(3)
    frames = recording(sensors, 14, 0.05)
    task = bumped(task_of(sensors, frames), 1, 0.8, 9.0)
    found = calibrate(task, NO_FRAME_HELD_BACK, found=alone(sensors, frames))
    nothing = replace(found.residuals[1], before=np.nan)
    found = replace(found, residuals={**found.residuals, 1: nothing})
    *lines, last = check_lines(found, "mm")
    assert last == "the calibration no longer holds: s1 moved"
    assert "; meets nothing, calibrated anew 0.0" in lines[2]


@pytest.mark.parametrize(("scale", "turn_deg"), [(0.1, 0.0), (1.2, 0.0), (1.0, 3.0), (1.2, 20.0)])
def test_sensors_that_only_came_nearer_ask_for_the_size_of_the_body(
    scale: float, turn_deg: float
) -> None:
    sensors = cameras(3)
    frames = recording(sensors, 14, 0.05)
    task = task_of(sensors, frames)
    first = sensors[0].T_sensor_world
    for k in (1, 2):
        T = sensors[k].T_sensor_world @ inverse(first)
        T[:3, 3] /= scale
        turn = from_rotation_vector([0, np.radians(turn_deg), 0], [0, 0, 0])
        task = replace(task, rig=task.rig.placed(k, T @ turn @ first))
    found = calibrate(task, NO_FRAME_HELD_BACK, found=alone(sensors, frames))
    told = [text for text in doubts_of(found, "mm") if "times as far apart" in text]
    assert bool(told) is (scale != 1.0 and not turn_deg)
    if told:
        assert f"found {scale:.2g}" in told[0][:25]
        assert f"is the body {1 / scale:.4g}"[:15] in told[0]
    assert told == [line[10:] for line in check_lines(found, "mm") if line.startswith("doubt")]


def test_a_marker_that_lies_elsewhere_is_named_as_deviations_do_not_know_of_it() -> None:
    sensors = cameras(2)
    off = POINTS + np.eye(6)[:, 3:4] * [0.0, 0.0, 2.0]
    exact, wrong = (recording(sensors, 16, 0.05, points=each) for each in (POINTS, off))
    assert (
        calibrate(
            task_of(sensors, exact), NO_FRAME_HELD_BACK, found=alone(sensors, exact)
        ).contradicted
        is None
    )
    found = calibrate(task_of(sensors, wrong), NO_FRAME_HELD_BACK, found=alone(sensors, wrong))
    true, T = (s[1].T_sensor_world for s in (sensors, found.after.sensors))  # type: ignore[attr-defined]
    away = np.abs(T[:3, 3] - true[:3, 3]) / found.deviations[:3]
    assert away.max() > 2.5  # 0.5 % of cameras whose deviations hold are that far off
    held = found.contradicted
    assert held is not None
    assert (held.names, held.parameter) == (("body",), f"{BODY.labels[3]}.z")
    assert held.deviations > 2.5
    assert any("add --free body to what is free" in text for text in doubts_of(found, "mm"))
    freed = task_of(sensors, wrong, body_free=True)
    assert calibrate(freed, NO_FRAME_HELD_BACK, found=alone(sensors, wrong)).contradicted is None


def test_a_late_camera_whose_delay_is_held_is_named() -> None:
    sensors = cameras(2)
    frames = recording(sensors, 16, 0.05, late=0.004)
    held = calibrate(
        task_of(sensors, frames), NO_FRAME_HELD_BACK, found=alone(sensors, frames)
    ).contradicted
    assert held is not None
    assert held.names[0].endswith(":delay")  # of one or the other: only their difference is told


@pytest.mark.parametrize(("count", "bumped_camera"), [(2, 1), (3, 0), (3, 2)])
def test_a_camera_bumped_during_the_recording_is_named_with_the_frame(
    count: int, bumped_camera: int
) -> None:
    sensors, since, frames_in_all = cameras(count), 14, 24
    moved = from_rotation_vector([0.001, -0.001, 0.001], [0.1, 0.1, 0.0])
    after = list(sensors)
    T = moved @ sensors[bumped_camera].T_sensor_world
    after[bumped_camera] = replace(sensors[bumped_camera], T_sensor_world=T)
    parts = [recording(rig, frames_in_all, 0.05) for rig in (sensors, after)]
    # by 0.1 degrees: detections move by up to 3 px, which poses and the other camera mostly absorb
    frames = parts[0][:since] + parts[1][since:]
    task, known = task_of(sensors, parts[0]), alone(sensors, parts[0])
    assert calibrate(task, NO_FRAME_HELD_BACK, found=known).contradicted is None
    known = alone(sensors, parts[0][:since]) | alone(after, parts[1][since:])
    found = calibrate(replace(task, frames=frames), NO_FRAME_HELD_BACK, found=known)
    held = found.contradicted
    assert held is not None
    # of two cameras no one can tell which
    assert held.names == (("s0", "s1") if count == 2 else (f"s{bumped_camera}",))
    assert held.frames == (since, frames_in_all - 1)
    assert held.deviations > 2 or count > 2  # of three, the bumped one may be outvoted
    told = f"{' or '.join(held.names)} stands elsewhere in frames {since} to 23 than in the others"
    assert any(text.startswith(told) for text in doubts_of(found, "mm"))


def test_sensors_that_drift_are_told_from_a_sensor_that_was_bumped() -> None:
    sensors, count = cameras(2), 24
    frames: list[SeenFrame] = []
    known: Known = {}
    for k in range(count):
        turned = from_rotation_vector([0.0, -0.0002 * k, 0.0002 * k], [0.0, 0.0, 0.0])
        T = turned @ sensors[1].T_sensor_world
        rig = [sensors[0], replace(sensors[1], T_sensor_world=T)]
        frames.append(recording(rig, count, 0.05)[k])
        known |= alone(rig, frames[-1:])
    found = calibrate(task_of(sensors, tuple(frames)), NO_FRAME_HELD_BACK, found=known)
    held = found.contradicted
    assert held is not None
    assert held.names == ()
    assert any("sensors that drift" in text for text in doubts_of(found, "mm"))


def test_a_camera_that_was_linked_wrongly_is_placed_by_the_others() -> None:
    sensors = cameras(3)
    frames = recording(sensors, 6, 0.05)
    known = alone(sensors, frames)
    wrong = from_rotation_vector([0.0, 0.0, 0.6], [60.0, 0.0, 0.0])
    for key, one in known.items():
        if key[1] == 2:
            known[key] = Hypotheses(wrong @ one.poses, one.evidence)
    found = calibrate(task_of(sensors, frames), found=known)
    truth = sensors[2].T_sensor_world
    T = found.after.sensors[2].T_sensor_world  # type: ignore[attr-defined]
    # three standard deviations as told: 0.027 degrees, 0.4 mm
    assert rotation_angle_deg(T, truth) < 0.09
    assert np.linalg.norm(inverse(T)[:3, 3] - inverse(truth)[:3, 3]) < 1.2
    assert found.unlinked == ()
    assert not doubts_of(found, "mm")


def test_a_camera_that_sees_three_features_at_a_time_is_placed_by_the_others() -> None:
    sensors = cameras(3)
    frames = tuple(
        replace(frame, points={**frame.points, 2: frame.points[2][:3]})
        for frame in recording(sensors, 8, 0.05)
    )
    known = alone(
        sensors[:2], [replace(f, points={0: f.points[0], 1: f.points[1]}) for f in frames]
    )
    known |= {(frame.number, 2): NOTHING for frame in frames}
    found = calibrate(
        bumped(task_of(sensors, frames), 2, 3.0, 40.0), NO_FRAME_HELD_BACK, found=known
    )
    truth = sensors[2].T_sensor_world
    T = found.after.sensors[2].T_sensor_world  # type: ignore[attr-defined]
    # three standard deviations as told: 0.033 degrees, 0.47 mm
    assert rotation_angle_deg(T, truth) < 0.1
    assert np.linalg.norm(inverse(T)[:3, 3] - inverse(truth)[:3, 3]) < 1.4
    assert found.unlinked == ()


def test_one_camera_that_knows_no_pose_alone_is_placed_by_known_poses() -> None:
    sensors = cameras(1)
    frames = recording(sensors, 6, 0.05)
    task = bumped(task_of(sensors, frames, free={0: ("pose",)}, known=POSES), 0, 1.0, 5.0)
    found = calibrate(
        task, NO_FRAME_HELD_BACK, found={(frame.number, 0): NOTHING for frame in frames}
    )
    T = found.after.sensors[0].T_sensor_world  # type: ignore[attr-defined]
    # three standard deviations as told: 0.016 degrees
    assert rotation_angle_deg(T, sensors[0].T_sensor_world) < 0.05
    assert found.bad == ()


def test_a_camera_whose_detections_do_not_fit_is_doubted() -> None:
    sensors = cameras(2)
    frames = recording(sensors, 12, 0.05)
    found = calibrate(task_of(sensors, frames), found=alone(sensors, frames))
    assert found.explained.min() > 0.8
    told = doubts_of(replace(found, explained=np.array([0.9, 0.2])), "mm")
    assert told == ["s1: 20 % of its detections fit: it may stand elsewhere"]


def test_one_camera_has_nothing_to_be_held_against() -> None:
    sensors = cameras(1)
    frames = recording(sensors, 8, 0.05)
    task = task_of(sensors, frames, free={})
    found = calibrate(task, NO_FRAME_HELD_BACK, found=alone(sensors, frames))
    assert check_lines(found, "mm")[-1].startswith("nothing to hold it against: one sensor alone")
