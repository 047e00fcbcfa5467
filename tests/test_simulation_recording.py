"""Whole recordings: they play, their truth is true, and they come out the same every time."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.errors import SessionError
from mixpose.frames import SourceSpec, open_source
from mixpose.poses.jsonl import read_poses
from mixpose.records import GridPattern, Image, PointPattern, RawFrame
from mixpose.rigid import transform
from mixpose.session import SensorSetup, Session, load_session
from mixpose.simulation import SimulationOptions, simulate

HEAD = """
unit = "mm"
[object]
name = "body"
points = [[0, 0, 0], [90, 10, 0], [-40, 70, 20], [10, -60, 55]]
[start]
rotation_vector = [0.1, -0.2, 0.3]
translation = [5, -6, 700]
"""
CAMERA = """
[[sensor]]
name = "{name}"
model = "pinhole"
source = {source}
resolution = [160, 120]
camera_matrix = [[180, 0, 80], [0, 180, 60], [0, 0, 1]]
"""
RANGE = """
[[sensor]]
name = "{name}"
model = "lateration"
source = {source}
position = [-900, 100, 300]
range_bias = 3.0
"""
FEW = SimulationOptions(frames=4, seed=3)


def camera(name: str = "left", source: str = '"left*.png"', more: str = "") -> str:
    return CAMERA.format(name=name, source=source) + more


def ranges(source: str, more: str = "") -> str:
    return RANGE.format(name="far", source=f'"{source}"') + more


def session_of(folder: Path, *sensors: str, head: str = HEAD) -> Session:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "setup.toml"
    path.write_text(head + "".join(sensors), encoding="utf-8")
    return load_session(path)


def recorded(
    tmp_path: Path, *sensors: str, options: SimulationOptions = FEW, head: str = HEAD
) -> Session:
    """The session of a recording made from sensors; the original lies in another folder."""
    simulate(session_of(tmp_path / "plan", *sensors, head=head), tmp_path / "out", options)
    return load_session(tmp_path / "out" / "session.toml")


def frames_of(session: Session, setup: SensorSetup) -> list[RawFrame]:
    spec = SourceSpec(
        setup.name,
        setup.source,
        session.folder,
        "lateration" if setup.model == "lateration" else "camera",
        setup.resolution,
        setup.times,
        setup.fps,
        setup.range_min,
        setup.bin_size,
    )
    return list(open_source(spec).frames())


def truth_of(session: Session) -> dict[int, NDArray[np.float64]]:
    truth = read_poses(session.folder / "truth.jsonl")
    assert truth.unit == session.unit
    return {p.frame: p.T_world_object for p in truth.poses if p.T_world_object is not None}


def projected(session: Session, setup: SensorSetup, frame: int) -> NDArray[np.float64]:
    points = transform(truth_of(session)[frame], session.body.means)
    return setup.sensor.project(points)[0]


def brightness_at(image: Image | PointPattern | GridPattern, place: NDArray[np.float64]) -> int:
    assert isinstance(image, np.ndarray)
    u, v = np.rint(place).astype(int)
    return int(image[v, u])


def all_bytes(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.mark.parametrize("source", ["left*.png", "left", "left.avi", "left.mp4"])
def test_images_show_the_features_where_the_truth_says(tmp_path: Path, source: str) -> None:
    session = recorded(tmp_path, camera(source=f'"{source}"'))
    (setup,) = session.sensors
    frames = frames_of(session, setup)
    assert [frame.number for frame in frames] == [0, 1, 2, 3] == list(truth_of(session))
    for frame in frames:
        for place in projected(session, setup, frame.number):
            assert brightness_at(frame.data, place) > 80


def test_the_truth_has_times_and_says_what_it_belongs_to(tmp_path: Path) -> None:
    session = recorded(tmp_path, camera(more="fps = 50\n"))
    truth = read_poses(session.folder / "truth.jsonl")
    assert truth.header["session_sha256"] == session.sha256
    assert truth.header["simulation"]["seed"] == 3
    assert [pose.time_s for pose in truth.poses] == [0.0, 0.02, 0.04, 0.06]
    assert {pose.object for pose in truth.poses} == {"body"}
    times = [frame.time_s for frame in frames_of(session, session.sensors[0])]
    assert times == [0.0, 0.02, 0.04, 0.06]


def test_the_motion_begins_with_the_first_frame_whatever_its_number(tmp_path: Path) -> None:
    few = replace(FEW, frames=2)
    late = recorded(tmp_path / "late", camera(source='["b13.png", "a12.png"]'), options=few)
    early = recorded(tmp_path / "early", camera(), options=few)
    assert list(truth_of(late)) == [12, 13]
    for number, T in truth_of(early).items():
        np.testing.assert_array_equal(truth_of(late)[12 + number], T)


def test_a_table_of_times_is_written_for_a_sensor_that_names_one(tmp_path: Path) -> None:
    session = recorded(tmp_path, camera(more='times = "clock/times.csv"\n'))
    times = [frame.time_s for frame in frames_of(session, session.sensors[0])]
    assert times == [0.0, 0.04, 0.08, 0.12]


def test_detections_of_a_camera_lie_about_the_projections(tmp_path: Path) -> None:
    options = replace(FEW, pixel_noise=0.1, frames=50)
    session = recorded(tmp_path, camera(source='"left.csv"'), options=options)
    (setup,) = session.sensors
    away, orders = [], set()
    for frame in frames_of(session, setup):
        assert isinstance(frame.data, PointPattern)
        gaps = frame.data.points[:, None] - projected(session, setup, frame.number)
        order = np.linalg.norm(gaps, axis=2).argmin(axis=1)
        orders.add(tuple(order.tolist()))
        away.append(gaps[np.arange(4), order])
        assert frame.data.weights.tolist() == [1, 1, 1, 1]
    assert len(orders) > 10  # the order tells nothing
    assert np.std(away) == pytest.approx(0.1, rel=0.15)
    assert np.mean(away) == pytest.approx(0, abs=0.02)


def test_detections_of_a_range_sensor_scatter_by_its_sigma(tmp_path: Path) -> None:
    more = "[sensor.extract]\nsigma = 0.5\n"
    session = recorded(tmp_path, ranges("far.csv", more), options=replace(FEW, frames=50))
    (setup,) = session.sensors
    away = []
    for frame in frames_of(session, setup):
        assert isinstance(frame.data, PointPattern)
        true = np.sort(projected(session, setup, frame.number), axis=0)
        away.append(np.sort(frame.data.points, axis=0) - true)
    assert np.std(away) == pytest.approx(0.5, rel=0.2)


@pytest.mark.parametrize("name", ["far.npy", "far.csv"])
def test_profiles_peak_at_the_ranges_of_the_features(tmp_path: Path, name: str) -> None:
    more = "range_min = 500.0\nbin_size = 0.5\n"
    options = replace(FEW, range_snr=200.0, brightness_spread=0.0)
    session = recorded(tmp_path, ranges(name, more), options=options)
    (setup,) = session.sensors
    frames = frames_of(session, setup)
    assert len(frames) == 4
    for frame in frames:
        assert isinstance(frame.data, GridPattern)
        values = frame.data.values[0].astype(np.float64)
        # four peaks of height 1 and 1.5 bins; the noise adds 0.4 / 200 per bin
        floor = 0.4 / 200 * len(values)
        assert values.sum() == pytest.approx(4 * np.sqrt(2 * np.pi) * 1.5 + floor, rel=0.05)
        at = 500.0 + 0.5 * np.arange(len(values))
        true = projected(session, setup, frame.number)[:, 0]
        peaks = np.where(
            values > 0.05, values, 0.0
        )  # ten times the noise, and a percent of each peak
        assert (peaks * at).sum() / peaks.sum() == pytest.approx(true.mean(), abs=0.3)
        assert values[np.rint((true - 500.0) / 0.5).astype(int)].min() > 0.9


def test_a_frame_in_which_a_table_has_no_feature_still_exists(tmp_path: Path) -> None:
    options = replace(FEW, hidden=1.0)
    session = recorded(tmp_path, camera(source='"left.csv"'), options=options)
    frames = frames_of(session, session.sensors[0])
    assert [frame.number for frame in frames] == [0, 1, 2, 3]
    assert all(len(f.data.points) == 0 for f in frames if isinstance(f.data, PointPattern))


def test_dark_features_are_drawn_dark(tmp_path: Path) -> None:
    session = recorded(tmp_path, camera(more='[sensor.extract]\npolarity = "dark"\n'))
    (setup,) = session.sensors
    frame = frames_of(session, setup)[0]
    assert all(brightness_at(frame.data, y) < 180 for y in projected(session, setup, 0))
    assert isinstance(frame.data, np.ndarray)
    assert np.median(frame.data) == pytest.approx(245, abs=1)


def test_missing_frames_are_missing_in_one_sensor_only(tmp_path: Path) -> None:
    options = replace(FEW, frames=60, missing=0.3)
    sensors = (camera(), camera("right", '"right*.png"'), camera("film", '"film.avi"'))
    session = recorded(tmp_path, *sensors, options=options)
    left, right, film = ([f.number for f in frames_of(session, s)] for s in session.sensors)
    assert 30 < len(left) < 54
    assert 30 < len(right) < 54
    assert left != right
    assert film == list(range(60)) == list(truth_of(session))


def test_frames_that_all_sensors_miss_have_no_truth(tmp_path: Path) -> None:
    session = recorded(tmp_path, camera(), options=replace(FEW, frames=40, missing=0.4))
    numbers = [frame.number for frame in frames_of(session, session.sensors[0])]
    assert len(numbers) < 40
    assert list(truth_of(session)) == numbers


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    sensors = (
        camera(),
        camera("avi", '"a.avi"'),
        camera("mp4", '"b.mp4"'),
        camera("table", '"c.csv"'),
        ranges("far.npy", "range_min = 500.0\nbin_size = 2.0\n"),
    )
    session = session_of(tmp_path / "plan", *sensors)
    options = replace(FEW, clutter=1.5, hidden=0.2, missing=0.1)
    for name in ("one", "two"):
        simulate(session, tmp_path / name, options)
    simulate(session, tmp_path / "other", replace(options, seed=4))
    one, two, other = (all_bytes(tmp_path / name) for name in ("one", "two", "other"))
    assert one == two
    assert len(one) == 6 + sum(name.startswith("left") for name in one)
    unchanged = {name for name in one if one[name] == other.get(name)}
    assert unchanged == {"session.toml"}


def test_a_sensor_is_the_same_whatever_stands_beside_it(tmp_path: Path) -> None:
    alone = session_of(tmp_path / "a", camera())
    beside = session_of(tmp_path / "b", camera(), camera("right", '"right*.png"'))
    simulate(alone, tmp_path / "one", FEW)
    simulate(beside, tmp_path / "two", FEW)
    one, two = all_bytes(tmp_path / "one"), all_bytes(tmp_path / "two")
    assert all(one[f"left000{i}.png"] == two[f"left000{i}.png"] for i in range(4))


def test_files_that_the_session_names_come_along(tmp_path: Path) -> None:
    plan = tmp_path / "plan"
    (plan / "lab").mkdir(parents=True)
    (plan / "lab" / "markers.csv").write_text("name,x,y,z\na,0,0,0\nb,90,0,0\nc,0,50,10\n")
    (plan / "cam.yml").write_text(
        "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n"
        "  data: [180., 0., 80., 0., 180., 60., 0., 0., 1.]\nimage_width: 160\nimage_height: 120\n"
        "distortion_coefficients: !!opencv-matrix\n  rows: 1\n  cols: 4\n  dt: d\n"
        "  data: [0., 0., 0., 0.]\n"
    )
    head = 'unit = "mm"\n[object]\nname = "body"\nfile = "lab/markers.csv"\n'
    sensor = (
        '[[sensor]]\nname = "left"\nmodel = "pinhole"\nsource = "left*.png"\n'
        'calibration = "cam.yml"\n[sensor.extract]\nmethod = "own_method:find"\n'
    )
    (plan / "own_method.py").write_text("def find(image, options): ...\n")
    session = recorded(tmp_path, sensor, head=head)
    assert (session.folder / "session.toml").read_bytes() == (plan / "setup.toml").read_bytes()
    assert len(session.body) == 3
    assert (session.folder / "own_method.py").exists()
    assert len(frames_of(session, session.sensors[0])) == 4


def test_a_recording_is_not_overwritten_unless_asked_for(tmp_path: Path) -> None:
    session = session_of(tmp_path / "plan", camera())
    out = tmp_path / "out"
    simulate(session, out, replace(FEW, frames=6))
    before = all_bytes(out)
    with pytest.raises(SessionError, match="holds a recording already"):
        simulate(session, out, FEW)
    assert all_bytes(out) == before
    (out / "notes.txt").write_text("mine")
    simulate(session, out, FEW, overwrite=True)
    # frames of the longer recording would otherwise play on after the last one
    expected = {"session.toml", "truth.jsonl", "notes.txt", *(f"left000{i}.png" for i in range(4))}
    assert set(all_bytes(out)) == expected


def test_frames_that_lie_in_the_folder_are_not_mixed_with_new_ones(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "left77.png").write_bytes(b"mine")
    with pytest.raises(SessionError, match=r"holds a recording already \(left77.png\)"):
        recorded(tmp_path, camera())


def test_the_folder_of_the_session_itself_is_refused(tmp_path: Path) -> None:
    session = session_of(tmp_path, camera())
    with pytest.raises(SessionError, match="choose another"):
        simulate(session, tmp_path / "sub" / "..", FEW, overwrite=True)


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    session = session_of(tmp_path / "plan", camera())
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(SessionError, match="simulate: "):
            simulate(session, folder, FEW)


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        (camera(more='[sensor.extract]\nmethod = "corners"\n'), "simulate draws spots"),
        (camera(source='"left.webm"'), "'left': source: found 'left.webm'"),
        (camera().replace("resolution = [160, 120]\n", ""), "resolution: missing"),
        (camera(more="fps = 25\n") + camera("b", '"b*.png"', "fps = 50\n"), "the same for all"),
        (ranges("far.npy", "range_min = 5e5\nbin_size = 0.5\n"), "range_min: found 500000"),
    ],
    ids=["corners", "source", "resolution", "fps", "range_min"],
)
def test_what_cannot_be_simulated_is_said_before_anything_is_written(
    tmp_path: Path, sensors: str, message: str
) -> None:
    with pytest.raises(SessionError, match=message) as problem:
        recorded(tmp_path, sensors)
    assert "\n" not in str(problem.value)
    assert str(problem.value).startswith(f"{tmp_path / 'plan' / 'setup.toml'}: ")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "wrong",
    [
        *({"frames": 0}, {"noise": -1.0}, {"hidden": 1.5}, {"clutter": float("nan")}, {"seed": -1}),
        {"others": 1.5},
    ],
)
def test_options_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(SessionError, match=f"simulate: {next(iter(wrong))}: found .*; allowed: "):
        SimulationOptions(**{"frames": 3, **wrong})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "far",
    [
        {"amplitude_translation": 1e308},
        {"background": -1e300},
        {"fps": 1e-300},
        {"clutter": 1e9},
        {"others": 10**9},
        {"spot_sigma": 1e300},
    ],
)
def test_options_that_nothing_can_be_reckoned_with_are_refused(far: dict[str, float]) -> None:
    with pytest.raises(SessionError, match=f"simulate: {next(iter(far))}: found .*; allowed: "):
        SimulationOptions(**{"frames": 2, **far})  # type: ignore[arg-type]


def test_progress_counts_the_frames(tmp_path: Path) -> None:
    done: list[int] = []
    simulate(session_of(tmp_path / "plan", camera()), tmp_path / "out", FEW, progress=done.append)
    assert done == [1, 2, 3, 4]


def test_a_truth_line_is_plain_json(tmp_path: Path) -> None:
    session = recorded(tmp_path, camera())
    lines = (session.folder / "truth.jsonl").read_text(encoding="utf-8").splitlines()
    first, second = json.loads(lines[0]), json.loads(lines[1])
    assert {k: first[k] for k in ("type", "format", "version", "unit")} == {
        "type": "header",
        "format": "mixpose-poses",
        "version": 1,
        "unit": "mm",
    }
    assert list(second) == ["type", "frame", "time_s", "object", "status", "T_world_object"]
    assert (second["type"], second["status"]) == ("pose", "ok")
