"""Studies of several bodies in one scene: how many poses are right, and whether identities hold.

    python tools/several_bodies.py scenes [--count 200] [--frames 5] [--seed 0]
    python tools/several_bodies.py crossing [--bodies 10] [--frames 500] [--seed 0]
    python tools/several_bodies.py parting [--count 60] [--seed 0]

`scenes` makes scenes of two to six bodies of four to six markers before two cameras, with two
hidden markers and four false ones in each view, and estimates their first frames from nothing.
`crossing` lets identical bodies of five markers cross each other's paths before four cameras.
`parting` has pairs of bodies that stay near each other, as limbs do, until the one of four markers
is hidden; then it is back beside the other, or somewhere else, or gone.
What is recorded shares nothing with the estimator but the cameras' geometry.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import mixpose
from mixpose.records import Estimate
from mixpose.rigid import from_parts, transform, twist_between
from mixpose.sensors import PinholeCamera

Floats: TypeAlias = NDArray[np.float64]
Motion: TypeAlias = Callable[[int], list[Floats]]

FOCAL, RESOLUTION, NOISE_PX = 1000.0, (1280, 1024), 0.2
RIGHT_DEG, RIGHT_MM = 5.0, 10.0
APART_PX = 4.0  # spots nearer than this are found as one
PARTED = 48, 68  # frames: when a body is back, or not, and the end


@dataclass(frozen=True)
class Setup:
    """Cameras and bodies; `counts` says how many there are of each."""

    cameras: dict[str, PinholeCamera]
    bodies: list[Floats]
    counts: list[int]

    def session(self) -> str:
        """The session file."""
        parts = ['unit = "mm"']
        for k, (points, count) in enumerate(zip(self.bodies, self.counts, strict=True)):
            many = f"\ncount = {count}" if count > 1 else ""
            parts.append(f'[[object]]\nname = "body{k}"{many}\npoints = {points.tolist()}')
        for name, camera in self.cameras.items():
            K, size = camera.camera_matrix.tolist(), list(camera.resolution or RESOLUTION)
            parts.append(
                f'[[sensor]]\nname = "{name}"\nmodel = "pinhole"\nsource = "{name}.csv"\n'
                f"resolution = {size}\nfps = 50\ncamera_matrix = {K}\n"
                f"T_sensor_world = {camera.T_sensor_world.tolist()}"
            )
        return "\n\n".join(parts) + "\n"

    @property
    def kinds(self) -> list[int]:
        """The body that each pose is of."""
        return [k for k, count in enumerate(self.counts) for _ in range(count)]


def camera_at(angle_deg: float, height_deg: float, away: float) -> PinholeCamera:
    """A camera that looks at the origin."""
    K = np.array([[FOCAL, 0, 639.5], [0, FOCAL, 511.5], [0, 0, 1.0]])
    turn = Rotation.from_euler("xy", [height_deg, angle_deg], degrees=True)
    T = from_parts(turn.as_matrix(), np.array([0.0, 0.0, away]))
    return PinholeCamera(K, np.zeros(5), RESOLUTION, T)


def record(
    setup: Setup,
    motion: Motion,
    frames: int,
    folder: Path,
    rng: np.random.Generator,
    *,
    hidden: int,
    false: int,
) -> list[list[Floats]]:
    """Write tables of detections and the session, and return the true poses of each frame."""
    rows: dict[str, list[str]] = {name: [] for name in setup.cameras}
    truth = [motion(frame) for frame in range(frames)]
    for frame, poses in enumerate(truth):
        world = np.concatenate(
            [transform(T, setup.bodies[k]) for k, T in zip(setup.kinds, poses, strict=True)]
        )
        for name, camera in setup.cameras.items():
            y, seen = camera.project(world)
            shown = np.flatnonzero(seen)
            shown = rng.permutation(shown)[hidden:] if hidden else shown
            spots = merged(y[shown])
            spots = spots + NOISE_PX * rng.standard_normal(spots.shape)
            spots = np.concatenate([spots, rng.uniform((0, 0), RESOLUTION, (false, 2))])
            rows[name] += [f"{frame},{u:.3f},{v:.3f}\n" for u, v in rng.permutation(spots)]
    for name, lines in rows.items():
        (folder / f"{name}.csv").write_text("frame,u,v\n" + "".join(lines))
    (folder / "session.toml").write_text(setup.session())
    return truth


def merged(y: Floats) -> Floats:
    """Spots that are seen as one, in their middle, where they lie very near each other."""
    left = list(range(len(y)))
    spots = []
    while left:
        i = left.pop(0)
        near = [j for j in left if np.linalg.norm(y[j] - y[i]) < APART_PX]
        left = [j for j in left if j not in near]
        spots.append(y[[i, *near]].mean(axis=0))
    return np.array(spots).reshape(-1, 2)


def random_body(rng: np.random.Generator, count: int) -> Floats:
    """Markers in a box of 120 mm, no two nearer than 30 mm."""
    points = np.zeros((0, 3))
    while len(points) < count:
        new = rng.uniform(-60, 60, 3)
        if not len(points) or np.linalg.norm(points - new, axis=1).min() > 30:
            points = np.concatenate([points, new[None]])
    return np.round(points, 3)


def places_apart(rng: np.random.Generator, count: int, apart: float) -> Floats:
    """Places in the common view, no two nearer than `apart`."""
    places = np.zeros((0, 3))
    while len(places) < count:
        new = rng.uniform((-260, -200, -150), (260, 200, 150))
        if not len(places) or np.linalg.norm(places - new, axis=1).min() > apart:
            places = np.concatenate([places, new[None]])
    return places


def scene(seed: int) -> tuple[Setup, Motion, np.random.Generator]:
    """Two to six bodies before two cameras, in slow motion."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 7))
    bodies = [random_body(rng, int(rng.integers(4, 7))) for _ in range(count)]
    cameras = {"left": camera_at(30, 10, 1200), "right": camera_at(-30, -10, 1200)}
    places = places_apart(rng, count, 110.0)
    turns = Rotation.random(count, rng=rng)
    shifts, spins = rng.uniform(-2, 2, (count, 3)), rng.uniform(-0.02, 0.02, (count, 3))

    def motion(frame: int) -> list[Floats]:
        turned = (Rotation.from_rotvec(frame * spins) * turns).as_matrix()
        return [from_parts(R, p + frame * v) for R, p, v in zip(turned, places, shifts)]

    return Setup(cameras, bodies, [1] * count), motion, rng


