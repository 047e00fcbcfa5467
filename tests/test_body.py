"""The object model: mixtures, samples, symmetries."""

from __future__ import annotations

import numpy as np
import pytest
from rounding import rounding

from mixpose.body import (
    Body,
    Gravity,
    PointFeature,
    Sampler,
    SegmentFeature,
    mirror_image,
    symmetries,
    uniforms,
)
from mixpose.rigid import from_rotation_vector, transform

COVARIANCE = np.array([[9.0, 2.0, 0.0], [2.0, 4.0, 1.0], [0.0, 1.0, 1.0]])


@pytest.mark.parametrize("sampler", ["latin-hypercube", "low-discrepancy"])
def test_samples_have_the_mean_and_covariance_of_their_feature(sampler: Sampler) -> None:
    features = (PointFeature(np.array([1.0, 2.0, 3.0]), COVARIANCE), PointFeature(np.zeros(3)))
    samples = Body("b", features).sample(2000, sampler=sampler)
    assert samples.shape == (2, 2000, 3)
    # antithetic pairs cancel the error of the mean altogether
    np.testing.assert_allclose(samples[0].mean(axis=0), [1, 2, 3], atol=1e-12)
    # stratified in each dimension: far better than the 0.3 of independent draws
    np.testing.assert_allclose(np.cov(samples[0].T), COVARIANCE, atol=0.2)
    np.testing.assert_allclose(samples[1], 0.0)


def test_a_uniform_spread_is_a_box_with_the_same_covariance() -> None:
    diagonal = np.diag([9.0, 4.0, 1.0])
    body = Body("b", (PointFeature(np.zeros(3), diagonal, "uniform"),))
    samples = body.sample(4000)[0]
    np.testing.assert_allclose(np.cov(samples.T), diagonal, atol=0.2)
    # a Gaussian would reach beyond √3 standard deviations in 8 % of the samples
    assert (np.abs(samples) <= np.sqrt(3 * np.array([9.0, 4.0, 1.0])) + 1e-9).all()


def test_gravity_displaces_along_the_world_whatever_the_pose() -> None:
    gravity = Gravity(np.array([0.0, 0.0, -2.0]), 1.5)
    body = Body("b", (PointFeature(np.zeros(3)),), gravity=gravity)
    offsets = body.world_offsets(1000)
    assert not body.is_exact
    assert offsets.shape == (1000, 3)
    assert not offsets[:, :2].any()
    assert offsets[:, 2].std() == pytest.approx(1.5, rel=0.02)


def test_gravity_widens_features_along_the_world_beside_their_own_spread() -> None:
    features = (PointFeature(np.zeros(3), np.diag([9.0, 0, 0])), PointFeature(np.ones(3)))
    body = Body("b", features, gravity=Gravity(np.array([0.0, 0.0, -2.0]), 4.0))
    lying = np.eye(4)
    lying[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]  # the body's x stands upright
    np.testing.assert_allclose(
        body.node_spreads(lying), [np.diag([0, 0, 25.0]), np.diag([0, 0, 16.0])], atol=1e-12
    )
    assert body.spread == pytest.approx(5.0)  # √(3² + 4²): no pose has more
    assert len(body.symmetries) == len(Body("b", features).symmetries)


def test_all_features_take_the_same_offsets_unless_told_otherwise() -> None:
    features = tuple(PointFeature(np.array([x, 0, 0.0]), COVARIANCE) for x in (0.0, 5.0))
    body = Body("b", features)
    common = body.sample(100)
    np.testing.assert_allclose(common[1] - common[0], np.tile([5.0, 0, 0], (100, 1)))
    fresh = body.sample(100, common=False)
    assert np.abs(fresh[1] - fresh[0] - [5.0, 0, 0]).max() > 1.0


def test_samples_repeat_with_the_seed() -> None:
    body = Body("b", (PointFeature(np.zeros(3), COVARIANCE),))
    np.testing.assert_array_equal(body.sample(64, seed=3), body.sample(64, seed=3))
    assert not np.array_equal(body.sample(64, seed=3), body.sample(64, seed=4))


def test_a_latin_hypercube_has_one_point_in_every_layer() -> None:
    points = uniforms(100, antithetic=False)
    for column in points.T:
        np.testing.assert_array_equal(np.sort((column * 100).astype(int)), np.arange(100))


