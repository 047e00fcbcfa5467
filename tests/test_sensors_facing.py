"""Which features turn their face to a sensor."""

from __future__ import annotations

import numpy as np
import pytest

from mixpose.body import Body, PointFeature, Shape
from mixpose.objective import project_body
from mixpose.sensors import PinholeCamera


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ("point", [True, False, False, False]),
        ("disk", [True, False, False, False]),
        ("sphere", [True, True, True, False]),
    ],
)
def test_flat_features_are_seen_at_up_to_80_degrees_and_spheres_from_the_front(
    shape: Shape, expected: list[bool]
) -> None:
    camera = PinholeCamera(
        np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]]), np.zeros(4), (640, 480)
    )
    away = np.array([0.0, 0.0, 1000.0])
    angles = np.radians([79.0, 81.0, 89.0, 91.0])
    normals = np.column_stack([np.sin(angles), np.zeros(4), -np.cos(angles)])
    point = PointFeature(np.zeros(3))
    body = Body("four", (point,) * 4, normals, shape=shape, radii=np.full(4, 2.0))
    T = np.eye(4)
    T[:3, 3] = away
    assert project_body((camera,), body).project(T[None]).seen[0, 0].tolist() == expected
