"""Whether the deviations of a calibration hold: many simulated rigs, each calibrated.

    python tools/calibration_study.py [--rigs 100] [--frames 16] [--seed 0] [--what pose,delay]

Each rig has two cameras about a body of seven markers, of which the second is believed to stand
2 degrees and 20 mm from where it does; detections err by 0.1 px, some are hidden, some false.
Printed are errors, and the share of the true parameters that the 95 % intervals hold.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.body import Body, PointFeature
from mixpose.calibration import Calibration, Rig, SeenFrame, Task, calibrate
from mixpose.calibration.rig import Kind
from mixpose.rigid import from_parts, from_rotation_vector, inverse, transform
from mixpose.sensors import PinholeCamera

NOISE, HIDDEN, FALSE = 0.1, 0.05, 1.0
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
K = np.array([[810.0, 0, 320], [0, 810.0, 256], [0, 0, 1]])
SIZE = (640, 512)
FPS = 30.0
DELAY = 0.007


def looking(angle: float, rng: np.random.Generator) -> np.ndarray:
    """T_sensor_world (4, 4) of a camera that looks at the middle from about 0.8 m away."""
    turn = from_rotation_vector([*rng.normal(0, 0.1, 1), angle, *rng.normal(0, 0.1, 1)], [0, 0, 0])
    shift = from_parts(np.eye(3), [*rng.normal(0, 15, 2), rng.uniform(750, 900)])
    return np.asarray(shift @ turn)


def motion(seed: int, count: int, late: float) -> np.ndarray:
    """Poses (K, 4, 4) of a smooth motion, `late` seconds after each frame."""
    rng = np.random.default_rng(seed)
    t = np.arange(count) / FPS + late
    amplitude = np.r_[np.full(3, 35.0), np.full(3, 0.35)]
    frequency, phase = rng.uniform(0.5, 1.3, (6, 2)), rng.uniform(0, 2 * np.pi, (6, 2))
    waves = np.sin(2 * np.pi * frequency[None] * t[:, None, None] + phase[None]).sum(axis=2) / 2
    base = from_rotation_vector(rng.uniform(-1, 1, 3), [0, 0, 0])
    twist = waves * amplitude
    return np.asarray(from_rotation_vector(twist[:, 3:], twist[:, :3]) @ base)


def recording(
    cameras: Sequence[PinholeCamera], seed: int, count: int, delay: float
) -> tuple[SeenFrame, ...]:
    """Shuffled detections of a moving body."""
    rng = np.random.default_rng(seed + 1_000_000)
    seen = [motion(seed, count, late) for late in (0.0, delay)]
    frames = []
    for k in range(count):
        points = {}
        for index, camera in enumerate(cameras):
            y, visible = camera.project(transform(seen[index][k], POINTS))
            y = y[visible & (rng.random(len(y)) > HIDDEN)]
            y = y + rng.normal(0, NOISE, y.shape)
            false = rng.random((rng.poisson(FALSE), 2)) * SIZE
            points[index] = rng.permutation(np.concatenate([y, false]))
        time = k / FPS
        frames.append(SeenFrame(k, time, points, {0: time, 1: time}))
    return tuple(frames)


def one(seed: int, count: int, what: tuple[Kind, ...]) -> tuple[np.ndarray, Calibration]:
    """Errors of a rig's parameters, in the order of its blocks, and its calibration."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.6, 1.8)
    cameras = [
        PinholeCamera(K, resolution=SIZE, T_sensor_world=looking(a, rng))
        for a in (-angle / 2, angle / 2)
    ]
    delay = DELAY if "delay" in what else 0.0
    frames = recording(cameras, seed, count, delay)
    axis, way = rng.normal(size=3), rng.normal(size=3)
    off = from_rotation_vector(
        np.radians(2) * axis / np.linalg.norm(axis), 20 * way / np.linalg.norm(way)
    )
    body = Body("seven", tuple(PointFeature(p) for p in POINTS))
    rig = Rig.of(("first", "second"), cameras, body)
    rig = rig.placed(1, off @ cameras[1].T_sensor_world)
    found = calibrate(Task(rig, body, frames, np.full(2, 1.5), {1: what}))
    T = found.after.sensors[1].T_sensor_world @ inverse(cameras[1].T_sensor_world)  # type: ignore[attr-defined]
    error = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_rotvec()]
    if "delay" in what:
        error.append(float(found.after.delays[1]) - delay)
    return np.array(error), found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--rigs", type=int, default=100)
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--what", default="pose")
    options = parser.parse_args()
    what: tuple[Kind, ...] = tuple(options.what.split(","))
    errors, deviations = [], []
    for seed in range(options.seed, options.seed + options.rigs):
        error, found = one(seed, options.frames, what)
        errors.append(error)
        deviations.append(found.deviations)
        z = np.abs(error) / found.deviations
        print(f"{seed}: {np.array2string(z, precision=2)}", flush=True)
    error, ratio = np.array(errors), np.array(errors) / np.array(deviations)
    turn = np.degrees(np.linalg.norm(error[:, 3:6], axis=1))
    shift = np.linalg.norm(error[:, :3], axis=1)
    print(f"{len(error)} rigs of {options.frames} frames")
    print(f"turn: median {np.median(turn):.4f}, worst {turn.max():.4f} deg")
    print(f"shift: median {np.median(shift):.4f}, worst {shift.max():.4f} mm")
    if error.shape[1] > 6:
        late = 1e3 * np.abs(error[:, 6])
        print(f"delay: median {np.median(late):.4f}, worst {late.max():.4f} ms")
    inside = np.abs(ratio) < 1.96
    print(f"inside the 95 % interval: {100 * inside.mean():.1f} % of {inside.size} parameters")
    print(f"squared error by variance: {np.mean(ratio**2):.3f} (right: 1)")


if __name__ == "__main__":
    main()
