"""Where features are looked for while a body is tracked, and when that was not enough."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mixpose.body import Body, PointFeature
from mixpose.rigid import from_parts
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Branch, Expectation

Floats = NDArray[np.float64]

FREE = np.ones(6, dtype=np.bool_)
CAMERA = PinholeCamera(
    np.array([[900.0, 0, 640], [0, 900, 512], [0, 0, 1]]), np.zeros(0), (1280, 1024)
)
SURE = np.full(6, 1e-9)


def body_of(*points: tuple[float, float, float], normals: Floats | None = None) -> Body:
    return Body("some", tuple(PointFeature(np.array(point)) for point in points), normals)


def window(body: Body, *places: tuple[float, float, float]) -> tuple[int, int, int, int]:
    predictions = [Branch(from_parts(np.eye(3), place), 1.0, SURE) for place in places]
    return Expectation(body, {"0": CAMERA}, FREE).windows(predictions)["0"]


def test_around_features_close_together_there_is_room_for_a_spot_and_its_ground() -> None:
    # 4 mm at 500 mm: 3.6 px to either side of the middle
    found = window(body_of((-2.0, 0.0, 0.0), (2.0, 0.0, 0.0)), (0.0, 0.0, 500.0))
    np.testing.assert_allclose(found, (596, 472, 685, 553), atol=1)  # whole pixels


def test_around_features_far_apart_there_is_room_for_their_images() -> None:
    # 100 mm at 500 mm: images of up to 50 mm to either side, 90 px, in any direction √2 · 90 px
    found = window(body_of((-50.0, 0.0, 0.0), (50.0, 0.0, 0.0)), (0.0, 0.0, 500.0))
    expected = (640 - 90 - 127, 512 - 127, 640 + 90 + 127 + 1, 512 + 127 + 1)
    np.testing.assert_allclose(found, expected, atol=2)


def test_a_window_holds_all_places_where_the_body_may_be() -> None:
    body = body_of((-2.0, 0.0, 0.0), (2.0, 0.0, 0.0))
    left, right = (-100.0, 0.0, 500.0), (100.0, 50.0, 500.0)
    one, other = window(body, left), window(body, right)
    both = (*np.minimum(one, other)[:2].tolist(), *np.maximum(one, other)[2:].tolist())
    assert window(body, left, right) == both
    assert window(body, right, left) == both


def test_features_that_a_camera_does_not_see_have_no_part_in_its_window() -> None:
    # the third is beyond the left border, the fourth turns its back
    points = ((-2.0, 0.0, 0.0), (2.0, 0.0, 0.0), (-500.0, 0.0, 0.0), (-200.0, 0.0, 0.0))
    normals = np.array([[0, 0, -1.0], [0, 0, -1], [0, 0, -1], [0, 0, 1]])
    found = window(body_of(*points, normals=normals), (0.0, 0.0, 500.0))
    np.testing.assert_allclose(found, (596, 472, 685, 553), atol=1)  # whole pixels
