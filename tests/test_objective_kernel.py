"""The matched kernel, ⟨g, h⟩² / ⟨h, h⟩ with its derivatives, on closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from rounding import rounding

from mixpose.density import peak
from mixpose.objective import Match
from mixpose.objective.matched import overlaps, slopes
from mixpose.optimise import Quadratic

Floats = NDArray[np.float64]

VARIANCES = np.array([[4.0], [9.0]])
TOPS = np.array([[peak(4.0, 2)], [peak(9.0, 2)]])
SCALES = np.array([[0.7], [1.9]])


class Scene:
    """Two sensors whose features move linearly with a twist, and C in closed form.

    Parameters
    ----------
    spacing : float
        How far apart features are: 3 overlap, 60 do not.
    """

    def __init__(self, spacing: float, count: int = 7, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        u, v = np.divmod(np.arange(count), 3)
        places = spacing * np.stack([u, v], axis=1) + rng.normal(0, 0.2, (2, count, 2))
        self.places = places
        self.J = rng.normal(0, 1, (2, count, 2, 6))
        self.weights = rng.uniform(0.5, 2, (2, count))
        # detections a bit off, one too many in either sensor
        found = places + rng.normal(0, 0.7, places.shape)
        self.detections = np.concatenate([found, rng.normal(0, 5, (2, 1, 2))], axis=1)

    def at(self, twists: Floats) -> Match:
        """Projection, C with its gradient, and overlaps at twists (H, 6)."""
        y = self.places[:, None] + np.einsum("lnmk,hk->lhnm", self.J, twists)
        shape = y.shape[:3]
        seen = np.ones(shape, dtype=np.bool_)
        weights = np.broadcast_to(self.weights[:, None], shape)
        J = np.broadcast_to(self.J[:, None], (*shape, 2, 6))
        away = self.detections[:, None, None] - y[:, :, :, None]
        v = VARIANCES[..., None, None]
        bells = np.exp(-0.5 * (away**2).sum(axis=4) / v) * TOPS[..., None, None]
        slope = (bells[..., None] * away).sum(axis=3) / v
        sampled = np.concatenate([bells.sum(axis=3)[..., None], slope], axis=3)
        over = overlaps(y, weights, VARIANCES, TOPS)
        return Match(y, J, seen, seen, weights, sampled, *over)

    def slopes(self, twists: Floats) -> Quadratic:
        return slopes(self.at(twists), VARIANCES, TOPS, SCALES)


def twists(count: int, size: float = 0.1) -> Floats:
    return np.random.default_rng(5).normal(0, size, (count, 6))


def written_down(scene: Scene, twist: Floats) -> float:
    """Σ_l s_l ⟨g, h⟩² / ⟨h, h⟩, sum by sum."""
    total = 0.0
    for k in range(2):
        v = float(VARIANCES[k, 0])
        y = scene.places[k] + scene.J[k] @ twist
        c = n = 0.0
        for i, p in enumerate(y):
            for q in scene.detections[k]:
                c += scene.weights[k, i] * np.exp(-((p - q) @ (p - q)) / 2 / v) / (2 * np.pi * v)
            for j, q in enumerate(y):
                w = scene.weights[k, i] * scene.weights[k, j]
                n += w * np.exp(-((p - q) @ (p - q)) / 2 / v) / (2 * np.pi * v)
        total += float(SCALES[k, 0]) * c**2 / n
    return total


@pytest.mark.parametrize("spacing", [3.0, 60.0])
def test_the_value_is_that_of_the_sums_written_down(spacing: float) -> None:
    scene = Scene(spacing)
    for twist in twists(3):
        found = float(scene.slopes(twist[None]).value[0])
        # pairs below e^-28 are left out
        assert found == pytest.approx(written_down(scene, twist), rel=1e-9)


@pytest.mark.parametrize("spacing", [3.0, 60.0])
def test_the_gradient_is_the_slope_of_the_value(spacing: float) -> None:
    scene = Scene(spacing)
    step = 1e-5
    for twist in twists(3):
        gradient = scene.slopes(twist[None]).gradient[0]
        ahead, behind = (scene.slopes(twist + s * step * np.eye(6)).value for s in (1, -1))
        numerical = (ahead - behind) / (2 * step)
        # third derivatives over a step of 1e-5 leave 1e-10, rounding of values 1e-11
        np.testing.assert_allclose(gradient, numerical, atol=1e-8 * np.abs(gradient).max())


@pytest.mark.parametrize("spacing", [1.0, 3.0, 60.0])
def test_the_curvature_is_symmetric_and_never_negative(spacing: float) -> None:
    # far from the maximum as well, where the Hessian is indefinite
    found = Scene(spacing).slopes(twists(40, 2.0))
    np.testing.assert_allclose(found.curvature, found.curvature.swapaxes(1, 2), atol=1e-12)
    values = np.linalg.eigvalsh(found.curvature)
    assert (values.min(axis=1) > -1e-12 * values.max(axis=1)).all()


@pytest.mark.parametrize("spacing", [3.0, 60.0])
def test_a_batch_of_poses_is_what_they_are_one_by_one(spacing: float) -> None:
    scene, several = Scene(spacing), twists(9)
    together = scene.slopes(several)
    for k, twist in enumerate(several):
        alone = scene.slopes(twist[None])
        for one, other in zip(together[:3], alone[:3], strict=True):
            np.testing.assert_allclose(one[k], other[0], rtol=1e-10, atol=1e-12)


def test_poses_of_which_some_have_overlapping_features_are_what_they_are_one_by_one() -> None:
    scene = Scene(60.0)
    # the second twist moves feature 0 of the first sensor onto feature 1
    several = np.zeros((2, 6))
    onto = scene.places[0, 1] - scene.places[0, 0]
    several[1] = np.linalg.pinv(scene.J[0, 0] - scene.J[0, 1]) @ onto
    assert len(scene.at(several[:1]).pairs) == 0
    assert len(scene.at(several[1:]).pairs) > 0
    together = scene.slopes(several)
    for k in range(2):
        alone = scene.slopes(several[k : k + 1])
        for one, other in zip(together[:3], alone[:3], strict=True):
            np.testing.assert_allclose(one[k], other[0], rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("spacing", [2.0, 4.0, 60.0])
def test_at_a_pose_that_fits_exactly_the_curvature_is_the_hessian(spacing: float) -> None:
    # where g = a h nothing is left over: Gauss-Newton and mean-shift are both exact
    scene = Scene(spacing)
    scene.weights[:] = 1.0
    scene.detections = scene.places
    here = scene.slopes(np.zeros((1, 6)))
    np.testing.assert_allclose(here.gradient, 0, atol=1e-10)
    step = 1e-4
    ahead, behind = (scene.slopes(s * step * np.eye(6)).gradient for s in (1, -1))
    numerical = -(ahead - behind) / (2 * step)
    # third derivatives over a step of 1e-4 in features of width 2 leave 1e-8
    scale = np.abs(numerical).max()
    np.testing.assert_allclose(here.curvature[0], numerical, atol=1e-6 * scale)


def test_the_norm_counts_every_pair_of_features_that_overlap() -> None:
    scene = Scene(3.0)
    at = scene.at(twists(2))
    away = at.y[:, :, :, None] - at.y[:, :, None]
    bells = np.exp(-0.5 * (away**2).sum(axis=4) / VARIANCES[..., None, None])
    expected = np.einsum("lhi,lhj,lhij->lh", at.weights, at.weights, bells) * TOPS
    # pairs with less than e⁻¹⁶ of a peak are left out
    np.testing.assert_allclose(at.norm, expected, rtol=1e-6)


def test_features_that_are_not_seen_neither_count_nor_pull() -> None:
    # hidden features sit together far outside, with weight 0
    scene = Scene(60.0)
    at = scene.at(np.zeros((1, 6)))
    y, J, weights = at.y.copy(), at.J.copy(), at.weights.copy()
    seen = at.seen.copy()
    y[:, :, 4:], J[:, :, 4:], weights[:, :, 4:], seen[:, :, 4:] = -1e6, 0.0, 0.0, False
    over = overlaps(y, weights, VARIANCES, TOPS)
    met = Match(y, J, seen, seen, weights, at.sampled, *over)
    found = slopes(met, VARIANCES, TOPS, SCALES)
    some = at.of(slice(None), 4)
    over = overlaps(some.y, some.weights, VARIANCES, TOPS)
    met = Match(*some[:6], *over)
    expected = slopes(met, VARIANCES, TOPS, SCALES)
    for one, other in zip(found[:3], expected[:3], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=rounding(1))


def test_a_sensor_that_sees_no_feature_adds_nothing() -> None:
    scene = Scene(60.0)
    at = scene.at(np.zeros((1, 6)))
    weights = at.weights.copy()
    weights[1] = 0.0
    over = overlaps(at.y, weights, VARIANCES, TOPS)
    met = Match(*at[:4], weights, at.sampled, *over)
    blind = slopes(met, VARIANCES, TOPS, SCALES)
    alone = slopes(scene.at(np.zeros((1, 6))), VARIANCES, TOPS, SCALES * [[1], [0]])
    for one, other in zip(blind[:3], alone[:3], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=rounding(1))
