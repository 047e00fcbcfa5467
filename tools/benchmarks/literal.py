"""The paper's method written down as it stands, with SciPy's look-ups: the pace to compare with.

Formula (4) by Monte-Carlo integration with bilinear interpolation, maximised by Nelder-Mead as
MATLAB's ``fminsearch`` starts and stops it.  Nothing here is shared with mixpose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from paper.search import fmaxsearch
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import map_coordinates
from scipy.stats import norm, qmc

Floats: TypeAlias = NDArray[np.float64]
LookUp: TypeAlias = Callable[[Floats, Floats], Floats]
Interpolation: TypeAlias = Literal["map_coordinates", "RegularGridInterpolator"]


@dataclass(frozen=True)
class Camera:
    """A camera with the density g that it measured.

    Attributes
    ----------
    g : (H, W) float64
        One value per pixel.
    P : (3, 4) float64
        Projects homogeneous world coordinates to homogeneous pixels.
    """

    g: Floats
    P: Floats


class LiteralObjective:
    """Formula (4) as a function of φ1, φ2, φ3 (radians), w1, w2, w3.

    Parameters
    ----------
    cameras : sequence of Camera
    samples : (S, 3) array
        Samples of all features, z_ir.
    interpolation : str
        Which of SciPy's two; the first is several times faster.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        samples: Floats,
        interpolation: Interpolation = "map_coordinates",
    ) -> None:
        self.samples = samples
        self.projections = [camera.P for camera in cameras]
        self.look_ups = [_look_up(camera.g, interpolation) for camera in cameras]

    def __call__(self, beta: Floats) -> float:
        x = (self.samples + beta[3:]) @ _rotation(beta).T
        homogeneous = np.column_stack([x, np.ones(len(x))])
        product = np.ones(len(x))
        for P, look_up in zip(self.projections, self.look_ups, strict=True):
            projected = homogeneous @ P.T
            u, v = projected[:, 0] / projected[:, 2], projected[:, 1] / projected[:, 2]
            product = product * look_up(u, v)
        return float(product.mean())

    def estimate(self, start: Floats) -> Floats:
        """The maximum that Nelder-Mead comes to from a start (6,)."""
        return fmaxsearch(self, start)


def samples_of(points: Floats, spread: float, count: int, seed: int) -> Floats:
    """Gaussian Latin hypercube samples (N·R, 3) of every feature (N, 3), as by ``lhsnorm``.

    All features have the same offsets, in mirrored pairs: errors of sampling neither deform the
    body nor shift it, which makes the method's estimates several times more accurate.
    """
    half = norm.ppf(qmc.LatinHypercube(3, rng=np.random.default_rng(seed)).random(count // 2))
    offsets = spread * np.concatenate([half, -half])
    return np.concatenate([point + offsets for point in points])


def _look_up(g: Floats, interpolation: Interpolation) -> LookUp:
    if interpolation == "map_coordinates":
        return lambda u, v: np.asarray(map_coordinates(g, [v, u], order=1, mode="constant"))
    axes = (np.arange(g.shape[0]), np.arange(g.shape[1]))
    bilinear = RegularGridInterpolator(axes, g, bounds_error=False, fill_value=0.0)
    return lambda u, v: np.asarray(bilinear(np.column_stack([v, u])))


def _rotation(beta: Floats) -> Floats:
    """R3(φ3) R2(φ2) R1(φ1)."""
    (c1, c2, c3), (s1, s2, s3) = np.cos(beta[:3]), np.sin(beta[:3])
    R1 = np.array([[1, 0, 0], [0, c1, -s1], [0, s1, c1]])
    R2 = np.array([[c2, 0, s2], [0, 1, 0], [-s2, 0, c2]])
    R3 = np.array([[c3, -s3, 0], [s3, c3, 0], [0, 0, 1]])
    return np.asarray(R3 @ R2 @ R1)
