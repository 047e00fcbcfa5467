"""Which frames are calibrated from, and which are held back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mixpose.calibration.frames import SeenFrame
from mixpose.calibration.rules import CalibrationRules
from mixpose.records import Floats

RUN = 8
"""Frames read together where motion between them counts."""

_HELD_RUN = 4
_FARTHEST = 2.5  # spreads from the middle: what lies beyond is as likely clutter
_MEANS = 1e-3  # information before the first frame, of a descriptor's spread


def held_back_with(count: int, rules: CalibrationRules, *, runs: bool) -> NDArray[np.intp]:
    """Which of `count` frames are held back together (count,): a fifth at a time; -1: never.

    Every fifth frame, or every fifth run of four.
    """
    period = round(1 / rules.held_back)
    if count - -(-count // period) < rules.least_frames:
        return np.full(count, -1)
    size = _HELD_RUN if runs and count >= _HELD_RUN * period else 1
    return np.asarray((np.arange(count) // size) % period)


def informative(
    frames: Sequence[SeenFrame], sensors: int, most: int, *, runs: bool
) -> tuple[SeenFrame, ...]:
    """The frames that add most information, in their order.

    Poses are not known yet.  What a frame tells goes by where, how large and how turned the body is
    in each sensor's view, which its detections' means and second moments say; one after the other,
    the frame is taken that adds most to the information on a model that is linear in these
    (D-optimal design).  So a body that lies still for most of a recording is taken but a few times.

    Parameters
    ----------
    most : int
        Frames that are taken.
    runs : bool
        Whether motion counts: then frames are taken in runs of neighbours.
    """
    if len(frames) <= most:
        return tuple(frames)
    described = _described(frames, sensors)
    size = RUN if runs else 1
    groups = np.array_split(np.arange(len(frames)), -(-len(frames) // size))
    rows = np.array([described[group].mean(axis=0) for group in groups])
    if runs:  # what moves tells of time
        changes = np.array([described[group[-1]] - described[group[0]] for group in groups])
        rows = np.column_stack([rows, changes])
    rows = np.column_stack([np.ones(len(rows)), rows])
    inverse = np.eye(rows.shape[1]) / _MEANS
    left = np.ones(len(rows), dtype=np.bool_)
    chosen: list[int] = []
    while left.any() and len(chosen) + size <= most:
        gains = np.einsum("ki,ij,kj->k", rows, inverse, rows, optimize=True)
        best = int(np.argmax(np.where(left, gains, -1.0)))
        left[best] = False
        chosen += groups[best].tolist()
        along = inverse @ rows[best]
        inverse = inverse - np.outer(along, along) / (1 + gains[best])
    return tuple(frames[k] for k in sorted(chosen))


def _described(frames: Sequence[SeenFrame], sensors: int) -> Floats:
    """Means and second moments of each sensor's detections (K, D), in their spreads; 0 for none."""
    columns = []
    for sensor in range(sensors):
        seen = [k for k, frame in enumerate(frames) if len(frame.points.get(sensor, ()))]
        if not seen:
            continue
        told = np.array([_moments(frames[k].points[sensor]) for k in seen])
        middle = np.median(told, axis=0)
        spread = np.median(np.abs(told - middle), axis=0) + 1e-3 * np.ptp(told, axis=0) + 1e-12
        column = np.zeros((len(frames), told.shape[1] + 1))
        column[seen, :-1] = np.clip((told - middle) / (1.5 * spread), -_FARTHEST, _FARTHEST)
        column[seen, -1] = 1.0
        columns.append(column)
    return np.concatenate(columns, axis=1)


def _moments(points: Floats) -> Floats:
    """Mean and, for two coordinates, half the log spread, elongation and direction of points."""
    middle = np.median(points, axis=0)
    away = points - middle
    second = (away.T @ away) / len(points)
    size = float(np.trace(second)) + 1e-12
    if points.shape[1] == 1:
        return np.array([middle[0], np.log(size) / 2])
    shape = np.array([second[0, 0] - second[1, 1], 2 * second[0, 1]]) / size
    return np.array([*middle, np.log(size) / 2, *shape])
