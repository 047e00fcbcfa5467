"""Whether a calibration is as exact as can be, and says how exact: many simulated rigs.

    python tools/calibration_study.py [--rigs 100] [--frames 40] [--noise 0.1] [--seed 0]
                                      [--free pose,delay] [--workers 2 | --scheduler ADDRESS]

Each rig has two cameras about a body of seven markers, of which the second is believed to stand
2 degrees and 20 mm from where it does (and to have another lens and clock where those are free);
with ``--free position`` it has three range sensors, each believed to be 30 mm off.  Some detections
are hidden, some false.  Printed are errors; the share of the true parameters that the 95 %
intervals hold; and errors over the least that they can be, the Cramer-Rao bound of who knows which
detection is which marker, by numerical derivatives of OpenCV's projection.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.calibration import Rig, SeenFrame, Task, calibrate
from mixpose.calibration.rig import Kind
from mixpose.executing import executor
from mixpose.rigid import from_parts, from_rotation_vector, inverse, perturb, transform
from mixpose.sensors import PinholeCamera, RangeSensor

Floats = np.ndarray
HIDDEN, FALSE = 0.05, 1.0
POINTS = np.array(
    [
        [0.0, 0.0, 0.0],
        [95.0, 12.0, -8.0],
        [-62.0, 70.0, 14.0],
        [-38.0, -84.0, 22.0],
        [41.0, 48.0, 76.0],
        [58.0, -57.0, 45.0],
        [-74.0, -10.0, -58.0],
    ]
)
BODY = Body("seven", tuple(PointFeature(p) for p in POINTS))
K = np.array([[810.0, 0, 320], [0, 810.0, 256], [0, 0, 1]])
LENS = np.array([-0.08, 0.01, 5e-4, -4e-4, 0.0])
SIZE = (640, 512)
FPS = 30.0
TRUE = {
    "focal": np.array([810.0]),
    "principal_point": np.array([320.0, 256.0]),
    "distortion": LENS,
    "delay": np.array([0.007]),
    "drift": np.array([0.002]),
}
BELIEVED = {
    "focal": np.array([818.0]),
    "principal_point": np.array([325.0, 252.0]),
    "distortion": np.zeros(5),
    "delay": np.zeros(1),
    "drift": np.zeros(1),
}
STEPS = {"focal": 1e-2, "principal_point": 1e-2, "distortion": 1e-4, "delay": 1e-5, "drift": 1e-5}
PLACES = np.array([[0, -1000, 0], [1000, 0, 0], [0, 0, 1000.0]])


@dataclass(frozen=True)
class Case:
    """One rig to be calibrated."""

    seed: int
    frames: int
    noise: float
    free: tuple[Kind, ...]


@dataclass(frozen=True)
class Outcome:
    """Errors, told deviations and least deviations of the parameters of a rig."""

    names: tuple[str, ...]
    errors: Floats
    deviations: Floats
    bound: Floats


def looking(angle: float, rng: np.random.Generator) -> Floats:
    """T_sensor_world (4, 4) of a camera that looks at the middle from about 0.8 m away."""
    turn = from_rotation_vector([*rng.normal(0, 0.1, 1), angle, *rng.normal(0, 0.1, 1)], [0, 0, 0])
    shift = from_parts(np.eye(3), [*rng.normal(0, 15, 2), rng.uniform(750, 900)])
    return np.asarray(shift @ turn)


def motion(seed: int, t: Floats) -> Floats:
    """Poses (K, 4, 4) of a smooth motion at times (K,)."""
    rng = np.random.default_rng(seed)
    amplitude = np.r_[np.full(3, 35.0), np.full(3, 0.35)]
    frequency, phase = rng.uniform(0.5, 1.3, (6, 2)), rng.uniform(0, 2 * np.pi, (6, 2))
    waves = np.sin(2 * np.pi * frequency[None] * t[:, None, None] + phase[None]).sum(axis=2) / 2
    base = from_rotation_vector(rng.uniform(-1, 1, 3), [0, 0, 0])
    twist = waves * amplitude
    return np.asarray(from_rotation_vector(twist[:, 3:], twist[:, :3]) @ base)


def recording(case: Case, sensors: Sequence[Any], late: Callable[[Floats], Floats]) -> Any:
    """Shuffled detections of a moving body; the second sensor takes its frames late."""
    rng = np.random.default_rng(case.seed + 1_000_000)
    times = np.arange(case.frames) / FPS
    seen = [
        motion(case.seed, times + (late(times) if k == 1 else 0.0)) for k in range(len(sensors))
    ]
    frames = []
    for k, time in enumerate(times):
        points = {}
        for index, sensor in enumerate(sensors):
            y, visible = sensor.project(transform(seen[index][k], POINTS))
            y = y[visible & (rng.random(len(y)) > HIDDEN)]
            y = y + rng.normal(0, case.noise, y.shape)
            count = rng.poisson(FALSE)
            false = rng.random((count, 2)) * SIZE if y.shape[1] == 2 else np.zeros((0, 1))
            points[index] = rng.permutation(np.concatenate([y, false]))
        frames.append(SeenFrame(k, float(time), points, dict.fromkeys(points, float(time))))
    return tuple(frames)


def cameras_of(case: Case) -> Outcome:
    """Two cameras, the second off."""
    rng = np.random.default_rng(case.seed)
    angle = rng.uniform(0.6, 1.8)
    lens = LENS if "distortion" in case.free else np.zeros(5)
    cameras = [
        PinholeCamera(K, lens, resolution=SIZE, T_sensor_world=looking(a, rng))
        for a in (-angle / 2, angle / 2)
    ]
    clock = [TRUE[k][0] if k in case.free else 0.0 for k in ("delay", "drift")]
    middle = (case.frames - 1) / FPS / 2
    frames = recording(case, cameras, lambda t: clock[0] + clock[1] * (t - middle))
    axis, way = rng.normal(size=3), rng.normal(size=3)
    off = from_rotation_vector(
        np.radians(2) * axis / np.linalg.norm(axis), 20 * way / np.linalg.norm(way)
    )
    rig = Rig.of(("first", "second"), cameras, BODY)
    if "pose" in case.free:
        rig = rig.placed(1, off @ cameras[1].T_sensor_world)
    rig = rig.exchanged(1, _believed(rig.sensors[1], case.free))
    found = calibrate(Task(rig, frames, np.full(2, 1.5), {1: case.free}))
    eye: Any = found.after.sensors[1]
    T = eye.T_sensor_world @ inverse(cameras[1].T_sensor_world)
    values = {
        "pose": np.r_[T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_rotvec()],
        "focal": eye.camera_matrix[[0], 0] - K[0, 0],
        "principal_point": eye.camera_matrix[:2, 2] - K[:2, 2],
        "distortion": eye.distortion[:5] - lens,
        "delay": found.after.delays[[1]] - clock[0],
        "drift": found.after.drifts[[1]] - clock[1],
    }
    names = tuple(f"{block.kind} {name}" for block in found.blocks for name in block.names)
    errors = np.concatenate([values[block.kind] for block in found.blocks])
    kinds = [block.kind for block in found.blocks]
    bound = _camera_bound(case, cameras, lens, kinds, clock)
    return Outcome(names, errors, found.deviations, bound)


def _believed(camera: Any, free: Sequence[Kind]) -> Any:
    matrix = camera.camera_matrix.copy()
    if "focal" in free:
        matrix[[0, 1], [0, 1]] = BELIEVED["focal"][0]
    if "principal_point" in free:
        matrix[:2, 2] = BELIEVED["principal_point"]
    lens = BELIEVED["distortion"] if "distortion" in free else camera.distortion
    return replace(camera, camera_matrix=matrix, distortion=lens)


def _camera_bound(
    case: Case, cameras: Sequence[Any], lens: Floats, kinds: Sequence[Kind], clock: list[float]
) -> Floats:
    """Least standard deviations (G,) with each detection known."""
    counts = [6 if kind == "pose" else len(TRUE[kind]) for kind in kinds]
    steps = np.concatenate(
        [
            np.r_[[1e-3] * 3, [1e-6] * 3] if k == "pose" else np.full(n, STEPS[k])
            for k, n in zip(kinds, counts)
        ]
    )
    middle = (case.frames - 1) / FPS / 2

    def seen(time: float, g: Floats, p: Floats) -> Floats:
        part = dict(zip(kinds, np.split(g, np.cumsum(counts)[:-1]), strict=True))
        zero = np.zeros(6)
        matrix, shift = K.copy(), part.get("pose", zero)
        matrix[[0, 1], [0, 1]] += part.get("focal", zero)[0]
        matrix[:2, 2] += part.get("principal_point", zero)[:2]
        late = clock[0] + part.get("delay", zero)[0]
        late += (clock[1] + part.get("drift", zero)[0]) * (time - middle)
        T = cameras[1].T_sensor_world
        views = (
            (0.0, cameras[0].T_sensor_world, K, lens),
            (
                late,
                from_rotation_vector(shift[3:], shift[:3]) @ T,
                matrix,
                lens + part.get("distortion", np.zeros(5)),
            ),
        )
        y = []
        for after, T_sensor_world, M, D in views:
            body = perturb(motion(case.seed, np.array([time + after])), p[None])[0]
            at = T_sensor_world @ body
            y.append(
                cv2.projectPoints(POINTS, cv2.Rodrigues(at[:3, :3])[0], at[:3, 3], M, D)[0].ravel()
            )
        return np.concatenate(y)

    return _bound(case, seen, steps)


def ranges_of(case: Case) -> Outcome:
    """Three range sensors, each off, judged by their triangle: the paper's gauge."""
    rng = np.random.default_rng(case.seed)
    off = rng.normal(size=(3, 3))
    off *= 30 / np.linalg.norm(off, axis=1)[:, None]
    frames = recording(case, [RangeSensor(p) for p in PLACES], lambda t: 0 * t)
    rig = Rig.of(("first", "second", "third"), [RangeSensor(p) for p in PLACES + off], BODY)
    start = perturb(motion(case.seed, np.zeros(1)), np.array([[2, -2, 1, 0.03, 0.02, -0.03]]))[0]
    free: dict[int, tuple[Kind, ...]] = dict.fromkeys(range(3), ("position",))
    found = calibrate(Task(rig, frames, np.full(3, 5.0), free, T_held=start))
    places = np.array([one.position for one in found.after.sensors])  # type: ignore[attr-defined]
    errors = _triangle(places) - _triangle(PLACES)
    J = np.array(
        [
            (_triangle(places + d.reshape(3, 3)) - _triangle(places - d.reshape(3, 3))) / 2e-3
            for d in 1e-3 * np.eye(9)
        ]
    ).T
    deviations = np.sqrt(np.diag(J @ found.covariance @ J.T))

    def seen(time: float, g: Floats, p: Floats) -> Floats:
        c, x, y = _triangle(PLACES) + g
        at = np.array([[0, 0, 0], [c, 0, 0], [x, y, 0]])
        turn, middle = Rotation.align_vectors(PLACES - PLACES[0], _upright())[0], PLACES[0]
        body = perturb(motion(case.seed, np.array([time])), p[None])[0]
        away = transform(body, POINTS)[None] - (turn.apply(at) + middle)[:, None]
        return np.asarray(np.linalg.norm(away, axis=2).ravel())

    bound = _bound(case, seen, np.full(3, 1e-3))
    return Outcome(("second x", "third x", "third y"), errors, deviations, bound)


