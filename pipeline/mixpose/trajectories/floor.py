"""Find a frame for the world by what lies on the floor: a body, three points or a plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.records import Estimate, Floats

Axis: TypeAlias = Literal["x", "y", "z"]

_ROUNDING_DEG = 1e-4  # deg, rounding of equal true poses
_REST_SIGMAS = 5.0  # deviations: a body that is always nearer to its mean is at rest
_LINE_RATIO = 1e-6  # of the largest spread, below which points lie on a line
_PLANE_RATIO = 3.0  # times offsets from the plane, or errors: less spread may be chance on a line


@dataclass(frozen=True)
class Floor:
    """A new frame for the world."""

    T_old_new: Floats  # (4, 4): maps coordinates of the new world to those of the old one
    defined_by: str  # in words
    rms_distance: float | None = None  # of the points; None if any would fit
    tilt_deg: float = 0.0  # standard deviation about the least known axis; 0 of true poses


def floor_of(estimates: Sequence[Estimate], up: Axis, sensors: Floats) -> Floor:
    """Find a frame whose axis `up` points up from bodies on the floor; that of a single body.

    A single body at rest defines the frame of the world itself. Three at rest, or three poses, are
    three points: the origin, a point on the first axis, and any other of the floor. More are a
    plane, with the origin and the first axis as near to the old ones as can be. The point of a body
    is its tip if it has one, else its origin. Up is the side of the sensors (n, 3), in the old
    world. Raises RecordingError if the poses define no floor.
    """
    bodies: dict[str, list[Estimate]] = {}
    for estimate in estimates:
        bodies.setdefault(estimate.label, []).append(estimate)
    are_at_rest = [_is_at_rest(body) for body in bodies.values()]
    if len(bodies) == 1 and are_at_rest[0]:
        poses = np.stack([e.T_world_object for e in estimates if e.T_world_object is not None])
        T = poses[0] if len(poses) == 1 else rigid.mean_motion(poses)
        _require_still(estimates, T)
        return Floor(T, f"the body {estimates[0].label!r}", None, _tilt_of_body(estimates, T, up))
    if all(are_at_rest):
        points = np.stack([np.mean([_point(e) for e in body], axis=0) for body in bodies.values()])
    if not all(are_at_rest) or len(points) < 3:
        points = np.stack([_point(estimate) for estimate in estimates])
    if len(points) < 3:
        raise RecordingError(
            f"found {len(points)} points; allowed: one body, three points, or more in a plane"
        )
    covariance = np.mean([_covariance(e) for e in estimates], axis=0)
    normal, off, spread = _normal(points, sensors, covariance)
    count, error = len(points), float(np.sqrt(normal @ covariance @ normal))
    if count == 3:
        T = _axes(points[0], points[1] - points[0], normal, up)
        return Floor(T, "three points", None, float(np.degrees(error / spread)))
    # points farther off the plane than their errors: it is not flat, or they are not on it
    error = max(error, off * np.sqrt(count / (count - 3)))
    T = _plane(points.mean(axis=0), normal, up)
    return Floor(T, f"a plane through {count} points", off, float(np.degrees(error / spread)))


def _tilt_of_body(estimates: Sequence[Estimate], T_mean: Floats, up: Axis) -> float:
    """Return `Floor.tilt_deg` by errors of one pose, as persistent errors do not average out."""
    turns = [e.covariance[3:, 3:] for e in estimates if e.covariance is not None]
    if not turns:
        return 0.0
    normal = T_mean[:3, "xyz".index(up)]
    level = np.eye(3) - np.outer(normal, normal)
    variances = np.linalg.eigvalsh(level @ np.mean(turns, axis=0) @ level)
    return float(np.degrees(np.sqrt(variances[-1])))


def _point(estimate: Estimate) -> Floats:
    assert estimate.T_world_object is not None
    return estimate.T_world_object[:3, 3] if estimate.tip is None else estimate.tip


def _covariance(estimate: Estimate) -> Floats:
    """Return the covariance (3, 3) of the point; 0 of true poses."""
    C = estimate.covariance if estimate.tip is None else estimate.tip_covariance
    return np.zeros((3, 3)) if C is None else np.asarray(C[:3, :3])


def _is_at_rest(estimates: Sequence[Estimate]) -> bool:
    points = np.stack([_point(estimate) for estimate in estimates])
    farthest = np.linalg.norm(points - points.mean(axis=0), axis=1).max()
    error = np.sqrt(np.mean([np.trace(_covariance(e)) for e in estimates]))
    rounded = 1e-9 * np.abs(points).max()  # means of numbers of a file
    return bool(farthest <= _REST_SIGMAS * error + rounded)


def _require_still(estimates: Sequence[Estimate], T_mean: Floats) -> None:
    """Raise a RecordingError if a body whose point is at rest turns about it."""
    poses = [e.T_world_object for e in estimates if e.T_world_object is not None]
    turned = max(rigid.rotation_angle_deg(T_mean, T) for T in poses)
    variances = [np.trace(e.covariance[3:, 3:]) for e in estimates if e.covariance is not None]
    if turned > _REST_SIGMAS * np.degrees(np.sqrt(np.mean(variances or [0.0]))) + _ROUNDING_DEG:
        raise RecordingError(
            f"the body {estimates[0].label!r} turns by {turned:.3g} deg about a point that rests; "
            "allowed: a body that rests, or poses of which these points are all over the floor"
        )


def _normal(points: Floats, sensors: Floats, covariance: Floats) -> tuple[Floats, float, float]:
    """Return the upward normal of the plane nearest to points (n, 3), RMS distance and spread."""
    middle = points.mean(axis=0)
    _, sizes, directions = np.linalg.svd(points - middle)
    errors = np.sqrt(len(points) * (directions[1] @ covariance @ directions[1]))
    if not sizes[1] > max(_LINE_RATIO * sizes[0], _PLANE_RATIO * sizes[2], _PLANE_RATIO * errors):
        raise RecordingError(
            f"the points lie on a line, or in no plane: they spread by {sizes[0]:.3g}, "
            f"{sizes[1]:.3g}, of which {errors:.2g} may be errors, and {sizes[2]:.3g}; allowed: "
            "points all over the floor, or the corners of a triangle, and nothing but these"
        )
    normal = directions[2] / np.linalg.norm(directions[2])
    if (sensors.mean(axis=0) - middle) @ normal < 0:  # up is the side of the sensors
        normal = -normal
    return normal, float(sizes[2] / np.sqrt(len(points))), float(sizes[1])


def _plane(middle: Floats, normal: Floats, up: Axis) -> Floats:
    """Return the frame of a plane through a point that is nearest to the old one."""
    origin = normal * (normal @ middle)  # the old origin, moved onto the plane
    first = np.eye(3)[0 if up != "x" else 1]
    if abs(normal @ first) > 0.99:  # the old first axis is normal to the floor
        first = np.eye(3)["xyz".index(up)]
    return _axes(origin, first, normal, up)


def _axes(origin: Floats, along: Floats, normal: Floats, up: Axis) -> Floats:
    """Return a frame with the normal as axis `up` and its first other axis along a direction."""
    k = "xyz".index(up)
    first = 0 if k else 1
    R = np.empty((3, 3))
    along = along - normal * (normal @ along)
    R[:, k], R[:, first] = normal, along / np.linalg.norm(along)
    last = 3 - k - first
    R[:, last] = np.cross(R[:, (last + 1) % 3], R[:, (last + 2) % 3])
    return rigid.from_parts(R, origin)
