"""The paper's objectives as fast functions of its six numbers.

The same values as `mixpose.objective.PaperObjective` and `IndependentObjective`, which serve any
sensors and batches of poses; here one pose of one system at a time, with the projections of all
samples in one matrix product, as the table takes millions of evaluations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.sensors import ParallelBeam, RangeSensor
from paper.measurements import Measurement
from paper.systems import System, rotation

Floats: TypeAlias = NDArray[np.float64]
Reals: TypeAlias = NDArray[np.floating[Any]]
Function: TypeAlias = Callable[[Floats], float]
Projection: TypeAlias = Callable[[Floats], Reals]


def sampled_objectives(
    system: System,
    measurements: Sequence[Measurement],
    samples: Floats,
    *,
    double: bool = False,
) -> tuple[Function, Function]:
    """Formula (4), and the product of separate objectives, to be maximised over β (6,).

    Parameters
    ----------
    system : System
    measurements : sequence of Measurement
        One per sensor.
    samples : (N, R, 3) array
        Samples of the features, in the object's frame.
    double : bool
        Whether coordinates and look-ups have double precision, several times slower, instead of
        the single precision of `cv2.remap`.
    """
    dtype = np.float64 if double else np.float32
    points = np.ascontiguousarray(samples.reshape(-1, 3).T)
    densities: list[Reals] = [_normalised(m.values).astype(dtype) for m in measurements]
    ranging = isinstance(system.sensors[0], RangeSensor)
    if ranging:
        # rows within an image are looked up twice as fast as the rows at its borders
        densities = [np.repeat(g, 4, axis=0) for g in densities]
    if double:
        densities = [np.pad(g, 1) for g in densities]
    shape = samples.shape[:2]  # cv2.remap takes maps of less than 32767 a side
    inner_row = np.ones(shape, dtype=dtype)
    project = (_ranges if ranging else _pixels)(system, measurements, points, dtype)
    look_up = _bilinear if double else _remap

    def looked_up(beta: Floats) -> list[Reals]:
        rows = project(beta)
        if ranging:
            maps = [(row.reshape(shape), inner_row) for row in rows]
        else:
            pairs = zip(rows[::2], rows[1::2], strict=True)
            maps = [(u.reshape(shape), v.reshape(shape)) for u, v in pairs]
        return [look_up(g, u, v) for g, (u, v) in zip(densities, maps, strict=True)]

    def paper(beta: Floats) -> float:
        values = looked_up(beta)
        product = values[0] * values[1]
        for g in values[2:]:
            product *= g
        return _mean(product)

    def independent(beta: Floats) -> float:
        return math.prod(_mean(g) for g in looked_up(beta))

    return paper, independent


def _normalised(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """A density; noise leaves the sum of an image undefined, so magnitudes are counted."""
    return np.asarray(values / np.abs(values).sum(dtype=np.float64), dtype=np.float32)


def _mean(values: Reals) -> float:
    # single precision would move the optimum by thousandths of a unit
    return float(values.astype(np.float64).sum()) / values.size


def _remap(values: Reals, u: Reals, v: Reals) -> Reals:
    looked_up = cv2.remap(values, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(looked_up, dtype=np.float32)


def _bilinear(padded: Reals, u: Reals, v: Reals) -> Reals:
    """As `_remap`, for an image within a border of zeros."""
    rows, columns = padded.shape
    u = np.clip(u + 1, 0, columns - 1.001)
    v = np.clip(v + 1, 0, rows - 1.001)
    i, j = u.astype(np.intp), v.astype(np.intp)
    a, b = u - i, v - j
    corner = padded.ravel()
    at = j * columns + i
    above = corner[at] * (1 - a) + corner[at + 1] * a
    below = corner[at + columns] * (1 - a) + corner[at + columns + 1] * a
    return np.asarray(above * (1 - b) + below * b)


def _pixels(
    system: System,
    measurements: Sequence[Measurement],
    points: Floats,
    dtype: type[np.floating[Any]],
) -> Projection:
    """Array indices (u, v, u, v) of all points for parallel-beam cameras: one affine map."""
    rows, offsets = [], []
    for sensor, measurement in zip(system.sensors, measurements, strict=True):
        assert isinstance(sensor, ParallelBeam)
        rows.append(sensor.T_sensor_world[:2, :3] / sensor.pixel_size)
        shift = sensor.T_sensor_world[:2, 3] / sensor.pixel_size
        offsets.append(shift + sensor.principal_point - measurement.origin)
    A, b = np.concatenate(rows), np.concatenate(offsets)
    homogeneous = np.vstack([points, np.ones_like(points[:1])]).astype(dtype)

    def project(beta: Floats) -> Reals:
        M = A @ rotation(beta)
        affine = np.column_stack([M, M @ beta[3:] + b]).astype(dtype)
        return np.asarray(affine @ homogeneous)

    return project


def _ranges(
    system: System,
    measurements: Sequence[Measurement],
    points: Floats,
    dtype: type[np.floating[Any]],
) -> Projection:
    """Array indices of all points for range sensors: ‖z + w − Rᵀγ‖."""
    sources = np.array([s.position for s in system.sensors if isinstance(s, RangeSensor)])
    first = np.array([measurement.origin for measurement in measurements], dtype=dtype)
    squares = (points**2).sum(axis=0)
    extended = np.vstack([points, squares, np.ones_like(squares)]).astype(dtype)

    def project(beta: Floats) -> Reals:
        away = beta[3:] - sources @ rotation(beta)
        # ‖z + a‖² = 2 a·z + ‖z‖² + ‖a‖²
        quadratic = np.column_stack([2 * away, np.ones(len(away)), (away**2).sum(axis=1)])
        ranges = quadratic.astype(dtype) @ extended
        np.sqrt(ranges, out=ranges)
        ranges -= first
        return np.asarray(ranges)

    return project
