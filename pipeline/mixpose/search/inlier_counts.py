"""How many distinct detections a pose explains: a quick judgement of very many guesses.

Detections of a camera are drawn once as disks of labels into a plane across its rays, where the
projection is a matrix whatever the lens, so that one look-up per predicted feature says which
detection it meets.  Features that fall on the same detection count once: counting features would
favour poses that gather them all on one blob.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body
from mixpose.records import Floats
from mixpose.search.detections import SensorDetections
from mixpose.search.problem import SearchProblem
from mixpose.search.three_points import cross
from mixpose.sensors import Rays

Integers: TypeAlias = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class LabelImage:
    """Disks around the detections of one camera."""

    projection: Floats  # (3, 4) from the world to columns and rows of cells, homogeneous
    eye: Floats  # (4,) centre of projection, or the way to it from everywhere, homogeneous
    # (rows, columns) detection 1 to M; in the lower eight bits 255 at a detection, 0 at its rim.
    # Most are empty, and take no memory; the outermost are for certain
    cells: Integers
    count: int  # M

    def look_up(self, world: Floats) -> Integers:
        """Cells (K,) that points in the world (3, K) fall into."""
        u, v, depth = self.projection[:, :3] @ world + self.projection[:, 3:]
        scale = 1.0 / np.maximum(depth, 1e-300)
        rows, columns = self.cells.shape
        column = np.clip(u * scale, 0.0, columns - 1.0).astype(np.int32)
        row = np.clip(v * scale, 0.0, rows - 1.0).astype(np.int32)
        return np.asarray(np.take(self.cells, row * columns + column))

    def faced(self, world: Floats, outward: Floats) -> NDArray[np.bool_]:
        """Which points (3, K) with normals (3, K) turn their face to the camera."""
        towards = self.eye[:3, None] - self.eye[3] * world
        return np.asarray((outward * towards).sum(axis=0) > 0)


def label_images(problem: SearchProblem) -> list[LabelImage]:
    """Label images of all cameras, with disks as large as errors of detections may be."""
    return [_label_image(problem, sensor, rays) for sensor, rays in problem.cameras]


def _label_image(problem: SearchProblem, sensor: SensorDetections, rays: Rays) -> LabelImage:
    budget, radius = problem.budget, problem.reach(sensor)
    middle = rays.directions.mean(axis=0)
    middle /= max(float(np.linalg.norm(middle)), 1e-12)
    side = cross(middle, np.eye(3)[np.abs(middle).argmin()])
    side /= np.linalg.norm(side)
    axes, centre = np.array([side, cross(middle, side), middle]), rays.origins[0]
    to_plane, eye = np.column_stack([axes, -axes @ centre]), np.append(centre, 1.0)
    if not rays.central:
        to_plane[2], eye = [0.0, 0.0, 0.0, 1.0], np.append(-middle, 0.0)
    unit = rays.slope if rays.central else rays.offset
    points = rays.origins + rays.directions
    plane = points @ to_plane[:, :3].T + to_plane[:, 3]
    depth = plane[:, 2:]
    # how many px a unit of the plane is at each detection, whatever the lens
    _, J, _ = sensor.view.sensor.linearise(points)
    per_unit = np.sqrt(np.abs(np.linalg.det(J @ axes[:2].T))) * depth[:, 0] * unit
    radii = radius / np.where(per_unit > 0, per_unit, 1.0)
    inside = depth[:, 0] > budget.min_cosine
    places, radii = (plane[:, :2] / unit / depth)[inside], radii[inside]
    if not len(places):
        places, radii = np.zeros((1, 2)), np.full(1, radius)
    lower, extent = places.min(axis=0), np.ptp(places, axis=0)
    step = float(np.median(radii)) / budget.cells
    step = max(step, float(np.sqrt(np.prod(extent) / (128 * budget.cache))))
    margin = radii.max() + 2 * step
    columns, rows = (np.ceil((extent + 2 * margin) / step) + 1).astype(int)
    u, v = (margin - lower) / step
    cells = np.zeros((rows, columns), dtype=np.int32)
    _draw(cells, places / step + np.array([u, v]), radii / step)
    to_cells = np.array([[1 / (unit * step), 0.0, u], [0.0, 1 / (unit * step), v], [0.0, 0.0, 1.0]])
    return LabelImage(to_cells @ to_plane, eye, cells, len(rays))


def _draw(cells: Integers, places: Floats, radii: Floats) -> None:
    """Disks of labels and nearness, at places (M, 2) in cells."""
    half = int(np.ceil(radii.max()))
    u, v = np.floor(places).astype(np.int64).T[..., None] + np.arange(-half, half + 1)
    du, dv = places[:, :1] - u - 0.5, places[:, 1:] - v - 0.5
    near = 1 - np.sqrt(dv[:, :, None] ** 2 + du[:, None] ** 2) / radii[:, None, None]
    label, iv, iu = np.nonzero(near > 0)
    value = (near[label, iv, iu] * 255).astype(np.int32)
    order = np.argsort(value, kind="stable")  # where disks overlap the nearest is drawn last
    label, iv, iu, value = (column[order] for column in (label, iv, iu, value))
    cells[v[label, iv], u[label, iu]] = ((label + 1) << 8) + value


def count_inliers(
    images: Sequence[LabelImage], body: Body, poses: Floats, max_together: int
) -> tuple[Floats, Floats]:
    """Distinct detections (L, H) of each camera that poses (H, 4, 4) explain, and how nearly (H,).

    That is nearness, 0 to 1, summed over features, for ranking equals.  Not more than
    `max_together` features times poses are tested together.
    """
    counts, near = np.zeros((len(images), len(poses))), np.zeros(len(poses))
    rows = max(max_together // len(body), 1)
    for start in range(0, len(poses), rows):
        part = slice(start, start + rows)
        axes = np.ascontiguousarray(poses[part, :3].transpose(1, 0, 2))
        world = axes[..., :3] @ body.means.T + axes[..., 3:]
        shape = world.shape[1:]
        world = world.reshape(3, -1)
        for k, image in enumerate(images):
            met = image.look_up(world)
            if body.normals is not None:
                outward = (axes[..., :3] @ body.normals.T).reshape(3, -1)
                met = np.where(image.faced(world, outward), met, 0)
            met = met.reshape(shape)
            labels = np.sort(met >> 8, axis=1)
            labels[:, 1:] *= labels[:, 1:] != labels[:, :-1]
            counts[k, part] = np.count_nonzero(labels, axis=1)
            near[part] += (met & 255).sum(axis=1) / 256
    return counts, near
