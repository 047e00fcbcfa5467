"""Calibrations that are stated to be off: the pose stays, its covariance knows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import command

from mixpose.rigid import from_rotation_vector, transform
from mixpose.runner import run
from mixpose.sensors import (
    CalibrationError,
    ParallelBeam,
    PinholeCamera,
    RangeSensor,
    calibration_shifts,
    perturbed,
)
from mixpose.session import load_session
from mixpose.simulation import SimulationOptions, simulate

K = np.array([[900.0, 0, 320], [0, 900, 256], [0, 0, 1]])
T = from_rotation_vector([0.1, -0.2, 0.3], [10.0, -20.0, 800.0])
POINTS = np.random.default_rng(0).uniform(-60, 60, (5, 3))


def test_what_a_stated_error_moves_in_the_image_is_that_of_the_parameter() -> None:
    camera = PinholeCamera(K, np.array([-0.1, 0.02, 0, 0]), (640, 512), T)
    y, _ = camera.project(POINTS)

    def moved(**error: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        return calibration_shifts(perturbed(camera, CalibrationError(**error)), POINTS)

    np.testing.assert_allclose(moved(principal_point=0.5)[..., 0], [[0.5, 0]] * 5, atol=1e-9)
    np.testing.assert_allclose(moved(principal_point=0.5)[..., 1], [[0, 0.5]] * 5, atol=1e-9)
    np.testing.assert_allclose(moved(focal=1e-3)[..., 0], 1e-3 * (y - K[:2, 2]), atol=1e-9)
    assert moved(rotation_deg=0.1, position=1.0, focal=1e-3).shape == (5, 2, 7)
    # about its own y axis by 0.1°: f tan 0.1° in the middle, more by how far off it is
    turned = moved(rotation_deg=0.1)[..., 1]
    assert np.abs(turned[:, 0]) == pytest.approx(900 * np.radians(0.1), rel=0.05)
    # along its own x axis by 1 mm: f / depth, but for the lens
    depth = transform(T, POINTS)[:, 2]
    assert moved(position=1.0)[:, 0, 0] == pytest.approx(900 / depth, rel=0.01)


def test_sensors_of_other_kinds_have_errors_of_their_own() -> None:
    ranges = RangeSensor(np.array([0.0, 0, -1000]))
    error = CalibrationError(range_bias=2.0, position=1.0)
    moved = calibration_shifts(perturbed(ranges, error), POINTS)
    np.testing.assert_allclose(moved[:, 0, 0], 2.0)
    away = (POINTS - ranges.position) / np.linalg.norm(POINTS - ranges.position, axis=1)[:, None]
    # a source that moves towards a point makes its range shorter, to first order
    np.testing.assert_allclose(np.abs(moved[:, 0, 1:]), np.abs(away), atol=2e-3)
    beams = ParallelBeam(0.5, np.array([100.0, 100.0]))
    moved = calibration_shifts(
        perturbed(beams, CalibrationError(principal_point=1.0, focal=0.01)), POINTS
    )
    y, _ = beams.project(POINTS)
    np.testing.assert_allclose(moved[..., :2], [np.eye(2)] * 5, atol=1e-9)
    np.testing.assert_allclose(moved[..., 2], 0.01 * (y - 100), atol=1e-9)


SESSION = """
unit = "mm"
[object]
name = "body"
points = [[0, 0, 0], [95, 12, -8], [-62, 70, 14], [-38, -84, 22], [41, 48, 76], [58, -57, 45]]
[start]
rotation_vector = [0.1, -0.2, 0.3]
translation = [5, -6, 900]
[[sensor]]
name = "camera"
model = "{model}"
source = "camera.csv"
resolution = [640, 512]
{camera}
{error}
"""
MATRIX = "camera_matrix = [[900, 0, 320], [0, 900, 256], [0, 0, 1]]"


def written(folder: Path, error: str, model: str = "pinhole", camera: str = MATRIX) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "session.toml"
    path.write_text(SESSION.format(error=error, model=model, camera=camera), encoding="utf-8")
    return path


def test_a_focal_length_that_is_wrong_is_in_the_covariance_of_the_depth(tmp_path: Path) -> None:
    plain = load_session(written(tmp_path / "draft", ""))
    simulate(plain, tmp_path / "made", SimulationOptions(6, pixel_noise=0.02, seed=3))
    path = tmp_path / "made" / "session.toml"
    exact = list(run(load_session(path)))
    stated = path.read_text(encoding="utf-8") + "calibration_error = { focal = 0.01 }\n"
    path.write_text(stated, encoding="utf-8")
    for one, other in zip(exact, run(load_session(path)), strict=True):
        assert one.T_world_object is not None
        assert other.T_world_object is not None
        assert one.covariance is not None
        assert other.covariance is not None
        np.testing.assert_array_equal(one.T_world_object, other.T_world_object)
        # 1 % of the focal length is 1 % of the distance, 9 mm; perspective tells a little of it
        deviation = np.sqrt(other.covariance[2, 2] - one.covariance[2, 2])
        assert deviation == pytest.approx(0.01 * other.T_world_object[2, 3], rel=0.15)


@pytest.mark.parametrize(
    ("error", "model", "camera", "said"),
    [
        (
            "calibration_error = { range_bias = 1 }",
            "pinhole",
            MATRIX,
            "allowed: all but range_bias",
        ),
        (
            "calibration_error = { focal = 0.1 }",
            "lateration",
            "position = [0, 0, 0]",
            "allowed: position, range_bias",
        ),
        ("calibration_error = { focal = -1 }", "pinhole", MATRIX, "a share, from 0 to 0.5"),
        ("calibration_error = { focus = 1 }", "pinhole", MATRIX, "focal"),
    ],
    ids=["of a range", "of a camera", "negative", "unknown"],
)
def test_an_error_that_a_sensor_cannot_have_is_refused(
    error: str, model: str, camera: str, said: str, tmp_path: Path
) -> None:
    path = written(tmp_path, error, model, camera)
    if model == "lateration":
        path.write_text(path.read_text().replace("resolution = [640, 512]\n", ""))
    done = command("check", path)
    assert done.returncode == 2
    assert "calibration_error" in done.stderr
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


def test_nothing_stated_is_nothing(tmp_path: Path) -> None:
    for text in ("", "calibration_error = {}", "calibration_error = { focal = 0 }"):
        assert load_session(written(tmp_path, text)).sensors[0].calibration_error is None
    stated = load_session(written(tmp_path, "calibration_error = { position = 2 }")).sensors[0]
    assert stated.calibration_error == replace(CalibrationError(), position=2.0)
