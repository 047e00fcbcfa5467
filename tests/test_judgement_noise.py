"""The noise of detections as residuals show it, and the covariance that follows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from matches import Seen, matches_of
from numpy.typing import NDArray
from scipy.special import fdtri

from mixpose.judgement import NoiseModel, RememberedNoise, noise
from mixpose.judgement.fields import Fields, rows_by_marker
from mixpose.judgement.noise import noise_of
from mixpose.matching import ErrorRules

Floats = NDArray[np.float64]

FREE = np.ones(6, dtype=np.bool_)
MODEL = NoiseModel()
ALONE = replace(MODEL, fewest_degrees=1e12, lasting=0.0, errors=ErrorRules(chances=(0.0, 0.0, 0.0)))
"""Nothing is enlarged or cut, and nothing believed to last before it is seen."""


def judged(
    sensors: Sequence[Seen],
    before: RememberedNoise = RememberedNoise(),
    model: NoiseModel = MODEL,
) -> tuple[Floats, RememberedNoise]:
    """The covariance of one frame, and what is remembered."""
    _, covariance, _, remembered, *_ = noise_of(matches_of(*sensors), FREE, before, model)
    return covariance, remembered


def sensor(name: str, rng: np.random.Generator, offsets: Floats) -> Seen:
    """A sensor of sigma 2 px that meets n features at any places."""
    n = len(offsets)
    places = rng.uniform(0, 100, (n, 2))
    J = rng.normal(0, 1, (n, 2, 6))
    return Seen(J, name, offsets, places=places, sigma=2.0)


def known(squares: float, degrees: float) -> RememberedNoise:
    return RememberedNoise(("0",), np.array([[squares], [degrees]]))


def of_first(remembered: RememberedNoise) -> list[float]:
    """Squares and degrees of freedom that are remembered of the sensor "0"."""
    return [float(one) for one in remembered.of(["0"])[:, 0]]


def fitted(found: list[Seen], errors: list[Floats]) -> tuple[list[Seen], Floats]:
    """What least squares leaves of errors, and by how much the pose is off."""
    J = np.concatenate([one.J.reshape(-1, 6) for one in found])
    e = np.concatenate([error.ravel() for error in errors])
    off = np.linalg.lstsq(J, e, rcond=None)[0]
    left = [
        replace(one, offsets=error - one.J @ off) for one, error in zip(found, errors, strict=True)
    ]
    return left, off


def test_the_variance_by_few_residuals_is_that_of_students_distribution() -> None:
    # ν / (ν − 2), for ν = 10; errors drawn with a variance that ten residuals tell agree
    assert MODEL.enlargement(np.array([10.0, 1e6])) == pytest.approx([1.25, 1.0], rel=1e-4)
    rng = np.random.default_rng(0)
    told = (rng.normal(size=(100_000, 10)) ** 2).mean(axis=1)
    squared = (rng.normal(size=100_000) ** 2 / told).mean()
    # by chance off by 0.8 %
    assert squared == pytest.approx(float(MODEL.enlargement(np.array([10.0]))[0]), rel=0.03)


def test_a_pose_uses_up_six_of_the_coordinates_met() -> None:
    one = sensor("0", np.random.default_rng(0), np.full((6, 2), 0.1))  # 0.05 σ along each axis
    squares, degrees = of_first(judged([one])[1])
    # twelve coordinates, six are used up; equal offsets weigh a little more than normal ones
    assert squares == pytest.approx(12 * 0.05**2, rel=0.1)
    assert degrees == pytest.approx(6.0, rel=0.05)
    three = replace(one, shares=np.array([1.0, 1, 1, 0, 0, 0]))
    assert of_first(judged([three])[1]) == [0.0, 0.0]


def test_where_no_residuals_say_otherwise_detections_err_by_what_is_usual() -> None:
    three = sensor("0", np.random.default_rng(0), np.zeros((3, 2)))
    covariance, _ = judged([three], model=replace(ALONE, bias=0.0))
    J = three.J.reshape(-1, 6) / 2.0
    np.testing.assert_allclose(covariance, 0.01 * np.linalg.inv(J.T @ J), rtol=1e-6)


def test_residuals_that_agree_by_chance_make_no_pose_exact() -> None:
    # two degrees of freedom, and a tenth of what is usual: of that variance 1 in 21, of which this
    # frame, whose errors may be smaller than those of others, takes a sixth
    four = sensor("0", np.random.default_rng(0), np.zeros((4, 2)))
    covariance, _ = judged([four], model=replace(ALONE, bias=0.0))
    J = four.J.reshape(-1, 6) / 2.0
    least = 0.01 / 21 * np.linalg.inv(J.T @ J)
    np.testing.assert_allclose(covariance, 5 / 6 * least, rtol=0.02)


def test_the_noise_of_a_frame_is_joined_with_what_is_remembered() -> None:
    one = sensor("0", np.random.default_rng(0), np.full((8, 2), 0.2))
    alone = of_first(judged([one])[1])
    joined = of_first(judged([one], known(40 * 0.01, 40.0))[1])
    # the blur at which offsets are weighted is another with what is remembered
    assert joined[0] == pytest.approx(0.95 * 0.4 + alone[0], rel=0.02)
    assert joined[1] == pytest.approx(0.95 * 40.0 + alone[1], rel=0.02)


def test_a_frame_of_much_larger_residuals_goes_by_its_own() -> None:
    rng = np.random.default_rng(1)
    one = sensor("0", rng, rng.normal(0, 0.2, (16, 2)))  # 0.1 σ; 26 degrees of freedom
    before = known(40 * 0.02**2, 40.0)
    covariance, found = judged([one], before, ALONE)
    covariance_alone, own = judged([one], model=ALONE)
    np.testing.assert_allclose(covariance, covariance_alone)
    # remembered as the largest that chance makes
    kept, alone = of_first(found), of_first(own)
    assert kept[1] == pytest.approx(0.95 * 40.0 + alone[1], rel=0.02)
    limit = fdtri(26, 40, 0.999) * 0.02**2 * alone[1]
    assert kept[0] == pytest.approx(0.95 * 40 * 0.02**2 + limit, rel=0.02)


def test_a_few_detections_farther_off_than_those_before_are_cut_and_change_no_noise() -> None:
    rng = np.random.default_rng(1)
    one = sensor("0", rng, rng.normal(0, 0.2, (8, 2)))
    before = known(40 * 0.02**2, 40.0)
    variances, _, _, found, ratio, rarity = noise_of(matches_of(one), FREE, before, ALONE)
    assert ratio > 1
    # 40 degrees of freedom of 0.02 σ and ten of 0.1 σ, which is usual; the frame has little to say,
    # as offsets of ten deviations are no noise
    at = (40 * 0.02**2 + 10 * 0.1**2) / 50
    assert at < variances[0] < 4 * at
    # a factor of 2 or so, by -2 (ln f + 1/f - 1)
    assert -1.0 < rarity < 0.0
    assert of_first(found) == pytest.approx([0.95 * 40 * 0.02**2, 0.95 * 40.0])


def test_a_detection_far_off_does_not_make_the_others_unsure() -> None:
    rng = np.random.default_rng(2)
    offsets = rng.normal(0, 0.1, (12, 2))
    whole, _ = judged([sensor("0", np.random.default_rng(3), offsets)], model=ALONE)
    offsets[4] = [1.5, -1.0]
    cut, _ = judged([sensor("0", np.random.default_rng(3), offsets)], model=ALONE)
    # one of twelve tells nothing: the other eleven fix the pose, two degrees of freedom fewer
    ratio = np.diag(cut) / np.diag(whole)
    assert ratio.max() < 2.5


def test_offsets_in_common_that_a_pose_takes_for_its_own_are_in_the_covariance() -> None:
    rng = np.random.default_rng(5)
    residuals, errors, plain = RememberedNoise(), [], []
    for _ in range(200):
        found = []
        for name in "01234":
            one = sensor(name, rng, np.zeros((12, 2)))
            shift = np.zeros((12, 2, 6))
            shift[...] = rng.normal(0, 1, (2, 6))  # nearly alike for all features of a sensor
            found.append(replace(one, J=shift + 0.3 * one.J))
        made = [rng.normal(0, 0.3, 2) + rng.normal(0, 0.1, (12, 2)) for _ in found]
        left, off = fitted(found, made)
        covariance, residuals = judged(left, residuals, ALONE)
        errors.append(off @ np.linalg.solve(covariance, off) / 6)
        J = np.concatenate([one.J.reshape(-1, 6) for one in left])
        r = np.concatenate([np.ravel(one.offsets) for one in left])
        plain.append(off @ (J.T @ J) @ off / (r @ r / (len(r) - 6)) / 6)
    # least squares takes errors for independent and is far too sure; 1 would be right, and of 80
    # degrees of freedom, spread unevenly over frames, the variance is known to a quarter
    assert np.mean(plain[20:]) > 5.0
    assert 0.5 < np.mean(errors[20:]) < 2.0


def test_an_offset_that_lasts_shows_in_many_frames_where_one_tells_little() -> None:
    blind = replace(ALONE, bias=0.0)
    made = {name: np.array(shift) for name, shift in (("0", [0.8, -0.5]), ("1", [-0.6, 0.7]))}
    errors: dict[NoiseModel, list[float]] = {ALONE: [], blind: []}
    for model, found in errors.items():
        rng, residuals = np.random.default_rng(9), RememberedNoise()
        for _ in range(60):
            sensors = []
            for name in made:
                one = sensor(name, rng, np.zeros((12, 2)))
                shift = np.broadcast_to(rng.normal(0, 1, (2, 6)), (12, 2, 6))
                sensors.append(replace(one, J=shift + 0.3 * one.J))
            noise = [made[one.name] + rng.normal(0, 0.1, (12, 2)) for one in sensors]
            left, off = fitted(sensors, noise)
            covariance, residuals = judged(left, residuals, model)
            found.append(float(off @ np.linalg.solve(covariance, off) / 6))
    # one degree of freedom in six is as large as it is; the others are noise
    assert np.mean(errors[ALONE][20:]) < 2.0
    assert np.mean(errors[blind][20:]) > 2 * np.mean(errors[ALONE][20:])


@pytest.mark.parametrize(
    ("size", "moved"),
    [(0.0004, 0.0), (0.04, MODEL.bias), (0.25, MODEL.bias)],
    ids=["as small as chance", "as small as calibrating leaves it", "as large as before it"],
)
def test_fields_that_no_residual_shows_may_be_large_where_something_lasts(
    size: float, moved: float
) -> None:
    fields = np.diag([2000.0] * 4 + [0.0])  # a pose takes the last
    _, mean, second = noise._biases({}, ("0",), fields, fields @ ([size] * 4 + [0.0]), MODEL)
    # z of 0.8 in four directions where 32 is expected leaves odds of 10^-6, of 80 all
    assert mean[:4] == pytest.approx(size if moved else 0.0, rel=0.01)
    assert second[4, 4] == pytest.approx(moved**2, rel=0.01)


def test_before_anything_is_seen_few_calibrations_are_off() -> None:
    _, mean, second = noise._biases({}, ("0",), np.zeros((1, 3)), np.zeros(1), MODEL)
    np.testing.assert_allclose(mean, 0.0)
    np.testing.assert_allclose(second, np.eye(3) * MODEL.off * MODEL.bias**2)


def test_sensors_that_were_seen_together_before_are_remembered_apart() -> None:
    rng, residuals = np.random.default_rng(4), RememberedNoise()
    for names in ("01", "0", "01", "1", "01"):
        found = [sensor(name, rng, rng.normal(0, 0.1, (8, 2))) for name in names]
        _, residuals = judged(found, residuals)
    kept = {names: len(sums) for names, sums in residuals.biases.items()}
    # an offset and a slant of each: 2 + 4 sizes
    assert kept == {("0", "1"): 12, ("0",): 6, ("1",): 6}


def test_markers_off_in_all_sensors_alike_are_in_the_covariance() -> None:
    rng = np.random.default_rng(6)
    residuals, errors, plain = RememberedNoise(), [], []
    for _ in range(100):
        off = rng.normal(0, 0.3, (12, 3))
        found = [sensor(name, rng, np.zeros((12, 2))) for name in "01234"]
        made = [
            (one.J[..., :3] @ off[..., None])[..., 0] + rng.normal(0, 0.1, (12, 2)) for one in found
        ]
        left, error = fitted(found, made)
        covariance, residuals = judged(left, residuals, ALONE)
        errors.append(error @ np.linalg.solve(covariance, error) / 6)
        J = np.concatenate([one.J.reshape(-1, 6) for one in left])
        r = np.concatenate([np.ravel(one.offsets) for one in left])
        plain.append(error @ (J.T @ J) @ error / (r @ r / (len(r) - 6)) / 6)
    # five sensors see the same errors: least squares takes them for independent; that markers are
    # where they are said to be is believed as surely as one frame of twenty tells
    assert np.mean(plain[20:]) > 2.5
    assert 0.8 < np.mean(errors[20:]) < 1.4


def test_what_features_of_a_sensor_are_off_by_in_common_is_told_from_their_noise() -> None:
    for common, least, most in ((0.0, 0.0, 0.2), (0.5, 0.8, 1.0)):
        rng, residuals = np.random.default_rng(8), RememberedNoise()
        assert residuals.fields == 1.0  # nothing is known of a sensor's own noise
        for _ in range(20):
            found = [sensor(name, rng, np.zeros((12, 2))) for name in "01"]
            made = [rng.normal(0, common, 2) + rng.normal(0, 0.1, (12, 2)) for _ in found]
            _, residuals = judged(fitted(found, made)[0], residuals)
        assert least <= residuals.fields < most


def test_sums_over_markers_are_those_over_pairs_of_markers() -> None:
    # all fields written down as columns of one matrix P, and what a pose leaves of each pair
    rng = np.random.default_rng(3)
    L, N, count, q = 2, 9, 6, 12
    J, fields, by_place = (rng.normal(0, 1, (2 * L * N, k)) for k in (count, q, 3))
    seen = matches_of(sensor("0", rng, np.zeros((N, 2))), sensor("1", rng, np.zeros((N, 2))))
    P = np.zeros((L, N, 2, N, 3))
    for i in range(N):
        P[:, i, :, i] = by_place.reshape(L, N, 2, 3)[:, i]
    P = np.concatenate([fields, P.reshape(2 * L * N, 3 * N)], axis=1)
    A, kinds = J.T @ J, np.eye(4)[[1, 2, 2] * (2 * L) + [3] * (3 * N)]
    inverse = np.asarray(np.linalg.inv(A), dtype=np.float64)
    gram = P.T @ P - P.T @ J @ inverse @ J.T @ P
    exact = kinds.T @ gram**2 @ kinds
    exact[0] = exact[:, 0] = gram.diagonal() @ kinds
    left = fields - J @ inverse @ J.T @ fields
    r, markers, taken = np.zeros(len(J)), rows_by_marker(by_place, seen), J.T @ P
    at = Fields(r, J, fields, markers, kinds, A, inverse, taken, inverse @ taken, left)
    np.testing.assert_allclose(at.expected_squares(seen), exact, rtol=1e-9, atol=1e-9)


def test_what_a_frame_leaves_open_is_no_wider_than_anywhere() -> None:
    rng = np.random.default_rng(0)
    one = sensor("0", rng, 0.1 * rng.standard_normal((40, 2)))
    one.J[..., 4] = 0.0  # a turn that it does not see, and a shift that is next to another one
    one.J[..., 1] = one.J[..., 0] * (1 + 1e-9 * rng.standard_normal(one.J[..., 0].shape))
    anywhere = np.repeat([1e4, 2.0], 3)
    found = matches_of(one)
    covariance = noise_of(found, FREE, RememberedNoise(), MODEL, None, anywhere, anywhere)[1]
    own, bounded = np.linalg.eigvalsh(covariance), np.diag(covariance)
    assert own.min() > 0.0
    # the noise is known to few degrees of freedom, for which all of it is larger
    larger = MODEL.enlargement(MODEL.guess)
    assert 0.9 * 2.0**2 < bounded[4] < larger * 2.0**2 * 1.01
    assert 0.4 * 1e8 < bounded[0] < larger * 1e8
