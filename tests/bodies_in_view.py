"""Scenes of several bodies, drawn from the cameras' geometry alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions
from mixpose.objective import View
from mixpose.records import Estimate, Floats, PointPattern
from mixpose.rigid import from_rotation_vector, rotation_angle_deg, transform
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Scene, Tracker

TOOL = np.array([[0, 0, 0], [60, 5, 0], [-20, 50, 10], [10, -30, 45], [35, 30, -40.0]])
OTHER = np.array([[0, 0, 0], [45, 0, 20], [-30, 35, 0], [5, -55, 10], [20, 20, 50.0]])


def camera(angle: float) -> PinholeCamera:
    K = np.array([[1000, 0, 640], [0, 1000, 512], [0, 0, 1.0]])
    T = from_rotation_vector([0, angle, 0], [0, 0, 1200])
    return PinholeCamera(K, np.zeros(5), (1280, 1024), T)


CAMERAS = {"left": camera(0.5), "right": camera(-0.5)}


def body(name: str, points: Floats) -> Body:
    return Body(name, tuple(PointFeature(point) for point in points))


def scene_of(*bodies: Body) -> Scene:
    """A scene in which the same body several times is as many identical ones."""
    members = []
    for k, one in enumerate(bodies):
        alike = [other for other in bodies if other is one]
        instance = [j for j, other in enumerate(bodies) if other is one].index(k)
        which = instance if len(alike) > 1 else None
        members.append(Tracker.create(one, EstimatorOptions(), instance=which))
    return Scene(tuple(members))


def views_of(bodies: Sequence[Body], poses: Sequence[Floats], seed: int) -> list[View]:
    """What the cameras see, with 0.2 px of noise, and a false spot."""
    rng = np.random.default_rng(seed)
    views = []
    for name, one in CAMERAS.items():
        spots = [np.array([[30.0, 40.0]])]
        for each, T in zip(bodies, poses, strict=True):
            spots.append(one.project(transform(T, each.means))[0])
        points = rng.permutation(np.concatenate(spots))
        points = points + 0.2 * rng.standard_normal(points.shape)
        pattern = PointPattern(points, np.ones(len(points)))
        views.append(View(name, one, Observation(pattern, 1.5)))
    return views


def at(x: float, y: float = 0.0, z: float = 0.0, turn: float = 0.0) -> Floats:
    return from_rotation_vector([0.3, turn, -0.2], [x, y, z])


def off(estimate: Estimate, T: Floats) -> tuple[float, float]:
    assert estimate.T_world_object is not None
    away = float(np.linalg.norm(estimate.T_world_object[:3, 3] - T[:3, 3]))
    return away, float(rotation_angle_deg(estimate.T_world_object, T))
