"""A poses file in another unit of length."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mixpose import rigid
from mixpose.poses.header import length_ratio
from mixpose.poses.jsonl import PoseFile
from mixpose.records import Floats, Hypothesis


def in_unit(file: PoseFile, unit: str | None) -> PoseFile:
    """The same motions with their lengths in another unit, if the file states its own."""
    if unit is None or file.unit is None or file.unit == unit:
        return file
    ratio = length_ratio(file.unit, unit)

    def scaled(T: Floats) -> Floats:
        return rigid.from_parts(T[..., :3, :3], T[..., :3, 3] * ratio)

    twist_scale = np.array([ratio] * 3 + [1.0] * 3)
    lines = tuple(
        replace(
            line,
            T_world_object=None if line.T_world_object is None else scaled(line.T_world_object),
            covariance=(
                None
                if line.covariance is None
                else line.covariance * twist_scale[:, None] * twist_scale
            ),
            hypotheses=tuple(
                Hypothesis(scaled(rival.T_world_object), rival.weight) for rival in line.hypotheses
            ),
        )
        for line in file.poses
    )
    symmetries = {name: scaled(motions) for name, motions in file.symmetries.items()}
    return replace(file, poses=lines, unit=unit, symmetries=symmetries)