def crossing(seed: int, count: int, frames: int) -> tuple[Setup, Motion, np.random.Generator]:
    """Identical bodies that cross a common place again and again, at heights of their own."""
    rng = np.random.default_rng(seed)
    body = random_body(rng, 5)
    cameras = {
        f"cam{i}": camera_at(angle, tilt, 1500)
        for i, (angle, tilt) in enumerate([(0, 15), (60, -10), (-60, 10), (150, -15)])
    }
    directions = rng.uniform(0, 2 * np.pi, count)
    heights = np.linspace(-220, 220, count)
    phases, periods = rng.uniform(0, 2 * np.pi, count), rng.uniform(120, 200, count)
    turns = Rotation.random(count, rng=rng)
    axes, swings = rng.standard_normal((count, 3)), rng.uniform(0, 2 * np.pi, count)

    def motion(frame: int) -> list[Floats]:
        poses = []
        for k in range(count):
            along = 280 * np.sin(phases[k] + 2 * np.pi * frame / periods[k])
            place = along * np.array([np.cos(directions[k]), 0.0, np.sin(directions[k])])
            place[1] = heights[k] * np.cos(2 * np.pi * frame / 260 + k)
            angle = 0.6 * np.sin(2 * np.pi * frame / 90 + swings[k])
            R = Rotation.from_rotvec(angle * axes[k] / np.linalg.norm(axes[k])) * turns[k]
            poses.append(from_parts(R.as_matrix(), place))
        return poses

    return Setup(cameras, [body], [count]), motion, rng


