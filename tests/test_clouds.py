"""Points in space as a sensor, on recordings that are made without the package."""

from __future__ import annotations

import csv
import json
import os
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from command_line import command
from scipy.spatial.transform import Rotation

import mixpose
from mixpose.errors import RecordingError, SessionError
from mixpose.poses.jsonl import read_poses
from mixpose.records import Estimate, Floats, Indices
from mixpose.rigid import from_parts, from_rotation_vector, perturb, transform, twist_between
from mixpose.sensors import CloudSensor, as_images, from_planes

NOISE = 0.3  # mm, of a coordinate
T_CLOUD = from_rotation_vector([0.4, -1.1, 2.0], [800.0, -200.0, 300.0])


@dataclass(frozen=True)
class Recording:
    """A body in a cloud: its session, where it was, and what belongs to which marker."""

    session: Path
    body: Floats  # (N, 3)
    truth: list[Floats]  # (4, 4) each
    seen: list[tuple[Indices, Floats]]  # markers (n,) and their points (n, 3) in the world


def recording(folder: Path, *, markers: int, frames: int, clutter: int, hidden: int) -> Recording:
    """A body anywhere in each frame, with some markers hidden and points that are not its own."""
    rng = np.random.default_rng(markers)
    body = rng.normal(size=(markers, 3)) * 45
    rows, truth, seen = ["frame,x,y,z"], [], []
    for frame in range(frames):
        R = Rotation.random(random_state=rng).as_matrix()
        T = from_parts(R, rng.uniform(-300, 300, 3))
        own = np.sort(rng.permutation(markers)[rng.integers(0, hidden + 1) :])
        points = transform(T, body[own]) + NOISE * rng.normal(size=(len(own), 3))
        others = T[:3, 3] + rng.uniform(-250, 250, (clutter, 3))
        table = transform(T_CLOUD, np.concatenate([points, others]))
        rows += [f"{frame},{x!r},{y!r},{z!r}" for x, y, z in rng.permutation(table).tolist()]
        truth.append(T)
        seen.append((own, points))
    (folder / "cloud.csv").write_text("\n".join(rows) + "\n")
    session = folder / "session.toml"
    session.write_text(
        f'unit = "mm"\n[object]\nname = "body"\npoints = {body.tolist()}\n'
        f'[[sensor]]\nname = "mocap"\nmodel = "cloud"\nsource = "cloud.csv"\n'
        f"T_sensor_world = {T_CLOUD.tolist()}\n"
    )
    return Recording(session, body, truth, seen)


def by_labels(body: Floats, points: Floats) -> Floats:
    """The pose (4, 4) of least squares where it is known which point is which (Kabsch)."""
    turned, _ = Rotation.align_vectors(points - points.mean(axis=0), body - body.mean(axis=0))
    R = turned.as_matrix()
    return from_parts(R, points.mean(axis=0) - R @ body.mean(axis=0))


