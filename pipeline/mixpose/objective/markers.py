"""Markers with a size: where the centres of their images are.

The image of a sphere or of an oblique disk is an ellipse, and with a lens nearly one, whose centre
is not where the marker's own centre is seen.  What a sensor sees of a sphere is the disk within the
circle at which lines of sight touch it.  So both are disks, of which the centroid of the image is

    ∫ y(x) |det ∂y| dx / ∫ |det ∂y| dx,

over the disk: the centroid of the grey values, and to the same order the centre of the ellipse
through the rim.  Four points at 1/√2 of the radius integrate polynomials of third degree over a
disk; what is left is of the fourth order of the marker's size over its distance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mixpose.body import Body
from mixpose.density import DRAWING
from mixpose.records import Floats, Mask
from mixpose.sensors import OUTSIDE, Sensor, SensorBatch


class MarkerBatch:
    """Sensors side by side that look at spheres or disks."""

    def __init__(self, sensors: Sequence[Sensor], body: Body, batch: SensorBatch) -> None:
        self._sensors = tuple(sensors)
        self._batch = batch
        radii = body.node_radii
        assert radii is not None, "a body of points needs no disks"
        self._radii = radii[:, None]
        self._ranges = [k for k, sensor in enumerate(sensors) if sensor.dimension == 1]
        normals = body.node_normals if body.shape == "disk" else None
        self._axes = None if normals is None else across(normals)

    def linearise(self, poses: Floats, world: Floats) -> tuple[Floats, Floats, Mask]:
        """As `SensorBatch.linearise`, of nodes (H * n, 3) of the body at poses (H, 4, 4).

        The Jacobian is that of a marker that moves without turning.
        """
        L, H, count = len(self._sensors), len(poses), len(world)
        radii = np.tile(self._radii, (H, 1))
        if self._axes is None:
            towards = np.array([sensor.towards(world) for sensor in self._sensors])
            squared = np.einsum("lni,lni->ln", towards, towards)[..., None]
            share = np.minimum(radii**2 / squared, DRAWING.nearest**2)
            middle = world + share * towards
            radii = radii * np.sqrt(1 - share)
            axes = across(towards / np.sqrt(squared))
        else:
            turned = self._axes[:, None] @ poses[:, :3, :3].swapaxes(1, 2)
            middle, axes = world, turned.reshape(2, count, 3)
        steps = np.sqrt(0.5) * radii * axes  # where the four points are
        nodes = np.stack(
            [middle + steps[0], middle - steps[0], middle + steps[1], middle - steps[1]]
        )
        if self._axes is None:
            nodes = nodes.swapaxes(0, 1).reshape(L, 4 * count, 3)
        else:
            nodes, axes = nodes.reshape(4 * count, 3), axes[:, None]
        y, J, seen = self._batch.linearise(nodes)
        y, J = y.reshape(L, 4, count, 2), J.reshape(L, 4, count, 2, 3)
        a, b = (np.einsum("lknij,lnj->lkni", J, axis) for axis in axes + np.zeros((1, L, 1, 1)))
        weights = np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
        total = weights.sum(axis=1)
        visible = seen.reshape(L, 4, count).all(axis=1) & (total > 0)
        weights /= np.where(visible, total, 1.0)[:, None]
        y, J = (weights[..., None] * y).sum(axis=1), (weights[..., None, None] * J).sum(axis=1)
        y[~visible], J[~visible] = OUTSIDE, 0.0
        if self._ranges:
            plain = self._batch.linearise(world)
            for own, other in zip((y, J, visible), plain, strict=True):
                own[self._ranges] = other[self._ranges]
        return y, J, visible


def across(directions: Floats) -> Floats:
    """Two unit vectors (2, ..., 3) across unit vectors (..., 3) and each other.

    Duff and others, Building an Orthonormal Basis, Revisited, JCGT 6 (2017).
    """
    x, y, z = np.moveaxis(directions, -1, 0)
    sign = np.copysign(1.0, z)
    a = -1 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    return np.stack([first, np.stack([b, sign + y * y * a, -y], axis=-1)])
