"""Labels of detections, and trajectories of markers in C3D and TRC, read by readers of others."""

from __future__ import annotations

import csv
import json
import os
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import command

from mixpose.body import Body, PointFeature
from mixpose.cli import main, session_formats
from mixpose.density import Observation
from mixpose.errors import RecordingError
from mixpose.poses.jsonl import PoseFile, read_poses
from mixpose.poses.poseline import PoseLine
from mixpose.poses.trajectories import Trajectories, numbers_of, rate_of
from mixpose.records import Estimate, Floats, Offsets, PointPattern, SensorReport
from mixpose.rigid import from_rotation_vector, transform
from mixpose.sensors import ParallelBeam
from mixpose.session import Session, load_session
from mixpose.tracking import labelled

FOLDER = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras"
# ten times what spots of the recording err by, and a hundredth of what features are apart
FOUND_PX = 0.1


@pytest.fixture(scope="module")
def session() -> Session:
    return load_session(FOLDER / "session.toml")


@pytest.fixture(scope="module")
def poses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "poses.jsonl"
    with pytest.raises(SystemExit) as leaving:
        main(["run", str(FOLDER / "session.toml"), "--labels", "-o", str(path)])
    assert not leaving.value.code
    return path


@pytest.fixture(scope="module")
def truth(session: Session) -> dict[int, Floats]:
    """True places of the markers in the world (N, 3), by frame."""
    return {
        line.frame: transform(line.T_world_object, session.body.means)
        for line in read_poses(FOLDER / "truth.jsonl").poses
        if line.T_world_object is not None
    }