def _upright() -> Floats:
    c, x, y = _triangle(PLACES)
    return np.array([[0, 0, 0], [c, 0, 0], [x, y, 0.0]])


def _triangle(p: Floats) -> Floats:
    """Second on the axis from the first, third in the plane: the three coordinates that remain."""
    c, a, b = (float(np.linalg.norm(p[i] - p[j])) for i, j in ((0, 1), (0, 2), (1, 2)))
    x = (a * a - b * b + c * c) / (2 * c)
    return np.array([c, x, np.sqrt(a * a - x * x)])


def _bound(case: Case, seen: Callable[[float, Floats, Floats], Floats], steps: Floats) -> Floats:
    """Square roots of the diagonal of the inverse information, poses unknown."""
    G = len(steps)
    every = np.concatenate([steps, [1e-3] * 3, [1e-6] * 3])
    S = np.zeros((G, G))
    for k in range(case.frames):
        J = np.array(
            [
                (seen(k / FPS, d[:G], d[G:]) - seen(k / FPS, -d[:G], -d[G:])) / (2 * d.sum())
                for d in np.diag(every)
            ]
        ).T
        A, B = J[:, :G], J[:, G:]
        S += A.T @ A - A.T @ B @ np.linalg.solve(B.T @ B, B.T @ A)
    return np.asarray(case.noise * np.sqrt(np.diag(np.linalg.inv(S * (1 - HIDDEN)))))


