"""Thirty bodies before eight cameras, of them twenty equal: what a frame costs, and who is who.

Bodies of four and five markers move through a room at up to 2 m/s, are hidden by each other marker
by marker, leave and come back; spots that are too near to each other are one.  Frames come 60 times
a second.  Nothing is told of where any body begins.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from several_bodies import (
    NOISE_PX,
    Setup,
    by_frame,
    camera_at,
    is_right,
    merged,
    random_body,
)

import mixpose
from benchmarks.timing import show
from mixpose.records import Estimate
from mixpose.rigid import from_parts, transform

Floats: TypeAlias = NDArray[np.float64]

EQUAL, OTHERS, CAMERAS = 20, 10, 8
ROOM = np.array([1500.0, 700.0, 1500.0])  # mm, each way from the middle
AWAY_MM = 4500.0
HIDDEN, FRAMES_HIDDEN = 0.1, 12  # share of markers that a camera does not see, for so long
LAMPS = 6
FPS = 60.0
FOCAL = 1800.0  # px, of four megapixels: a room of 3 m is in view


@dataclass(frozen=True)
class Crowd:
    """What is there in each of F frames of n bodies."""

    poses: Floats  # (F, n, 4, 4)
    present: NDArray[np.bool_]  # (F, n)
    seen: NDArray[np.bool_]  # (F, n): three markers or more are shown by two cameras each


def setup_of(rng: np.random.Generator, equal: int, others: int) -> Setup:
    """One kind of which there are many, and others, before cameras all around."""
    bodies = [random_body(rng, 5)] + [
        random_body(rng, int(rng.integers(4, 6))) for _ in range(others)
    ]
    cameras = {}
    for k in range(CAMERAS):
        there = camera_at(360.0 * k / CAMERAS, 15.0 + 10.0 * (k % 2), AWAY_MM)
        K, wide = np.array([[FOCAL, 0, 1023.5], [0, FOCAL, 1023.5], [0, 0, 1.0]]), (2048, 2048)
        cameras[f"cam{k}"] = replace(there, camera_matrix=K, resolution=wide)
    return Setup(cameras, bodies, [equal] + [1] * others)


def paths(rng: np.random.Generator, bodies: int, frames: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Poses (F, n, 4, 4), and which bodies are there (F, n); each is away for a while."""
    t = np.arange(frames)[:, None, None] / FPS
    phases, periods = rng.uniform(0, 2 * np.pi, (bodies, 3)), rng.uniform(5.0, 12.0, (bodies, 3))
    places = ROOM * np.sin(phases + 2 * np.pi * t / periods)
    axes = rng.standard_normal((bodies, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    angles = 1.2 * np.sin(2 * np.pi * t[..., 0] / rng.uniform(2.0, 6.0, bodies))
    begun = Rotation.random(bodies, rng=rng)
    poses = np.empty((frames, bodies, 4, 4))
    for frame, k in np.ndindex(frames, bodies):
        R = (Rotation.from_rotvec(angles[frame, k] * axes[k]) * begun[k]).as_matrix()
        poses[frame, k] = from_parts(R, places[frame, k])
    present = np.ones((frames, bodies), dtype=np.bool_)
    for k in range(bodies):
        for first in rng.integers(20, max(frames, 21), max(frames // 500, 1)):
            present[first : first + int(rng.integers(30, 120)), k] = False
    return poses, present


def record(setup: Setup, frames: int, folder: Path, rng: np.random.Generator) -> Crowd:
    """Write what cameras detect, and the session."""
    kinds = setup.kinds
    poses, present = paths(rng, len(kinds), frames)
    whose = np.concatenate([np.full(len(setup.bodies[k]), n) for n, k in enumerate(kinds)])
    lamps = rng.uniform(-2 * ROOM, 2 * ROOM, (LAMPS, 3))
    views = np.zeros((frames, len(whose)), dtype=int)
    lines: dict[str, list[str]] = {name: [] for name in setup.cameras}
    hidden = {name: np.zeros(len(whose), dtype=int) for name in setup.cameras}  # frames left
    for frame in range(frames):
        world = np.concatenate(
            [transform(T, setup.bodies[k]) for k, T in zip(kinds, poses[frame], strict=True)]
        )
        for name, camera in setup.cameras.items():
            left = hidden[name]
            np.maximum(left - 1, 0, out=left)
            left[rng.uniform(size=len(left)) < HIDDEN / FRAMES_HIDDEN] = FRAMES_HIDDEN
            y, in_view = camera.project(world)
            shown = in_view & (left == 0) & present[frame, whose]
            views[frame] += shown
            z, lit = camera.project(lamps)
            spots = merged(np.concatenate([y[shown], z[lit]]))
            spots = rng.permutation(spots + NOISE_PX * rng.standard_normal(spots.shape))
            inside = ((spots > 0) & (spots < np.array(camera.resolution or (0, 0)) - 1)).all(axis=1)
            lines[name] += [f"{frame},{u:.3f},{v:.3f}\n" for u, v in spots[inside]]
    for name, own in lines.items():
        (folder / f"{name}.csv").write_text("frame,u,v\n" + "".join(own))
    (folder / "session.toml").write_text(setup.session().replace("fps = 50", f"fps = {FPS:g}"))
    seen = np.stack(
        [(views[:, whose == n] >= 2).sum(axis=1) >= 3 for n in range(len(kinds))], axis=1
    )
    return Crowd(poses, present, seen)


class Tally:
    """Which body each estimate was of, and what was told of those that can be seen."""

    def __init__(self, setup: Setup, crowd: Crowd, bodies: Sequence[mixpose.Body]) -> None:
        self.counts: Counter[str] = Counter()
        self._crowd, self._bodies, self._kinds = crowd, bodies, np.array(setup.kinds)
        self._held: dict[int, tuple[int, int]] = {}  # label: body and frame

    def add(self, frame: int, estimates: Sequence[Estimate]) -> None:
        """One frame, estimates in the order of the session."""
        crowd, counts = self._crowd, self.counts
        found = set[int]()
        for k, estimate in enumerate(estimates):
            counts[estimate.status] += 1
            if estimate.T_world_object is None:
                continue
            alike = np.flatnonzero((self._kinds == self._kinds[k]) & crowd.present[frame])
            away = crowd.poses[frame, alike, :3, 3] - estimate.T_world_object[:3, 3]
            n = int(alike[np.linalg.norm(away, axis=1).argmin()]) if len(alike) else -1
            symmetries = self._bodies[self._kinds[k]].symmetries
            if n < 0 or not is_right(estimate, crowd.poses[frame, n], symmetries):
                counts["wrong and ok"] += estimate.status == "ok"
                continue
            found.add(n)
            counts["right"] += bool(crowd.seen[frame, n])
            counts["right and ok"] += bool(crowd.seen[frame, n] and estimate.status == "ok")
            if estimate.status == "ok":
                self._follow(frame, k, n)
        counts["there"] += int(crowd.seen[frame].sum())

    def _follow(self, frame: int, k: int, n: int) -> None:
        last, since = self._held.get(k, (n, frame))
        if last != n and self._crowd.seen[since : frame + 1, last].all():
            self.counts["swaps"] += 1
        self._held[k] = n, frame


def measured(frames: int, equal: int, others: int, seed: int) -> Mapping[str, float]:
    """Shares of bodies in view that are right, errors, and milliseconds per frame."""
    rng = np.random.default_rng(seed)
    setup = setup_of(rng, equal, others)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        crowd = record(setup, frames, folder, rng)
        session = mixpose.load_session(folder / "session.toml")
        tally, times, began = (
            Tally(setup, crowd, [one.body for one in session.objects]),
            list[float](),
            0.0,
        )
        began = time.process_time()
        for frame, estimates in enumerate(by_frame(session)):
            times.append(1e3 * (time.process_time() - began))
            tally.add(frame, estimates)
            began = time.process_time()
    counts = tally.counts
    return {
        "right": counts["right"] / counts["there"],
        "right_and_ok": counts["right and ok"] / counts["there"],
        "wrong_and_ok": counts["wrong and ok"],
        "swaps": counts["swaps"],
        "first_ms": times[0],
        "ms": float(np.mean(times[1:])),
        "slowest_ms": max(times[1:]),
    }


def run(options: argparse.Namespace) -> dict[str, Any]:
    print(f"many: {EQUAL} equal bodies and {OTHERS} others, {CAMERAS} cameras, from nothing")
    figures = measured(options.trials, EQUAL, OTHERS, seed=0)
    show("right, of those that two cameras see, %", 100 * figures["right"], at_least=99.0)
    show("right and ok, %", 100 * figures["right_and_ok"])
    show("wrong and ok", figures["wrong_and_ok"], at_most=0)
    show("swaps while markers last", figures["swaps"], at_most=0)
    show("ms of processor time per frame", figures["ms"], at_most=30.0)
    show("the first frame, ms", figures["first_ms"])
    show("the slowest after it, ms", figures["slowest_ms"])
    return dict(figures)
