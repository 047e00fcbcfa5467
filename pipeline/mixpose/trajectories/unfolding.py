"""Poses of a symmetric body, such that one follows from the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mixpose import rigid
from mixpose.poses.poseline import PoseLine
from mixpose.records import Floats


def unfolded(lines: Sequence[PoseLine], symmetries: Floats | None) -> list[PoseLine]:
    """Of poses that look the same, those that are turned least against the one before.

    Parameters
    ----------
    lines : sequence of PoseLine
    symmetries : (n, 4, 4) array or None
        Motions T_object_object, identity included.
    """
    if symmetries is None or len(symmetries) < 2:
        return list(lines)
    before: Floats | None = None
    found = []
    for line in lines:
        if line.T_world_object is None:
            found.append(line)
            continue
        before = line.T_world_object if before is None else before
        found.append(_turned(line, before, symmetries))
        if line.status == "ok":
            before = found[-1].T_world_object
    return found


def _turned(line: PoseLine, before: Floats, symmetries: Floats) -> PoseLine:
    """A line whose poses are turned least against another pose."""
    T = line.T_world_object
    assert T is not None
    S = _nearest(T, before, symmetries)
    arm, C = T[:3, :3] @ S[:3, 3], line.covariance
    tip = line.tip_object
    rivals = [each.T_world_object for each in line.hypotheses]
    return replace(
        line,
        T_world_object=T @ S,
        covariance=None if C is None else rigid.covariance_at(C, arm),
        tip_object=None if tip is None else S[:3, :3].T @ (tip - S[:3, 3]),
        hypotheses=tuple(
            replace(each, T_world_object=rival @ _nearest(rival, before, symmetries))
            for each, rival in zip(line.hypotheses, rivals, strict=True)
        ),
    )


def _nearest(T: Floats, before: Floats, symmetries: Floats) -> Floats:
    angles = rigid.rotation_angle_deg(np.broadcast_to(before, symmetries.shape), T @ symmetries)
    return np.asarray(symmetries[int(np.argmin(angles))])