def convert(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as leaving:
        main(["convert", *map(str, arguments)])
    return int(leaving.value.code or 0)


def last_error(capfd: pytest.CaptureFixture[str]) -> str:
    (line,) = capfd.readouterr().err.splitlines()
    return line


def c3d_points(path: Path) -> tuple[Any, Floats]:
    """A C3D file by the package c3d: its reader, and x, y, z, residual, cameras (F, N, 5)."""
    c3d = pytest.importorskip("c3d")
    with path.open("rb") as stream, warnings.catch_warnings(action="ignore"):  # of no analog data
        reader = c3d.Reader(stream)
        frames = [points.astype(np.float64) for _, points, _ in reader.read_frames()]
    return reader, np.array(frames)


def test_labels_name_the_feature_that_is_there_in_truth(
    poses: Path, session: Session, truth: dict[int, Floats]
) -> None:
    sensors = {setup.name: setup.sensor for setup in session.sensors}
    count = 0
    for line in read_poses(poses).poses:
        for name, report in line.sensors.items():
            y, _ = sensors[name].project(truth[line.frame])
            for label, one in report.labels.items():
                off = np.linalg.norm(y[session.body.labels.index(label)] - one.at)
                assert off < FOUND_PX
                count += 1
            # what is labelled is what was met
            met = {label for label, r in report.residuals.items() if r is not None}
            assert set(report.labels) == met
    assert count > 0.9 * 40 * 2 * 7


def test_no_detection_is_two_features_but_where_they_run_together(poses: Path) -> None:
    for line in read_poses(poses).poses:
        for report in line.sensors.values():
            times = Counter(one.detection for one in report.labels.values())
            for label, one in report.labels.items():
                assert label not in line.points or times[one.detection] == 1


def test_measured_points_are_where_markers_are_and_not_where_the_pose_has_them(
    poses: Path, session: Session, truth: dict[int, Floats]
) -> None:
    errors, from_pose = [], []
    for line in read_poses(poses).poses:
        assert line.T_world_object is not None
        by_pose = transform(line.T_world_object, session.body.means)
        for label, point in line.points.items():
            i = session.body.labels.index(label)
            errors.append(np.linalg.norm(point.at - truth[line.frame][i]))
            from_pose.append(np.linalg.norm(point.at - by_pose[i]))
    # one spot errs by 0.0085 px (`rms`), two cameras at 0.6 mm per px: 0.01 mm, tails included
    assert np.sqrt(np.mean(np.square(errors))) < 0.03
    assert np.median(from_pose) > 1e-3


def test_a_marker_seen_by_one_camera_is_not_measured(poses: Path) -> None:
    for line in read_poses(poses).poses:
        seen = Counter(label for one in line.sensors.values() for label in one.labels)
        assert all(seen[label] == 2 for label in line.points)


BODY = Body("cube", tuple(PointFeature(np.array(z)) for z in np.eye(3)))
ASIDE = np.array([0.02, -0.01, 0.03])  # by which the second marker is not where the body has it


def seen_aside(angle_deg: float, *, shared: bool = False) -> Estimate:
    """The body as two parallel-beam cameras at an angle see it, its second marker bent aside."""
    seen, offsets = {}, {}
    for name, turn in (("a", 0.0), ("b", angle_deg)):
        T = from_rotation_vector([0, np.radians(turn), 0], [0, 0, 0])
        sensor = ParallelBeam(0.5, np.zeros(2), None, T)
        at = sensor.linearise(BODY.means)
        points = BODY.means + np.eye(3)[1][:, None] * ASIDE
        y, _ = sensor.project(points)
        seen[name] = Observation(PointPattern(y, np.ones(3)), 1.5)
        pair = np.array([shared, shared, False])
        offsets[name] = Offsets(
            np.arange(3), np.ones(3, dtype=bool), y - at[0], at[1], y, pair, np.ones(3)
        )
    reports = {name: SensorReport(True) for name in offsets}
    pose = Estimate(0, None, "cube", "ok", np.eye(4), None, 1.0, reports, measured=lambda: offsets)
    return labelled(pose, seen, BODY)


def test_a_marker_that_is_bent_aside_is_measured_where_it_is() -> None:
    points = seen_aside(90).points
    assert list(points) == ["1", "2", "3"]
    np.testing.assert_allclose(points["2"].at, BODY.means[1] + ASIDE, atol=1e-12)
    np.testing.assert_allclose(points["3"].at, BODY.means[2], atol=1e-12)
    assert points["2"].residual < 1e-12


@pytest.mark.parametrize(("angle_deg", "count"), [(1.9, 0), (2.1, 3)])
def test_rays_that_are_nearly_parallel_measure_nothing(angle_deg: float, count: int) -> None:
    assert len(seen_aside(angle_deg).points) == count


def test_features_that_share_a_detection_are_labelled_and_not_measured() -> None:
    both = seen_aside(90, shared=True)
    assert list(both.points) == ["3"]
    assert list(both.sensors["a"].labels) == ["1", "2", "3"]


def test_c3d_is_read_back_by_a_reader_of_others(
    poses: Path, session: Session, tmp_path: Path
) -> None:
    pytest.importorskip("ezc3d")
    assert convert(poses, "-o", tmp_path / "markers.c3d") == 0
    reader, points = c3d_points(tmp_path / "markers.c3d")
    assert [name.strip() for name in reader.point_labels] == list(session.body.labels)
    assert (reader.first_frame, reader.last_frame, reader.point_rate) == (1, 40, 25.0)
    for row, line in zip(points, read_poses(poses).poses, strict=True):
        assert line.T_world_object is not None
        expected = transform(line.T_world_object, session.body.means)
        for i, label in enumerate(session.body.labels):
            if label in line.points:
                expected[i] = line.points[label].at
            # a measured place has a residual and cameras, one by the pose has neither
            assert (row[i, 3] > 0) == (row[i, 4] > 0) == (label in line.points)
        np.testing.assert_allclose(row[:, :3], expected, rtol=1e-6, atol=1e-6)


def test_gaps_stay_gaps_where_only_measured_places_are_wanted(
    poses: Path, session: Session, tmp_path: Path
) -> None:
    pytest.importorskip("ezc3d")
    assert convert(poses, "-o", tmp_path / "markers.c3d", "--measured") == 0
    _, points = c3d_points(tmp_path / "markers.c3d")
    measured = [
        [label in line.points for label in session.body.labels] for line in read_poses(poses).poses
    ]
    assert 0 < np.sum(measured) < np.size(measured)
    np.testing.assert_array_equal(points[..., 3] >= 0, measured)
    np.testing.assert_array_equal(points[..., 3] == -1, ~np.array(measured))


def test_trc_is_read_back_by_a_reader_of_others(
    poses: Path, session: Session, tmp_path: Path
) -> None:
    trc = pytest.importorskip("trc")
    assert convert(poses, "-o", tmp_path / "markers.trc", "--measured") == 0
    table = trc.TRCData()
    table.load(tmp_path / "markers.trc")
    assert table["Markers"] == list(session.body.labels)
    assert (table["NumFrames"], table["DataRate"], table["Units"]) == (40, 25.0, "mm")
    np.testing.assert_allclose(table["Time"], np.arange(40) / 25, atol=1e-9)
    for k, line in enumerate(read_poses(poses).poses):
        for label in session.body.labels:
            found = line.points.get(label)
            expected = np.full(3, np.nan) if found is None else found.at
            np.testing.assert_allclose(table[label][k], expected, atol=1e-6)


def line(frame: int, *, time_s: float | None = None, name: str = "tracker") -> PoseLine:
    return PoseLine(
        line=1, frame=frame, time_s=time_s, object=name, status="ok", T_world_object=np.eye(4),
        covariance=None, score=1.0, sensors={}, hypotheses=(), latency_ms=None,
    )  # fmt: skip


def test_frames_that_are_not_there_are_gaps(session: Session) -> None:
    lines = tuple(line(frame, time_s=frame / 50) for frame in (3, 4, 7))
    found = session_formats.trajectories_of(
        PoseFile(Path("p"), {}, lines), lines, session, measured=False
    )
    assert found.first == 3
    assert found.rate == pytest.approx(50)
    np.testing.assert_array_equal(
        found.is_known, np.repeat([[1], [1], [0], [0], [1]], 7, axis=1).astype(bool)
    )
    assert not found.is_measured.any()


def rate(lines: list[PoseLine]) -> tuple[float, float] | None:
    return rate_of(lines, numbers_of(lines))


def test_rate_is_that_of_the_times_and_unevenness_is_told() -> None:
    assert rate([line(frame) for frame in range(3)]) is None
    even = rate([line(frame, time_s=5 + frame / 30) for frame in (0, 1, 5)])
    np.testing.assert_allclose(np.array(even, dtype=np.float64), [30, 0], atol=1e-9)
    late = rate([line(0, time_s=0.0), line(1, time_s=1.6), line(2, time_s=2.0)])
    np.testing.assert_allclose(np.array(late, dtype=np.float64), [1, 0.6], atol=1e-9)
    with pytest.raises(RecordingError, match="--fps"):
        rate([line(0, time_s=1.0), line(1, time_s=1.0)])


def trajectories(frames: int, markers: int = 2, first: int = 0) -> Trajectories:
    shape = frames, markers
    places = np.arange(3.0 * frames * markers).reshape(*shape, 3)
    measured = np.zeros((*shape, 9), dtype=np.bool_)
    measured[:, 0] = True
    residuals = np.where(measured.any(axis=2), 1e-5, np.nan)
    names = tuple(f"marker {k}" for k in range(markers))
    return Trajectories(names, places, residuals, measured, first, 100.0, "m")


def test_lengths_are_in_mm_and_a_small_residual_is_still_one(tmp_path: Path) -> None:
    pytest.importorskip("ezc3d")
    from mixpose.poses.trajectories import write_c3d

    mixed = trajectories(3)
    mixed.residuals[1, 0] = 2.0  # so large that 0.01 mm would be rounded to nothing beside it
    assert write_c3d(tmp_path / "a.c3d", mixed)
    _, points = c3d_points(tmp_path / "a.c3d")
    np.testing.assert_allclose(points[..., :3], 1000 * mixed.places)
    assert (points[:, 0, 3] > 0).all()
    assert not points[:, 1, 3:].any()


def test_frames_whose_numbers_are_too_large_begin_at_one(tmp_path: Path) -> None:
    pytest.importorskip("ezc3d")
    from mixpose.poses.trajectories import LAST_FRAME, write_c3d

    path = tmp_path / "a.c3d"
    assert write_c3d(path, trajectories(10, first=LAST_FRAME - 10))
    reader, points = c3d_points(path)
    assert (reader.last_frame, len(points)) == (LAST_FRAME, 10)
    assert not write_c3d(path, trajectories(10, first=LAST_FRAME - 9))
    assert c3d_points(path)[0].first_frame == 1
    with pytest.raises(RecordingError, match=f"room for {LAST_FRAME}; write .trc"):
        write_c3d(path, trajectories(LAST_FRAME + 1, 1))


@pytest.mark.parametrize("suffix", [".c3d", ".trc"])
def test_own_files_are_replaced_and_others_are_kept(
    suffix: str, poses: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("ezc3d")
    path = tmp_path / f"markers{suffix}"
    assert convert(poses, "-o", path) == convert(poses, "-o", path) == 0
    capfd.readouterr()
    path.write_bytes(path.read_bytes().replace(b"mixpose", b"another"))
    assert convert(poses, "-o", path) == 2
    assert "holds something that mixpose did not write" in last_error(capfd)


def test_a_file_of_very_many_markers_is_known_as_own(tmp_path: Path) -> None:
    pytest.importorskip("ezc3d")
    from mixpose.cli.output import refuse_to_overwrite_but
    from mixpose.poses.trajectories import MARKS, write_c3d

    write_c3d(tmp_path / "a.c3d", trajectories(2, 250))
    begins, mark = MARKS["c3d"]
    refuse_to_overwrite_but(tmp_path / "a.c3d", [], mark, begins=begins)
    assert len(c3d_points(tmp_path / "a.c3d")[0].point_labels) == 250


def test_poses_without_labels_give_places_by_the_pose_and_say_so(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    given = (FOLDER / "truth.jsonl", "--session", FOLDER / "session.toml", "--unit", "mm")
    assert convert(*given, "-o", tmp_path / "true.trc") == 0
    said = capfd.readouterr().err
    assert "no frame has a marker that was measured" in said
    assert "280 by the pose" in said
    assert convert(*given, "-o", tmp_path / "true.trc", "--measured") == 2
    assert "run again with --labels" in last_error(capfd)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--format", "c3d"), "needs -o FILE.c3d"),
        (("-o", "a.csv", "--measured"), "--measured: belongs to --format c3d or trc"),
        (("-o", "a.tum", "--fps", "5"), "--fps: belongs to --format c3d or trc"),
        (("-o", "a.trc", "--relative-to", "left"), "--relative-to: belongs to --format bop"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    arguments: tuple[str, ...], said: str, poses: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert convert(poses, *arguments) == 2
    assert said in last_error(capfd)


def test_the_extra_to_install_is_named(
    poses: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("mixpose.errors.find_spec", lambda name: None)
    assert convert(poses, "-o", tmp_path / "a.c3d") == 2
    assert "python -m pip install 'mixpose[c3d]'" in last_error(capfd)
    assert not (tmp_path / "a.c3d").exists()


def test_labels_need_a_format_that_has_room_for_them(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as leaving:
        main(["run", str(FOLDER / "session.toml"), "--labels", "-o", str(tmp_path / "a.csv")])
    assert leaving.value.code == 2
    assert "--labels: found --format csv; allowed: jsonl" in last_error(capfd)


def test_lines_with_labels_are_valid_and_convert_to_themselves(poses: Path, tmp_path: Path) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    from mixpose.poses.schema import schema

    check = jsonschema.Draft202012Validator(schema())
    first = poses.read_text().splitlines()[1]
    check.validate(json.loads(first))
    broken = json.loads(first)
    broken["points"]["1"]["at"] = [0.0, 1.0]
    assert not check.is_valid(broken)
    assert convert(poses, "-o", tmp_path / "again.jsonl") == 0
    assert (tmp_path / "again.jsonl").read_text() == poses.read_text()


def test_labels_change_no_pose(poses: Path, tmp_path: Path) -> None:
    plain = command("run", FOLDER / "session.toml", "--stop", "9").stdout
    for without, with_labels in zip(plain.splitlines()[1:], poses.read_text().splitlines()[1:]):
        expected, found = json.loads(without), json.loads(with_labels)
        assert "points" not in expected
        for report in found["sensors"].values():
            del report["labels"]
        del found["points"]
        assert {**found, "latency_ms": 0} == {**expected, "latency_ms": 0}


@pytest.mark.skipif("MIXPOSE_RECORDINGS" not in os.environ, reason="needs the real recordings")
def test_labels_of_a_real_board_are_those_that_its_makers_gave(tmp_path: Path) -> None:
    """Four web cams; the board looks alike after half a turn: its numbers may be reversed."""
    folder = Path(os.environ["MIXPOSE_RECORDINGS"]) / "webcams4_a"
    poses = tmp_path / "poses.jsonl"
    with pytest.raises(SystemExit):
        main(["run", str(folder / "session_reference.toml"), "--labels", "-o", str(poses)])
    given = {}
    with (folder / "detections_labelled.csv").open(newline="") as stream:
        for row in csv.DictReader(stream):
            given[row["camera"], int(row["frame"]), row["u"], row["v"]] = int(row["corner"])
    count = 0
    for pose in read_poses(poses).poses:
        pairs = [
            (int(label) - 1, given[name, pose.frame, f"{one.at[0]:.4f}", f"{one.at[1]:.4f}"])
            for name, report in pose.sensors.items()
            for label, one in report.labels.items()
        ]
        as_given, turned = (sum(i == (j, 11 - j)[k] for i, j in pairs) for k in (0, 1))
        assert max(as_given, turned) == len(pairs)
        count += len(pairs)
    assert count > 1800
