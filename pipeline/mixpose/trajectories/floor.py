"""The frame of the world by what lies on the floor: a body, three points or a plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.records import Estimate, Floats

Axis: TypeAlias = Literal["x", "y", "z"]

_ROUNDED = 1e-4  # deg, of true poses that are equal
_RESTS = 5.0  # times its deviation: a body that is nowhere farther off its mean rests
_FLAT = 1e-6  # of the largest spread: points on a line span no plane
_SURELY = 3.0  # times what they are off the plane, or err by: points on a line span none by chance


@dataclass(frozen=True)
class Floor:
    """A frame for the world."""

    T_old_new: Floats  # (4, 4): maps coordinates of the new world to those of the old one
    by: str  # what it was found by
    off: float | None = None  # RMS distance of the points from it; None where any would fit
    tilt_deg: float = 0.0  # standard deviation about the axis known least; 0 of true poses


def floor_of(estimates: Sequence[Estimate], up: Axis, sensors: Floats) -> Floor:
    """The frame that bodies on the floor tell, whose axis `up` points up; of a body, its own.

    One body that rests is the frame of the world. Three that rest, or three poses apart, are three
    points: the origin, where the first axis leads to, and any other of the floor. More are a plane,
    in which the origin and the first axis are as near to where they were as can be. Of a body with
    a tip the tip is the point, of others the origin. Up is where the sensors (n, 3), in the old
    world, are. Raises RecordingError if the poses tell no floor.
    """
    bodies: dict[str, list[Estimate]] = {}
    for each in estimates:
        bodies.setdefault(each.label, []).append(each)
    rests = [_rests(own) for own in bodies.values()]
    if len(bodies) == 1 and rests[0]:
        poses = np.stack([e.T_world_object for e in estimates if e.T_world_object is not None])
        T = poses[0] if len(poses) == 1 else rigid.mean_motion(poses)
        _require_still(estimates, T)
        return Floor(T, f"the body {estimates[0].label!r}", None, _tilt_of_body(estimates, T, up))
    if all(rests):
        points = np.stack([np.mean([_point(e) for e in own], axis=0) for own in bodies.values()])
    if not all(rests) or len(points) < 3:
        points = np.stack([_point(each) for each in estimates])
    if len(points) < 3:
        raise RecordingError(
            f"found {len(points)} points; allowed: one body, three points, or more in a plane"
        )
    covariance = np.mean([_covariance(e) for e in estimates], axis=0)
    normal, off, across = _normal(points, sensors, covariance)
    count, errs = len(points), float(np.sqrt(normal @ covariance @ normal))
    if count == 3:
        T = _axes(points[0], points[1] - points[0], normal, up)
        return Floor(T, "three points", None, float(np.degrees(errs / across)))
    # where points are farther off the plane than they err by, it is not flat, or they lie not on it
    errs = max(errs, off * np.sqrt(count / (count - 3)))
    T = _plane(points.mean(axis=0), normal, up)
    return Floor(T, f"a plane through {count} points", off, float(np.degrees(errs / across)))


def _tilt_of_body(estimates: Sequence[Estimate], T_mean: Floats, up: Axis) -> float:
    """As `Floor.tilt_deg`, as one pose errs: what lasts does not become less with their number."""
    turns = [e.covariance[3:, 3:] for e in estimates if e.covariance is not None]
    if not turns:
        return 0.0
    normal = T_mean[:3, "xyz".index(up)]
    level = np.eye(3) - np.outer(normal, normal)
    variances = np.linalg.eigvalsh(level @ np.mean(turns, axis=0) @ level)
    return float(np.degrees(np.sqrt(variances[-1])))


def _point(one: Estimate) -> Floats:
    assert one.T_world_object is not None
    return one.T_world_object[:3, 3] if one.tip is None else one.tip


def _covariance(one: Estimate) -> Floats:
    """That of the point (3, 3); 0 of true poses."""
    C = one.covariance if one.tip is None else one.tip_covariance
    return np.zeros((3, 3)) if C is None else np.asarray(C[:3, :3])


def _rests(estimates: Sequence[Estimate]) -> bool:
    points = np.stack([_point(each) for each in estimates])
    away = np.linalg.norm(points - points.mean(axis=0), axis=1).max()
    errs = np.sqrt(np.mean([np.trace(_covariance(e)) for e in estimates]))
    rounded = 1e-9 * np.abs(points).max()  # means of numbers of a file
    return bool(away <= _RESTS * errs + rounded)


def _require_still(estimates: Sequence[Estimate], T_mean: Floats) -> None:
    """Raise a RecordingError where a body whose point rests turns about it."""
    poses = [each.T_world_object for each in estimates if each.T_world_object is not None]
    turned = max(rigid.rotation_angle_deg(T_mean, T) for T in poses)
    known = [np.trace(e.covariance[3:, 3:]) for e in estimates if e.covariance is not None]
    if turned > _RESTS * np.degrees(np.sqrt(np.mean(known or [0.0]))) + _ROUNDED:
        raise RecordingError(
            f"the body {estimates[0].label!r} turns by {turned:.3g} deg about a point that rests; "
            "allowed: a body that rests, or poses of which these points are all over the floor"
        )


def _normal(points: Floats, sensors: Floats, covariance: Floats) -> tuple[Floats, float, float]:
    """Upward normal of the plane nearest to points (n, 3), their RMS off it, spread in it."""
    middle = points.mean(axis=0)
    _, sizes, directions = np.linalg.svd(points - middle)
    errors = np.sqrt(len(points) * (directions[1] @ covariance @ directions[1]))
    if not sizes[1] > max(_FLAT * sizes[0], _SURELY * sizes[2], _SURELY * errors):
        raise RecordingError(
            f"the points lie on a line, or in no plane: they spread by {sizes[0]:.3g}, "
            f"{sizes[1]:.3g}, of which {errors:.2g} may be errors, and {sizes[2]:.3g}; allowed: "
            "points all over the floor, or the corners of a triangle, and nothing but these"
        )
    normal = directions[2] / np.linalg.norm(directions[2])
    if (sensors.mean(axis=0) - middle) @ normal < 0:  # up is where the sensors are
        normal = -normal
    return normal, float(sizes[2] / np.sqrt(len(points))), float(sizes[1])


def _plane(middle: Floats, normal: Floats, up: Axis) -> Floats:
    """The frame of a plane through a point, as near to the old one as can be."""
    origin = normal * (normal @ middle)  # the old origin, moved onto the plane
    first = np.eye(3)[0 if up != "x" else 1]
    if abs(normal @ first) > 0.99:  # it stands on the floor
        first = np.eye(3)["xyz".index(up)]
    return _axes(origin, first, normal, up)


def _axes(origin: Floats, along: Floats, normal: Floats, up: Axis) -> Floats:
    """A frame whose axis `up` is the normal, and whose first other one leads along a direction."""
    k = "xyz".index(up)
    first = 0 if k else 1
    R = np.empty((3, 3))
    along = along - normal * (normal @ along)
    R[:, k], R[:, first] = normal, along / np.linalg.norm(along)
    last = 3 - k - first
    R[:, last] = np.cross(R[:, (last + 1) % 3], R[:, (last + 2) % 3])
    return rigid.from_parts(R, origin)
