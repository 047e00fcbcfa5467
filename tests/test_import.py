"""``mixpose import``: rigs of other programs, to the last bit, and what is odd about them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import calibration_texts as texts
import numpy as np
import pytest
from rounding import rounding

from mixpose.cli.importing import gather, session_text
from mixpose.errors import SessionError
from mixpose.records import Floats
from mixpose.rigid import from_parts, rotation_matrix
from mixpose.sensors import FisheyeCamera, PinholeCamera
from mixpose.session import Session, load_session
from mixpose.units import Unit

Writer = Callable[[Path], list[Path]]


def one(name: str, text: str) -> Writer:
    def write(folder: Path) -> list[Path]:
        (folder / name).write_text(text, encoding="utf-8")
        return [folder / name]

    return write


# files, unit of their lengths where they do not say, millimetres per unit of the writer, names
RIGS: dict[str, tuple[Writer, Unit | None, list[str]]] = {
    "kalibr": (one("chain.yaml", texts.kalibr()), None, ["cam0", "cam1"]),
    "kalibr as OpenVINS": (
        one("chain.yaml", texts.kalibr("%YAML:1.0\n\n", ("T_cam_imu", "T_cam_imu"))),
        None,
        ["cam0", "cam1"],
    ),
    "kalibr as OpenVINS, inverse": (
        one("c.yaml", texts.kalibr("%YAML:1.0 # type\n", ("T_imu_cam", "T_imu_cam"))),
        None,
        ["cam0", "cam1"],
    ),
    "opencv stereo yml": (
        lambda folder: texts.stereo_storage(folder, "yml"),
        "mm",
        ["camera1", "camera2"],
    ),
    "opencv stereo xml, other order": (
        lambda folder: texts.stereo_storage(folder, "xml")[::-1],
        "mm",
        ["camera1", "camera2"],
    ),
    "opencv stereo json": (
        lambda folder: texts.stereo_storage(folder, "json"),
        "mm",
        ["camera1", "camera2"],
    ),
    "MC-Calib": (one("c.yml", texts.mc_calib()), "cm", ["camera_0", "camera_1"]),
    "MC-Calib, header 1.2": (
        one("c.yml", texts.mc_calib("%YAML 1.2\n---\n")),
        "cm",
        ["camera_0", "camera_1"],
    ),
    "pycalib": (one("c.json", texts.pycalib()), "cm", ["cam1", "cam2"]),
    "caliscope": (one("camera_array.toml", texts.toml("cameras.")), None, ["cam0", "cam1"]),
    "caliscope, matrices": (
        one("camera_array.toml", texts.toml("cameras.", as_vector=False)),
        None,
        ["cam0", "cam1"],
    ),
    "aniposelib": (
        one("calibration.toml", texts.toml("cam_", scale=1000, names=True)),
        "mm",
        ["view0", "view1"],
    ),
    "colmap images": (
        lambda folder: texts.colmap(folder, with_rig=False),
        "m",
        ["view_0", "view_1"],
    ),
    "colmap rigs": (
        lambda folder: texts.colmap(folder, with_rig=True)[::-1],
        "m",
        ["camera1", "camera2"],
    ),
}


def imported(paths: list[Path], unit: Unit, lengths: Unit | None, output: Path) -> Session:
    output.write_text(session_text(gather(paths, unit, lengths), output), encoding="utf-8")
    return load_session(output)


def expect_rig(session: Session, millimetres: float) -> None:
    matrices: list[Floats] = [texts.K1, texts.K2]
    for setup, K, D in zip(session.sensors, matrices, (texts.D1, texts.D2), strict=True):
        assert isinstance(setup.sensor, PinholeCamera)
        np.testing.assert_array_equal(setup.sensor.camera_matrix, K)
        np.testing.assert_array_equal(setup.sensor.distortion, D)
    first, second = (setup.sensor for setup in session.sensors)
    assert isinstance(first, PinholeCamera)
    assert isinstance(second, PinholeCamera)
    np.testing.assert_allclose(first.T_sensor_world, np.eye(4), atol=rounding(1))
    # rounding of a product and a projection onto rotations
    expected = texts.T_second_first(1000 / millimetres)
    np.testing.assert_allclose(second.T_sensor_world, expected, rtol=0, atol=rounding(expected))


@pytest.mark.parametrize("unit", ["mm", "m"])
@pytest.mark.parametrize("name", RIGS)
def test_a_rig_comes_out_as_it_went_in(tmp_path: Path, name: str, unit: Unit) -> None:
    write, lengths, names = RIGS[name]
    session = imported(write(tmp_path), unit, lengths, tmp_path / "session.toml")
    assert [setup.name for setup in session.sensors] == names
    assert session.unit == unit
    expect_rig(session, {"mm": 1.0, "m": 1000.0}[unit])
    if "stereo" not in name and name != "pycalib":
        assert session.sensors[0].resolution == texts.SIZE


@pytest.mark.parametrize("name", [name for name in RIGS if "stereo" not in name])
def test_a_session_that_names_the_file_has_the_same_cameras(tmp_path: Path, name: str) -> None:
    write, lengths, names = RIGS[name]
    paths = write(tmp_path)
    file = next((path for path in paths if path.name == "cameras.txt"), paths[0]).name
    names = ["camera1", "camera2"] if "colmap" in name else names
    sensors = [
        f'[[sensor]]\nname = "s{each}"\nmodel = "pinhole"\n'
        f'calibration = {{ file = "{file}", camera = "{each}"'
        + (f', unit = "{lengths}" }}' if lengths else " }")
        for each in names
    ]
    path = tmp_path / "session.toml"
    path.write_text(
        'unit = "mm"\n[object]\nname = "o"\npoints = [[0,0,0],[1,0,0],[0,1,0]]\n'
        + "\n".join(sensors),
        encoding="utf-8",
    )
    session = load_session(path)
    if "colmap" in name:  # where its cameras stand is in the other files
        for setup in session.sensors:
            assert isinstance(setup.sensor, PinholeCamera)
            np.testing.assert_array_equal(setup.sensor.T_sensor_world, np.eye(4))
        return
    expect_rig(session, 1.0)


def test_a_chain_of_three_cameras_is_followed_from_link_to_link(tmp_path: Path) -> None:
    chain = texts.kalibr()
    chain += chain[chain.index("cam1:") :].replace("cam1:", "cam2:")
    session = imported(one("c.yaml", chain)(tmp_path), "m", None, tmp_path / "s.toml")
    third = session.sensors[2].sensor
    assert isinstance(third, PinholeCamera)
    step = texts.T_second_first()
    np.testing.assert_allclose(third.T_sensor_world, step @ step, atol=rounding(step))
    # a link of another kind, so that their order matters
    other = from_parts(rotation_matrix([0.3, 0.1, -0.2]), [0.1, 0.2, 0.0])
    head, _, tail = chain.rpartition("T_cn_cnm1:")
    rows = "".join(f"    - {row}\n" for row in other.tolist())
    chain = f"{head}T_cn_cnm1:\n{rows}{tail[tail.index('  camera_model') :]}"
    session = imported(one("c.yaml", chain)(tmp_path), "m", None, tmp_path / "s.toml")
    third = session.sensors[2].sensor
    assert isinstance(third, PinholeCamera)
    np.testing.assert_allclose(third.T_sensor_world, other @ step, atol=rounding(step))


def test_cameras_of_two_worlds_are_not_put_into_one(tmp_path: Path) -> None:
    for name in ("a.yaml", "b.yaml"):
        (tmp_path / name).write_text(texts.kalibr(), encoding="utf-8")
    with pytest.raises(SessionError, match=r"b\.yaml: its cameras stand in another world than"):
        gather([tmp_path / "a.yaml", tmp_path / "b.yaml"], "mm", None)


def test_a_pose_without_a_unit_is_asked_for(tmp_path: Path) -> None:
    (tmp_path / "c.json").write_text(texts.pycalib(), encoding="utf-8")
    (tmp_path / "session.toml").write_text(
        'unit = "mm"\n[object]\nname = "o"\npoints = [[0,0,0],[1,0,0],[0,1,0]]\n'
        '[[sensor]]\nname = "s"\nmodel = "pinhole"\n'
        'calibration = { file = "c.json", camera = "cam2" }\n',
        encoding="utf-8",
    )
    with pytest.raises(SessionError, match=r'calibration\.unit: c\.json says where .* unit = "mm"'):
        load_session(tmp_path / "session.toml")


def test_an_ini_file_of_ros(tmp_path: Path) -> None:
    session = imported(one("c.ini", texts.ROS_INI)(tmp_path), "mm", None, tmp_path / "s.toml")
    (setup,) = session.sensors
    assert (setup.name, setup.resolution) == ("left", texts.SIZE)
    assert isinstance(setup.sensor, PinholeCamera)
    np.testing.assert_array_equal(setup.sensor.camera_matrix, texts.K1)
    np.testing.assert_array_equal(setup.sensor.distortion, [*texts.D1, 0.0])


def test_fisheye_lenses_of_every_format_that_has_them(tmp_path: Path) -> None:
    chain = texts.kalibr().replace("radtan", "equidistant")
    storage = texts.mc_calib().replace("distortion_type: 0", "distortion_type: 1")
    tables = texts.toml("cameras.").replace("size =", "fisheye = true\nsize =")
    for k, text in enumerate((chain, storage, tables)):
        session = imported(one(f"c{k}.toml", text)(tmp_path), "m", "cm", tmp_path / f"s{k}.toml")
        for setup in session.sensors:
            assert isinstance(setup.sensor, FisheyeCamera)


@pytest.mark.parametrize(
    ("model", "parameters", "distortion"),
    [
        ("SIMPLE_PINHOLE", "800 640.5 512.5", []),
        ("PINHOLE", "800 810 640.5 512.5", []),
        ("SIMPLE_RADIAL", "800 640.5 512.5 -0.1", [-0.1, 0, 0, 0]),
        ("RADIAL", "800 640.5 512.5 -0.1 0.02", [-0.1, 0.02, 0, 0]),
        ("FULL_OPENCV", "800 810 640.5 512.5 1 2 3 4 5 6 7 8", [1, 2, 3, 4, 5, 6, 7, 8]),
        ("OPENCV_FISHEYE", "800 810 640.5 512.5 0.1 0.2 0.3 0.4", [0.1, 0.2, 0.3, 0.4]),
        ("SIMPLE_RADIAL_FISHEYE", "800 640.5 512.5 0.1", [0.1, 0, 0, 0]),
    ],
)
def test_lenses_of_colmap_and_its_corner_of_pixels(
    tmp_path: Path, model: str, parameters: str, distortion: list[float]
) -> None:
    write = one("cameras.txt", f"# Camera list\n7 {model} 1280 1024 {parameters}\n")
    (camera,) = gather(write(tmp_path), "mm", None).cameras
    assert camera.name == "camera7"
    np.testing.assert_array_equal(camera.intrinsics.camera_matrix[:2, 2], [640, 512])
    assert camera.intrinsics.camera_matrix[0, 0] == 800
    np.testing.assert_array_equal(camera.intrinsics.distortion, distortion)
    assert camera.intrinsics.model == ("fisheye" if "FISHEYE" in model else "pinhole")


COLMAP_LINE = "1 PINHOLE 640 480 1 1 3 2\n"
WRONG = {
    "kalibr model": (texts.kalibr().replace("model: pinhole", "model: omni"), '"omni"'),
    "kalibr lens": (texts.kalibr().replace("radtan", "fov"), 'cam0.distortion_model: found "fov"'),
    "kalibr chain": (
        texts.kalibr().replace("- [0.0, 0.0, 0.0, 1.0]", "- [0, 1]"),
        "cam1.T_cn_cnm1",
    ),
    "kalibr scaled": (
        texts.kalibr().replace("- [0.0, 0.0, 0.0, 1.0]", "- [0, 0, 0, 2]"),
        "found no rigid motion: its last row",
    ),
    "opencv": (texts.mc_calib().replace("rows: 3", "rows: 2"), "camera_0.camera_matrix: found a"),
    "opencv pose": (
        texts.mc_calib().replace("camera_pose_matrix", "camera_pose_matrix ").replace("1.0]", "9]"),
        "camera_0",
    ),
    "opencv cut": (texts.mc_calib()[:400], "OpenCV cannot parse"),
    "pycalib": (texts.pycalib().replace('"d"', '"dist"'), "d: missing"),
    "pycalib rotation": (
        texts.pycalib().replace("[[1.0, 0.0, 0.0]", "[[1.5, 0.0, 0.0]"),
        "no rigid motion",
    ),
    "ini": (texts.ROS_INI.replace("810.500000", "f"), "camera matrix: found"),
    "ini size": (texts.ROS_INI.replace("1280", "12.5"), "[image]: found [12.5, 1024]"),
    "ini endless": (texts.ROS_INI.replace("1280", "inf"), "[image]: found [inf, 1024]"),
    "ini no number": (texts.ROS_INI.replace("1280", "nan"), "[image]: found [nan, 1024]"),
    "caliscope": (texts.toml("cameras.").replace("1280", '"wide"', 1), "cameras.0.size: found"),
    "aniposelib": (texts.toml("cam_").replace("-0.11, ", "", 1), "cam_0.distortions: found 3"),
    "aniposelib rotation": (
        texts.toml("cam_").replace("rotation = [", "rotation = [1.0, ", 1),
        "cam_0.rotation: found",
    ),
    "colmap model": ("1 FOV 640 480 1 1 320 240 0.1\n", "camera.1: found"),
    "colmap parameters": (
        "1 OPENCV 640 480 1 1 320 240\n",
        "found 4 parameters of OPENCV; allowed: 8",
    ),
    "colmap number": ("1 PINHOLE 640 480 1 x 320 240\n", 'found "x"; allowed: a finite number'),
    "colmap size": (
        "1 PINHOLE 640 480 1 1 3 2\n2 PINHOLE x 480 1 1 3 2\n",
        'found "x"; allowed: an in',
    ),
    "colmap cut": (
        "1 PINHOLE 640 480 1 1 3 2\n2 PINHOLE\n",
        'found "2 PINHOLE"; allowed: CAMERA_ID',
    ),
    "colmap alone": ("1 1 0 0 0 0 0 0 1 a.png\n\n", "cameras.txt is missing"),
    "unknown": ("hello: world\n", "found hello; allowed: Kalibr"),
    "binary": ("\x00\x01", "not YAML"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_file_of_each_format_is_told_in_one_line(tmp_path: Path, name: str) -> None:
    text, words = WRONG[name]
    (tmp_path / "wrong.cal").write_text(text, encoding="utf-8")
    with pytest.raises(SessionError) as caught:
        gather([tmp_path / "wrong.cal"], "mm", "mm")
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert "wrong.cal: " in message
    assert words in message


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.toml", texts.toml("cameras.")[:200], "a.toml: not TOML: "),
        ("a.json", texts.pycalib()[:200], "a.json: not JSON: "),
        ("images.txt", "1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0\n", "images.txt: found '2 1 0'; allowed"),
    ],
)
def test_a_file_that_was_cut_off_is_told_as_what_it_is(
    tmp_path: Path, name: str, text: str, words: str
) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n", encoding="utf-8")
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(SessionError) as caught:
        gather([tmp_path / "cameras.txt", tmp_path / name], "mm", "mm")
    assert words in str(caught.value)


POSE = "1 0 0 0 0 0 0"


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"more.txt": COLMAP_LINE}, "found 2 files of COLMAP cameras; allowed: those of one model"),
        (
            {"images.txt": f"1 {POSE} 7 a.png\n\n"},
            "cameras.txt, which a was taken by",
        ),
        (
            {"images.txt": "1 1 0 0 0 0 0 x 1 a.png\n\n"},
            'image.1: found "x"; allowed: a finite number',
        ),
        (
            {"images.txt": "1 2 0 0 0 0 0 0 1 a.png\n\n"},
            "image.1: found a quaternion of length 2; allowed: 1",
        ),
        (
            {"images.txt": "".join(f"{k} {POSE} 1 {k}.png\n\n" for k in range(101))},
            "found 101 images; allowed: at most 100, one of each camera",
        ),
        (
            {"rigs.txt": 2 * f"1 2 CAMERA 1 CAMERA 2 1 {POSE}\n"},
            "found 2 rigs of several sensors; allowed: one",
        ),
        (
            {"rigs.txt": "1 2 CAMERA 1 CAMERA 2 1 1 0 0 0\n"},
            'found "1 0 0 0"; allowed: QW QX QY QZ TX TY TZ',
        ),
    ],
)
def test_files_of_a_colmap_model_that_do_not_go_together_are_told(
    tmp_path: Path, files: dict[str, str], words: str
) -> None:
    files = {"cameras.txt": COLMAP_LINE} | files
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(SessionError) as caught:
        gather([tmp_path / name for name in files], "mm", "mm")
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert words in message


def test_several_bodies_are_imported_with_a_name_each(tmp_path: Path) -> None:
    (tmp_path / "chain.yaml").write_text(texts.kalibr(), encoding="utf-8")
    for folder, x in (("a", 5), ("b", 7)):
        (tmp_path / folder).mkdir()
        table = f"name,x,y,z\np,0,0,0\nq,{x},0,0\nr,0,9,0\n"
        (tmp_path / folder / "marks.csv").write_text(table, encoding="utf-8")
    paths = [tmp_path / "chain.yaml", tmp_path / "a" / "marks.csv", tmp_path / "b" / "marks.csv"]
    session = imported(paths, "mm", None, tmp_path / "s.toml")
    assert [one.body.name for one in session.objects] == ["marks", "marks_2"]
    assert [one.body.means[1, 0] for one in session.objects] == [5, 7]


def test_every_real_calibration_file_is_read_or_refused_in_one_line(
    recordings: Path, tmp_path: Path
) -> None:
    root = recordings / "calibration_files"
    counts: dict[str, int] = {}
    for path in sorted(root.rglob("*")):
        if path.is_dir() or path.name == "README.md":
            continue
        try:
            session = imported([path], "mm", "mm", tmp_path / f"{path.stem}.toml")
        except SessionError as error:
            counts[path.name] = -len(str(error).splitlines())
        else:
            counts[path.name] = len(session.sensors)
    assert counts == {
        "sleap_anipose_duplicate_camera.toml": 4,
        "rotation_matrix.toml": 4,
        "rotation_vector_10cams.toml": 11,
        "cameras.txt": 1,
        "cameras_2_opencv_models.txt": 2,
        "images.txt": -1,  # a line: it says nothing about lenses
        "euroc_mav.yaml": 2,
        "kaist_vio.yaml": 2,
        "rs_d455.yaml": 1,
        "tum_vi.yaml": 2,
        "miluv_ifo001.yaml": 2,
        "miluv_ifo002.yaml": 2,
        "miluv_ifo003.yaml": 2,
        "mc_calib_2cams_from_readme.yml": 2,
        "pycalib_15cams.json": 15,
        "calib5.ini": 1,
        "calib8.ini": 1,
        "camera_info_manager_test.yaml": 1,
    }


def test_baselines_of_real_rigs(recordings: Path, tmp_path: Path) -> None:
    """Euclid's distance of the makers' stereo cameras: 11 cm of EuRoC, 5 cm of RealSense."""
    root = recordings / "calibration_files" / "kalibr"
    for name, expected in {"euroc_mav": 110, "kaist_vio": 50, "miluv_ifo001": 50}.items():
        session = imported([root / f"{name}.yaml"], "mm", None, tmp_path / f"{name}.toml")
        second = session.sensors[1].sensor
        assert isinstance(second, PinholeCamera)
        baseline = float(np.linalg.norm(second.T_sensor_world[:3, 3]))
        assert baseline == pytest.approx(expected, rel=0.01)  # as their data sheets round


def test_a_copied_camera_in_a_real_file_is_noticed(recordings: Path) -> None:
    path = recordings / "calibration_files" / "aniposelib" / "sleap_anipose_duplicate_camera.toml"
    warnings = gather([path], "mm", "mm").warnings
    assert any(warning.startswith("side and top are the same camera") for warning in warnings)


def test_a_real_rig_agrees_with_a_session_that_was_made_by_hand(
    recordings: Path, tmp_path: Path
) -> None:
    """The four web cams, whose extrinsics were copied from caliscope's file."""
    folder = recordings / "webcams4_a"
    path = folder / "caliscope" / "camera_array.toml"
    session = imported([path], "m", None, tmp_path / "s.toml")
    by_hand = load_session(folder / "session_as_found.toml")
    for ours, theirs in zip(session.sensors, by_hand.sensors, strict=True):
        assert isinstance(ours.sensor, PinholeCamera)
        assert isinstance(theirs.sensor, PinholeCamera)
        # ten digits were written down
        np.testing.assert_allclose(
            ours.sensor.T_sensor_world, theirs.sensor.T_sensor_world, atol=1e-9
        )
