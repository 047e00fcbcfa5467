"""The pinhole camera with OpenCV's lens distortion."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from mixpose.records import Floats, Mask
from mixpose.sensors.base import Rays, hide, within
from mixpose.sensors.camera import CentralCamera
from mixpose.sensors.distortion import LensDistortion

# OpenCV's default of five iterations leaves errors of a pixel for strong lenses.
_UNDISTORT_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
NEAREST = 1e-9  # depth in length units below which a point counts as behind the camera


@dataclass(frozen=True, eq=False)
class PinholeCamera(CentralCamera):
    """A perspective camera.

    Raises `ValueError` if `distortion` has not 0, 4, 5, 8, 12 or 14 coefficients.
    """

    camera_matrix: Floats  # (3, 3) ``[[fx, skew, cx], [0, fy, cy], [0, 0, 1]]``, px
    distortion: Floats = field(default_factory=lambda: np.zeros(0))  # (k,) in OpenCV's order
    resolution: tuple[int, int] | None = None  # width and height, px; None: unbounded
    T_sensor_world: Floats = field(default_factory=lambda: np.eye(4))  # (4, 4)
    lens: LensDistortion | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._as_floats("camera_matrix", "distortion", "T_sensor_world")
        object.__setattr__(self, "lens", LensDistortion.from_coefficients(self.distortion))

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        """Return pixels (..., 2) of world points (..., 3), and which of them the camera sees."""
        xy, _, visible = self._normalised(points_world)
        if self.lens:
            xy = self.lens.apply(xy.reshape(-1, 2).T).T.reshape(xy.shape)
        y = xy @ self.camera_matrix[:2, :2].T
        y += self.camera_matrix[:2, 2]
        visible &= within(y, self.lower, self.upper)
        hide(y, visible)
        return y, visible

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """Return pixels as `project`, their Jacobian (..., 2, 3), px per length, and the mask."""
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

    def rays(self, y: Floats) -> Rays:
        """Return lines of sight of pixels (M, 2)."""
        K = self.camera_matrix
        # cv2 ignores skew, so the camera matrix is removed before
        xy = (y - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
        if self.lens is not None and len(y):  # OpenCV has no empty arrays
            arguments = xy.reshape(-1, 1, 2), np.eye(3), self.lens.coefficients
            points = cv2.undistortPoints(*arguments, criteria=_UNDISTORT_CRITERIA)
            xy = np.asarray(points.reshape(-1, 2), float)
        return self._rays_along(np.column_stack([xy, np.ones(len(xy))]), y)

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
