"""Pose lines of a body whose motion, and whose errors, are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mixpose import rigid
from mixpose.poses.header import Header
from mixpose.poses.jsonl import JsonlWriter
from mixpose.poses.poseline import PoseLine
from mixpose.records import Estimate, Floats
from mixpose.simulation.motion import plan_motion


def swinging(
    frames: int, *, seed: int = 0, interval_s: float = 0.04, period_s: float = 3.0
) -> Floats:
    """Poses (N, 4, 4) of a body that swings by up to 30 length units and 25 degrees."""
    motion = plan_motion(
        rigid.from_rotation_vector([0.3, -0.2, 0.5], [10.0, 20.0, 800.0]),
        np.array([5.0, 0.0, -3.0]),
        translation=30.0,
        rotation_deg=25.0,
        period_s=period_s,
        seed=seed,
    )
    return motion.poses(np.arange(frames, dtype=np.float64) * interval_s)


def covariance_of(length: float, turn: float, seed: int = 0) -> Floats:
    """A covariance (6, 6) with correlations, of about these standard deviations."""
    mixing = np.random.default_rng(seed).normal(size=(6, 6))
    deviations = np.repeat([length, turn], 3)
    return np.asarray((np.eye(6) + mixing @ mixing.T / 12) * deviations[:, None] * deviations)


def measured(truth: Floats, covariance: Floats, seed: int = 0, scale: float = 1.0) -> Floats:
    """Poses with errors of a covariance, times a scale."""
    factor = np.linalg.cholesky(covariance)
    errors = np.random.default_rng(seed).normal(size=(len(truth), 6)) @ factor.T
    return rigid.perturb(truth, scale * errors)


def pose_line(frame: int, T: Floats | None, covariance: Floats | None, **other: object) -> PoseLine:
    """A line of a file; ok, or lost without a pose."""
    values: dict[str, object] = {
        "line": frame + 2,
        "frame": frame,
        "time_s": 0.04 * frame,
        "object": "tool",
        "status": "lost" if T is None else "ok",
        "T_world_object": T,
        "covariance": None if T is None else covariance,
        "score": 0.9,
        "sensors": {},
        "hypotheses": (),
        "latency_ms": 1.0,
        **other,
    }
    return PoseLine(**values)  # type: ignore[arg-type]


def lines_of(poses: Floats, covariance: Floats) -> list[PoseLine]:
    """A line per pose, all ok."""
    return [pose_line(frame, T, covariance) for frame, T in enumerate(poses)]


def squared_errors(truth: Floats, estimates: Sequence[Estimate]) -> Floats:
    """Squared errors per dimension, (N,), by the covariances of the estimates."""
    found = []
    for T, one in zip(truth, estimates, strict=True):
        assert one.T_world_object is not None
        assert one.covariance is not None
        error = rigid.twist_between(T, one.T_world_object)
        found.append(error @ np.linalg.solve(one.covariance, error) / 6)
    return np.array(found)


def rms_errors(truth: Floats, poses: Floats) -> tuple[float, float]:
    """Root mean squares of positions and of turns in radians."""
    twists = rigid.twist_between(truth, poses)
    return tuple(np.sqrt((twists.reshape(-1, 2, 3) ** 2).mean(axis=(0, 2))).tolist())


def write_poses(path: object, estimates: Sequence[Estimate], unit: str = "mm") -> None:
    """A poses file as `mixpose run` writes it."""
    with open(str(path), "w", encoding="utf-8") as stream:  # noqa: PTH123
        writer = JsonlWriter(stream, Header(unit, None, None, "0.1.0", 0))
        for one in estimates:
            writer.write(one)
