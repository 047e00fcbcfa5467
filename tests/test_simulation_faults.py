"""Faults of real rigs in simulated recordings, each against what it should be."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import command
from numpy.typing import NDArray

from mixpose.errors import SessionError
from mixpose.extraction import ExtractOptions, extract
from mixpose.frames import read_image
from mixpose.records import Image, PointPattern
from mixpose.session import load_session
from mixpose.simulation import SimulationOptions, simulate
from mixpose.simulation.recording import TRUTH_NAME
from mixpose.simulation.visible_spots import centroid, coverage, outline

Floats = NDArray[np.float64]

SESSION = """
unit = "mm"
[object]
name = "body"
points = [[0, 0, 0], [90, 10, 0], [-40, 70, 20], [10, -60, 55]]
{object}
[start]
rotation_vector = [0.1, -0.2, 0.3]
translation = [5, -6, 700]
"""
CAMERA = """
[[sensor]]
name = "{name}"
model = "pinhole"
source = "{source}"
fps = 25
resolution = [320, 240]
camera_matrix = [[300, 0, 160], [0, 300, 120], [0, 0, 1]]
distortion = [-0.1, 0.02, 0, 0]
{more}
"""
LEFT = CAMERA.format(name="left", source="left*.png", more="")
TABLE = CAMERA.format(name="left", source="left.csv", more="{more}")
STILL = {"amplitude_translation": 0.0, "amplitude_rotation_deg": 0.0}
QUIET = {"noise": 0.0, "shot_noise": 0.0, "brightness_spread": 0.0, "pixel_noise": 0.0}


def write(folder: Path, *sensors: str, body: str = "") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "setup.toml"
    path.write_text(SESSION.format(object=body) + "".join(sensors), encoding="utf-8")
    return path


def made(folder: Path, session: Path, **options: object) -> Path:
    settings = SimulationOptions(**{"frames": 3, "seed": 4, **options})  # type: ignore[arg-type]
    simulate(load_session(session), folder, settings)
    return folder


def detections(folder: Path, name: str = "left.csv") -> dict[int, Floats]:
    """Rows u, v by frame."""
    frames: dict[int, list[list[float]]] = {}
    with (folder / name).open(encoding="ascii") as file:
        for row in csv.DictReader(file):
            if float(row["weight"]):
                frames.setdefault(int(row["frame"]), []).append([float(row["u"]), float(row["v"])])
    return {number: np.array(rows) for number, rows in frames.items()}


def truth(folder: Path) -> list[dict[str, object]]:
    lines = (folder / TRUTH_NAME).read_text(encoding="ascii").splitlines()
    return [json.loads(line) for line in lines[1:]]


def blobs(image: Image) -> Floats:
    pattern = extract(image, ExtractOptions(method="blobs"))
    assert isinstance(pattern, PointPattern)
    return pattern.points


def near(points: Floats, places: Floats) -> Floats:
    """Distance of each place to the nearest point."""
    return np.asarray(np.linalg.norm(points - places[:, None], axis=2).min(axis=1))


def test_a_late_sensor_sees_the_body_of_later(tmp_path: Path) -> None:
    # one frame later at 25 frames per second
    session = write(tmp_path / "s", TABLE.format(more=""))
    plain = made(tmp_path / "plain", session, frames=4, **QUIET)
    late = made(tmp_path / "late", session, frames=4, delay={"left": 0.04}, **QUIET)
    told = write(tmp_path / "t", TABLE.format(more="delay = 0.04"))
    stated = made(tmp_path / "stated", told, frames=4, **QUIET)
    for number in range(3):
        moved = near(detections(plain)[number + 1], detections(plain)[number])
        assert moved.max() > 0.5
        for other in (late, stated):
            # nine digits are written
            assert near(detections(plain)[number + 1], detections(other)[number]).max() < 1e-5


def test_a_rolling_shutter_reads_each_row_at_its_time(tmp_path: Path) -> None:
    session = write(tmp_path / "s", TABLE.format(more="readout = 0.03"))
    rolling = detections(made(tmp_path / "rolling", session, **QUIET))
    plain = write(tmp_path / "p", TABLE.format(more=""))
    for number, seen in rolling.items():
        for u, v in seen:
            # the same row, were all of the image read when this row is
            moment = 0.03 * (v / 239 - 0.5)
            folder = tmp_path / f"{number}_{v:.6f}"
            same = made(folder, plain, delay={"left": moment}, **QUIET)
            assert near(detections(same)[number], np.array([[u, v]])).max() < 1e-4


def test_an_exposure_draws_streaks_about_the_same_middle(tmp_path: Path) -> None:
    session = write(tmp_path / "s", LEFT)
    fast = {"amplitude_translation": 60.0, "period_s": 1.0, **QUIET}
    sharp = read_image(made(tmp_path / "a", session, **fast) / "left0000.png").astype(np.float64)
    blurred = read_image(
        made(tmp_path / "b", session, exposure=0.03, **fast) / "left0000.png"
    ).astype(np.float64)
    assert blurred.max() < 0.9 * sharp.max()
    v, u = np.indices(sharp.shape)
    middles = []
    for image in (sharp, blurred):
        light = np.maximum(image - 10, 0)
        middles.append([(light * u).sum() / light.sum(), (light * v).sum() / light.sum()])
    # grey levels are whole, and the motion is curved a little
    np.testing.assert_allclose(middles[0], middles[1], atol=0.15)


@pytest.mark.parametrize("shape", ["sphere", "disk"])
def test_a_marker_with_a_size_is_as_bright_and_as_wide_as_its_outline(
    tmp_path: Path, shape: str
) -> None:
    normals = "normals = [[0,0,-1],[0.4,0,-1],[0,-0.5,-1],[0.2,0.2,-1]]"
    body = f'shape = "{shape}"\nradius = 9\n{normals if shape == "disk" else ""}'
    path = write(tmp_path / "s", LEFT, body=body)
    folder = made(tmp_path / "out", path, frames=1, **STILL, **QUIET)
    image = read_image(folder / "left0000.png").astype(np.float64) - 10
    session = load_session(path)
    T = np.array(truth(folder)[0]["T_world_object"])
    for k in range(4):
        edge = outline(session.sensors[0].sensor, session.body, k, T)
        assert edge is not None
        (u0, v0), (u1, v1) = np.floor(edge.min(axis=0) - 4), np.ceil(edge.max(axis=0) + 5)
        patch = image[int(v0) : int(v1), int(u0) : int(u1)]
        v, u = np.indices(patch.shape)
        found = np.array([(patch * u).sum(), (patch * v).sum()]) / patch.sum() + (u0, v0)
        # whole grey levels at the rim
        np.testing.assert_allclose(found, centroid(edge), atol=0.02)
        area = cv2.contourArea(edge.astype(np.float32))
        assert patch.sum() == pytest.approx(170 * area, rel=0.01)


def test_pixels_are_covered_by_as_much_as_a_polygon_has_area() -> None:
    corners = np.array([[10.2, 4.1], [18.7, 6.3], [16.4, 15.2], [9.1, 11.8]])
    rows, columns, shares = coverage(corners, (30, 40))
    v, u = np.indices((30, 40))
    middle = [(shares * one[rows, columns]).sum() / shares.sum() for one in (u, v)]
    area = cv2.contourArea(corners.astype(np.float32))
    assert shares.sum() == pytest.approx(area, rel=2e-3)
    np.testing.assert_allclose(middle, centroid(corners), atol=5e-3)
    assert shares.min() >= 0
    assert shares.max() <= 1


def test_lamps_others_and_a_mirror_shine_beside_the_body(tmp_path: Path) -> None:
    session = write(tmp_path / "s", LEFT)
    plain = read_image(made(tmp_path / "plain", session, frames=1, **QUIET) / "left0000.png")
    for name, option in (
        ("lamps", {"lamps": 6}),
        ("others", {"others": 2}),
        ("mirror", {"mirror": 0.45}),
    ):
        folder = made(tmp_path / name, session, frames=1, **option, **QUIET)
        image = read_image(folder / "left0000.png")
        assert (image >= plain).all()  # the body is where it was
        more = image.astype(np.int64) - plain
        count = cv2.connectedComponents((more > 20).astype(np.uint8))[0] - 1
        assert count >= 2, name
        if name == "mirror":
            assert more.max() < 0.6 * (plain.max() - 10)
        if name == "lamps":
            assert image.max() == 255


def test_a_mirror_image_lies_as_deep_in_the_table_as_the_body_above(tmp_path: Path) -> None:
    session = write(tmp_path / "s", TABLE.format(more=""))
    plain = detections(made(tmp_path / "a", session, **QUIET))
    mirrored = detections(made(tmp_path / "b", session, mirror=0.4, **QUIET))
    for number, points in plain.items():
        images = mirrored[number][near(points, mirrored[number]) > 1e-6]
        assert len(images) >= 2
        # below, as rows count down
        assert images[:, 1].min() > points[:, 1].max()


def test_an_arm_covers_and_uncovers_markers(tmp_path: Path) -> None:
    session = write(tmp_path / "s", TABLE.format(more=""))
    counts = [
        len(points)
        for points in detections(
            made(tmp_path / "out", session, frames=60, occluder=2, **QUIET)
        ).values()
    ]
    assert min(counts) < 4
    assert max(counts) == 4
    path = write(tmp_path / "i", LEFT)
    plain, covered = (
        read_image(made(tmp_path / str(n), path, frames=12, occluder=n, **QUIET) / "left0008.png")
        for n in (0, 3)
    )
    assert (covered <= plain).all()
    assert (covered < plain).any()


def test_a_body_that_is_away_leaves_no_light_and_no_truth(tmp_path: Path) -> None:
    session = write(tmp_path / "s", TABLE.format(more=""))
    folder = made(tmp_path / "out", session, frames=5, away_from=2, mirror=0.4, **QUIET)
    assert sorted(detections(folder)) == [0, 1]
    assert [line["frame"] for line in truth(folder)] == [0, 1]


def test_compression_and_a_colour_sensor_change_pixels_but_not_places(tmp_path: Path) -> None:
    session = write(tmp_path / "s", LEFT)
    plain = read_image(made(tmp_path / "plain", session, frames=1) / "left0000.png")
    for name, option in (("jpeg", {"jpeg": 60}), ("bayer", {"bayer": True})):
        folder = made(tmp_path / name, session, frames=1, **option)
        image = read_image(folder / "left0000.png")
        assert (image != plain).mean() > 0.3
        found = [blobs(one) for one in (plain, image)]
        assert len(found[1]) == 4
        # edges of colours and of blocks
        assert near(*found).max() < 0.25


def test_a_turned_camera_is_turned_by_as_much_and_the_session_does_not_know(
    tmp_path: Path,
) -> None:
    right = CAMERA.format(name="right", source="right.csv", more="")
    session = write(tmp_path / "s", TABLE.format(more=""), right)
    plain = made(tmp_path / "a", session, **QUIET)
    turned = made(tmp_path / "b", session, turned_camera_deg=0.5, **QUIET)
    assert (plain / "session.toml").read_bytes() == (turned / "session.toml").read_bytes()
    assert (plain / "left.csv").read_bytes() == (turned / "left.csv").read_bytes()
    off = near(detections(turned, "right.csv")[0], detections(plain, "right.csv")[0])
    # 300 px to the radian, less where the axis is the line of sight
    assert 0.3 < off.max() < 1.5 * np.radians(0.5) * 300


def test_sensors_out_of_step_say_so_in_their_times(tmp_path: Path) -> None:
    # their times are the table's own, where there is no frame rate
    told = CAMERA.replace("fps = 25\n", "")
    tables = [told.format(name=name, source=f"{name}.csv", more="") for name in ("left", "right")]
    session = write(tmp_path / "s", *tables)
    folder = made(tmp_path / "out", session, out_of_step=0.04, frames=3, **QUIET)
    left, right = detections(folder), detections(folder, "right.csv")
    assert near(left[1], right[0]).max() < 1e-5
    with (folder / "right.csv").open(encoding="ascii") as file:
        times = {int(row["frame"]): float(row["time_s"]) for row in csv.DictReader(file)}
    assert times == pytest.approx({0: 0.04, 1: 0.08, 2: 0.12})
    images = write(tmp_path / "i", LEFT)
    with pytest.raises(SessionError, match="times: missing"):
        made(tmp_path / "no", images, out_of_step=0.01)


def test_the_command_takes_every_fault(tmp_path: Path) -> None:
    session = write(tmp_path / "s", LEFT, body='shape = "sphere"\nradius = 6')
    words = (
        "--frames 2 --readout 0.02 --exposure 0.004 --delay left=0.003 --lamps 2 --mirror 0.4 "
        "--others 1 --occluder 1 --jpeg 80 --bayer --turned-camera 0.1 --away-from 1"
    )
    done = command("simulate", session, "-o", tmp_path / "out", *words.split())
    assert done.returncode == 0, done.stderr
    header = json.loads((tmp_path / "out" / TRUTH_NAME).read_text().splitlines()[0])
    assert header["simulation"]["delay"] == {"left": 0.003}
    for delay, words in (("0.003", "NAME=SECONDS"), ("right=0.1", "allowed: left")):
        asked = ("--frames", "2", "--delay", delay)
        failed = command("simulate", session, "-o", tmp_path / "no", *asked)
        assert failed.returncode == 2
        assert words in failed.stderr


def test_without_faults_poses_are_those_of_before(tmp_path: Path) -> None:
    # what else is drawn has random numbers of its own
    session = write(tmp_path / "s", LEFT)
    plain = made(tmp_path / "a", session)
    busy = made(tmp_path / "b", session, lamps=2, others=1, occluder=1, mirror=0.3)
    for one, other in zip(truth(plain), truth(busy), strict=True):
        T, U = np.array(one["T_world_object"]), np.array(other["T_world_object"])
        np.testing.assert_array_equal(T, U)
