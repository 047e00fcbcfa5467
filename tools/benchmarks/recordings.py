"""Sessions and simulated recordings of cameras that look at a body from one metre."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.search_cases import looking_at
from mixpose.frames import read_image
from mixpose.session import Session, load_session
from mixpose.simulation import SimulationOptions, simulate

Floats: TypeAlias = NDArray[np.float64]

# eight markers in a box of 200 mm, without symmetry
MARKERS = [
    [-100.0, -60.0, -80.0], [95.0, -75.0, -55.0], [20.0, 100.0, -90.0], [-70.0, 80.0, 30.0],
    [100.0, 55.0, 40.0], [-20.0, -95.0, 70.0], [60.0, -10.0, 100.0], [-90.0, -5.0, 95.0],
]  # fmt: skip
DISTANCE = 1000.0
EYES = (
    [0.0, -DISTANCE, 0.0], [DISTANCE, 0.0, 0.0],
    [-0.6 * DISTANCE, -0.5 * DISTANCE, 0.6 * DISTANCE],
    [0.5 * DISTANCE, -0.6 * DISTANCE, 0.6 * DISTANCE],
)  # fmt: skip
NAMES = ("left", "right", "above", "beside")


def session_text(
    sources: Sequence[str],
    resolution: tuple[int, int],
    focal: float,
    *,
    fps: float = 50.0,
    markers: int | None = None,
    points: Sequence[Sequence[float]] | None = None,
    shape: str = "",
    eyes: Sequence[Sequence[float]] = EYES,
) -> str:
    """A session of one camera to four, the body's first pose given."""
    turn = Rotation.from_euler("xyz", [0.2, -0.3, 0.4]).as_rotvec().tolist()
    lines = [
        'unit = "mm"', "[object]", 'name = "body"', shape,
        f"points = {list(points or MARKERS)[:markers]}",
        "[start]", f"rotation_vector = {turn}", "translation = [0, 0, 0]",
        "rotation_deg = 10", "distance = 20",
    ]  # fmt: skip
    centre = [(side - 1) / 2 for side in resolution]
    K = [[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]]
    for name, source, eye in zip(NAMES, sources, eyes):
        T = looking_at(np.array(eye), np.zeros(3))
        lines += [
            "[[sensor]]", f'name = "{name}"', 'model = "pinhole"', f"source = {source}",
            f"fps = {fps}", f"resolution = {list(resolution)}", f"camera_matrix = {K}",
            f"T_sensor_world = {T.tolist()}",
        ]  # fmt: skip
    return "\n".join(lines) + "\n"


def write_session(path: Path, text: str) -> Session:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return load_session(path)


def simulated(folder: Path, text: str, options: SimulationOptions) -> Session:
    """The session of a recording that is made in a folder."""
    plan = write_session(folder.with_name(folder.name + "-plan") / "session.toml", text)
    simulate(plan, folder, options)
    return load_session(folder / "session.toml")


def write_mjpeg(path: Path, images: Sequence[Path], fps: float) -> None:
    """A Motion JPEG video of grey images."""
    height, width = read_image(images[0]).shape
    code = cv2.VideoWriter.fourcc(*"MJPG")
    video = cv2.VideoWriter(str(path), code, fps, (width, height), isColor=False)
    assert video.isOpened(), "OpenCV writes Motion JPEG by itself"
    for image in images:
        video.write(read_image(image))
    video.release()
