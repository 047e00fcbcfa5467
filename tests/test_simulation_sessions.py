"""From a session file to a plan: where the body is, and which files the recording has."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mixpose.errors import SessionError
from mixpose.frames.images import frame_numbers
from mixpose.rigid import rotation_matrix, transform
from mixpose.session import Session, load_session
from mixpose.simulation import SimulationOptions, simulate
from mixpose.simulation.central_pose import central_pose, count_seen, pivot_of
from mixpose.simulation.naming import plan_files
from mixpose.simulation.session_copy import copy_session

OBJECT = """
unit = "mm"
[object]
name = "body"
points = [[0, 0, 0], [90, 10, 0], [-40, 70, 20], [10, -60, 55]]
"""
CAMERA = """
[[sensor]]
name = "{name}"
model = "pinhole"
source = {source}
resolution = [640, 480]
camera_matrix = [[700, 0, 320], [0, 700, 240], [0, 0, 1]]
"""
RANGE = """
[[sensor]]
name = "{name}"
model = "lateration"
source = {source}
position = {position}
"""


def camera(name: str = "left", source: str = '"left*.png"', **keys: object) -> str:
    extra = "".join(f"{key} = {value}\n" for key, value in keys.items())
    return CAMERA.format(name=name, source=source) + extra


def session_of(folder: Path, *sensors: str, before: str = "") -> Session:
    path = folder / "session.toml"
    path.write_text(OBJECT + before + "".join(sensors), encoding="utf-8")
    return load_session(path)


def names(folder: Path, source: str, frames: int = 3, *others: str) -> list[str]:
    session = session_of(folder, camera(source=source), *others)
    numbers, files = plan_files([(s, s.source) for s in session.sensors], frames)
    return [files[0].name(number) for number in numbers]


# where the body is


def test_a_start_pose_is_the_central_pose(tmp_path: Path) -> None:
    start = "[start]\nrotation_vector = [0.1, 0.2, 0.3]\ntranslation = [5, 6, 700]\n"
    session = session_of(tmp_path, camera(), before=start)
    assert session.start is not None
    assert np.array_equal(central_pose(session, 0), session.start.T_world_object)


def test_a_start_pose_that_no_sensor_sees_is_refused(tmp_path: Path) -> None:
    start = "[start]\nrotation_vector = [0, 0, 0]\ntranslation = [5, 6, -700]\n"
    with pytest.raises(SessionError, match="start: no sensor sees"):
        central_pose(session_of(tmp_path, camera(), before=start), 0)


CLOUD = """
[[sensor]]
name = "depth"
model = "cloud"
source = "points.csv"
"""


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        (CLOUD, "object: found 2 bodies before range sensors or clouds; simulate draws"),
        (camera(), "object 'wall': found no place apart from the other bodies in view"),
    ],
)
def test_bodies_that_cannot_be_drawn_together_are_refused_with_the_file_named_once(
    sensor: str, words: str, tmp_path: Path
) -> None:
    wall = f"""