def parting(seed: int) -> tuple[Setup, Motion, np.random.Generator]:
    """Two bodies side by side in quick motion, and what becomes of the second one after a while."""
    rng = np.random.default_rng(seed)
    bodies = [random_body(rng, 6), random_body(rng, 4)]
    cameras = {"left": camera_at(30, 10, 1200), "right": camera_at(-30, -10, 1200)}
    beside = rng.uniform(100, 140) * np.array([1.0, 0.3, 0.0])
    turns, axes = Rotation.random(2, rng=rng), rng.standard_normal((2, 3))
    phases, swings = rng.uniform(0, 6, 4), rng.normal(0, 0.15, (PARTED[1], 6))
    away = [-np.sign(beside) * rng.uniform(60, 150, 3), rng.uniform(-2, 2, 3)]

    def motion(frame: int) -> list[Floats]:
        along = 120 * np.sin(phases[:3] + frame * np.array([0.9, 0.5, 0.7]))
        turned = Rotation.from_rotvec(0.5 * np.sin(phases[3] + 0.6 * frame) * axes[0])
        first = from_parts((turned * turns[0]).as_matrix(), along)
        swung = (Rotation.from_rotvec(swings[frame, 3:]) * turns[1]).as_matrix()
        second = first @ from_parts(swung, beside + 60 * swings[frame, :3])
        if frame >= PARTED[0] - 8 and (frame < PARTED[0] or seed % 3 == 2):
            second = from_parts(np.eye(3), np.array([0.0, 0.0, 1e6]))  # out of sight
        elif frame >= PARTED[0] and seed % 3 == 1:
            second = from_parts(Rotation.from_rotvec(away[1]).as_matrix(), away[0] + along / 4)
        return [first, second]

    return Setup(cameras, bodies, [1, 1]), motion, rng


def is_right(estimate: Estimate, T_true: Floats, symmetries: Floats) -> bool:
    """Whether a pose is near the true one, or near one that looks the same."""
    T = estimate.T_world_object
    if T is None:
        return False
    away = [twist_between(alike, T) for alike in T_true @ symmetries]
    return any(
        np.linalg.norm(x[:3]) <= RIGHT_MM and np.degrees(np.linalg.norm(x[3:])) < RIGHT_DEG
        for x in away
    )


def by_frame(session: mixpose.Session) -> Iterator[list[Estimate]]:
    """The estimates of each frame."""
    some: list[Estimate] = []
    for estimate in mixpose.run(session):
        some.append(estimate)
        if len(some) == len(session.labels):
            yield some
            some = []


def study_scenes(count: int, frames: int, seed: int) -> int:
    """Poses from nothing, and the frames after."""
    tally: Counter[str] = Counter()
    for k in range(count):
        setup, motion, rng = scene(seed + k)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            truth = record(setup, motion, frames, folder, rng, hidden=2, false=4)
            session = mixpose.load_session(folder / "session.toml")
            bodies = [one.body for one in session.objects]
            for frame, estimates in enumerate(by_frame(session)):
                for estimate, T, body in zip(estimates, truth[frame], bodies, strict=True):
                    right = is_right(estimate, T, body.symmetries)
                    tally["poses"] += 1
                    tally["right"] += right
                    tally[estimate.status] += 1
                    tally["ok and right"] += right and estimate.status == "ok"
                    if estimate.status == "ok" and not right:
                        tally["wrong ok"] += 1
                        print(f"seed {seed + k}, frame {frame}: {estimate.label} is wrong and ok")
        if (k + 1) % 20 == 0:
            print(f"{k + 1} scenes: {said(tally)}", flush=True)
    print(f"{count} scenes of {frames} frames: {said(tally)}")
    return int(tally["wrong ok"] > 0)


