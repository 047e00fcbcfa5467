from __future__ import annotations

import numpy as np
from detections import ALL_FREE
from scipy.spatial.transform import Rotation

from mixpose.body import Body
from mixpose.density import Observation
from mixpose.objective import View
from mixpose.records import GridPattern, PointPattern
from mixpose.rigid import from_rotation_vector, transform
from mixpose.search.poses import count_inliers, label_image, spread_rotations
from mixpose.search.problem import SearchProblem, peaks, sensor_detections
from mixpose.sensors import PinholeCamera

TRUTH = from_rotation_vector([0.3, -0.2, 0.5], [5.0, -3.0, 8.0])


def seen_by(cameras: list[PinholeCamera], body: Body) -> list[View]:
    return [
        View(str(k), camera, Observation(PointPattern(y, np.linspace(1, 2, len(y))), 2.0))
        for k, camera in enumerate(cameras)
        for y in (camera.project(transform(TRUTH, body.means))[0],)
    ]


def test_features_that_share_a_detection_count_once(
    paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    views = seen_by(pinhole_cameras, paper_body)
    detections = sensor_detections(views, paper_body)
    problem = SearchProblem(detections, paper_body, ALL_FREE, np.eye(4))
    images = [label_image(*camera, problem.reach(camera[0])) for camera in problem.cameras]
    collapsed = TRUTH.copy()
    # far behind its place the whole body falls within one disk
    collapsed[:3, 3] = [50.0, 4e6, 40.0]
    counts, _ = count_inliers(images, paper_body, np.array([TRUTH, collapsed]))
    assert counts[:, 0].tolist() == [6, 6]
    assert counts[0, 1] <= 1


def test_peaks_of_an_image_are_found_between_pixels() -> None:
    places = np.array([[20.3, 30.7], [60.1, 12.4]])
    v, u = np.mgrid[:64, :80]
    image = sum(np.exp(-0.5 * ((u - x) ** 2 + (v - y) ** 2) / 2.0**2) for x, y in places)
    pattern = GridPattern(np.asarray(image, dtype=np.float32), np.array([100.0, 50.0]), 1.0)
    found = peaks(pattern, 1.5)
    order = np.argsort(found[:, 0])
    # the vertex of a parabola through a Gaussian of 2.5 px is off by less than 0.02 px
    np.testing.assert_allclose(found[order], places + pattern.origin, atol=0.02)


def test_spread_rotations_leave_no_large_gap() -> None:
    rotations = Rotation.from_matrix(spread_rotations(ALL_FREE[3:], np.radians(8.45)))
    assert len(rotations) == 4616
    probes = Rotation.random(4000, rng=np.random.default_rng(0)).as_quat()
    cosines = np.abs(probes @ rotations.as_quat().T).max(axis=1)
    # 4608 balls of 8° radius would fill the orientations; the spiral's worst gap is at 13°
    assert np.degrees(2 * np.arccos(cosines.min())) < 14


def test_turns_keep_to_the_free_axes() -> None:
    about_z = spread_rotations(np.array([False, False, True]), 0.1)
    assert np.abs(about_z[:, 2] - [0.0, 0.0, 1.0]).max() < 1e-12
    assert len(about_z) == 63
    assert spread_rotations(np.zeros(3, dtype=np.bool_), 0.1).shape == (1, 3, 3)