@pytest.fixture(scope="module")
def seven(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return recording(tmp_path_factory.mktemp("c"), markers=7, frames=30, clutter=5, hidden=1)


@pytest.fixture(scope="module")
def estimates(seven: Recording) -> list[Estimate]:
    return list(mixpose.run(mixpose.load_session(seven.session), labels=True))


def test_three_images_are_as_far_off_as_a_point_is_in_space() -> None:
    sensor = CloudSensor(T_CLOUD)
    rng = np.random.default_rng(0)
    points, shift = rng.normal(size=(2, 20, 3))
    before, after = (
        np.array([plane.project(p)[0] for plane in sensor.planes]) for p in (points, points + shift)
    )
    squared = np.square(after - before).sum(axis=(0, 2))
    np.testing.assert_allclose(squared, 2 * np.square(shift).sum(axis=1), rtol=1e-12)
    np.testing.assert_allclose(from_planes(before), sensor.project(points)[0], atol=1e-9)
    _, deviations, first = as_images([sensor, sensor], [0.3, 0.4])
    np.testing.assert_allclose(deviations, np.sqrt(2) * np.repeat([0.3, 0.4], 3))
    assert first == [0, 3]


def test_poses_from_nothing_are_those_of_known_labels(
    seven: Recording, estimates: Sequence[Estimate]
) -> None:
    own, known = [], []
    for estimate, T, (markers, points) in zip(estimates, seven.truth, seven.seen, strict=True):
        assert estimate.status == "ok"
        assert estimate.T_world_object is not None
        own.append(twist_between(T, estimate.T_world_object))
        known.append(twist_between(T, by_labels(seven.body[markers], points)))
    ratio = np.sqrt(np.square(own).sum(axis=0) / np.square(known).sum(axis=0))
    # noise is known from few frames, and what is far off counts less: 3 % are lost
    assert (ratio < 1.1).all()


def test_covariance_counts_three_coordinates_of_a_point_not_six(
    seven: Recording, estimates: Sequence[Estimate]
) -> None:
    squared = []
    for estimate, T in zip(estimates, seven.truth, strict=True):
        assert estimate.T_world_object is not None
        assert estimate.covariance is not None
        off = twist_between(T, estimate.T_world_object)
        squared.append(off @ np.linalg.solve(estimate.covariance, off))
    # 180 numbers: 1 +- 0.1; six coordinates would give 2
    assert 0.7 < np.mean(squared) / 6 < 1.35


def test_the_covariance_of_a_first_frame_holds(seven: Recording) -> None:
    session, squared = mixpose.load_session(seven.session), []
    for frame, T in enumerate(seven.truth):
        (estimate,) = mixpose.run(session, selection=mixpose.Selection(frame, frame + 1))
        assert estimate.status == "ok"
        assert estimate.T_world_object is not None
        assert estimate.covariance is not None
        off = twist_between(T, estimate.T_world_object)
        squared.append(off @ np.linalg.solve(estimate.covariance, off))
    # 180 numbers: 1 +- 0.1; that 99.9 % are inside by a noise of 15 residuals makes it 0.6 times as
    # large, and fields, not known yet, smaller; six coordinates give 1.0
    assert 0.4 < np.mean(squared) / 6 < 0.85


def beside_a_camera(made: Recording, moved: Floats) -> Path:
    """A session of the cloud and a camera that sees the body, moved in its axes (6,)."""
    rng, K = np.random.default_rng(1), np.array([[800.0, 0, 640], [0, 800, 512], [0, 0, 1]])
    T_camera, folder = from_parts(np.eye(3), [0.0, 0.0, 1200.0]), made.session.parent
    rows = ["frame,u,v"]
    for frame, T in enumerate(made.truth):
        y = transform(perturb(T_camera, moved) @ T, made.body) @ K.T
        pixels = y[:, :2] / y[:, 2:] + 0.1 * rng.normal(size=(len(y), 2))
        rows += [f"{frame},{u!r},{v!r}" for u, v in rng.permutation(pixels).tolist()]
    (folder / "camera.csv").write_text("\n".join(rows) + "\n")
    camera = (
        f'[[sensor]]\nname = "camera"\nmodel = "pinhole"\nsource = "camera.csv"\n'
        f"resolution = [1280, 1024]\ncamera_matrix = {K.tolist()}\n"
        f'T_sensor_world = {T_camera.tolist()}\n[[sensor]]\nname = "mocap"'
    )
    return text(made.session, ('[[sensor]]\nname = "mocap"', camera))


@pytest.mark.parametrize(("moved", "are_ok"), [(0.0, True), (3.0, False), (12.0, False)])
def test_a_cloud_and_a_camera_that_contradict_each_other_are_two_sensors(
    tmp_path: Path, moved: float, are_ok: bool
) -> None:
    made = recording(tmp_path, markers=7, frames=5, clutter=2, hidden=0)
    shift = np.array([moved, -0.7 * moved, 0.0, 0.0, 0.0, 0.0])
    estimates = list(mixpose.run(mixpose.load_session(beside_a_camera(made, shift))))
    # three images of the cloud outvote nobody: which of the two is wrong is not known
    assert [one.status == "ok" for one in estimates] == 5 * [are_ok]


def test_labels_are_the_rows_of_the_table_and_points_those_in_the_world(
    seven: Recording, estimates: Sequence[Estimate]
) -> None:
    table = np.loadtxt(seven.session.parent / "cloud.csv", delimiter=",", skiprows=1)
    right = count = 0
    for estimate, (markers, points) in zip(estimates, seven.seen, strict=True):
        (report,) = estimate.sensors.values()
        rows = table[table[:, 0] == estimate.frame, 1:]
        for label, one in report.labels.items():
            np.testing.assert_array_equal(rows[one.detection], one.at)
            at = estimate.points[label].at
            np.testing.assert_allclose(transform(T_CLOUD, at[None])[0], one.at, atol=1e-9)
            count += 1
            i = np.flatnonzero(markers == int(label) - 1)
            right += len(i) == 1 and bool(np.allclose(at, points[i[0]], atol=1e-6))
    assert count >= sum(len(markers) for markers, _ in seven.seen) - 2
    # a point of clutter may lie where a marker is hidden
    assert right >= count - 2


def test_residuals_are_distances_in_space(seven: Recording, estimates: Sequence[Estimate]) -> None:
    for estimate in estimates:
        assert list(estimate.sensors) == ["mocap"]
        report = estimate.sensors["mocap"]
        assert estimate.T_world_object is not None
        places = transform(estimate.T_world_object, seven.body)
        off = {
            label: float(np.linalg.norm(point.at - places[int(label) - 1]))
            for label, point in estimate.points.items()
        }
        met = {label: r for label, r in report.residuals.items() if r is not None}
        assert met == pytest.approx(off, rel=1e-6)
        assert report.rms == pytest.approx(np.sqrt(np.mean(np.square([*off.values()]))), rel=1e-6)


def text(session: Path, *changes: tuple[str, str]) -> Path:
    content = session.read_text()
    for old, new in changes:
        assert old in content
        content = content.replace(old, new)
    path = session.parent / "changed.toml"
    path.write_text(content)
    return path


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ('delay = "estimate"\n', "allowed: seconds"),
        ("calibration_error = { position = 1 }\n", 'model = "cloud"; allowed: with others'),
        ("resolution = [640, 480]\n", "resolution"),
    ],
)
def test_keys_that_a_cloud_does_not_have_are_refused(
    more: str, said: str, seven: Recording
) -> None:
    with pytest.raises(SessionError, match=said):
        mixpose.load_session(
            text(seven.session, ('source = "cloud.csv"\n', f'source = "cloud.csv"\n{more}'))
        )