def test_a_segment_is_uniform_along_its_line() -> None:
    feature = SegmentFeature(np.zeros(3), np.array([10.0, 0.0, 0.0]))
    samples = Body("b", (feature,)).sample(1000)
    np.testing.assert_allclose(np.histogram(samples[0, :, 0], 10, (0, 10))[0], 100, atol=1)
    points, weights = feature.nodes()
    assert weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(weights @ points, feature.mean)


def test_an_exact_body_needs_no_samples() -> None:
    body = Body("b", tuple(PointFeature(np.array([x, 0, 0.0])) for x in (0.0, 1.0, 3.0)))
    assert body.is_exact
    assert body.sample(1000).shape == (3, 1, 3)


CUBE = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("points", "order"),
    [
        (CUBE, 24),
        (CUBE[1:-1], 6),  # the paper's object: two opposite corners missing
        (np.array([[0, 0, 0], [0, 0.045, 0], [0, -0.045, 0], [0.04, 0, 0]]), 2),  # a T
        (np.array([[x, y, 0.0] for x in range(9) for y in range(6)]), 4),  # a chessboard
        (RNG.uniform(-1, 1, (7, 3)), 1),
        (np.array([[0, 0, -1.0], [0, 0, 0], [0, 0, 1.0]]), 2),  # on a line: half a turn
    ],
)
def test_symmetries_are_found_and_map_the_points_onto_themselves(
    points: np.ndarray, order: int
) -> None:
    turned = transform(from_rotation_vector([0.3, -1.0, 0.5], [10.0, 2.0, -3.0]), points)
    found = symmetries(turned, 1e-3)
    assert len(found) == order
    np.testing.assert_allclose(found[0], np.eye(4), atol=rounding(turned, 1))
    for T in found:
        mapped = transform(T, turned)
        distance = np.linalg.norm(mapped[:, None] - turned[None], axis=-1)
        assert distance.min(axis=1).max() < 1e-6
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_symmetries_of_a_triangle_whose_sides_are_nearly_equal_are_all_found() -> None:
    # within 0.6 %: half turns and turns err by up to 1.5 times the tolerance of one of them
    points = np.array([[-8.20, 23.21, -3.60], [14.26, -4.93, 19.54], [-6.06, -18.28, -15.94]])
    found = Body("triangle", tuple(map(PointFeature, points))).symmetries
    assert len(found) == 6
    products = (found[:, None] @ found[None])[..., :3, :3].reshape(-1, 3, 3)
    # whose traces of differences are 3 for the same turn
    same = np.einsum("aij,bij->ab", products, found[:, :3, :3]).max(axis=1)
    assert same.min() > 1 + 2 * np.cos(np.radians(2.0))


def test_normals_forbid_symmetries_that_turn_them() -> None:
    points = tuple(PointFeature(np.array([x, y, 0.0])) for x in range(9) for y in range(6))
    up = np.tile([0.0, 0.0, 2.0], (54, 1))
    assert len(Body("board", points).symmetries) == 4
    kept = Body("board", points, up).symmetries
    # half a turn in its plane is left; over its edges the board would show its back
    np.testing.assert_allclose(kept[:, :3, :3], [np.eye(3), np.diag([-1.0, -1, 1])], atol=1e-9)
    two_sided = np.where(np.arange(54)[:, None] % 2, up, -up)
    assert len(Body("board", points, two_sided).symmetries) < 4


def test_a_symmetry_within_the_spread_of_the_features_counts() -> None:
    bent = CUBE + np.random.default_rng(1).normal(0, 0.01, CUBE.shape)
    assert len(symmetries(bent, 1e-3)) == 1
    assert len(symmetries(bent, 0.1)) == 24


@pytest.mark.parametrize(
    ("rows", "columns", "expected"),
    [
        (1, 1, 0),
        (2, 2, 0),  # a step maps two of four onto the others
        (3, 3, 4),  # six of nine, along and across
        (7, 5, 12),  # along, across and diagonally, also by two rows or columns along: 21 of 35
    ],
)
def test_a_grid_has_steps_that_map_most_of_it_onto_itself(
    rows: int, columns: int, expected: int
) -> None:
    places = [(20.0 * i, 20.0 * j, 0.0) for i in range(rows) for j in range(columns)]
    grid = Body("grid", tuple(PointFeature(np.array(place)) for place in places))
    steps = grid.grid_steps
    assert len(steps) == expected
    assert all(any(np.allclose(step, -other) for other in steps) for step in steps)


