"""What is done to a finished recording: painted over, or told otherwise than it was."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from benchmarks.recordings import MARKERS
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mixpose.frames import read_image
from mixpose.poses.jsonl import read_poses
from mixpose.rigid import transform
from mixpose.session import load_session

Floats: TypeAlias = NDArray[np.float64]

COVERED = range(16, 24)  # frames in which the body is covered


def arm(folder: Path, seed: int) -> None:
    """Paint a dark arm over all images, which sweeps across them."""
    rng = np.random.default_rng([seed, 7])
    for camera in range(2):
        angle, speed = rng.uniform(0, np.pi), rng.uniform(5, 9)
        along = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([-along[1], along[0]])
        for k, path in enumerate(sorted(folder.glob(f"c{camera}_*.png"))):
            image = read_image(path)
            middle = np.array([319.5, 255.5]) + across * (speed * (k - 20))
            mask = np.zeros_like(image)
            ends = [tuple(np.round(16 * (middle + s * 900 * along)).astype(int)) for s in (-1, 1)]
            cv2.line(mask, ends[0], ends[1], 255, 24, cv2.LINE_AA, 4)
            share = cv2.GaussianBlur(mask, (0, 0), 1.0).astype(np.float64) / 255
            dark = 10 + rng.normal(0, 1, image.shape)
            cv2.imwrite(str(path), np.clip(image + share * (dark - image) + 0.5, 0, 255))


def covered(folder: Path, seed: int) -> None:
    """Cover the body for some frames, and not what mirrors it."""
    session = load_session(folder / "session.toml")
    truth = {one.frame: one.T_world_object for one in read_poses(folder / "truth.jsonl").poses}
    for frame in COVERED:
        T = truth.get(frame)
        if T is None:
            continue
        for k, setup in enumerate(session.sensors):
            path = sorted(folder.glob(f"c{k}_*.png"))[frame]
            image = read_image(path)
            dark = int(np.median(image))
            for u, v in setup.sensor.project(transform(T, session.body.means))[0]:
                if np.isfinite([u, v]).all() and abs(u) + abs(v) < 1e4:
                    cv2.circle(image, (round(float(u)), round(float(v))), 14, dark, -1)
            cv2.imwrite(str(path), image)


def turned(folder: Path, seed: int) -> None:
    """Turn the last camera by 0.1° after its calibration, about any axis."""
    axis = np.random.default_rng([seed, 9]).normal(size=3)
    turn = Rotation.from_rotvec(0.1 * axis / np.linalg.norm(axis), degrees=True).as_matrix()
    _last_placed(folder, lambda T: np.vstack([turn @ T[:3], T[3]]))


def _last_placed(folder: Path, change: Callable[[Floats], Floats]) -> None:
    lines = (folder / "session.toml").read_text(encoding="utf-8").splitlines()
    k = max(k for k, line in enumerate(lines) if line.startswith("T_sensor_world"))
    T = np.array(json.loads(lines[k].split("=")[1]))
    lines[k] = f"T_sensor_world = {change(T).tolist()}"
    (folder / "session.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def bad_lens(folder: Path, seed: int) -> None:
    """Tell the session another principal point, focal length and distortion than there were."""
    told_otherwise(
        folder,
        [
            ("[[900.0, 0, 319.5], [0, 900.0, 255.5]", "[[900.4, 0, 319.9], [0, 900.2, 255.2]"),
            ("distortion = [0.0,", "distortion = [0.002,"),
        ],
    )


def bad_body(folder: Path, seed: int) -> None:
    """Tell the session markers that are off by 0.1 mm."""
    off = np.array(MARKERS) + np.random.default_rng([seed, 8]).normal(0, 0.1, (len(MARKERS), 3))
    told_otherwise(folder, [(f"points = {MARKERS}", f"points = {off.tolist()}")])


def told_otherwise(folder: Path, pairs: Iterable[tuple[str, str]]) -> None:
    """Replace texts of the session.

    Raises
    ------
    RuntimeError
        If one is not there.
    """
    path = folder / "session.toml"
    text = path.read_text(encoding="utf-8")
    for old, new in pairs:
        if old not in text:
            raise RuntimeError(f"{old} is not in the session")
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")
