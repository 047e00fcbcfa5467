"""Fine densities where features are expected: one small tile per predicted feature.

At the finest blur a window over the whole body would be almost empty, and a grid fine enough for
unbiased gradients too large.  An atlas stacks a tile around each predicted feature into one array,
so that a single `cv2.remap` still looks everything up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from mixpose.density.blur import bell
from mixpose.density.grid import FAR, remap
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
    values : (n * H, W, 1 + m) float32
        Tiles below one another.
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
        n, m = self.origins.shape
        index = (y - self.origins) / self.step
        columns = self.values.shape[1]
        limits = np.array([columns - 1, self.rows - 1][:m])
        inside = np.all((index >= 0) & (index <= limits), axis=-1)
        map_u = np.where(inside, index[..., 0], FAR)
        row = index[..., 1] if m == 2 else np.zeros(index.shape[:-1])
        map_v = np.where(inside, row + self.rows * np.arange(n), FAR)
        flat = remap(
            self.values, map_u.ravel().astype(np.float32), map_v.ravel().astype(np.float32)
        )
        return flat.reshape(*y.shape[:-1], self.values.shape[2])


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
    bells, slopes = zip(
        *(
            bell((centres[:, k, None] + offsets)[:, None, :], pattern.points[:, k], sigma)
            for k in range(m)
        ),
        strict=True,
    )
    if m == 1:
        layers = [weights @ bells[0], weights @ slopes[0]]
        rows = 1
    else:
        down = np.swapaxes(bells[1] * weights[:, None], 1, 2)
        slope_down = np.swapaxes(slopes[1] * weights[:, None], 1, 2)
        layers = [down @ bells[0], down @ slopes[0], slope_down @ bells[0]]
        rows = len(offsets)
    stacked = cv2.merge([np.ascontiguousarray(layer.reshape(n * rows, -1)) for layer in layers])
    origins = centres + offsets[0]
    return Atlas(np.asarray(stacked, dtype=np.float32), origins, rows, step, sigma)
