"""Recordings of bodies that move before cameras, made without what learns bodies from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
CAMERA_MATRIX = np.array([[1200.0, 0, 639.5], [0, 1200, 511.5], [0, 0, 1]])
RESOLUTION = (1280, 1024)


@dataclass(frozen=True)
class Scene:
    """What a recording shows.

    Attributes
    ----------
    frames : int
    noise : float
        Of detections, px.
    hidden : float
        Chance that a marker is not seen by a camera.
    still : int
        Other markers that stand still.
    false : int
        False detections of each camera and frame.
    turn_deg, travel : float
        About how far bodies turn and move, mm.
    """

    frames: int = 100
    noise: float = 0.15
    hidden: float = 0.1
    still: int = 4
    false: int = 3
    turn_deg: float = 50.0
    travel: float = 90.0


def camera(azimuth_deg: float, distance: float = 1000.0, height: float = 250.0) -> Array:
    """T_sensor_world of a camera that looks at the world's origin, at 1 m."""
    azimuth = np.radians(azimuth_deg)
    eye = np.array([np.cos(azimuth), np.sin(azimuth), height / distance]) * distance
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.array([right, np.cross(forward, right), forward])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ eye
    return T


def body(
    markers: int, rng: np.random.Generator, radius: float = 60.0, apart: float = 18.0
) -> Array:
    """Markers (N, 3) at random, none near another."""
    points = np.zeros((0, 3))
    while len(points) < markers:
        new = rng.uniform(-radius, radius, (1, 3))
        if not len(points) or np.linalg.norm(points - new, axis=1).min() > apart:
            points = np.concatenate([points, new])
        if len(points) == 3 and np.linalg.svd(points - points.mean(axis=0))[1][1] < 15:
            points = points[:0]  # three on a line fix no turn
    return points


def motion(scene: Scene, rng: np.random.Generator) -> Array:
    """Poses (K, 4, 4) along a smooth path of sines."""
    t = np.linspace(0, 2 * np.pi, scene.frames, endpoint=False)
    waves = rng.uniform(0.5, 3.0, (6, 2)), rng.uniform(0, 2 * np.pi, (6, 2))
    path = np.array([np.sin(np.outer(t, f) + p).sum(axis=1) / 1.4 for f, p in zip(*waves)])
    T = np.tile(np.eye(4), (scene.frames, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.radians(scene.turn_deg) * path[:3].T).as_matrix()
    T[:, :3, 3] = scene.travel * path[3:].T
    return T


def detections(
    bodies: Sequence[tuple[Array, Array]], cameras: Sequence[Array], scene: Scene, seed: int
) -> list[list[Array]]:
    """What cameras detect in each frame, in no order.

    Parameters
    ----------
    bodies : sequence of (markers (N, 3), poses (K, 4, 4))
    cameras : sequence of (4, 4) array
    scene : Scene
    seed : int
    """
    rng = np.random.default_rng(seed)
    still = rng.uniform(-250, 250, (scene.still, 3))
    frames = []
    for k in range(scene.frames):
        moved = [points @ T[k, :3, :3].T + T[k, :3, 3] for points, T in bodies]
        world = np.concatenate([*moved, still])
        views = []
        for T in cameras:
            turn = cv2.Rodrigues(T[:3, :3])[0]
            pixels = cv2.projectPoints(world, turn, T[:3, 3], CAMERA_MATRIX, None)[0][:, 0]
            seen = pixels[rng.random(len(pixels)) >= scene.hidden]
            seen = seen + scene.noise * rng.standard_normal(seen.shape)
            false = rng.uniform((0, 0), RESOLUTION, (scene.false, 2))
            views.append(rng.permutation(np.concatenate([seen, false])))
        frames.append(views)
    return frames


def write_recording(
    folder: Path, frames: Sequence[Sequence[Array]], cameras: Sequence[Array]
) -> Path:
    """Write tables of detections and a session that names a body which is not there yet."""
    lines = ['unit = "mm"', "[object]", 'name = "tool"', 'file = "body.csv"', "[extract]"]
    lines += ["sigma = 1.0"]
    for index, T in enumerate(cameras):
        rows = ["frame,u,v"]
        for k, views in enumerate(frames):
            rows += [f"{k},{u:.4f},{v:.4f}" for u, v in views[index].tolist()]
        (folder / f"cam{index}.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
        lines += [
            *("[[sensor]]", f'name = "cam{index}"', 'model = "pinhole"'),
            f'source = "cam{index}.csv"',
            f"camera_matrix = {CAMERA_MATRIX.tolist()}",
            f"resolution = {list(RESOLUTION)}",
            f"T_sensor_world = {T.tolist()}",
        ]
    path = folder / "session.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def aligned_errors(found: Array, true: Array) -> Array:
    """Differences (N, 3) of markers in any frame and order from the true ones, best aligned.

    Partners are those whose distances to all others are most alike.
    """
    from itertools import permutations

    if len(found) != len(true):
        raise AssertionError(f"found {len(found)} markers of {len(true)}")
    best, kept = np.inf, np.zeros((0, 3))
    sides = np.linalg.norm(true[:3, None] - true[None, :3], axis=2)
    for triple in permutations(range(len(found)), 3):
        own = np.linalg.norm(found[list(triple), None] - found[None, list(triple)], axis=2)
        if np.abs(own - sides).max() > 2.0:
            continue
        R, t = _motion(found[list(triple)], true[:3])
        moved = found @ R.T + t
        partner = np.linalg.norm(true[:, None] - moved[None], axis=2).argmin(axis=1)
        if len(set(partner.tolist())) < len(true):
            continue
        R, t = _motion(found[partner], true)
        away = found[partner] @ R.T + t - true
        if (away**2).sum() < best:
            best, kept = float((away**2).sum()), away
    if not np.isfinite(best):
        raise AssertionError("found no congruent body")
    return kept


def _motion(source: Array, target: Array) -> tuple[Array, Array]:
    a, b = source.mean(axis=0), target.mean(axis=0)
    R = Rotation.align_vectors(target - b, source - a)[0].as_matrix()
    return R, b - R @ a


def size_of(points: Array) -> float:
    """Largest distance of two markers."""
    return float(pdist(points).max())
