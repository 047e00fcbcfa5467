"""Projection of a body into several sensors at once, at many poses; markers with a size.

Arrays have the sensors first, then the poses: places y (L, H, n, 2), Jacobians J (L, H, n, 2, 6).
Sensors of one coordinate have 0 as their second.

The image of a sphere or of an oblique disk is nearly an ellipse, whose centre is not the image of
the marker's centre.  A sensor sees a sphere as the disk within the circle at which lines of sight
touch it.  So both are disks, and the centroid of their image is
∫ y(x) |det ∂y| dx / ∫ |det ∂y| dx over the disk.  Four points at 1/√2 of the radius integrate
polynomials of third degree; the error is of fourth order in the marker's size over its distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mixpose.body import Body
from mixpose.density import Observation
from mixpose.records import Floats, Indices, Mask, replace
from mixpose.rigid import cross
from mixpose.sensors import Sensor, facing, hide, side_by_side

_NOTHING = np.array([])
# number of poses whose projections are cached: poses at which identical bodies are expected are
# searched, weighed, and fitted from at several blurs
_KEPT = 8


@dataclass(frozen=True)
class View:
    """A sensor with what it observed; times in seconds."""

    name: str
    sensor: Sensor
    observation: Observation
    delay: float = 0.0  # of its frame after the common time
    readout: float = 0.0  # from first to last row; the time of a frame is that of its middle row
    unsure: float | None = None  # deviation of an estimated delay; None if it is given
    estimated: float = 0.0  # part of the delay that was estimated
    # if its calibration is not exact: the sensor without motion, then with each error
    doubts: tuple[Sensor, ...] = ()

    def only(self, chosen: Mask) -> View:
        """Return the view with the chosen (M,) of its detections; itself if these are all."""
        return self if chosen.all() else replace(self, observation=self.observation.only(chosen))


class Match(NamedTuple):
    """A body's features in L sensors at H poses, with the densities of an objective there."""

    y: Floats  # (L, H, n, 2)
    J: Floats  # (L, H, n, 2, 6) by the twist of the pose; zero of features that are not visible
    seen: Mask  # (L, H, n) in view, and facing the sensor where normals are known
    faced: Mask  # (L, H, n) facing the sensor, in view or not
    weights: Floats  # (L, H, n) zero where a feature is not seen
    # with densities:
    sampled: Floats = _NOTHING  # (L, H, n, 3) C and its gradient
    norm: Floats = _NOTHING  # (L, H) ⟨h, h⟩; its derivatives need:
    pairs: Indices = _NOTHING.astype(np.intp)  # (P, 2) close features i < j
    bells: Floats = _NOTHING  # (L, H, P) w_i w_j N(p_i − p_j; 0, v); 0 where they do not overlap
    away: Floats = _NOTHING  # (L, H, P, 2) p_i − p_j

    def of(self, poses: slice | Indices, n: int | None = None) -> Match:
        """Return the match at some of the poses, of the first n features; others have no weight."""
        bells = self.bells[:, poses]
        near = bells.any(axis=(0, 1))
        features = [part[:, poses, :n] for part in self[:6]]
        norm, away = self.norm[:, poses], self.away[:, poses][:, :, near]
        return Match._make([*features, norm, self.pairs[near], bells[..., near], away])


