"""The paper's objectives as fast functions of its six numbers.

The same values as `mixpose.objective.PaperObjective` and `IndependentObjective`, which serve any
sensors and batches of poses; here one pose of one system at a time, with the projections of all
samples in one matrix product, as the table takes millions of evaluations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.sensors import ParallelBeam, RangeSensor
from paper.measurements import Measurement
from paper.systems import System, rotation

Floats: TypeAlias = NDArray[np.float64]
Function: TypeAlias = Callable[[Floats], float]
Projection: TypeAlias = Callable[[Floats], list[NDArray[np.float32]]]


def sampled_objectives(
    system: System, measurements: Sequence[Measurement], samples: Floats
) -> tuple[Function, Function]:
    """Formula (4), and the product of separate objectives, to be maximised over β (6,).

    Parameters
    ----------
    system : System
    measurements : sequence of Measurement
        One per sensor.
    samples : (N, R, 3) array
        Samples of the features, in the object's frame.
    """
    points = np.ascontiguousarray(samples.reshape(-1, 3).T)
    densities = [_normalised(m.values) for m in measurements]
    ranging = isinstance(system.sensors[0], RangeSensor)
    project = (_ranges if ranging else _pixels)(system, measurements, points)
    shape = samples.shape[:2]  # cv2.remap takes maps of less than 32767 a side
    flat = np.zeros(shape, dtype=np.float32)

    def looked_up(beta: Floats) -> list[NDArray[np.float32]]:
        rows = project(beta)
        if ranging:
            maps = [(row.reshape(shape), flat) for row in rows]
        else:
            pairs = zip(rows[::2], rows[1::2], strict=True)
            maps = [(u.reshape(shape), v.reshape(shape)) for u, v in pairs]
        return [_remap(g, u, v) for g, (u, v) in zip(densities, maps, strict=True)]

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


def _mean(values: NDArray[np.float32]) -> float:
    # single precision would move the optimum by thousandths of a unit
    return float(values.astype(np.float64).sum()) / values.size


def _remap(
    values: NDArray[np.float32], u: NDArray[np.float32], v: NDArray[np.float32]
) -> NDArray[np.float32]:
    looked_up = cv2.remap(values, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(looked_up, dtype=np.float32)


def _pixels(system: System, measurements: Sequence[Measurement], points: Floats) -> Projection:
    """Array indices (u, v, u, v) of all points for parallel-beam cameras: one affine map."""
    rows, offsets = [], []
    for sensor, measurement in zip(system.sensors, measurements, strict=True):
        assert isinstance(sensor, ParallelBeam)
        rows.append(sensor.T_sensor_world[:2, :3] / sensor.pixel_size)
        shift = sensor.T_sensor_world[:2, 3] / sensor.pixel_size
        offsets.append(shift + sensor.principal_point - measurement.origin)
    A, b = np.concatenate(rows), np.concatenate(offsets)
    homogeneous = np.vstack([points, np.ones_like(points[:1])]).astype(np.float32)

    def project(beta: Floats) -> list[NDArray[np.float32]]:
        M = A @ rotation(beta)
        affine = np.column_stack([M, M @ beta[3:] + b]).astype(np.float32)
        return list(affine @ homogeneous)

    return project


def _ranges(system: System, measurements: Sequence[Measurement], points: Floats) -> Projection:
    """Array indices of all points for range sensors: ‖z + w − Rᵀγ‖."""
    sources = np.array([s.position for s in system.sensors if isinstance(s, RangeSensor)])
    first = np.array([measurement.origin for measurement in measurements], dtype=np.float32)
    squares = (points**2).sum(axis=0)
    extended = np.vstack([points, squares, np.ones_like(squares)]).astype(np.float32)

    def project(beta: Floats) -> list[NDArray[np.float32]]:
        away = beta[3:] - sources @ rotation(beta)
        # ‖z + a‖² = 2 a·z + ‖z‖² + ‖a‖²
        quadratic = np.column_stack([2 * away, np.ones(len(away)), (away**2).sum(axis=1)])
        ranges = quadratic.astype(np.float32) @ extended
        np.sqrt(ranges, out=ranges)
        ranges -= first
        return list(ranges)

    return project
