"""How many distinct detections a pose explains: a quick judgement of very many guesses.

Detections of a camera are drawn once as disks of labels into a plane across its rays, where the
projection is a matrix whatever the lens, so that one look-up per predicted feature says which
detection it meets.  Only pages of the plane with a detection are kept.  Features that fall on the
same detection count once: counting features would favour poses that gather them all on one blob.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.search.alignment import cross
from mixpose.search.budget import LabelOptions
from mixpose.search.detections import SensorDetections
from mixpose.sensors import Rays

Floats: TypeAlias = NDArray[np.float64]
Integers: TypeAlias = NDArray[np.int32]

_PAGE = 16  # cells along a page
_NEARNESS = 256  # a cell holds label * 256 + nearness
_WORD = 63  # labels in one word of bits


@dataclass(frozen=True)
class LabelImage:
    """Disks around the detections of one camera.

    Attributes
    ----------
    axes : (3, 3) float64
        Rows: the plane's two axes, scaled to cells, and the middle of the rays.
    centre : (3,) float64
        Centre of projection, or a point of the plane for parallel rays.
    central : bool
    origin : (2,) float64
        Cells from the corner of the plane to the middle of the rays.
    limits : (2,) float64
        Largest indices; the outermost pages are empty.
    table : (pages,) int32
        Where each page begins in `cells`; 0 where it is empty.
    columns : int
        Pages in a row of the table.
    cells : (cells,) int32
        Detection 1 to M times 256, plus nearness: 255 at a detection, 0 at the rim.
    count : int
        M.
    """

    axes: Floats
    centre: Floats
    central: bool
    origin: Floats
    limits: Floats
    table: Integers
    columns: int
    cells: Integers
    count: int

    def look_up(self, world: Floats) -> Integers:
        """Cells (K,) that points in the world (3, K) fall into."""
        u, v, depth = self.axes @ world - (self.axes @ self.centre)[:, None]
        if self.central:
            scale = 1.0 / np.maximum(depth, 1e-300)
            u *= scale
            v *= scale
        column = np.clip(u + self.origin[0], 0.0, self.limits[0]).astype(np.int32)
        row = np.clip(v + self.origin[1], 0.0, self.limits[1]).astype(np.int32)
        page = self.table[(row >> 4) * self.columns + (column >> 4)]
        return np.asarray(self.cells[page + ((row & 15) << 4) + (column & 15)])

    def faced(self, world: Floats, outward: Floats) -> NDArray[np.bool_]:
        """Which points (3, K) with normals (3, K) turn their face to the camera."""
        towards = self.centre[:, None] - world if self.central else -self.axes[2][:, None]
        return np.asarray((outward * towards).sum(axis=0) > 0)


def label_images(
    detections: Sequence[SensorDetections], gate: float, options: LabelOptions
) -> list[LabelImage]:
    """Label images of all cameras, with disks of `gate` times σ_ε."""
    return [
        _label_image(each, each.rays, gate * each.sigma, options)
        for each in detections
        if each.rays is not None and len(each.rays)
    ]


def _label_image(
    seen: SensorDetections, rays: Rays, radius: float, options: LabelOptions
) -> LabelImage:
    axes = _axes(rays.directions)
    centre = rays.origins[0]
    points = rays.origins + rays.directions
    plane = (points - centre) @ axes.T
    unit = rays.slope if rays.central else rays.offset
    # how many px a unit of the plane is at each detection, whatever the lens
    _, J, _ = seen.view.sensor.linearise(points)
    depth = plane[:, 2] if rays.central else np.ones(len(plane))
    per_unit = np.sqrt(np.abs(np.linalg.det(J @ axes[:2].T))) * depth * unit
    radii = radius / np.where(per_unit > 0, per_unit, 1.0)
    places = plane[:, :2] / unit / (plane[:, 2:] if rays.central else 1.0)
    inside = ~np.array(rays.central) | (plane[:, 2] > options.min_cosine)
    places, radii = places[inside], radii[inside]
    if not len(places):
        places, radii = np.zeros((1, 2)), np.full(1, radius)
    lower, upper = places.min(axis=0), places.max(axis=0)
    step = float(np.median(radii)) / options.cells
    step = max(step, float(np.sqrt(np.prod((upper - lower) / _PAGE) / options.max_pages)))
    margin = radii.max() + (_PAGE + 1) * step
    origin = -(lower - margin) / step
    columns, rows = (np.ceil((upper - lower + 2 * margin) / (_PAGE * step)) + 1).astype(int)
    table, cells = _drawn(places / step + origin, radii / step, int(columns), int(rows))
    return LabelImage(
        axes=axes / np.array([[unit * step], [unit * step], [1.0]]),
        centre=centre,
        central=rays.central,
        origin=origin,
        limits=_PAGE * np.array([columns, rows]) - 1.0,
        table=table,
        columns=int(columns),
        cells=cells,
        count=len(rays),
    )


def _axes(directions: Floats) -> Floats:
    """Two axes across the middle of rays, and the middle itself (3, 3)."""
    middle = directions.mean(axis=0)
    middle /= max(float(np.linalg.norm(middle)), 1e-12)
    side = cross(middle, np.eye(3)[np.abs(middle).argmin()])
    side /= np.linalg.norm(side)
    return np.array([side, cross(middle, side), middle])


def _drawn(places: Floats, radii: Floats, columns: int, rows: int) -> tuple[Integers, Integers]:
    """Table of pages, and cells of those with a disk, of places (M, 2) in cells."""
    half = int(np.ceil(radii.max()))
    offsets = np.arange(-half, half + 1)
    whole = np.floor(places).astype(np.int64)
    u, v = (whole[:, k, None] + offsets for k in (0, 1))
    du, dv = (places[:, k, None] - each - 0.5 for k, each in ((0, u), (1, v)))
    near = 1 - np.sqrt(dv[:, :, None] ** 2 + du[:, None] ** 2) / radii[:, None, None]
    label, iv, iu = np.nonzero(near > 0)
    value = (near[label, iv, iu] * (_NEARNESS - 1)).astype(np.int32)
    u, v = u[label, iu], v[label, iv]
    page = (v >> 4) * columns + (u >> 4)
    drawn, which = np.unique(page, return_inverse=True)
    cell = (which + 1) * _PAGE**2 + ((v & 15) << 4) + (u & 15)
    order = np.argsort(value, kind="stable")  # where disks overlap the nearest is drawn last
    cells = np.zeros((len(drawn) + 1) * _PAGE**2, dtype=np.int32)
    cells[cell[order]] = ((label + 1) * _NEARNESS + value)[order]
    table = np.zeros(rows * columns, dtype=np.int32)
    table[drawn] = _PAGE**2 * np.arange(1, len(drawn) + 1)
    return table, cells


def count_inliers(
    images: Sequence[LabelImage],
    features: Floats,
    normals: Floats | None,
    poses: Floats,
    max_together: int,
) -> tuple[Floats, Floats]:
    """Distinct detections explained by poses (H, 4, 4).

    Parameters
    ----------
    images : sequence of LabelImage
    features : (n, 3) array
        In the object's frame.
    normals : (n, 3) array or None
    poses : (H, 4, 4) array
    max_together : int
        Features times poses that are tested together.

    Returns
    -------
    (L, H) array
        Number per camera.
    (H,) array
        How near they are met: nearness, 0 to 1, summed over features, for ranking equals.
    """
    counts, near = np.zeros((len(images), len(poses))), np.zeros(len(poses))
    rows = max(max_together // len(features), 1)
    for start in range(0, len(poses), rows):
        part = slice(start, min(start + rows, len(poses)))
        axes = np.ascontiguousarray(poses[part, :3].transpose(1, 0, 2))
        world = axes[..., :3] @ features.T + axes[..., 3:]
        shape = world.shape[1:]
        world = world.reshape(3, -1)
        outward = None if normals is None else (axes[..., :3] @ normals.T).reshape(3, -1)
        for k, image in enumerate(images):
            met = image.look_up(world)
            if outward is not None:
                met = np.where(image.faced(world, outward), met, 0)
            met = met.reshape(shape)
            counts[k, part] = _distinct(met >> 8, image.count)
            near[part] += (met & 255).sum(axis=1) * (1.0 / _NEARNESS)
    return counts, near


def _distinct(labels: Integers, count: int) -> Floats:
    """Number of different labels above 0 in each row (H, n)."""
    total = np.zeros(len(labels))
    for first in range(1, count + 1, _WORD):
        table = np.zeros(count + 1, dtype=np.uint64)
        own = np.arange(first, min(first + _WORD, count + 1))
        table[own] = np.uint64(1) << (own - first).astype(np.uint64)
        total += np.bitwise_count(np.bitwise_or.reduce(table[labels], axis=1))
    return total
