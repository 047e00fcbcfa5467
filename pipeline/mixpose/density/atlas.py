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

from mixpose.density.blur import bell
from mixpose.density.grid import FAR, merge, remap
from mixpose.records import PointPattern

Floats: TypeAlias = NDArray[np.float64]

FINEST_STEPS = 16.0
"""Grid points per standard deviation: gradients at a peak then err by 1e-5 standard deviations."""

COARSEST_STEPS = 4.0
MOST_CELLS = 300_000


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


def render_atlas(pattern: PointPattern, sigma: float, centres: Floats, reach: float) -> Atlas:
    """Blur a point pattern on tiles around given positions.

    Parameters
    ----------
    pattern : PointPattern
        Not empty.
    sigma : float
        Standard deviation of the blur in sensor units.
    centres : (n, m) array
        Where features are expected.
    reach : float
        Half-width of a tile in sensor units.
    """
    n, m = centres.shape
    affordable = (MOST_CELLS / n) ** (1 / m) * sigma / (2 * reach)
    step = sigma / float(np.clip(affordable, COARSEST_STEPS, FINEST_STEPS))
    half = int(np.ceil(reach / step))
    offsets = step * np.arange(-half, half + 1)
    weights = (pattern.weights / pattern.weights.sum()).astype(np.float32)
    axes = [
        bell((centres[:, k, None] + offsets)[:, None, :], pattern.points[:, k], sigma)
        for k in range(m)
    ]
    if m == 1:
        rows, layers = 1, [weights @ derivative for derivative in axes[0]]
    else:
        rows = len(offsets)
        along = axes[0]
        down = [np.swapaxes(derivative * weights[:, None], 1, 2) for derivative in axes[1]]
        orders = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
        layers = [down[v] @ along[u] for u, v in orders]
    flat = [np.ascontiguousarray(layer.reshape(n * rows, -1)) for layer in layers]
    return Atlas(
        values=merge(flat[: 1 + m]),
        second=merge(flat[1 + m :]),
        origins=centres + offsets[0],
        rows=rows,
        step=step,
        sigma=sigma,
    )
