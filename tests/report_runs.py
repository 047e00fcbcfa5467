"""Poses files for the tests of reports, written without estimating anything."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mixpose import rigid
from mixpose.poses.header import Header
from mixpose.poses.jsonl import JsonlWriter, read_poses
from mixpose.records import Estimate, Floats, Hypothesis, SensorReport, Status

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
RECORDING = SYNTHETIC / "two_cameras"

# What the poses of `write_run` are off by, along and about the world's axes: mm and rad.
OFFSET = np.array([0.03, 0.0, -0.04, 0.0, np.radians(0.1), 0.0])
COVARIANCE = np.diag([0.02, 0.02, 0.03, *np.radians([0.05, 0.06, 0.07])]) ** 2


def estimate(
    frame: int,
    T_world_object: Floats,
    status: Status = "ok",
    *,
    object: str = "tracker",
    sensors: tuple[str, ...] = ("left", "right"),
    time_s: float | None = None,
) -> Estimate:
    is_lost = status == "lost"
    rivals = (Hypothesis(T_world_object, 0.6), Hypothesis(T_world_object, 0.4))
    return Estimate(
        frame=frame,
        time_s=time_s,
        object=object,
        status=status,
        T_world_object=None if is_lost else T_world_object,
        covariance=None if is_lost else COVARIANCE,
        score=0.2 if is_lost else 0.9 - 0.001 * frame,
        sensors={name: SensorReport(True, 0.8, 0.02 + 0.01 * k) for k, name in enumerate(sensors)},
        hypotheses=rivals if status == "ambiguous" else (),
        latency_ms=2.0 + frame,
    )


def write(
    path: Path, estimates: list[Estimate], session: Path | None, sha256: str | None = None
) -> Path:
    if session is not None and sha256 is None:
        sha256 = hashlib.sha256(session.read_bytes()).hexdigest()
    name = None if session is None else str(session)
    with path.open("w", encoding="utf-8") as stream:
        writer = JsonlWriter(stream, Header("mm", name, sha256, "0.1.0", 0))
        for each in estimates:
            writer.write(each)
    return path


def write_run(path: Path, statuses: Mapping[int, Status]) -> Path:
    """Poses of the two-camera recording, off by `OFFSET`; "ok" where no other status is given."""
    truth = read_poses(RECORDING / "truth.jsonl").poses
    estimates = []
    for line in truth:
        assert line.T_world_object is not None
        T = rigid.perturb(line.T_world_object, OFFSET)
        status = statuses.get(line.frame, "ok")
        estimates.append(estimate(line.frame, T, status, time_s=line.frame / 25))
    return write(path, estimates, RECORDING / "session.toml")