def test_points_at_random_have_no_steps() -> None:
    points = np.random.default_rng(3).normal(scale=50.0, size=(9, 3))
    body = Body("scatter", tuple(PointFeature(point) for point in points))
    assert len(body.grid_steps) == 0


def test_a_corner_moved_beyond_the_tolerance_leaves_the_turns_about_its_diagonal() -> None:
    marked = CUBE.copy()
    marked[-1] *= 1 + 0.02 / np.sqrt(3)  # by 0.02 along its diagonal
    # on average over the eight corners a turn would miss by 0.005 only
    assert len(symmetries(marked, 0.01)) == 3
    assert len(symmetries(marked, 0.05)) == 24


def test_one_normal_that_differs_forbids_a_symmetry() -> None:
    square = tuple(PointFeature(np.array([x, y, 0.0])) for x in (-1.0, 1) for y in (-1.0, 1))
    normals = np.tile([0.0, 0.0, 1.0], (4, 1))
    assert len(Body("square", square, normals).symmetries) == 4
    normals[2] = [1.0, 0.0, 0.0]
    assert len(Body("square", square, normals).symmetries) == 1


def test_a_body_looks_alike_where_its_own_spread_hides_the_difference() -> None:
    bent = CUBE + np.random.default_rng(1).normal(0, 0.03, CUBE.shape)
    for sigma, order in ((0.0, 1), (0.3, 24)):
        features = tuple(PointFeature(point, sigma**2 * np.eye(3)) for point in bent)
        assert len(Body("bent", features).symmetries) == order


def test_the_mirror_image_of_spheres_is_of_spheres_with_the_same_labels() -> None:
    points = np.array([[0.0, 0, 0], [60, 0, 5], [0, 70, -10], [40, 30, 50]])
    features, radii = tuple(map(PointFeature, points)), np.full(4, 7.5)
    labels = ("a", "b", "c", "d")
    body = Body("ball", features, names=labels, radii=radii, shape="sphere")
    mirrored = mirror_image(body, frozenset(range(4)))
    assert (mirrored.shape, mirrored.labels) == ("sphere", labels)
    np.testing.assert_array_equal(mirrored.radii, radii)
    # all distances are kept, and the volume changes its sign
    at, own = mirrored.means, body.means
    sides = [np.linalg.norm(one - one[:, None], axis=2) for one in (at, own)]
    np.testing.assert_allclose(sides[0], sides[1], atol=1e-9)
    volumes = [np.linalg.det(one[1:] - one[0]) for one in (at, own)]
    assert volumes[0] == pytest.approx(-volumes[1])


def test_the_radius_does_not_depend_on_where_the_body_is_measured_from() -> None:
    corners = tuple(PointFeature(point) for point in CUBE + np.array([100.0, 0, -50]))
    assert Body("cube", corners).radius == pytest.approx(np.sqrt(3))


def test_the_spread_is_that_of_the_widest_direction() -> None:
    flat = PointFeature(np.zeros(3), np.diag([0.0, 4.0, 1.0]))
    turned = np.array([[5.0, 4.0, 0], [4.0, 5.0, 0], [0, 0, 0.0]])  # 9 along (1, 1), 1 across
    assert Body("b", (flat,)).spread == pytest.approx(2.0)
    assert Body("b", (flat, PointFeature(np.zeros(3), turned))).spread == pytest.approx(3.0)


def test_the_displacement_along_gravity_has_nothing_to_do_with_the_place_along_a_line() -> None:
    line = SegmentFeature(np.zeros(3), np.array([1.0, 0.0, 0.0]))
    body = Body("b", (line,), gravity=Gravity(np.array([0.0, 0.0, -1.0]), 1.0))
    along = body.sample(4000)[0, :, 0]
    down = body.world_offsets(4000)[:, 2]
    # of 2000 pairs drawn by chance the correlation is 0.02 or so
    assert abs(np.corrcoef(along, down)[0, 1]) < 0.1
