"""Turn pose lines into estimates in other units and axes, for any writer."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from mixpose import rigid
from mixpose.poses.header import Header
from mixpose.poses.jsonl import PoseFile
from mixpose.poses.poseline import PoseLine
from mixpose.records import Estimate, Floats
from mixpose.units import length_ratio

_Posed = TypeVar("_Posed", bound=Estimate)


def header_of(poses: PoseFile, unit: str, version: str) -> Header:
    """Return the header of a poses file; `version` if it names no version of mixpose."""
    header = poses.header
    names = dict.fromkeys(name for line in poses.poses for name in line.sensors)
    return Header(
        unit=unit,
        session=header.get("session"),
        session_sha256=header.get("session_sha256"),
        mixpose=header.get("mixpose", version),
        seed=header.get("seed", 0),
        symmetries=poses.symmetries,
        sources=poses.sources,
        options=header.get("options", {}),
        sensors=tuple(names),
        objects=objects_of(poses.poses),
        smoothed=header.get("smoothed", {}),
        tips=any(line.tip_object is not None for line in poses.poses),
    )


def objects_of(lines: Iterable[PoseLine]) -> dict[str, int]:
    """Count the bodies of each name, in the order of the lines."""
    counts: dict[str, int] = {}
    for line in lines:
        counts[line.object] = max(counts.get(line.object, 1), (line.instance or 0) + 1)
    return counts


def relative_to(T_sensor_world: Floats, estimate: Estimate) -> Estimate:
    """Return an estimate in the axes of a sensor (4, 4), so that its pose is T_sensor_object."""
    turn = np.asarray(np.kron(np.eye(2), T_sensor_world[:3, :3]), dtype=np.float64)
    return _mapped(estimate, lambda T: T_sensor_world @ T, turn)


def relative_to_body(line: PoseLine, reference: PoseLine | None) -> PoseLine:
    """Return a pose in the axes of another body, T_reference_object; lost without that body.

    It is as sure as both together. Their errors count as independent. Hypotheses are left out.
    """
    T = line.T_world_object
    if reference is None or T is None or reference.T_world_object is None:
        return replace(
            line, status="lost", T_world_object=None, covariance=None, hypotheses=(), confidence=0.0
        )
    T_reference, p, p_reference = reference.T_world_object, line.confidence, reference.confidence
    return replace(
        line,
        status="ok" if line.status == reference.status == "ok" else "ambiguous",
        T_world_object=rigid.inverse(T_reference) @ T,
        covariance=_relative_covariance(line, reference, T[:3, 3] - T_reference[:3, 3]),
        hypotheses=(),
        confidence=None if p is None or p_reference is None else p * p_reference,
        filled=line.filled or reference.filled,
    )


def _relative_covariance(line: PoseLine, reference: PoseLine, arm: Floats) -> Floats | None:
    """Return the covariance (6, 6) of a pose `arm` (3,) away from a reference, in its axes."""
    assert reference.T_world_object is not None
    if line.covariance is None or reference.covariance is None:
        return None
    turn = np.kron(np.eye(2), reference.T_world_object[:3, :3].T)
    C = line.covariance + rigid.covariance_at(reference.covariance, arm)
    return np.asarray(turn @ C @ turn.T)


def _mapped(estimate: _Posed, motion_of: Callable[[Floats], Floats], by_twist: Floats) -> _Posed:
    """Map the poses of an estimate by `motion_of`, and twists of its pose by a matrix (6, 6)."""
    T, covariance = estimate.T_world_object, estimate.covariance
    return replace(
        estimate,
        T_world_object=None if T is None else motion_of(T),
        covariance=None if covariance is None else by_twist @ covariance @ by_twist.T,
        hypotheses=tuple(
            replace(rival, T_world_object=motion_of(rival.T_world_object))
            for rival in estimate.hypotheses
        ),
    )


def first_answers(lines: Iterable[PoseLine]) -> list[PoseLine]:
    """Return the first line of each frame and body; a truth file may have several right ones."""
    first_lines: dict[tuple[int, str], PoseLine] = {}
    for line in lines:
        first_lines.setdefault((line.frame, line.label), line)
    return list(first_lines.values())


def in_unit(file: PoseFile, unit: str | None) -> PoseFile:
    """Convert all lengths of a poses file to another unit, if it states its own."""
    if unit is None or file.unit is None or file.unit == unit:
        return file
    ratio = length_ratio(file.unit, unit)

    def scaled(T: Floats) -> Floats:
        return rigid.from_parts(T[..., :3, :3], T[..., :3, 3] * ratio)

    by_twist: Floats = np.diag([ratio] * 3 + [1.0] * 3)
    lines = tuple(
        replace(
            _mapped(line, scaled, by_twist),
            tip_object=None if line.tip_object is None else ratio * line.tip_object,
            points={
                name: replace(point, at=ratio * point.at, residual=ratio * point.residual)
                for name, point in line.points.items()
            },
        )
        for line in file.poses
    )
    symmetries = {name: scaled(motions) for name, motions in file.symmetries.items()}
    return replace(file, poses=lines, unit=unit, symmetries=symmetries)
