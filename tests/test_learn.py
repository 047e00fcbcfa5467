"""Bodies that are learnt from a recording in which they move."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import command
from moving_bodies import (
    CAMERA_MATRIX,
    RESOLUTION,
    Array,
    Scene,
    aligned_errors,
    body,
    camera,
    detections,
    motion,
    write_recording,
)

from mixpose.body import Body, PointFeature
from mixpose.calibration import Rig, SeenFrame
from mixpose.errors import RecordingError, SessionError
from mixpose.learning import (
    LearningResult,
    SensorSet,
    in_axes_of,
    in_marker_axes,
    learn,
    learn_from,
)
from mixpose.learning.telling import doubts_of
from mixpose.rigid import rotation_angle_deg
from mixpose.sensors import CalibrationError, PinholeCamera
from mixpose.session import load_scene, load_session

CAMERAS = [camera(20.0), camera(85.0)]
SENSORS = [PinholeCamera(CAMERA_MATRIX, np.zeros(0), RESOLUTION, T) for T in CAMERAS]
EYES = SensorSet(
    Rig.of(("a", "b"), SENSORS, Body("none", (PointFeature(np.zeros(3)),))), np.ones(2)
)
SHORT = Scene(frames=40)


def lesson_of(
    bodies: list[tuple[Array, Array]], scene: Scene = SHORT, seed: int = 1
) -> LearningResult:
    frames = detections(bodies, CAMERAS, scene, seed)
    seen = [SeenFrame(k, None, dict(enumerate(views)), {}) for k, views in enumerate(frames)]
    return learn_from(seen, EYES)


def moving(markers: int, seed: int, scene: Scene = SHORT) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    return body(markers, rng), motion(scene, rng)


@pytest.fixture(scope="module")
def five() -> tuple[Array, LearningResult]:
    """Five markers with hidden ones, false detections and four others that stand still."""
    points, poses = moving(5, 3)
    return points, lesson_of([(points, poses)])


def test_a_body_among_clutter_is_learnt_within_its_deviations(
    five: tuple[Array, LearningResult],
) -> None:
    points, lesson = five
    (found,) = lesson.bodies
    errors = aligned_errors(found.points, points)
    # 0.15 px at 1 m and a focal length of 1200 px are 0.13 mm, of 40 frames 0.03 mm
    assert np.linalg.norm(errors, axis=1).max() < 0.1
    deviations = np.linalg.norm(found.deviations, axis=1)
    assert (np.linalg.norm(errors, axis=1) < 3 * deviations).all()
    assert 0.01 < deviations.mean() < 0.05


def test_what_stands_still_is_counted_and_is_no_body(five: tuple[Array, LearningResult]) -> None:
    assert five[1].still == SHORT.still
    assert [one.count for one in five[1].bodies] == [1]


def test_the_noise_of_detections_is_told_by_how_closely_rays_meet(
    five: tuple[Array, LearningResult],
) -> None:
    # of about 200 gaps between rays, whose deviation errs by 5 %; false meetings make it worse
    assert five[1].noise == pytest.approx(SHORT.noise, rel=0.25)


def test_the_frame_is_that_of_the_principal_axes(five: tuple[Array, LearningResult]) -> None:
    found = five[1].bodies[0].points
    second = found.T @ found
    assert np.abs(found.mean(axis=0)).max() < 1e-9
    assert np.abs(second - np.diag(np.diag(second))).max() < 1e-6 * second.max()
    assert (np.diff(np.diag(second)) < 0).all()
    assert (np.diff(found[:, 0]) < 0).all()


def test_axes_by_markers_put_them_there(five: tuple[Array, LearningResult]) -> None:
    found = in_marker_axes(five[1].bodies[0], "2,5,1")
    at = dict(zip(found.names, found.points, strict=True))
    assert np.abs(at["2"]).max() < 1e-9
    assert np.abs(at["5"][1:]).max() < 1e-9 < at["5"][0]
    assert abs(at["1"][2]) < 1e-9 < at["1"][1]
    for words in ("1,2,9", "1,1,2", "1,2,3,1"):
        with pytest.raises(SessionError, match="allowed: ORIGIN,X,Y, three of the markers 1, 2, 3"):
            in_marker_axes(five[1].bodies[0], words)


def test_an_older_table_gives_axes_names_and_order(five: tuple[Array, LearningResult]) -> None:
    points, lesson = five
    ruler = points.round()  # measured to a millimetre, one marker not at all
    names = ["tip", "left", "right", "top"]
    likeness = in_axes_of(lesson.bodies[0], ruler[:4], names)
    assert likeness is not None
    assert likeness.body.names == (*names, "5")
    # the ruler's errors of 0.5 mm turn and shift the frame by as much at most
    assert np.abs(likeness.body.points - points).max() < 1.5
    assert in_axes_of(lesson.bodies[0], 1.5 * ruler, []) is None


def test_a_body_before_late_cameras_that_may_be_off_is_within_its_deviations() -> None:
    # the second camera looks 1/40 of a frame later, when markers are up to a pixel further
    fine = replace(SHORT, frames=40 * SHORT.frames, noise=0.03, still=0, false=0)
    points, poses = moving(5, 3, fine)
    a, b = (
        detections([(points, poses[start::40])], CAMERAS, replace(fine, frames=40), 1)
        for start in (0, 1)
    )
    seen = zip(a, b, strict=True)
    frames = [
        SeenFrame(k, float(k), {0: first[0], 1: second[1]}, dict.fromkeys((0, 1), float(k)))
        for k, (first, second) in enumerate(seen)
    ]
    late = replace(EYES, rig=replace(EYES.rig, delays=np.array([0.0, 1 / 40])))
    (told,) = learn_from(frames, late).bodies
    (not_told,) = learn_from(frames, EYES).bodies
    doubted = replace(late, errors={1: CalibrationError(position=1.0)})
    (unsure,) = learn_from(frames, doubted).bodies
    off, too_far = (aligned_errors(one.points, points) for one in (told, not_told))
    # 0.03 px are 0.006 mm of 40 frames
    assert (np.linalg.norm(off, axis=1) < 3 * np.linalg.norm(told.deviations, axis=1)).all()
    assert np.abs(off).max() < 0.02 < np.abs(too_far).max()
    # a millimetre at a metre turns lines of sight by 0.06 deg, which is 0.1 mm and more on the body
    assert unsure.deviations.mean() > 2 * told.deviations.mean()


def test_a_body_before_late_cameras_is_learnt_beside_lights_that_stand_still() -> None:
    # the second camera looks a twelfth of a frame later, when lines of sight miss each other by
    # pixels, and by a sixth of one at the lights
    fine = replace(SHORT, frames=12 * SHORT.frames, still=4)
    points, poses = moving(6, 3, fine)
    a, b = (
        detections([(points, poses[start::12])], CAMERAS, replace(fine, frames=SHORT.frames), 1)
        for start in (0, 1)
    )
    frames = [
        SeenFrame(k, float(k), {0: first[0], 1: second[1]}, dict.fromkeys((0, 1), float(k)))
        for k, (first, second) in enumerate(zip(a, b, strict=True))
    ]
    late = replace(EYES, rig=replace(EYES.rig, delays=np.array([0.0, 1 / 12])))
    lesson = learn_from(frames, late)
    (body,) = lesson.bodies
    assert (len(body.points), lesson.still) == (6, 4)
    off = np.linalg.norm(aligned_errors(body.points, points), axis=1)
    assert (off < 3 * np.linalg.norm(body.deviations, axis=1)).all()
    assert off.max() < 0.1


def test_frames_in_which_a_body_may_be_turned_over_are_left_aside() -> None:
    # three of four markers lie alike when turned over, but for 0.2 mm; one is hidden now and then
    points = np.array([[-30.0, 0.0, 0.0], [30.0, 0.0, 0.0], [0.1, 65.0, 0.0], [25.0, -40.0, 40.0]])
    scene = replace(SHORT, hidden=0.2)
    poses = motion(scene, np.random.default_rng(3))
    (found,) = lesson_of([(points, poses)], scene).bodies
    turned, true = (T @ np.linalg.inv(T[0]) for T in (found.poses, poses[found.numbers]))
    # markers 60 mm apart that err by 0.15 mm
    assert rotation_angle_deg(turned, true).max() < 1.5
    assert len(found.numbers) >= 10  # that show the fourth marker


def test_two_bodies_are_told_apart() -> None:
    first, second = moving(5, 3), moving(4, 8)
    lesson = lesson_of([first, (second[0], second[1])])
    assert [len(one.points) for one in lesson.bodies] == [5, 4]
    assert np.abs(aligned_errors(lesson.bodies[0].points, first[0])).max() < 0.1
    assert np.abs(aligned_errors(lesson.bodies[1].points, second[0])).max() < 0.1
    # each of them in its own frames: a body takes no detections from the other
    assert min(one.frames.min() for one in lesson.bodies) > 0.6 * SHORT.frames
    assert [one.spread for one in lesson.bodies] == [0.0, 0.0]


def test_two_congruent_bodies_are_one_of_which_there_are_two() -> None:
    points, poses = moving(4, 3)
    rng = np.random.default_rng(9)
    lesson = lesson_of([(points, poses), (points, motion(SHORT, rng))])
    assert [(len(one.points), one.count) for one in lesson.bodies] == [(4, 2)]


def test_mirror_images_are_two_bodies_though_their_triangles_are_congruent() -> None:
    # four markers, as of a left and a right hand; any three of one lie like three of the other
    points, poses = moving(4, 8)
    mirrored = points * [-1, 1, 1]
    rng = np.random.default_rng(9)
    lesson = lesson_of([(points, poses), (mirrored, motion(SHORT, rng))])
    assert [(len(one.points), one.count) for one in lesson.bodies] == [(4, 1), (4, 1)]
    errors = [
        min(np.abs(aligned_errors(one.points, each)).max() for one in lesson.bodies)
        for each in (points, mirrored)
    ]
    assert max(errors) < 0.15


def test_a_triangle_that_another_body_has_nearly_alike_is_no_copy() -> None:
    first, (points, poses) = moving(5, 3), moving(4, 8)
    points[:3] = first[0][:3] + np.array([[0.4, 0, 0], [0, -0.4, 0], [0, 0, 0.4]])
    lesson = lesson_of([first, (points, poses)])
    assert [(len(one.points), one.count) for one in lesson.bodies] == [(5, 1), (4, 1)]
    # 0.4 mm are within the error of a frame's triangulation, and mixed up would be 0.2 mm off
    assert np.abs(aligned_errors(lesson.bodies[0].points, first[0])).max() < 0.12


def test_bodies_that_move_together_for_half_of_the_time_are_two() -> None:
    first, (points, poses) = moving(6, 3), moving(4, 8)
    half = SHORT.frames // 2
    poses[:half] = first[1][:half] @ np.linalg.inv(first[1][half]) @ poses[half]
    lesson = lesson_of([first, (points, poses)])
    assert [(len(one.points), one.count) for one in lesson.bodies] == [(6, 1), (4, 1)]


def test_a_body_that_shows_four_of_nine_markers_for_a_while_is_one_body() -> None:
    scene, few = Scene(frames=52), [0, 4, 6, 3]
    points, poses = moving(9, 3, scene)
    frames = detections([(points, poses)], CAMERAS, scene, 1)
    frames[20:32] = detections([(points[few], poses)], CAMERAS, scene, 2)[20:32]
    seen = [SeenFrame(k, None, dict(enumerate(views)), {}) for k, views in enumerate(frames)]
    (found,) = learn_from(seen, EYES).bodies
    assert len(found.points) == 9
    # a marker is hidden from either camera in a tenth of frames: most of the 52 fix these four
    nearest = np.linalg.norm(aligned_errors(found.points, points), axis=1)
    assert nearest.max() < 0.2
    assert np.sort(found.frames)[-4:].min() > 32


def test_a_body_that_never_moves_is_refused_with_what_is_missing() -> None:
    points, poses = moving(5, 3)
    with pytest.raises(
        RecordingError, match=r"and 9 places that never move; .*turn it by 30 degrees"
    ):
        lesson_of([(points, np.repeat(poses[:1], SHORT.frames, axis=0))])


def test_points_that_keep_no_distances_are_refused_though_there_are_enough() -> None:
    rng = np.random.default_rng(3)
    scene = Scene(frames=12, hidden=0.0, still=0, false=0)
    with pytest.raises(RecordingError, match=r"3 points .*no three that keep their distances"):
        lesson_of([(np.zeros((1, 3)), motion(scene, rng)) for _ in range(3)], scene)


def test_a_body_that_is_only_shifted_is_learnt_and_turns_are_missed() -> None:
    points, poses = moving(5, 3)
    poses[:, :3, :3] = np.eye(3)
    (found,) = lesson_of([(points, poses)]).bodies
    assert len(found.points) == 5
    (doubt,) = doubts_of(found, "body.csv", "mm")
    assert "turned by 0." in doubt
    assert "missing: turns of 30 deg or more about each axis" in doubt


def test_a_recording_of_which_each_frame_is_of_one_camera_is_refused() -> None:
    views = detections([moving(5, 3)], CAMERAS, SHORT, 1)
    alone = [SeenFrame(k, None, {k % 2: one[k % 2]}, {}) for k, one in enumerate(views)]
    with pytest.raises(RecordingError, match="no frame in which two cameras see anything; a, b"):
        learn_from(alone, EYES)


def test_one_camera_is_refused_with_what_to_do_instead(tmp_path: Path) -> None:
    frames = detections([moving(5, 3)], CAMERAS[:1], SHORT, 1)
    session = load_scene(write_recording(tmp_path, frames, CAMERAS[:1]))
    with pytest.raises(SessionError, match=r"found 1 camera; .*mixpose calibrate --free body"):
        learn(session)


def test_the_command_writes_a_table_that_the_same_session_reads(tmp_path: Path) -> None:
    points, poses = moving(4, 5)
    path = write_recording(tmp_path, detections([(points, poses)], CAMERAS, SHORT, 1), CAMERAS)
    done = command("learn", path, "-o", "body.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "body.csv: 4 markers" in done.stdout
    assert "4 other points stood still" in done.stderr
    means = load_session(path).body.means
    assert np.abs(aligned_errors(means, points)).max() < 0.1
    table = (tmp_path / "body.csv").read_text(encoding="utf-8")
    assert table.startswith("name,x,y,z,deviation_x,deviation_y,deviation_z,frames\n1,")


def test_what_no_camera_saw_is_said_to_be_left_out(tmp_path: Path) -> None:
    frames = detections([moving(4, 5)], CAMERAS, SHORT, 1)
    path = write_recording(tmp_path, frames, CAMERAS)
    (tmp_path / "anchor.csv").write_text("frame,range\n0,900\n", encoding="utf-8")
    with path.open("a", encoding="utf-8") as session:
        session.write(
            '\n[[sensor]]\nname = "anchor"\nmodel = "lateration"\nsource = "anchor.csv"\n'
        )
        session.write("position = [0, 0, 900]\n")
    done = command("learn", path, "-o", "body.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    said = "anchor: bodies are learnt from cameras and clouds, and not from this"
    assert said in done.stderr


def test_a_table_of_somebody_else_is_not_overwritten(tmp_path: Path) -> None:
    path = write_recording(tmp_path, [[np.zeros((0, 2))] * 2], CAMERAS)
    (tmp_path / "body.csv").write_text("name,x,y,z\na,0,0,0\n", encoding="utf-8")
    done = command("learn", path, "-o", "body.csv", cwd=tmp_path)
    assert done.returncode == 2
    assert "holds something that mixpose did not write" in done.stderr


def test_a_board_before_web_cams_is_learnt_from_tables_without_identities(
    recordings: Path,
) -> None:
    (found,) = learn(load_scene(recordings / "webcams4_a" / "session_reference.toml")).bodies
    grid = np.array([[x, y, 0.0] for x in range(3) for y in range(4)]) * 0.054
    likeness = in_axes_of(found, grid, [])
    assert likeness is not None
    assert likeness.shared == len(found.points) == 12
    # cameras out of step by up to 20 ms, and a printed board
    assert likeness.max_distance < 1e-3
    assert np.linalg.norm(likeness.body.points - grid, axis=1).max() < 1e-3


@pytest.mark.parametrize("is_real", [False, True])
def test_a_body_that_may_map_onto_itself_has_no_shape_of_its_own_but_what_frames_tell(
    is_real: bool,
) -> None:
    """Turns of a square are chosen as noise suits them; a corner 3 mm off tells which it is."""
    square = np.array([[50.0, 50, 0], [-50, 50, 0], [-50, -50, 0], [50, -50, 0]])
    square[0, 0] += 3.0 * is_real
    scene = replace(SHORT, still=0, false=0)
    poses = motion(scene, np.random.default_rng(4))
    (found,) = lesson_of([(square, poses)], scene).bodies
    errors = aligned_errors(found.points, square)
    deviations = np.linalg.norm(found.deviations, axis=1)
    assert (np.linalg.norm(errors, axis=1) < 3 * deviations).all()
    sides = np.linalg.norm(found.points[:, None] - found.points, axis=2)
    uneven = np.ptp(np.sort(sides[np.triu_indices(4, 1)])[:4])
    # sides of a square that nobody tells from its turns are equal
    assert uneven == pytest.approx(3.0 * is_real, abs=0.1 if is_real else 0.02)