def outcome_of(case: Case) -> Outcome:
    return ranges_of(case) if "position" in case.free else cameras_of(case)


def told(outcomes: Sequence[Outcome], case: Case) -> None:
    """Print what all rigs together say."""
    errors = np.array([one.errors for one in outcomes])
    deviations = np.array([one.deviations for one in outcomes])
    bounds = np.array([one.bound for one in outcomes])
    print(
        f"{len(errors)} rigs of {case.frames} frames, {case.noise:g} noise, "
        f"free: {','.join(case.free)}"
    )
    parts = [("shift, mm", slice(0, 3), 1.0)]
    parts += [] if "position" in case.free else [("turn, deg", slice(3, 6), 180 / np.pi)]
    if {"pose", "position"} & set(case.free):
        for title, place, scale in parts:
            size = np.linalg.norm(errors[:, place], axis=1) * scale
            least = np.sqrt((bounds[:, place] ** 2).sum(axis=1).mean()) * scale
            print(
                f"{title}: median {np.median(size):.4f}, worst {size.max():.4f}, root mean square "
                f"{np.sqrt((size**2).mean()):.4f}, least possible {least:.4f}"
            )
    for k, name in enumerate(outcomes[0].names):
        rms, least = (np.sqrt((each[:, k] ** 2).mean()) for each in (errors, bounds))
        print(
            f"{name}: root mean square {rms:.4g}, worst {np.abs(errors[:, k]).max():.4g}, "
            f"{rms / least:.3f} times the least possible"
        )
    ratio = errors / deviations
    inside = np.abs(ratio) < 1.96
    print(f"inside the 95 % interval: {100 * inside.mean():.1f} % of {inside.size} parameters")
    print(f"squared error by variance: {np.mean(ratio**2):.3f} (right: 1)")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rigs", type=int, default=100)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--noise", type=float, default=0.1, help="of detections, px or mm")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--free", default="pose")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--scheduler", help="address of a dask.distributed scheduler, or local")
    asked = parser.parse_args()
    of = partial(Case, frames=asked.frames, noise=asked.noise, free=tuple(asked.free.split(",")))
    cases = [of(seed) for seed in range(asked.seed, asked.seed + asked.rigs)]
    outcomes: list[Outcome] = []
    with executor(asked.scheduler, asked.workers) as workers:
        for k, one in workers.run(outcome_of, cases):
            if isinstance(one, Exception):
                print(f"{cases[k].seed}: {one}", flush=True)
                continue
            outcomes.append(one)
            said = np.array2string(np.abs(one.errors) / one.deviations, precision=2)
            print(f"{cases[k].seed}: errors by deviations {said}", flush=True)
    told(outcomes, cases[0])
    return 0


if __name__ == "__main__":
    sys.exit(main())