def test_a_table_of_pixels_is_no_cloud(seven: Recording) -> None:
    (seven.session.parent / "pixels.csv").write_text("frame,u,v\n0,1,2\n")
    session = mixpose.load_session(text(seven.session, ("cloud.csv", "pixels.csv")))
    with pytest.raises(RecordingError, match="frame or time_s or both, then x,y,z"):
        list(mixpose.run(session))


def run(*arguments: str | Path) -> str:
    done = command(*arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_check_tells_a_cloud_and_what_it_would_give(seven: Recording) -> None:
    said = run("check", seven.session)
    assert "mocap: cloud, sigma 1.5 mm" in said
    assert "mocap 7/7" in said
    # of 7 points that err by 1.5 mm, the middle 0.57 mm along each axis, the origin a little more
    x = float(said.partition("sigma: x ")[2].split()[0])
    assert 0.57 <= x < 0.9


def test_inspect_tells_what_a_pose_meets_of_a_cloud(seven: Recording, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    said = run("inspect", seven.session, "--frame", "3", "-o", tmp_path / "seen")
    found = len(seven.seen[3][0])
    assert f"mocap: {found + 5} points found; the pose meets {found} of 7 features" in said
    # offsets in space of noise of three axes: 0.3 sqrt(3), less what the pose takes up
    assert 0.2 < float(said.partition(" within ")[2].split()[0]) < 0.8


def test_a_report_tells_how_far_off_a_cloud_is_in_lengths(seven: Recording, tmp_path: Path) -> None:
    pytest.importorskip("jinja2")
    run("run", seven.session, "--stop", "3", "-o", tmp_path / "poses.jsonl")
    run("report", tmp_path / "poses.jsonl", "-o", tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    (row,) = re.findall(r'<tr><th scope="row">mocap</th>.*</tr>', page)
    assert row.endswith(" mm</td></tr>")


def test_a_cloud_that_errs_by_more_than_its_session_says_is_in_doubt_to_the_end(
    seven: Recording, tmp_path: Path
) -> None:
    tight = tmp_path / "tight.toml"
    words = seven.session.read_text().replace("cloud.csv", str(seven.session.parent / "cloud.csv"))
    tight.write_text(words + "[sensor.extract]\nsigma = 0.15\n")  # half of what points err by
    said = run("run", tight, "-o", tmp_path / "poses.jsonl", "--stop", "12")
    assert "12 frames:" in said
    assert len((tmp_path / "poses.jsonl").read_text().splitlines()) == 13


def test_a_simulated_cloud_is_found_again(seven: Recording, tmp_path: Path) -> None:
    given = ("--frames", "12", "--clutter", "3", "--hidden", "0.1", "--range-noise", "0.2")
    run("simulate", seven.session, "-o", tmp_path / "try", *given)
    poses = tmp_path / "poses.jsonl"
    assert "12 frames: 12 ok" in run("run", tmp_path / "try" / "session.toml", "-o", poses)
    found = json.loads(run("evaluate", poses, tmp_path / "try" / "truth.jsonl", "--json"))
    assert found["translation"]["rms"] < 0.5


def test_a_cloud_is_placed_against_a_camera(tmp_path: Path) -> None:
    made = recording(tmp_path, markers=8, frames=8, clutter=2, hidden=0)
    stated = f"T_sensor_world = {T_CLOUD.tolist()}\n"
    both = beside_a_camera(made, np.zeros(6))
    both.write_text(both.read_text().replace(stated, ""))
    run("calibrate", both, "-o", tmp_path / "placed.toml")
    with (tmp_path / "placed.toml").open("rb") as stream:
        found = np.array(tomllib.load(stream)["sensor"][1]["T_sensor_world"])
    # a camera knows depths of 8 frames to 0.1 px * 1200 mm / 100 px, and their turns alike
    assert np.linalg.norm(transform(found, np.zeros((1, 3))) - T_CLOUD[:3, 3]) < 3.0
    assert np.degrees(np.linalg.norm(twist_between(T_CLOUD, found)[3:])) < 0.3


def test_a_cloud_that_never_shows_the_body_is_told_and_nothing_else_of_it(tmp_path: Path) -> None:
    made = recording(tmp_path, markers=8, frames=8, clutter=2, hidden=0)
    left = beside_a_camera(made, np.zeros(6))
    (tmp_path / "camera.csv").rename(tmp_path / "left.csv")
    left.write_text(left.read_text().replace('"camera', '"left'))
    both = beside_a_camera(replace(made, session=left), np.zeros(6))
    others = np.random.default_rng(1).uniform(-300, 300, (64, 3)).tolist()
    rows = [f"{k // 8},{x!r},{y!r},{z!r}" for k, (x, y, z) in enumerate(others)]
    (tmp_path / "cloud.csv").write_text("\n".join(["frame,x,y,z", *rows]) + "\n")
    said = run("calibrate", both, "--check")
    assert "mocap: shares no view" in said
    assert "the calibration holds, of what shares views" in said
    assert "nan" not in said


def triangulated(folder: Path, frames: int) -> dict[int, list[Floats]]:
    """Points in space of a recording whose detections have names, by least squares."""
    with (folder / "session.toml").open("rb") as stream:
        cameras = {one["name"]: one for one in tomllib.load(stream)["sensor"]}
    lines: dict[tuple[int, str], list[Floats]] = {}
    with (folder / "detections_labelled.csv").open(newline="") as stream:
        for row in csv.DictReader(stream):
            camera = cameras[f"cam{row['camera']}"]
            P = np.array(camera["camera_matrix"]) @ np.array(camera["T_sensor_world"])[:3]
            own = lines.setdefault((int(row["frame"]), row["label"]), [])
            own += [float(row["u"]) * P[2] - P[0], float(row["v"]) * P[2] - P[1]]
    found: dict[int, list[Floats]] = {frame: [] for frame in range(frames)}
    for (frame, _), rows in lines.items():
        if frame < frames and len(rows) > 2:
            A = np.array(rows) / np.linalg.norm(np.array(rows)[:, :3], axis=1, keepdims=True)
            found[frame].append(np.linalg.lstsq(A[:, :3], -A[:, 3])[0])
    return found


@pytest.mark.skipif("MIXPOSE_RECORDINGS" not in os.environ, reason="needs the real recordings")
def test_nine_triangles_are_as_well_found_in_points_as_by_cameras(tmp_path: Path) -> None:
    folder = Path(os.environ["MIXPOSE_RECORDINGS"]) / "several_bodies" / "racing_9_triangles"
    frames = 6
    cloud = triangulated(folder, frames)
    rows = [
        f"{k},{x!r},{y!r},{z!r}" for k, own in cloud.items() for x, y, z in np.array(own).tolist()
    ]
    (tmp_path / "cloud.csv").write_text("\n".join(["frame,x,y,z", *sorted(rows)]) + "\n")
    content = (folder / "session.toml").read_text().partition("[[sensor]]")[0]
    sensor = '[[sensor]]\nname = "mocap"\nmodel = "cloud"\nsource = "cloud.csv"\nfps = 17.4982\n'
    (tmp_path / "session.toml").write_text(content + sensor)
    truth: dict[int, list[Floats]] = {}
    for pose in read_poses(folder / "truth.jsonl").poses:
        assert pose.T_world_object is not None
        truth.setdefault(pose.frame, []).append(pose.T_world_object[:3, 3])
    numbers = []
    for path in (tmp_path, folder):
        session = mixpose.load_session(path / "session.toml")
        some = mixpose.run(session, selection=mixpose.Selection(0, frames))
        right = [one for one in some if one.status == "ok" and one.T_world_object is not None]
        for one in right:
            assert one.T_world_object is not None
            away = np.linalg.norm(truth[one.frame] - one.T_world_object[:3, 3], axis=1)
            assert away.min() < 2.0  # worst of all 60 frames 0.59 mm
        numbers.append(len(right))
    # in all 60 frames 488 in points, 481 by cameras
    assert numbers[0] >= numbers[1]


@pytest.mark.parametrize(("factor", "told"), [(1e-3, "1000 times as large"), (1e3, "a thousandth")])
def test_check_names_a_cloud_in_another_unit(seven: Recording, factor: float, told: str) -> None:
    rows = (seven.session.parent / "cloud.csv").read_text().splitlines()
    other = [rows[0]]
    for row in rows[1:]:
        frame, *place = row.split(",")
        other.append(",".join([frame, *(f"{float(each) * factor:.7f}" for each in place)]))
    (seven.session.parent / "other.csv").write_text("\n".join(other) + "\n")
    said = run("check", text(seven.session, ("cloud.csv", "other.csv")))
    assert f"the points of 'mocap' are in another unit than the session: with them {told}" in said
    assert "4 of 4 frames are explained" in said