[[object]]
name = "wall"
points = {[[9e4 * k, 9e4 * (k % 2), 0] for k in range(-3, 4)]}
"""
    text = OBJECT.replace("[object]", "[[object]]") + wall + sensor
    path = tmp_path / "session.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SessionError) as caught:
        simulate(load_session(path), tmp_path / "out", SimulationOptions(frames=1))
    assert str(caught.value).startswith(f"{path}: {words}")


def test_before_one_camera_the_body_fills_half_of_the_smaller_side(tmp_path: Path) -> None:
    session = session_of(tmp_path, camera())
    place = transform(central_pose(session, 0), pivot_of(session.body)[None])[0]
    assert 2 * session.body.radius * 700 / place[2] == pytest.approx(240)
    # the middle of the image, which is half a pixel from the principal point
    assert session.sensors[0].sensor.project(place)[0] == pytest.approx([319.5, 239.5])


def test_several_cameras_look_at_the_body_together(tmp_path: Path) -> None:
    target = np.array([200.0, -100.0, 50.0])
    sensors = []
    for name, vector in (("a", [0.1, 0.0, 0.0]), ("b", [0.0, 1.5, 0.2])):
        R = rotation_matrix(vector)
        sight = np.array([319.5 - 320, 239.5 - 240, 700]) / 700 * 600
        shift = [round(float(x), 9) for x in sight - R @ target]
        sensors.append(camera(name, f'"{name}*.png"', rotation_vector=vector, translation=shift))
    session = session_of(tmp_path, *sensors)
    place = transform(central_pose(session, 0), pivot_of(session.body)[None])[0]
    np.testing.assert_allclose(place, target, atol=1e-6)
    assert count_seen(session, central_pose(session, 0)) == 8


def test_parallel_beams_meet_in_the_middle_of_their_images() -> None:
    path = Path(__file__).parents[1] / "data" / "synthetic" / "parallel_beams" / "session.toml"
    session = replace(load_session(path), start=None)
    place = transform(central_pose(session, 0), pivot_of(session.body)[None])
    for setup in session.sensors:
        assert setup.sensor.project(place)[0][0] == pytest.approx([199.5, 159.5])  # of 400 x 320


def test_cameras_side_by_side_have_the_body_before_them(tmp_path: Path) -> None:
    shift = {"rotation_vector": [0, 0, 0], "translation": [-60, 0, 0]}
    session = session_of(tmp_path, camera(), camera("right", '"right*.png"', **shift))
    assert count_seen(session, central_pose(session, 0)) == 8


def test_range_sensors_have_the_body_beside_their_plane(tmp_path: Path) -> None:
    positions = ([0, -1000, 0], [1000, 0, 0], [0, 0, 1000])
    sensors = [
        RANGE.format(name=f"r{i}", source=f'"r{i}.csv"', position=p)
        for i, p in enumerate(positions)
    ]
    session = session_of(tmp_path, *sensors)
    place = transform(central_pose(session, 0), pivot_of(session.body)[None])[0]
    normal = np.array([1, -1, 1]) / np.sqrt(3)
    assert abs(float((place - [1000, 0, 0]) @ normal)) == pytest.approx(
        max(np.sqrt(2 / 3) * 1000 / 2, 5 * session.body.radius)
    )


def test_averted_features_turn_to_the_camera(tmp_path: Path) -> None:
    session = session_of(tmp_path, camera())
    path = session.path
    normals = "normals = [[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0.2, 1]]\n"
    path.write_text(OBJECT + normals + camera(), encoding="utf-8")
    session = load_session(path)
    assert count_seen(session, central_pose(session, 0)) == 4


# which files there are


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("left*.png", "left0001.png"),
        ("left_*.jpg", "left_0001.jpg"),
        ("cam2*.png", "cam2_0001.png"),
        ("cam2-????.png", "cam2-0001.png"),
        ("cam2????.png", "cam2_001.png"),
        ("left[0-9][0-9].bmp", "left01.bmp"),
        ("*_left.png", "0001_left.png"),
        ("frames/*_a.png", "frames/0001_a.png"),
        ("**/left*.tif", "left0001.tif"),
        ("left*", "left0001.png"),
        ("left*.*", "left0001.png"),
        ("run*/left*.png", "run/left0001.png"),
        ("frames", "frames/0001.png"),
        ("frames/left/", "frames/left/0001.png"),
        ("left.avi", "left.avi"),
        ("left*.mp4", "left.mp4"),
        ("left.csv", "left.csv"),
    ],
)
def test_names_are_those_that_the_source_would_read(
    tmp_path: Path, source: str, expected: str
) -> None:
    found = names(tmp_path, f'"{source}"')
    assert found[1] == expected
    if expected.endswith((".png", ".jpg", ".bmp", ".tif")):
        assert frame_numbers([Path(name) for name in found]) == [0, 1, 2]


def test_a_list_gives_names_and_numbers_to_all_sensors(tmp_path: Path) -> None:
    other = camera("right", '"right*.png"')
    session = session_of(tmp_path, camera(source='["b12.png", "a7.png"]'), other)
    numbers, files = plan_files([(s, s.source) for s in session.sensors], 2)
    assert list(numbers) == [7, 12]
    assert [files[0].name(n) for n in numbers] == ["a7.png", "b12.png"]
    assert [files[1].name(n) for n in numbers] == ["right0007.png", "right0012.png"]


def test_more_frames_than_digits_get_more_digits(tmp_path: Path) -> None:
    assert names(tmp_path, '"left*.png"', 20001)[-1] == "left20000.png"


@pytest.mark.parametrize(
    ("source", "frames", "message"),
    [
        ('["a.png", "b.png"]', 3, "names 2 images; allowed: one per frame"),
        ('"a.png"', 3, "names 1 image; allowed"),
        ('["a.png", "a.png"]', 2, "names an image twice"),
        ('"left??.png"', 101, "no room for the numbers of 101 frames"),
        ('"*_cam2.png"', 1, "no room for the numbers of 1 frames"),
        ('"left*.exr"', 3, "simulate writes .png"),
        ('"left.mkv"', 3, "simulate writes images, .avi, .mp4 and .csv"),
        ('"rtsp://camera/1"', 3, "simulate writes images, .avi, .mp4 and .csv"),
        ("0", 3, "found 'camera:0'; simulate writes images, .avi, .mp4 and .csv"),
        ('"camera:0"', 3, "simulate writes images, .avi, .mp4 and .csv"),
        ('"left.npy"', 3, "simulate writes images, .avi, .mp4 and .csv"),
    ],
)
def test_sources_that_cannot_be_written_are_refused(
    tmp_path: Path, source: str, frames: int, message: str
) -> None:
    with pytest.raises(SessionError, match="sensor 'left': source") as problem:
        names(tmp_path, source, frames)
    assert message in str(problem.value)
    assert "\n" not in str(problem.value)


def test_odd_sizes_are_refused_in_mp4_which_would_cut_them(tmp_path: Path) -> None:
    text = camera(source='"left.mp4"').replace("640, 480", "641, 480")
    session = session_of(tmp_path, text)
    with pytest.raises(SessionError, match="needs an even width and height"):
        plan_files([(s, s.source) for s in session.sensors], 2)


def test_a_planned_sensor_without_a_source_is_refused(tmp_path: Path) -> None:
    text = camera().replace('source = "left*.png"\n', "")
    session = session_of(tmp_path, text)
    with pytest.raises(SessionError, match="source: missing"):
        plan_files([(s, s.source) for s in session.sensors], 2)


def test_sensors_that_would_read_each_others_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=r"would also read cam_b0000.png of sensor 'right'"):
        names(tmp_path, '"cam*.png"', 3, camera("right", '"cam_b*.png"'))
    with pytest.raises(SessionError, match="would also read"):
        names(tmp_path, '"frames"', 3, camera("right", '"frames/"'))


def test_lists_with_different_numbers_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="other frame numbers than that of 'left'"):
        names(tmp_path, '["a1.png", "a2.png"]', 2, camera("right", '["b1.png", "b3.png"]'))


def test_a_video_beside_a_list_that_does_not_count_from_0_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="'right': source: counts frames from 0"):
        names(tmp_path, '["a1.png", "a2.png"]', 2, camera("right", '"right.avi"'))


@pytest.mark.parametrize(
    ("source", "bins", "message"),
    [
        ('"r*.png"', "", "allowed for ranges"),
        ('["r0.npy", "r1.npy"]', "", "allowed for ranges"),
        ('"r.npy"', "", "bin_size: missing"),
    ],
)
def test_range_sources_that_cannot_be_written_are_refused(
    tmp_path: Path, source: str, bins: str, message: str
) -> None:
    text = RANGE.format(name="r", source=source, position=[0, 0, 0]) + bins
    session = session_of(tmp_path, text)
    with pytest.raises(SessionError, match=message):
        plan_files([(s, s.source) for s in session.sensors], 2)


# what is taken over from the session


def test_a_session_inside_its_folder_is_copied_byte_for_byte(tmp_path: Path) -> None:
    session = session_of(tmp_path, "# a note\r\n", camera())
    assert copy_session(session).content == session.path.read_bytes()


def test_paths_that_lead_out_move_in_and_nothing_else_changes(tmp_path: Path) -> None:
    inner = tmp_path / "inner"
    inner.mkdir()
    (tmp_path / "markers.csv").write_text("name,x,y,z\na,0,0,0\nb,9,0,0\nc,0,5,1\n")
    text = (
        'unit = "mm"\n[object]\nname = "b"  # ../markers.csv\nfile = \'../markers.csv\'\n'
        + camera(source=f'"{tmp_path}/cam/left*.png"')
        + camera("right", '["../r0.png", "../r1.png"]')
    )
    path = inner / "session.toml"
    path.write_text(text, encoding="utf-8")
    copied = copy_session(load_session(path))
    assert copied.sources == ("left/left*.png", ("right/r0.png", "right/r1.png"))
    assert [(origin.resolve(), name) for origin, name in copied.files] == [
        (tmp_path.resolve() / "markers.csv", "object/markers.csv")
    ]
    expected = (
        text.replace("'../markers.csv'", '"object/markers.csv"')
        .replace(f"{tmp_path}/cam/left*.png", "left/left*.png")
        .replace("../r", "right/r")
    )
    assert copied.content.decode() == expected


def test_a_path_is_changed_and_a_name_that_reads_alike_is_not(tmp_path: Path) -> None:
    text = camera("right", '"../r*.png"') + '[sensor.extract]\nmethod = "blobs"\n'
    path = tmp_path / "session.toml"
    path.write_text(OBJECT.replace('"body"', '"../r*.png"') + text, encoding="utf-8")
    copied = copy_session(load_session(path)).content.decode()
    assert copied == OBJECT.replace('"body"', '"../r*.png"') + text.replace("../r*", "right/r*")
