"""The recording for the Rerun viewer, read back by Rerun's own reader."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mixpose import rigid
from mixpose.cli import main
from mixpose.cli.session_formats import recording_of
from mixpose.poses.jsonl import read_poses
from mixpose.session import load_session

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
SESSION = SYNTHETIC / "two_cameras" / "session.toml"


def convert(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as left:
        main(["convert", *map(str, arguments)])
    assert isinstance(left.value.code, int)
    return left.value.code


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    """Four frames: the truth, of which the second is lost and the others have a covariance."""
    text = SESSION.with_name("truth.jsonl").read_text()
    lines = [json.loads(line) for line in text.splitlines()[:5]]
    for line in lines[1:]:
        line["covariance"] = np.diag([4.0, 1.0, 9.0, 1e-4, 1e-4, 1e-4]).tolist()
    lines[2] |= {"status": "lost", "T_world_object": None, "covariance": None}
    path = tmp_path / "poses.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def entities(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """What moves, by entity, column and frame; and what stands still, by entity and column."""
    chunk = pytest.importorskip("rerun.chunk")
    moving: dict[str, Any] = {}
    still: dict[str, Any] = {}
    for piece in chunk.RrdReader(path).stream().to_chunks():
        batch = piece.to_record_batch()
        for name in batch.schema.names:
            values = batch.column(name).to_pylist()
            if piece.is_static:
                still.setdefault(piece.entity_path, {})[name] = values[0]
            else:
                frames = batch.column("frame").to_pylist()
                columns = moving.setdefault(piece.entity_path, {})
                columns.setdefault(name, {}).update(zip(frames, values, strict=True))
    return moving, still


def test_recording_holds_cameras_frames_densities_and_poses(poses: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    assert convert(poses, "-o", tmp_path / "poses.rrd", "--session", SESSION) == 0
    moving, still = entities(tmp_path / "poses.rrd")
    session = load_session(SESSION)

    camera = session.sensors[1].sensor
    T_world_sensor = rigid.inverse(camera.T_sensor_world)  # type: ignore[attr-defined]
    placed = still["/world/right"]
    np.testing.assert_allclose(
        placed["Transform3D:translation"][0], T_world_sensor[:3, 3], rtol=1e-5
    )
    columns = np.array(placed["Transform3D:mat3x3"][0]).reshape(3, 3)
    np.testing.assert_allclose(columns.T, T_world_sensor[:3, :3], atol=1e-6)
    K = np.array(still["/world/right/image"]["Pinhole:image_from_camera"][0]).reshape(3, 3).T
    expected = camera.camera_matrix[:2, 2] + 0.5  # type: ignore[attr-defined]
    np.testing.assert_allclose(K[:2, 2], expected, rtol=1e-6)

    frames = moving["/world/left/image"]
    assert list(frames["EncodedImage:blob"]) == [0, 1, 2, 3]
    jpeg = np.frombuffer(bytes(frames["EncodedImage:blob"][3][0]), np.uint8)
    image = cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE)
    original = cv2.imread(str(SESSION.with_name("left0003.png")), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    assert original is not None
    # what JPEG loses of noisy pixels at quality 85, a few grey levels
    assert np.abs(image.astype(float) - original).mean() < 3

    features = np.array(moving["/world/left/image/features"]["Points2D:positions"][3]) - 0.5
    blob = np.frombuffer(bytes(moving["/density/left"]["EncodedImage:blob"][3][0]), np.uint8)
    density = cv2.imdecode(blob, cv2.IMREAD_GRAYSCALE)
    assert density is not None
    step = 639 / 640  # of its grid: 640 steps over the 640 pixels' centres
    for u, v in features:
        assert density[round(v / step), round(u / step)] > 100
    assert np.median(density) < 5


def test_poses_move_the_object_and_a_lost_one_disappears(poses: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    convert(poses, "-o", tmp_path / "poses.rrd", "--session", SESSION)
    moving, still = entities(tmp_path / "poses.rrd")
    session = load_session(SESSION)
    body = session.body
    lines = [line.T_world_object for line in read_poses(poses).poses]

    object_ = moving[f"/world/{body.name}"]
    found = object_["Transform3D:translation"]
    assert sorted(found) == [0, 2, 3]
    assert list(object_["Clear:is_recursive"]) == [1]
    for frame in (0, 2, 3):
        T = lines[frame]
        assert T is not None
        np.testing.assert_allclose(found[frame][0], T[:3, 3], rtol=1e-5)
    points = still[f"/world/{body.name}/points"]["Points3D:positions"]
    np.testing.assert_allclose(points, body.means, atol=1e-4)
    radii = moving[f"/world/{body.name}/points"]["Points3D:radii"]
    assert radii[1] == [0.0]
    assert radii[2][0] > 1

    sizes = moving[f"/world/{body.name}\\ covariance"]["Ellipsoids3D:half_sizes"]
    # standard deviations of 1, 2 and 3 mm, times the root of the 95 % point of chi² with 3 d.o.f.
    np.testing.assert_allclose(sizes[0][0], np.array([1, 2, 3]) * 2.7955, rtol=1e-4)

    predicted = np.array(moving["/world/left/image/predicted"]["Points2D:positions"][0]) - 0.5
    features = np.array(moving["/world/left/image/features"]["Points2D:positions"][0]) - 0.5
    away = np.linalg.norm(predicted[:, None] - features, axis=2).min(axis=1)
    assert np.sort(away)[len(away) // 2] < 0.5  # the true pose meets what is found, px


def test_range_profiles_become_bar_charts(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    truth = SYNTHETIC / "range_profiles" / "truth.jsonl"
    assert convert(truth, "-o", tmp_path / "ranges.rrd") == 0  # the session stands beside it
    moving, _ = entities(tmp_path / "ranges.rrd")
    charts = [table for path, table in moving.items() if path.startswith("/density/")]
    assert len(charts) == 3
    assert all(len(table["BarChart:values"]) == 20 for table in charts)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--format", "rerun"], "--format rerun: needs -o FILE.rrd"),
        (["-o", "x.rrd"], "its session session.toml is not there; add --session SESSION.toml"),
        (["-o", "x.rrd", "--session", str(SESSION), "--source", "top=a"], "no such sensor"),
        (["-o", "x.rrd", "--session", str(SESSION), "--source", "left=camera:0"], "is live"),
    ],
)
def test_what_a_recording_needs_is_told(
    poses: Path, options: list[str], message: str, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rerun")
    assert convert(poses, *options) == 2
    errors = capfd.readouterr().err
    assert message in errors
    assert len(errors.splitlines()) == 1


def test_the_recording_is_the_one_that_the_run_read(poses: Path, tmp_path: Path) -> None:
    (tmp_path / "tuesday").mkdir()
    cv2.imwrite(str(tmp_path / "tuesday" / "left0003.png"), np.zeros((512, 640), np.uint8))
    header, *lines = poses.read_text().splitlines()
    told = json.dumps({**json.loads(header), "sources": {"left": str(tmp_path / "tuesday")}})
    poses.write_text("\n".join([told, *lines, ""]))
    session, left = load_session(SESSION), SESSION.with_name("left*.png")
    opened = recording_of(read_poses(poses), session, [])
    assert "1 image" in opened["left"].describe()
    assert "40 images" in opened["right"].describe()
    named = recording_of(read_poses(poses), session, [f"left={left}"])
    assert "40 images" in named["left"].describe()


def test_missing_package_is_told_with_what_to_install(
    poses: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("mixpose.errors.find_spec", lambda _: None)
    assert convert(poses, "-o", tmp_path / "x.rrd") == 2
    assert "python -m pip install 'mixpose[rerun]'" in capfd.readouterr().err


def test_only_a_recording_of_mixpose_is_replaced(
    poses: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rerun")
    output = tmp_path / "poses.rrd"
    options = ("-o", output, "--session", SESSION)
    assert convert(poses, *options) == 0
    assert convert(poses, *options) == 0
    output.write_bytes(b"RRF2 of another program")
    assert convert(poses, *options) == 2
    assert "mixpose did not write" in capfd.readouterr().err
    assert output.read_bytes() == b"RRF2 of another program"
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
