"""Fine densities where features are expected: one small tile per predicted feature.

At the finest blur a window over the whole body would be almost empty, and a grid fine enough for
unbiased gradients too large.  An atlas stacks a tile around each predicted feature into one array,
so that a single `cv2.remap` still looks everything up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mixpose.density.blur import bell, mass
from mixpose.density.grid import FAR, merge, remap
from mixpose.records import GridPattern, PointPattern

Floats: TypeAlias = NDArray[np.float64]

FINEST_STEPS = {"range": 24.0, "points": 16.0, "grid": 8.0}
"""Grid points per standard deviation.  A gradient that is looked up between them errs by a share of
the third derivative, which vanishes at a peak; more points gain nothing, as the single precision of
coordinates then counts.  Sums over a grid take the longest, and rows cost less than areas."""

COARSEST_STEPS = 4.0
MOST_CELLS = 300_000
_CUT = 6.0  # standard deviations at which sums over a grid end: the tail holds 1e-9


@dataclass(frozen=True)
class Atlas:
    """A density with gradient on one tile per feature.

    Attributes
    ----------
    values : (n * H, W, 3) float32
        Tiles below one another: density, then gradient;
        for ranges the last channel is empty.
    second : (n * H, W, 3 or 1) float32
        Second derivatives on the same tiles: uu, uv, vv, or rr alone for ranges.
    origins : (n, m) float64
        Sensor coordinates of each tile's first grid point.
    rows : int
        H, rows per tile; one for ranges.
    step : float
        Sensor units between grid points.
    sigma : float
        Standard deviation, in sensor units, that one exact feature has in it.
    """

    values: NDArray[np.float32]
    second: NDArray[np.float32]
    origins: Floats
    rows: int
    step: float
    sigma: float

    def sample(self, y: Floats) -> NDArray[np.float32]:
        """Look feature i up in tile i; the floor outside its tile.

        Parameters
        ----------
        y : (..., n, m) float64

        Returns
        -------
        (..., n, 1 + m) float32
        """
        return self._look_up(self.values, y, self._maps(y))

    def sample_all(self, y: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """As `sample`, with the second derivatives (..., n, m, m)."""
        maps = self._maps(y)
        second = remap(self.second, *maps)
        if self.origins.shape[1] == 2:
            second = second[:, [0, 1, 1, 2]]
        return self._look_up(self.values, y, maps), second.reshape(*y.shape, y.shape[-1])

    def _look_up(
        self,
        layers: NDArray[np.float32],
        y: Floats,
        maps: tuple[NDArray[np.float32], NDArray[np.float32]],
    ) -> NDArray[np.float32]:
        channels = 1 + y.shape[-1]
        return remap(layers, *maps)[:, :channels].reshape(*y.shape[:-1], channels)

    def _maps(self, y: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        n, m = self.origins.shape
        index = (y - self.origins) / self.step
        limits = np.array([self.values.shape[1] - 1, self.rows - 1][:m])
        inside = np.all((index >= 0) & (index <= limits), axis=-1)
        map_u = np.where(inside, index[..., 0], FAR)
        row = index[..., 1] if m == 2 else np.zeros(index.shape[:-1])
        map_v = np.where(inside, row + self.rows * np.arange(n), FAR)
        return map_u.ravel().astype(np.float32), map_v.ravel().astype(np.float32)


def render_atlas(
    pattern: PointPattern | GridPattern, sigma: float, centres: Floats, reach: float
) -> Atlas:
    """Blur a pattern on tiles around given positions, without interpolation.

    A tile is a product of three matrices: Gaussians along v, the pattern, Gaussians along u.  The
    pattern is diagonal for points and the values themselves for a grid.

    Parameters
    ----------
    pattern : PointPattern or GridPattern
        Not empty.
    sigma : float
        Standard deviation of the blur in sensor units; for a grid at least its step.
    centres : (n, m) array
        Where features are expected.
    reach : float
        Half-width of a tile in sensor units.
    """
    n, m = centres.shape
    affordable = (MOST_CELLS / n) ** (1 / m) * sigma / (2 * reach)
    kind = "range" if m == 1 else "points" if isinstance(pattern, PointPattern) else "grid"
    step = sigma / float(np.clip(affordable, COARSEST_STEPS, FINEST_STEPS[kind]))
    half = int(np.ceil(reach / step))
    offsets: Floats = step * np.arange(-half, half + 1, dtype=np.float64)
    if isinstance(pattern, PointPattern):
        layers = _point_tiles(pattern, sigma, centres, offsets)
    else:
        total = mass(pattern) / pattern.step**m  # sums times the area of a grid cell are integrals
        tiles = [_grid_tile(pattern, total, sigma, centre, offsets) for centre in centres]
        layers = [np.stack(layer) for layer in zip(*tiles, strict=True)]
    rows = layers[0].shape[1]
    flat = [np.ascontiguousarray(layer.reshape(n * rows, -1), dtype=np.float32) for layer in layers]
    return Atlas(
        values=merge(flat[: 1 + m]),
        second=merge(flat[1 + m :]),
        origins=centres + offsets[0],
        rows=rows,
        step=step,
        sigma=sigma,
    )


_ORDERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # derivatives along u, along v


def _point_tiles(
    pattern: PointPattern, sigma: float, centres: Floats, offsets: Floats
) -> list[NDArray[np.float32]]:
    """Layers (n, H, W) of all tiles: density, gradient, second derivatives."""
    weights = (pattern.weights / pattern.weights.sum()).astype(np.float32)
    axes = [
        bell((centres[:, k, None] + offsets)[:, None, :], pattern.points[:, k], sigma)
        for k in range(centres.shape[1])
    ]
    if len(axes) == 1:
        return [(weights @ derivative)[:, None, :] for derivative in axes[0]]
    along = axes[0]
    down = [np.swapaxes(derivative * weights[:, None], 1, 2) for derivative in axes[1]]
    return [down[v] @ along[u] for u, v in _ORDERS]


def _grid_tile(
    pattern: GridPattern, total: float, sigma: float, centre: Floats, offsets: Floats
) -> list[NDArray[np.float32]]:
    """Layers (H, W) of one tile: sums over the pattern's grid points around it."""
    step, m = pattern.step, len(pattern.origin)
    cuts: list[slice] = []
    axes: list[tuple[NDArray[np.float32], ...]] = []
    for k in range(m):
        size = pattern.values.shape[1 - k]
        margin = offsets[-1] + _CUT * sigma
        first = int(np.clip((centre[k] - margin - pattern.origin[k]) / step, 0, size - 1))
        last = int(np.clip((centre[k] + margin - pattern.origin[k]) / step + 2, first + 1, size))
        places = pattern.origin[k] + step * np.arange(first, last)
        cuts.append(slice(first, last))
        axes.append(bell(centre[k] + offsets, places, sigma))
    if m == 1:
        row = (pattern.values[0, cuts[0]] / total).astype(np.float32)
        profiles: list[NDArray[np.float32]] = [(row @ derivative)[None] for derivative in axes[0]]
        return profiles
    values = (pattern.values[cuts[1], cuts[0]] / total).astype(np.float32)
    rows: list[NDArray[np.float32]] = [derivative.T @ values for derivative in axes[1]]
    layers: list[NDArray[np.float32]] = [rows[v] @ axes[0][u] for u, v in _ORDERS]
    return layers
