"""What tests share: the paper's body and cameras, and the folder of real recordings."""

from __future__ import annotations

import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported, as the command line
# where no bytecode is kept, each process that a test starts compiles the package anew: 0.15 s
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.body import Body, PointFeature
from mixpose.sensors import ParallelBeam, PinholeCamera, RangeSensor

PAPER_POINTS = np.array(
    [
        [0, -25, -43.3],
        [100, -25, -43.3],
        [0, 61.6, -93.3],
        [100, 111.6, -6.7],
        [100, 25, 43.3],
        [0, 111.6, -6.7],
    ]
)


def look_at(eye: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """T_sensor_world of a camera at `eye` that looks at `target`."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.array([right, np.cross(forward, right), forward])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ eye
    return T


@pytest.fixture
def paper_body() -> Body:
    return Body("paper", tuple(PointFeature(point) for point in PAPER_POINTS))


@pytest.fixture
def soft_paper_body() -> Body:
    return Body("paper", tuple(PointFeature(point, 25.0 * np.eye(3)) for point in PAPER_POINTS))


@pytest.fixture
def parallel_cameras() -> list[ParallelBeam]:
    cameras = []
    for gamma in (0.0, np.pi / 2):
        c, s = np.cos(gamma), np.sin(gamma)
        T = np.eye(4)
        T[:3, :3] = [[c, s, 0], [0, 0, 1], [s, -c, 0]]
        cameras.append(ParallelBeam(1.0, np.array([200.0, 200.0]), (401, 401), T))
    return cameras


@pytest.fixture
def pinhole_cameras() -> list[PinholeCamera]:
    K = np.array([[900.0, 0, 639.5], [0, 900.0, 511.5], [0, 0, 1]])
    lens = np.array([-0.1, 0.02, 1e-4, -2e-4])
    centre = np.array([50.0, 40.0, 0.0])
    eyes = (np.array([50.0, -900.0, 100.0]), np.array([900.0, 40.0, -50.0]))
    return [PinholeCamera(K, lens, (1280, 1024), look_at(eye, centre)) for eye in eyes]


@pytest.fixture
def range_sensors() -> list[RangeSensor]:
    positions = np.array([[0, -1000.0, 0], [1000.0, 0, 0], [0, 0, 1000.0]])
    return [RangeSensor(position) for position in positions]


@pytest.fixture
def recordings() -> Path:
    folder = os.environ.get("MIXPOSE_RECORDINGS")
    if not folder:
        pytest.skip("MIXPOSE_RECORDINGS names no folder of real recordings")
    return Path(folder)


@pytest.fixture
def without_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """No charts in reports and on the sheet of `inspect`, which take longer than all the rest."""
    plain = np.zeros((4, 4, 3), np.uint8)
    monkeypatch.setattr("mixpose.pictures.sheet.objective_around", lambda *_: ((), ()))
    monkeypatch.setattr("mixpose.pictures.sheet.objective_picture", lambda *_: plain)
    monkeypatch.setattr("mixpose.report.figures.svg_of", lambda _: "<svg></svg>")
