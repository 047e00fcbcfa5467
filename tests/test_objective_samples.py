"""Values of sampled objectives: single precision and common products give what sensors say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from mixpose.density import Density, Window
from mixpose.objective import IndependentObjective, PaperObjective
from mixpose.objective.paper import SampledTerm
from mixpose.rigid import from_rotation_vector, perturb, transform
from mixpose.sensors import FisheyeCamera, ParallelBeam, PinholeCamera, RangeSensor, Sensor

Floats = NDArray[np.float64]
TRUTH = from_rotation_vector([0.3, -0.2, 0.5], [20.0, -30.0, 500.0])
K = np.array([[800.0, 0.5, 320.0], [0, 790.0, 240.0], [0, 0, 1.0]])
TURNED = from_rotation_vector([0.0, 0.7, 0.1], [-250.0, 30.0, 150.0])
LIMITED = (640, 480)
RIGS: dict[str, list[Sensor]] = {
    "parallel": [
        ParallelBeam(0.5, np.array([300.0, 240.0]), LIMITED),
        ParallelBeam(0.7, np.array([310.0, 200.0]), None, TURNED),
    ],
    "pinhole": [PinholeCamera(K, resolution=LIMITED), PinholeCamera(K, T_sensor_world=TURNED)],
    "ranges": [
        RangeSensor(np.array([10.0, -40.0, 20.0]), 3.0, (420.0, 560.0)),
        RangeSensor(np.array([900.0, 0, 100.0])),
    ],
    "mixed": [
        RangeSensor(np.array([900.0, 0, 100.0])),
        PinholeCamera(K, np.array([-0.2, 0.05, 1e-3, 0]), LIMITED),
        ParallelBeam(0.5, np.array([300.0, 240.0]), LIMITED),
        FisheyeCamera(K, resolution=LIMITED),
        PinholeCamera(K, resolution=LIMITED),
    ],
}


def densities(sensors: Sequence[Sensor], samples: Floats) -> list[SampledTerm]:
    """Smooth densities on windows that reach over the middle half of the samples only."""
    terms = []
    for sensor in sensors:
        y, visible = sensor.project(transform(TRUTH, samples.reshape(-1, 3)))
        lower, upper = np.quantile(y[visible], [0.1, 0.9], axis=0)
        window = Window.around(lower, upper, 0.8)
        u = np.sin(np.arange(window.shape[1]) / 9.0) + 1.5
        v = np.cos(np.arange(window.shape[0]) / 11.0) + 1.5
        terms.append(SampledTerm(sensor, Density((v[:, None] * u).astype(np.float32), window, 5.0)))
    return terms


def as_sensors_say(terms: Sequence[SampledTerm], points_world: Floats) -> list[Floats]:
    """Densities (k, S) of points in the world, sensor by sensor in double precision."""
    return [
        term.density.sample(term.sensor.project(points_world)[0]).astype(np.float64)
        for term in terms
    ]


def poses_near_and_far() -> Floats:
    rng = np.random.default_rng(3)
    near = perturb(TRUTH, rng.uniform(-1, 1, (6, 6)) * np.repeat([15.0, 0.1], 3))
    aside = perturb(TRUTH, np.array([250.0, 0, 0, 0, 0, 0]))
    about_the_camera = perturb(TRUTH, np.array([0, 0, -495.0, 0, 0, 0]))
    behind = perturb(TRUTH, np.array([0, 0, -1000.0, 0, 0, 0]))
    return np.stack([TRUTH, *near, aside, about_the_camera, behind])


@pytest.mark.parametrize("sagging", [False, True])
@pytest.mark.parametrize("count", [700, 7000])  # 7000: more than one block
@pytest.mark.parametrize("rig", RIGS)
def test_values_are_those_of_sensors_one_by_one(rig: str, count: int, sagging: bool) -> None:
    rng = np.random.default_rng(1)
    # the object's origin is not among its features
    samples = rng.uniform(-40, 40, (3, 1, 3)) + rng.normal(0, 5, (3, count, 3)) + [30.0, 0, 0]
    offsets = rng.normal(0, 4, (count, 3)) * [0, 0, 1] if sagging else None
    terms, poses = densities(RIGS[rig], samples), poses_near_and_far()
    points = transform(poses, samples.reshape(-1, 3))
    if offsets is not None:
        points = points + np.tile(offsets, (3, 1))
    g = as_sensors_say(terms, points)
    expected = np.prod(g, axis=0).mean(axis=-1)
    assert expected[0] > 0.1
    assert expected.min() < 0.1 * expected[0]  # some poses are hardly seen
    paper = PaperObjective(terms, samples, offsets)
    # a sample in 2000 may fall on the other side of a border, where densities drop within a step
    tolerance = {"rtol": 1e-5, "atol": 1e-5 * expected[0]}
    np.testing.assert_allclose(paper.value(poses), expected, **tolerance)
    singles = [float(paper.value(T)) for T in poses]
    np.testing.assert_allclose(singles, expected, **tolerance)
    independent = IndependentObjective(terms, samples, offsets).value(poses)
    means = np.prod([one.mean(axis=-1) for one in g], axis=0)
    np.testing.assert_allclose(independent, means, rtol=1e-5, atol=1e-5 * means[0])


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("wrong", [np.nan, 1e30, 1e300])
def test_a_pose_that_is_nowhere_has_the_floor(rig: str, wrong: float) -> None:
    samples = np.random.default_rng(1).normal(0, 20, (3, 50, 3))
    objective = PaperObjective(densities(RIGS[rig], samples), samples)
    T = TRUTH.copy()
    T[:3, 3] = wrong
    assert float(objective.value(T)) == 0.0
    several = objective.value(np.stack([TRUTH, T]))
    assert several[0] > 0
    assert several[1] == 0.0


def flat_density(lower: float, upper: float) -> Density:
    """1 on a window that is larger than what the sensor measures."""
    window = Window.around(np.full(2, lower), np.full(2, upper), 1.0)
    return Density(np.ones((*window.shape, 3), dtype=np.float32), window, 2.0)


def test_what_is_beside_the_picture_is_not_seen() -> None:
    beam = ParallelBeam(1.0, np.array([50.0, 50.0]), (101, 101), np.eye(4))
    term = SampledTerm(beam, flat_density(-30.0, 130.0))
    # the picture begins half a pixel before 0 and ends half a pixel after 100
    for place, expected in ((-60.0, 0.0), (-50.0, 1.0), (50.0, 1.0), (60.0, 0.0)):
        for axis in (0, 1):
            T = np.eye(4)
            T[axis, 3] = place
            objective = PaperObjective([term], np.zeros((1, 1, 3)))
            assert float(objective.value(T)) == expected


def test_a_body_behind_a_camera_is_not_seen_although_its_mirror_image_is() -> None:
    K = np.array([[500.0, 0, 50], [0, 500.0, 50], [0, 0, 1]])
    camera = PinholeCamera(K, resolution=(101, 101))
    # what looks alike turned by half a turn about the axis has the same image from behind
    samples = np.array([[[20.0, 10.0, 0.0], [-20.0, -10.0, 0.0]]])
    objective = PaperObjective([SampledTerm(camera, flat_density(0.0, 100.0))], samples)
    before, behind = np.eye(4), np.eye(4)
    before[2, 3], behind[2, 3] = 500.0, -500.0
    assert objective.value(np.stack([before, behind])) == pytest.approx([1.0, 0.0])


@pytest.mark.parametrize("count", [16385, 16387, 40001])
def test_samples_that_do_not_fill_blocks_count_once(count: int) -> None:
    beam = ParallelBeam(1.0, np.array([50.0, 50.0]), (101, 101), np.eye(4))
    samples = np.full((1, count, 3), 1e3)
    samples[0, -1] = 0.0  # only the last is seen
    objective = PaperObjective([SampledTerm(beam, flat_density(0.0, 100.0))], samples)
    poses = np.stack([np.eye(4)] * 3)
    assert objective.value(poses) == pytest.approx([1 / count] * 3, rel=1e-6)


def test_no_poses_have_no_values() -> None:
    samples = np.zeros((1, 4, 3))
    objective = PaperObjective(densities(RIGS["parallel"], samples), samples)
    assert objective.value(np.zeros((0, 4, 4))).shape == (0,)
