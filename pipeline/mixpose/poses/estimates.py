"""Pose lines as estimates again, so that every writer can write them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from mixpose.poses.header import Header
from mixpose.poses.jsonl import PoseFile
from mixpose.poses.poseline import PoseLine
from mixpose.records import Estimate, Floats


def header_of(poses: PoseFile, unit: str, version: str) -> Header:
    """What a poses file says about its run; `version` where it names no version of mixpose."""
    found = poses.header
    names = dict.fromkeys(name for line in poses.poses for name in line.sensors)
    return Header(
        unit=unit,
        session=found.get("session"),
        session_sha256=found.get("session_sha256"),
        mixpose=found.get("mixpose", version),
        seed=found.get("seed", 0),
        symmetries=poses.symmetries,
        sensors=tuple(names),
        objects=objects_of(poses.poses),
        smoothed=found.get("smoothed", {}),
    )


def estimate_of(line: PoseLine) -> Estimate:
    """The estimate of a line; a line without a score, as of a truth file, is certain: 1."""
    return Estimate(
        frame=line.frame,
        time_s=line.time_s,
        object=line.object,
        status=line.status,
        T_world_object=line.T_world_object,
        covariance=line.covariance,
        score=1.0 if line.score is None else line.score,
        sensors=line.sensors,
        hypotheses=line.hypotheses,
        latency_ms=0.0 if line.latency_ms is None else line.latency_ms,
        instance=line.instance,
        confidence=line.confidence,
        points=line.points,
        tip_object=tip_in_object(line),
        filled=line.filled,
    )


def tip_in_object(line: PoseLine) -> Floats | None:
    """The tip of a line's body in the coordinates of the body, (3,); None where it tells none."""
    T = line.T_world_object
    if T is None or line.tip is None:
        return None
    return np.asarray(T[:3, :3].T @ (line.tip - T[:3, 3]))


def objects_of(lines: Iterable[PoseLine]) -> dict[str, int]:
    """Names of the bodies with how many there are of each, in the order of the lines."""
    counts: dict[str, int] = {}
    for line in lines:
        counts[line.object] = max(counts.get(line.object, 1), (line.instance or 0) + 1)
    return counts


def relative_to(T_sensor_world: Floats, estimate: Estimate) -> Estimate:
    """An estimate in the axes of a sensor, (4, 4): its pose is then T_sensor_object."""
    if estimate.T_world_object is None:
        return estimate
    covariance = estimate.covariance
    if covariance is not None:
        turn = np.kron(np.eye(2), T_sensor_world[:3, :3])  # lengths and turns alike
        covariance = turn @ covariance @ turn.T
    return replace(
        estimate,
        T_world_object=T_sensor_world @ estimate.T_world_object,
        covariance=covariance,
        hypotheses=tuple(
            replace(rival, T_world_object=T_sensor_world @ rival.T_world_object)
            for rival in estimate.hypotheses
        ),
    )


def first_answers(lines: Iterable[PoseLine]) -> list[PoseLine]:
    """The first line of each frame and body; in a truth file others may be equally right."""
    first: dict[tuple[int, str], PoseLine] = {}
    for line in lines:
        first.setdefault((line.frame, line.label), line)
    return list(first.values())
