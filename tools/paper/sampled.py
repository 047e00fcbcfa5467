"""The paper's objectives as fast functions of its six numbers.

They are `mixpose.objective.PaperObjective` and `IndependentObjective`; in double precision, for
comparison, they are computed here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.density import Density, Window
from mixpose.objective import IndependentObjective, PaperObjective
from mixpose.objective.paper import SampledTerm
from mixpose.sensors import ParallelBeam, RangeSensor
from paper.measurements import Measurement
from paper.systems import System, pose, rotation

Floats: TypeAlias = NDArray[np.float64]
Function: TypeAlias = Callable[[Floats], float]
Projection: TypeAlias = Callable[[Floats], Floats]


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
    if double:
        return _in_double_precision(system, measurements, samples)
    terms = []
    for sensor, measured in zip(system.sensors, measurements, strict=True):
        window = Window(measured.origin, measured.values.shape, 1.0)
        # values do not depend on the width of a feature, only curvatures do
        terms.append(SampledTerm(sensor, Density(_normalised(measured.values), window, 1.0)))
    inside, outside = PaperObjective(terms, samples), IndependentObjective(terms, samples)
    return (
        lambda beta: float(inside.value(pose(beta))),
        lambda beta: float(outside.value(pose(beta))),
    )


def _in_double_precision(
    system: System, measurements: Sequence[Measurement], samples: Floats
) -> tuple[Function, Function]:
    points = np.ascontiguousarray(samples.reshape(-1, 3).T)
    densities = [np.pad(_normalised(m.values).astype(np.float64), 1) for m in measurements]
    ranging = isinstance(system.sensors[0], RangeSensor)
    project = (_ranges if ranging else _pixels)(system, measurements, points)

    def looked_up(beta: Floats) -> list[Floats]:
        rows = project(beta)
        if ranging:
            pairs = [(row, np.zeros_like(row)) for row in rows]
        else:
            pairs = list(zip(rows[::2], rows[1::2], strict=True))
        return [_bilinear(g, u, v) for g, (u, v) in zip(densities, pairs, strict=True)]

    def paper(beta: Floats) -> float:
        return float(np.prod(looked_up(beta), axis=0).mean())

    def independent(beta: Floats) -> float:
        return math.prod(float(g.mean()) for g in looked_up(beta))

    return paper, independent


def _normalised(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """A density; noise leaves the sum of an image undefined, so magnitudes are counted."""
    return np.asarray(values / np.abs(values).sum(dtype=np.float64), dtype=np.float32)


def _bilinear(padded: Floats, u: Floats, v: Floats) -> Floats:
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
) -> Projection:
    """Array indices (u, v, u, v) of all points for parallel-beam cameras: one affine map."""
    rows, offsets = [], []
    for sensor, measurement in zip(system.sensors, measurements, strict=True):
        assert isinstance(sensor, ParallelBeam)
        rows.append(sensor.T_sensor_world[:2, :3] / sensor.pixel_size)
        shift = sensor.T_sensor_world[:2, 3] / sensor.pixel_size
        offsets.append(shift + sensor.principal_point - measurement.origin)
    A, b = np.concatenate(rows), np.concatenate(offsets)
    homogeneous = np.vstack([points, np.ones_like(points[:1])])

    def project(beta: Floats) -> Floats:
        M = A @ rotation(beta)
        affine = np.column_stack([M, M @ beta[3:] + b])
        return np.asarray(affine @ homogeneous)

    return project


def _ranges(
    system: System,
    measurements: Sequence[Measurement],
    points: Floats,
) -> Projection:
    """Array indices of all points for range sensors: ‖z + w − Rᵀγ‖."""
    sources = np.array([s.position for s in system.sensors if isinstance(s, RangeSensor)])
    first = np.array([measurement.origin for measurement in measurements])
    squares = (points**2).sum(axis=0)
    extended = np.vstack([points, squares, np.ones_like(squares)])

    def project(beta: Floats) -> Floats:
        away = beta[3:] - sources @ rotation(beta)
        # ‖z + a‖² = 2 a·z + ‖z‖² + ‖a‖²
        quadratic = np.column_stack([2 * away, np.ones(len(away)), (away**2).sum(axis=1)])
        ranges = quadratic @ extended
        np.sqrt(ranges, out=ranges)
        ranges -= first
        return np.asarray(ranges)

    return project