class BodyProjection:
    """Projection of a body into sensors; `project_body` caches them.

    Or of K bodies that `has_bare_points`, at a pose of each (K, 4, 4): bodies with fewer features
    than others are filled up with their first one, without weight.
    """

    def __init__(self, sensors: tuple[Sensor, ...], bodies: tuple[Body, ...]) -> None:
        self.sensors, self.bodies = sensors, bodies
        self.body = body = max(bodies, key=lambda body: len(body.nodes.points))
        self.dimensions = np.array([sensor.dimension for sensor in sensors])  # (L,)
        shape = len(bodies), len(body.nodes.points)
        self._points, self._weights = np.zeros((*shape, 3)), np.zeros(shape)
        for points, weights, nodes in zip(self._points, self._weights, (b.nodes for b in bodies)):
            n = len(nodes.points)
            points[:], points[:n], weights[:n] = nodes.points[0], nodes.points, nodes.weights
        self._normals, radii = body.node_normals, body.node_radii
        self._radii = radii if radii is not None and radii.any() else None
        self._batch = side_by_side(sensors)
        self._ranges = np.flatnonzero(self.dimensions == 1)
        self._cache = dict[bytes, Match]()  # of the last poses

    def project(self, poses: Floats) -> Match:
        """Project the body at poses (H, 4, 4) into the sensors."""
        cache, key = self._cache, poses.tobytes()
        if (match := cache.get(key)) is None:
            match = self._project(poses)
            if len(poses) <= _KEPT:
                # runs in other threads may use the same cache
                for oldest in list(cache)[: 1 - _KEPT]:
                    cache.pop(oldest, None)
                cache[key] = match
        return match

    def _project(self, poses: Floats) -> Match:
        H, n, L = len(poses), self._points.shape[-2], len(self.sensors)
        arms = self._points @ poses[:, :3, :3].swapaxes(1, 2)
        world = (arms + poses[:, None, :3, 3]).reshape(-1, 3)
        if self._radii is None:
            y, by_world, visible = self._batch.linearise(world)
        else:
            y, by_world, visible = self._of_disks(poses, world, np.tile(self._radii, H)[:, None])
        J = pose_jacobian(by_world, arms.reshape(-1, 3)).reshape(L, H, n, 2, 6)
        seen = visible.reshape(L, H, n)
        if self._normals is None:
            faced = ~np.zeros(seen.shape, dtype=np.bool_)
        else:
            arguments = poses, world.reshape(H, n, 3), self._normals, self.body.edge_on
            faced = np.array([facing(sensor, *arguments) for sensor in self.sensors])
            seen &= faced
        return Match(y.reshape(L, H, n, 2), J, seen, faced, self._weights * seen)

    def _of_disks(self, poses: Floats, world: Floats, radii: Floats) -> tuple[Floats, Floats, Mask]:
        """Linearise spheres or disks (H * n, 3), moving without turning, as `SensorBatch` does."""
        L, count = len(self.sensors), len(world)
        normals = self._normals if self.body.shape == "disk" else None
        if normals is not None:
            turned = _across(normals)[:, None] @ poses[:, :3, :3].swapaxes(1, 2)
            middle, axes = world[None, None], turned.reshape(2, 1, count, 3)
        else:
            towards = self._batch.towards(world)
            squared = np.vecdot(towards, towards)[..., None]
            share = np.minimum(radii**2 / squared, 0.81)  # no sensor is within a sphere
            middle = (world + share * towards)[:, None]
            axes, radii = _across(towards / np.sqrt(squared)), radii * np.sqrt(1 - share)[:, None]
        axes = axes.swapaxes(0, 1)  # (L, 2, count, 3), with one in place of L where all are alike
        steps = np.sqrt(0.5) * radii * axes
        # four points, two on either side
        nodes = np.concatenate([middle + steps, middle - steps], axis=1)
        y, J, seen = self._batch.linearise(nodes.reshape(len(nodes), 4 * count, 3))
        y, J = y.reshape(L, 4, count, 2), J.reshape(L, 4, count, 2, 3)
        along, across = (np.vecdot(J, axes[:, k, None, :, None]) for k in (0, 1))
        weights = np.abs(along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0])
        total = weights.sum(axis=1)
        visible = seen.reshape(L, 4, count).all(axis=1) & (total > 0)
        weights /= np.where(visible, total, 1.0)[:, None]
        y, J = (weights[..., None] * y).sum(axis=1), (weights[..., None, None] * J).sum(axis=1)
        hide(y, visible, J)
        if len(self._ranges):  # a range is that to the centre
            for part, of_centre in zip((y, J, visible), self._batch.linearise(world), strict=True):
                part[self._ranges] = of_centre[self._ranges]
        return y, J, visible


@lru_cache(maxsize=64)
def project_body(sensors: tuple[Sensor, ...], *bodies: Body) -> BodyProjection:
    """Return the cached projection of bodies into sensors, the same objects in all frames."""
    return BodyProjection(sensors, bodies)


def has_bare_points(body: Body) -> bool:
    """Test whether a body has bare points only: no normals, and no size of markers."""
    return body.normals is None and (body.node_radii is None or not body.node_radii.any())


def in_image(spreads: Floats, J: Floats) -> Floats:
    """Project spreads (..., n, 3, 3) by J (..., n, m, 6): variances (..., n), the mean of axes."""
    by_world = J[..., :3]
    total = np.einsum("...nmi,...nij,...nmj->...n", by_world, spreads, by_world)
    return np.asarray(total / J.shape[-2])


def pose_jacobian(by_world: Floats, arms: Floats) -> Floats:
    """Chain Jacobians (..., n, m, 3) by world points into (..., n, m, 6) by the pose's twist.

    A turn ω about the object's origin moves an arm x = R z, of (..., n, 3), by ω × x, and
    a · (ω × x) = ω · (x × a).
    """
    J = np.empty((*by_world.shape[:-1], 6))
    J[..., :3] = by_world
    J[..., 3:] = cross(arms[..., None, :], by_world, axis=-1)
    return J


def _across(directions: Floats) -> Floats:
    """Return unit vectors (2, ..., 3) across unit vectors (..., 3): Duff et al., JCGT 6 (2017)."""
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    sign, across = np.copysign(1.0, z), np.empty((2, *directions.shape))
    a = -1 / (sign + z)
    b, turned = x * y * a, sign * x
    for k, component in enumerate((1 + turned * x * a, sign * b, -turned, b, sign + y * y * a, -y)):
        across[k // 3, ..., k % 3] = component
    return across
