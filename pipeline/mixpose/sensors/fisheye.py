"""The equidistant fisheye camera (Kannala-Brandt, as in OpenCV's `cv2.fisheye`)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mixpose.records import Floats, Mask
from mixpose.sensors.base import Rays, hide, within
from mixpose.sensors.camera import CentralCamera

_WIDEST = np.radians(140.0)  # from the axis: no lens shows more, however large its image is
_NEWTON = 4  # Newton steps from a table of angles, whose error is 1e-6


@dataclass(frozen=True, eq=False)
class FisheyeCamera(CentralCamera):
    """A fisheye camera: image radius θ(1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) for the angle θ.

    It sees angles up to which the radius grows, at most 140°, inside the image; 90° at most if the
    resolution is unknown. Raises `ValueError` if `distortion` has neither 0 nor 4 numbers.
    """

    camera_matrix: Floats  # (3, 3) px
    distortion: Floats = field(default_factory=lambda: np.zeros(4))  # (4,) k1 to k4, or none
    resolution: tuple[int, int] | None = None  # width and height, px; None: unbounded
    T_sensor_world: Floats = field(default_factory=lambda: np.eye(4))  # (4, 4)
    theta_limit: float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        distortion = np.asarray(self.distortion, dtype=np.float64).ravel()
        if distortion.size not in (0, 4):
            raise ValueError(f"{distortion.size} distortion coefficients, a fisheye camera has 4")
        distortion = np.zeros(4) if distortion.size == 0 else distortion
        object.__setattr__(self, "distortion", distortion)
        self._as_floats("camera_matrix", "T_sensor_world")
        widest = np.pi / 2 if self.resolution is None else _WIDEST
        theta = np.linspace(0, widest, 2001)
        bad = ~(np.diff(self._radius(theta)[0]) > 0)
        object.__setattr__(self, "theta_limit", float(theta[bad.argmax()]) if bad.any() else widest)

    def project(self, points_world: Floats) -> tuple[Floats, Mask]:
        """Return pixels (..., 2) of world points (..., 3), and which of them the camera sees."""
        y, _, visible = self._map(points_world, want_jacobian=False)
        return y, visible

    def linearise(self, points_world: Floats) -> tuple[Floats, Floats, Mask]:
        """Return pixels as `project`, their Jacobian (..., 2, 3), px per length, and the mask."""
        y, J, visible = self._map(points_world, want_jacobian=True)
        assert J is not None
        return y, J, visible

    def rays(self, y: Floats) -> Rays:
        """Return lines of sight of pixels (M, 2)."""
        K = self.camera_matrix
        xy = (y - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
        radius = np.hypot(xy[:, 0], xy[:, 1])
        table = np.linspace(0, self.theta_limit, 2001)
        theta = np.interp(radius, self._radius(table)[0], table)
        for _ in range(_NEWTON):
            model, slope = self._radius(theta)
            theta = np.clip(theta - (model - radius) / np.maximum(slope, 1e-9), 0, self.theta_limit)
        across = np.sin(theta) / np.where(radius > 0, radius, 1.0)
        return self._rays_along(np.column_stack([xy * across[:, None], np.cos(theta)]), y)

    def _radius(self, theta: Floats) -> tuple[Floats, Floats]:
        k1, k2, k3, k4 = self.distortion
        t2 = theta * theta
        radius = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        return np.asarray(radius), np.asarray(slope)

    def _map(
        self, points_world: Floats, *, want_jacobian: bool
    ) -> tuple[Floats, Floats | None, Mask]:
        R = self.T_sensor_world[:3, :3]
        points = points_world @ R.T + self.T_sensor_world[:3, 3]
        xy, z = points[..., :2], points[..., 2]
        rho = np.hypot(xy[..., 0], xy[..., 1])
        theta = np.arctan2(rho, z)
        visible = theta < self.theta_limit
        radius, slope = self._radius(theta)
        # on the axis radius/rho tends to 1/z, and the direction of xy does not matter
        on_axis = rho < 1e-12 * np.maximum(np.abs(z), 1e-300)
        safe_rho = np.where(on_axis, 1.0, rho)
        scale = np.where(on_axis, 1.0 / np.where(z == 0, 1.0, z), radius / safe_rho)
        K = self.camera_matrix[:2, :2]
        y = (xy * scale[..., None]) @ K.T + self.camera_matrix[:2, 2]
        visible &= within(y, self.lower, self.upper)
        J = None
        if want_jacobian:
            direction = xy / safe_rho[..., None]
            distance2 = np.maximum(rho * rho + z * z, 1e-300)
            radial = (slope * z / distance2 - scale)[..., None, None]
            by_sensor = np.empty((*xy.shape, 3))
            by_sensor[..., :2] = radial * direction[..., :, None] * direction[..., None, :]
            by_sensor[..., :2] += scale[..., None, None] * np.eye(2)
            by_sensor[..., 2] = direction * (-slope * rho / distance2)[..., None]
            J = K @ by_sensor @ R
        hide(y, visible, J)
        return y, J, np.asarray(visible)
