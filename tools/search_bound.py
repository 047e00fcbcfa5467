"""What the best estimator could do with the frames of `tools/benchmark.py search`: a bound.

    python tools/search_bound.py [ROW ...] [--trials N]

It is told what mixpose is not: how many markers are hidden and how many detections false, where
false ones lie, and, in rows of their own, the noise of detections and where bodies may be; of
noise that it is not told it knows as little as mixpose, log-uniform up to σ_ε.  It takes every
triple of features for every triple of detections of every camera (`cv2.solveP3P`), fits the poses
that meet most, sums their evidence, and adds the true pose to them, so that it misses none.
Rivals that it overlooks make the bound only higher.

First means that the true pose is the most probable one; right, that it is more probable than that
nothing is there, too; sure, that it holds 99.9 % of all probability; absent, that in frames without
the body the odds are for none.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import NamedTuple

import cv2
import numpy as np
from benchmarks.search_cases import (
    NOISE_PX,
    SIGMA_PX,
    Row,
    Trial,
    absent,
    is_right,
    rows_named,
    trial,
)
from numpy.typing import NDArray
from scipy.special import logsumexp

from mixpose.records import PointPattern
from mixpose.rigid import perturb, transform
from mixpose.sensors import PinholeCamera

Floats = NDArray[np.float64]

REACH_PX = 6.0  # from a feature of a pose of three to its detection
REFINED = 300  # poses that are fitted
STEPS = 8
BLOCK = 20_000
HALF_ROOM = 50.0  # mm each way, in which bodies of the benchmark have their middle
SURE = 0.999
ALIKE = 5e-3  # of poses that are one: of the distance, and radians
FRESH = 10_000  # first seed of the frames without a body
TOLD: dict[str, tuple[Sequence[float], bool]] = {
    "neither": ((SIGMA_PX * np.geomspace(0.05, 1.0, 7)).tolist(), False),
    "noise": ((NOISE_PX,), False),
    "noise and where": ((NOISE_PX,), True),
}


@dataclass(frozen=True)
class Seen:
    """A camera, what it detected, and how dense false detections are there."""

    camera: PinholeCamera
    detections: Floats  # (M, 2)
    density: Floats  # (M,) per px²


class Known(NamedTuple):
    """What is known of a frame."""

    is_first: bool  # the true pose is the most probable one
    is_there: bool  # the most probable pose is more probable than none
    of_true: float  # probability of the true pose
    of_none: float  # that there is nothing


def seen_by(frame: Trial, row: Row) -> list[Seen]:
    """The cameras of a frame; where the body would be, false detections are dense."""
    found = []
    for view in frame.views:
        camera, pattern = view.sensor, view.observation.pattern
        assert isinstance(camera, PinholeCamera)
        assert isinstance(pattern, PointPattern)
        y, _ = camera.project(transform(frame.T_world_object, frame.body.means))
        low, high = y.min(axis=0), y.max(axis=0)
        points = pattern.points
        anywhere, near = -(-row.false // 2), row.false // 2
        density = anywhere / np.prod(np.subtract(camera.upper, camera.lower)) + near / np.prod(
            high - low
        ) * ((points > low) & (points < high)).all(axis=1)
        found.append(Seen(camera, points, np.maximum(density, 1e-9)))
    return found


def poses_of_three(points: Floats, seen: Seen) -> Iterator[Floats]:
    """Poses (4, 4) that put three features on three detections, all triples of both."""
    K, T_world_sensor = seen.camera.camera_matrix, np.linalg.inv(seen.camera.T_sensor_world)
    for features in combinations(range(len(points)), 3):
        own = np.ascontiguousarray(points[list(features)])
        for chosen in permutations(range(len(seen.detections)), 3):
            image = np.ascontiguousarray(seen.detections[list(chosen)])
            count, turns, shifts = cv2.solveP3P(own, image, K, None, flags=cv2.SOLVEPNP_AP3P)
            for k in range(count):
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = cv2.Rodrigues(turns[k])[0], shifts[k].ravel()
                yield T_world_sensor @ T


def projected(camera: PinholeCamera, poses: Floats, points: Floats) -> Floats:
    """Places (P, N, 2) of points at poses (P, 4, 4)."""
    T = camera.T_sensor_world @ poses
    world = points @ T[:, :3, :3].swapaxes(1, 2) + T[:, None, :3, 3]
    flat = world[..., :2] / np.maximum(world[..., 2:], 1.0)
    K = camera.camera_matrix
    return np.asarray(flat * [K[0, 0], K[1, 1]] + K[:2, 2])


def met(seen: Seen, y: Floats, reach: float) -> tuple[Floats, NDArray[np.intp]]:
    """Offsets (P, N, 2) of the nearest detections, and which these are (P, N); -1 for none."""
    away = seen.detections - y[:, :, None]
    squared = (away * away).sum(axis=3)
    nearest = squared.argmin(axis=2)
    offsets = np.take_along_axis(away, nearest[..., None, None], axis=2)[:, :, 0]
    is_met = np.take_along_axis(squared, nearest[..., None], axis=2)[..., 0] < reach**2
    # of features that share a detection the nearer one has it
    for k in range(nearest.shape[1]):
        for j in range(k):
            both = is_met[:, k] & is_met[:, j] & (nearest[:, k] == nearest[:, j])
            nearer = (offsets[:, k] ** 2).sum(axis=1) < (offsets[:, j] ** 2).sum(axis=1)
            is_met[:, j] &= ~(both & nearer)
            is_met[:, k] &= ~(both & ~nearer)
    return offsets, np.where(is_met, nearest, -1)


def most_met(poses: Floats, points: Floats, cameras: Sequence[Seen]) -> Floats:
    """Those poses that meet most, by squares of offsets within reach."""
    scores = []
    for first in range(0, len(poses), BLOCK):
        some = poses[first : first + BLOCK]
        total = np.zeros(len(some))
        for seen in cameras:
            offsets, numbers = met(seen, projected(seen.camera, some, points), REACH_PX)
            gain = 1 - (offsets**2).sum(axis=2) / REACH_PX**2
            total += (gain * (numbers >= 0)).sum(axis=1)
        scores.append(total)
    return np.asarray(poses[np.argsort(-np.concatenate(scores))[:REFINED]])


def fitted(
    poses: Floats, points: Floats, cameras: Sequence[Seen], share: float, noise: float
) -> tuple[Floats, Floats]:
    """Poses after Gauss-Newton with nearest detections, and their log likelihoods over clutter.

    What no detection tells of a pose is as open as anywhere within ten radii, turned in any way.
    """
    wide = np.array([10 * radius_of(points)] * 3 + [np.pi] * 3)
    reaches = np.geomspace(max(REACH_PX, 4 * noise), 4 * noise, STEPS)
    for reach in reaches.tolist():
        information, pull, _ = least_squares(poses, points, cameras, share, noise, reach)
        scale = 1 / np.sqrt(np.einsum("pjj->pj", information))
        scaled = information * scale[:, None] * scale[..., None] + 1e-9 * np.eye(6)
        twist = scale * np.linalg.solve(scaled, (scale * pull)[..., None])[..., 0]
        length = np.linalg.norm(twist[:, 3:], axis=1, keepdims=True)
        poses = perturb(poses, twist * np.minimum(1.0, 0.3 / np.maximum(length, 1e-12)))
    information, _, gained = least_squares(poses, points, cameras, share, noise, reaches[-1])
    volume = -0.5 * np.linalg.slogdet((information + np.diag(wide**-2.0)) / (2 * np.pi))[1]
    return poses, np.nan_to_num(gained + volume, nan=-np.inf)


def least_squares(
    poses: Floats,
    points: Floats,
    cameras: Sequence[Seen],
    share: float,
    noise: float,
    reach: float,
) -> tuple[Floats, Floats, Floats]:
    """Normal equations (P, 6, 6) and (P, 6), and what features gain over clutter (P,)."""
    information = np.zeros((len(poses), 6, 6)) + 1e-12 * np.eye(6)
    pull, gained = np.zeros((len(poses), 6)), np.zeros(len(poses))
    steps = np.diag([1e-3] * 3 + [1e-6] * 3)
    for seen in cameras:
        y = projected(seen.camera, poses, points)
        offsets, numbers = met(seen, y, reach)
        is_met = numbers >= 0
        moved = [perturb(poses, np.tile(step, (len(poses), 1))) for step in steps]
        columns = [projected(seen.camera, T, points) - y for T in moved]
        J = np.stack(columns, axis=-1) / steps.diagonal() * is_met[..., None, None]
        information += np.einsum("pnij,pnik->pjk", J, J) / noise**2
        pull += np.einsum("pnij,pni->pj", J, offsets) / noise**2
        rarity = np.log(share / (2 * np.pi * noise**2 * seen.density[numbers]))
        cost = 0.5 * (offsets**2).sum(axis=2) / noise**2
        gained += np.where(is_met, rarity - cost, np.log(max(1 - share, 1e-3))).sum(axis=1)
    return information, pull, gained


def radius_of(points: Floats) -> float:
    """Largest distance from the middle."""
    return float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())


def log_density(poses: Floats, points: Floats, *, is_told: bool) -> Floats:
    """Of the pose before the frame: anywhere within ten radii, or where bodies are put."""
    turns = np.log(8 * np.pi**2)
    if not is_told:
        return np.full(len(poses), -3 * np.log(10 * radius_of(points)) - turns)
    middles = transform(poses, points.mean(axis=0)[None])[:, 0]
    inside = (np.abs(middles) < HALF_ROOM + 3.0).all(axis=1)
    return np.where(inside, -3 * np.log(2 * HALF_ROOM) - turns, -np.inf)


def told(frame: Trial, row: Row, *, present: bool) -> list[Known]:
    """What is known of a frame, by what is told."""
    points, cameras = frame.body.means, seen_by(frame, row)
    guesses = [T for seen in cameras for T in poses_of_three(points, seen)]
    begun = most_met(np.array(guesses), points, cameras)
    share = (row.features - row.hidden) / row.features
    found = []
    for noises, is_told in TOLD.values():
        ends = []
        for noise in noises:
            ends.append(fitted(begun, points, cameras, share, noise))
            if present:
                ends.append(fitted(frame.T_world_object[None], points, cameras, share, noise))
        poses, likelihoods = (np.concatenate(parts) for parts in zip(*ends, strict=True))
        evidence = likelihoods + log_density(poses, points, is_told=is_told) - np.log(len(noises))
        found.append(summed(poses, evidence, frame if present else None))
    return found


def summed(poses: Floats, evidence: Floats, frame: Trial | None) -> Known:
    """What poses (P, 4, 4) let know; of those that are one the most evident counts."""
    modes, logs = list[Floats](), list[float]()
    for k in np.argsort(-evidence).tolist():
        if not np.isfinite(evidence[k]):
            break
        near = [j for j, T in enumerate(modes) if are_one(T, poses[k])]
        if near:
            continue
        modes.append(poses[k])
        logs.append(float(evidence[k]))
    total = float(logsumexp([0.0, *logs]))
    right = [k for k, T in enumerate(modes) if frame is not None and is_right(T, frame)]
    of_true = float(np.exp(np.array(logs)[right] - total).sum())
    return Known(right[:1] == [0], logs[:1] > [0.0], of_true, float(np.exp(-total)))


def are_one(a: Floats, b: Floats) -> bool:
    """Whether two poses are the same but for what a fit leaves."""
    shift = float(np.abs(a[:3, 3] - b[:3, 3]).max())
    return shift < ALIKE * 1e3 and float(np.abs(a[:3, :3] - b[:3, :3]).max()) < ALIKE


def main() -> None:
    """Print a line per row and what is told."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", nargs="*", help="texts of rows' names")
    parser.add_argument("--trials", type=int, default=60)
    options = parser.parse_args()
    print(f"{'row':18} {'told':17} {'first':>7} {'right':>7} {'sure':>7} {'absent':>7}")
    for row in rows_named(options.rows):
        if "pinhole" not in row.sensors:
            continue
        count = range(options.trials)
        there = [told(trial(row, k), row, present=True) for k in count]
        gone = [told(absent(row, FRESH + k), row, present=False) for k in count[::2]]
        for k, name in enumerate(TOLD):
            own = [one[k] for one in there]
            shares = (
                np.mean([one.is_first for one in own]),
                np.mean([one.is_first and one.is_there for one in own]),
                np.mean([one.of_true >= SURE for one in own]),
                np.mean([one[k].of_none > 0.5 for one in gone]),
            )
            print(f"{row.name:18} {name:17}", *(f"{share:7.1%}" for share in shares), flush=True)


if __name__ == "__main__":
    main()