def study_parting(count: int, seed: int) -> int:
    """What a body beside another is worth where it was, and where it is no longer."""
    tallies: dict[str, Counter[str]] = {each: Counter() for each in ("beside", "away", "gone")}
    for k in range(count):
        setup, motion, rng = parting(seed + k)
        tally = tallies[list(tallies)[(seed + k) % 3]]
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            truth = record(setup, motion, PARTED[1], folder, rng, hidden=2, false=6)
            session = mixpose.load_session(folder / "session.toml")
            for frame, (_, estimate) in enumerate(by_frame(session)):
                right = is_right(estimate, truth[frame][1], np.eye(4)[None])
                if estimate.status == "ok" and not right:
                    tally["wrong ok"] += 1
                    print(f"seed {seed + k}, frame {frame}: {estimate.label} is wrong and ok")
                if frame >= PARTED[0]:
                    tally["poses"] += 1
                    tally["right"] += right
                    tally[estimate.status] += 1
                    tally["ok and right"] += right and estimate.status == "ok"
    for what, tally in tallies.items():
        print(f"{what} after {PARTED[0]} frames: {said(tally)}")
    return int(any(tally["wrong ok"] for tally in tallies.values()))


def said(tally: Counter[str]) -> str:
    """Counts in words."""
    shares = {key: 100 * tally[key] / max(tally["poses"], 1) for key in ("right", "ok and right")}
    return (
        f"{tally['poses']} poses: {shares['right']:.2f} % right, {shares['ok and right']:.2f} % "
        f"right and ok; {tally['ambiguous']} ambiguous, {tally['lost']} lost, "
        f"{tally['wrong ok']} wrong and ok"
    )


def study_crossing(count: int, frames: int, seed: int) -> int:
    """Identical bodies: which is which, from the first frame to the last."""
    setup, motion, rng = crossing(seed, count, frames)
    tally: Counter[str] = Counter()
    holds: dict[int, int] = {}
    doubted: set[int] = set()
    began = time.process_time()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        truth = record(setup, motion, frames, folder, rng, hidden=0, false=0)
        session = mixpose.load_session(folder / "session.toml")
        for frame, estimates in enumerate(by_frame(session)):
            places = np.array([T[:3, 3] for T in truth[frame]])
            for k, estimate in enumerate(estimates):
                tally[estimate.status] += 1
                if estimate.status != "ok":
                    doubted.add(k)
                if estimate.T_world_object is None:
                    continue
                away = np.linalg.norm(places - estimate.T_world_object[:3, 3], axis=1)
                now = int(np.argmin(away))
                if not is_right(estimate, truth[frame][now], session.body.symmetries):
                    tally["wrong"] += 1
                    tally["wrong ok"] += estimate.status == "ok"
                    continue
                if holds.get(k, now) != now:
                    tally["swaps"] += 1
                    tally["unannounced"] += k not in doubted
                    print(f"frame {frame}: {estimate.label} goes on as another one")
                holds[k] = now
                if estimate.status == "ok":
                    doubted.discard(k)
    ms = 1e3 * (time.process_time() - began) / frames
    print(
        f"{count} bodies, {frames} frames: {tally['ok']} ok, {tally['ambiguous']} ambiguous, "
        f"{tally['lost']} lost; {tally['wrong']} wrong, {tally['wrong ok']} of them ok; "
        f"{tally['swaps']} swaps, {tally['unannounced']} unannounced; {ms:.0f} ms per frame"
    )
    return int(tally["unannounced"] + tally["wrong ok"] > 0)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    studies = parser.add_subparsers(dest="study", required=True)
    scenes = studies.add_parser("scenes")
    scenes.add_argument("--count", type=int, default=200)
    scenes.add_argument("--frames", type=int, default=5)
    crossings = studies.add_parser("crossing")
    crossings.add_argument("--bodies", type=int, default=10)
    crossings.add_argument("--frames", type=int, default=500)
    partings = studies.add_parser("parting")
    partings.add_argument("--count", type=int, default=60)
    for each in (scenes, crossings, partings):
        each.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    if chosen.study == "scenes":
        return study_scenes(chosen.count, chosen.frames, chosen.seed)
    if chosen.study == "parting":
        return study_parting(chosen.count, chosen.seed)
    return study_crossing(chosen.bodies, chosen.frames, chosen.seed)


if __name__ == "__main__":
    sys.exit(main())
