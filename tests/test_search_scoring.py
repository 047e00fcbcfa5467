from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose.body import Body
from mixpose.density import Observation
from mixpose.objective import View, matched_objective
from mixpose.records import GridPattern, PointPattern
from mixpose.rigid import from_rotation_vector, perturb, transform
from mixpose.search.counting import explained, label_maps
from mixpose.search.levels import levels
from mixpose.search.orientations import spread_rotations, spread_turns
from mixpose.search.scoring import scores, slopes
from mixpose.search.sightings import Sighting, peaks, sightings
from mixpose.sensors import PinholeCamera, RangeSensor

TRUTH = from_rotation_vector([0.3, -0.2, 0.5], [5.0, -3.0, 8.0])


def seen_by(cameras: list[PinholeCamera], body: Body) -> list[View]:
    return [
        View(str(k), camera, Observation(PointPattern(y, np.linspace(1, 2, len(y))), 2.0))
        for k, camera in enumerate(cameras)
        for y in (camera.project(transform(TRUTH, body.means))[0],)
    ]


def ranged(sensors: list[RangeSensor], body: Body) -> list[View]:
    views = []
    for k, sensor in enumerate(sensors):
        ranges = sensor.project(transform(TRUTH, body.means))[0]
        bins = np.arange(np.floor(ranges.min()) - 50, ranges.max() + 50)
        profile = np.exp(-0.5 * ((bins - ranges) / 5) ** 2).sum(axis=0, keepdims=True)
        pattern = GridPattern(profile.astype(np.float32), bins[:1], 1.0)
        views.append(View(str(k), sensor, Observation(pattern, 5.0, intrinsic=5.0)))
    return views


def nearby(count: int, size: float) -> np.ndarray:
    scale = size * np.array([1, 1, 1, 0.02, 0.02, 0.02])
    return perturb(TRUTH, scale * np.random.default_rng(0).standard_normal((count, 6)))


def evened(found: list[Sighting]) -> list[View]:
    return [sighting.view for sighting in found]


def test_scores_are_those_of_the_matched_objective(
    paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    found = sightings(seen_by(pinhole_cameras, paper_body), paper_body)
    poses = nearby(5, 2.0)
    got = scores(levels(found, [2.0, 2.0], len(paper_body)), paper_body, poses).sum(axis=0)
    wanted = matched_objective(evened(found), paper_body, [4.0, 4.0]).value(poses)
    # the objective looks its density up on a grid of four points per σ: 1 % of a value
    np.testing.assert_allclose(got, wanted, rtol=0.02)


def test_gradients_are_those_of_the_scores(
    paper_body: Body, pinhole_cameras: list[PinholeCamera], range_sensors: list[RangeSensor]
) -> None:
    views = seen_by(pinhole_cameras, paper_body) + ranged(range_sensors, paper_body)
    blurred = levels(sightings(views, paper_body), [2.0] * 5, len(paper_body))
    pose = nearby(1, 1.0)
    model = slopes(blurred, paper_body, pose)
    for k, step in enumerate([0.05] * 3 + [0.0005] * 3):
        twist = step * np.eye(6)[k]
        ends = np.concatenate([perturb(pose, twist), perturb(pose, -twist)])
        value = scores(blurred, paper_body, ends).sum(axis=0)
        # ranges are looked up bilinearly: slopes between grid points err by some percent
        scale = np.abs(model.gradient[0, 3 * (k // 3) : 3 * (k // 3) + 3]).max()
        assert abs((value[0] - value[1]) / (2 * step) - model.gradient[0, k]) < 0.05 * scale


def test_features_that_share_a_detection_count_once(
    paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    found = sightings(seen_by(pinhole_cameras, paper_body), paper_body)
    maps = label_maps(found)
    collapsed = TRUTH.copy()
    # far behind its place the whole body falls within one disk
    collapsed[:3, 3] = [50.0, 4e6, 40.0]
    counts, _ = explained(maps, paper_body.means, None, np.array([TRUTH, collapsed]))
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
    rotations = Rotation.from_matrix(spread_rotations(4608))
    for probe in Rotation.random(50, rng=np.random.default_rng(0)):
        # 4608 balls of 8° radius would fill the orientations; the worst gap is under twice that
        assert np.degrees((rotations * probe.inv()).magnitude().min()) < 16


def test_turns_keep_to_the_free_axes() -> None:
    about_z = spread_turns(np.array([False, False, True]), 0.1)
    assert np.abs(about_z[:, 2] - [0.0, 0.0, 1.0]).max() < 1e-12
    assert len(about_z) == 63
    assert spread_turns(np.zeros(3, dtype=np.bool_), 0.1).shape == (1, 3, 3)
