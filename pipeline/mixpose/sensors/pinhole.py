"""The pinhole camera with OpenCV's lens distortion."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, Self

import cv2
import numpy as np

from mixpose.records import Floats, Mask
from mixpose.sensors.base import hide, image_bounds, within
from mixpose.sensors.distortion import LensDistortion
from mixpose.sensors.rays import Rays, central_rays

# Of a strong lens OpenCV's five rounds leave a pixel.
_UNDONE = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)

NEAREST = 1e-9  # depth in length units below which a point counts as behind the camera


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """A perspective camera.

    Parameters
    ----------
    camera_matrix : (3, 3) array
        ``[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]`` in px.
    distortion : (k,) array
        0, 4, 5, 8, 12 or 14 OpenCV coefficients.
    resolution : (int, int) or None
        Width and height in px; None leaves the image unbounded.
    T_sensor_world : (4, 4) array

    Raises
    ------
    ValueError
        If the number of distortion coefficients is not one of OpenCV's.
    """

    camera_matrix: Floats
    distortion: Floats = field(default_factory=lambda: np.zeros(0))
    resolution: tuple[int, int] | None = None
    T_sensor_world: Floats = field(default_factory=lambda: np.eye(4))
    lower: Floats = field(init=False, repr=False)
    upper: Floats = field(init=False, repr=False)
    lens: LensDistortion | None = field(init=False, repr=False)

    dimension = 2
    unit: Literal["px", "length"] = field(default="px", init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("camera_matrix", "distortion", "T_sensor_world"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        lower, upper = image_bounds(self.resolution)
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)
        object.__setattr__(self, "lens", LensDistortion.from_coefficients(self.distortion))

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        """Pixels (..., 2) of world points (..., 3), and which of them the camera sees."""
        xy, _, visible = self._normalised(points_world)
        if self.lens:
            xy = self.lens.apply(xy.reshape(-1, 2).T).T.reshape(xy.shape)
        y = xy @ self.camera_matrix[:2, :2].T
        y += self.camera_matrix[:2, 2]
        visible &= within(y, self.lower, self.upper)
        hide(y, visible)
        return y, visible

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """As `project`, with the Jacobian (..., 2, 3) in px per length in between."""
        xy, inverse_depth, visible = self._normalised(points_world)
        y, D = xy, np.broadcast_to(np.eye(2), (*xy.shape, 2))
        if self.lens:
            y, D = self.lens.linearise(xy.reshape(-1, 2).T)
            y, D = y.T.reshape(xy.shape), D.transpose(2, 0, 1).reshape(*xy.shape, 2)
        y = y @ self.camera_matrix[:2, :2].T + self.camera_matrix[:2, 2]
        R = self.T_sensor_world[:3, :3]
        normalised_by_world = (R[:2] - xy[..., :, None] * R[2]) * inverse_depth[..., None, None]
        J = self.camera_matrix[:2, :2] @ D @ normalised_by_world
        visible &= within(y, self.lower, self.upper)
        hide(y, visible, J)
        return y, J, visible

    def towards(self, points_world: Floats) -> Floats:
        """Vectors (..., 3) from world points (..., 3) to the centre of projection."""
        centre = -self.T_sensor_world[:3, :3].T @ self.T_sensor_world[:3, 3]
        return np.asarray(centre - points_world)

    def rays(self, y: Floats) -> Rays:
        """Lines of sight of pixels (M, 2)."""
        K = self.camera_matrix
        # cv2 ignores skew, so that the camera matrix is taken off before
        distorted = (y - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
        xy = distorted
        if self.lens is not None and len(y):  # OpenCV has no empty arrays
            given = distorted.reshape(-1, 1, 2), np.eye(3), self.lens.coefficients
            xy = np.asarray(cv2.undistortPoints(*given, criteria=_UNDONE).reshape(-1, 2), float)
        return central_rays(self, y, np.column_stack([xy, np.ones(len(xy))]))

    def moved(self, motion: Floats) -> Self:
        """The camera that sees points x where this one sees ``motion @ x``."""
        return replace(self, T_sensor_world=self.T_sensor_world @ motion)

    def _normalised(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        points = points_world @ self.T_sensor_world[:3, :3].T + self.T_sensor_world[:3, 3]
        visible = points[..., 2] > NEAREST
        inverse_depth = 1.0 / np.where(visible, points[..., 2], 1.0)
        xy = points[..., :2] * inverse_depth[..., None]
        if self.lens and np.isfinite(self.lens.radius_limit):
            inside = (xy * xy).sum(-1) < self.lens.radius_limit**2
            visible &= inside
            # polynomials of huge radii overflow; hidden points are overwritten anyway
            xy = np.where(visible[..., None], xy, 0.0)
        return xy, inverse_depth, np.asarray(visible)
