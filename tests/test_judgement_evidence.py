"""The odds for a pose against clutter, worked out by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import lgamma, log, pi

import numpy as np
import pytest
from matches import Seen, matches_of
from numpy.typing import NDArray

from mixpose.judgement import DetectionModel, Prior
from mixpose.judgement.evidence import log_evidence, odds_of
from mixpose.judgement.information import information_of
from mixpose.matching import Matches

Floats = NDArray[np.float64]

FREE = np.ones(6, dtype=np.bool_)
BY_VOLUME = DetectionModel(by_count=False)
S2 = 0.04  # of the noise, in σ²
KNOWN = 1e4 * np.eye(6)
"""An information that a prior of unit width adds nothing to, but for 1e-4."""

SIX = Seen(np.random.default_rng(0).normal(0, 1, (6, 2, 6)), sigma=2.0)


def odds_at(
    found: list[Seen],
    information: Floats,
    prior: Prior,
    size: float,
    model: DetectionModel,
    spreads: Floats | None = None,
    surfaces: Sequence[int] | None = None,
) -> float:
    """Of one pose."""
    variances, sizes = np.full((1, len(found)), S2), np.array([size])
    matches = Matches.stacked([matches_of(*found)])
    at_S2 = information[None] / S2
    given = [prior], sizes, model, at_S2, spreads
    of = None if surfaces is None else np.array(surfaces)
    odds = log_evidence(matches, variances, FREE, *given, of)
    return float(odds[0, 0])


def evidence(
    one: Seen,
    *,
    log_density: float = -10.0,
    information: Floats = KNOWN,
    detection: DetectionModel = BY_VOLUME,
) -> float:
    prior = log_density, np.ones(6)
    return odds_at([one], information, prior, 1.0, detection)


def test_the_odds_by_volume_are_those_of_the_formula() -> None:
    met = log(0.75 / (2.0**2 * 1e-5 * 2 * pi * S2))
    laplace = 0.5 * (6 * log(2 * pi) - 6 * log(1e4 / S2 + 1))
    assert evidence(SIX) == pytest.approx(6 * met + laplace - 10.0)


def test_a_feature_that_is_missed_costs_as_much_as_its_chance() -> None:
    lost = evidence(SIX) - evidence(replace(SIX, expected=7.0))
    assert lost == pytest.approx(log(4))


def test_a_surface_of_which_nothing_is_seen_is_hidden_as_one_feature() -> None:
    def odds(met: int, surfaces: list[int]) -> float:
        J = np.random.default_rng(0).normal(0, 1, (10, 2, 6))
        shares = (np.arange(10) < met).astype(np.float64)
        one = Seen(J, sigma=2.0, shares=shares, count=10.0)
        return odds_at([one], KNOWN, (-10.0, np.ones(6)), 1.0, BY_VOLUME, None, surfaces)

    alone, on_two = list(range(10)), [0] * 6 + [1] * 4
    # four tags' corners, say, of which a finger covers one: 4 misses by themselves, 1 together
    assert odds(6, on_two) - odds(6, alone) == pytest.approx(3 * log(4))
    # a surface that is seen in part is missed feature by feature
    assert odds(7, on_two) == pytest.approx(odds(7, alone))
    # of a body of one surface a sensor meets something or is blind
    assert odds(6, [0] * 10) == pytest.approx(odds(6, [-1] * 10))


def test_a_feature_that_no_camera_sees_is_covered_and_counts_as_missed_twice() -> None:
    six = replace(SIX, J=np.zeros((7, 2, 6)), shares=np.append(np.ones(6), 0.0), count=6.0)
    for cameras, misses in ((1, 1), (2, 2), (4, 2)):
        seen = [replace(six, name=str(k)) for k in range(cameras)]
        all_met = [replace(one, shares=np.ones(7)) for one in seen]
        lost = odds_by_volume(all_met, in_space=False) - odds_by_volume(seen, in_space=False)
        met = cameras * log(0.75 / (2.0**2 * 1e-5 * 2 * pi * S2))
        assert lost == pytest.approx(met + misses * log(4))


def test_a_feature_out_of_view_costs_as_much_as_its_chance() -> None:
    assert evidence(SIX) - evidence(replace(SIX, unseen=2.0)) == pytest.approx(2.4)


def test_in_denser_clutter_every_feature_met_says_less() -> None:
    lost = evidence(SIX) - evidence(replace(SIX, crowd=5e-5))
    assert lost == pytest.approx(6 * log(5))


def test_a_feature_met_loosely_says_less() -> None:
    offsets = np.zeros((6, 2))
    offsets[2, 0] = 0.8  # 0.4 σ, two standard deviations
    assert evidence(SIX) - evidence(replace(SIX, offsets=offsets)) == pytest.approx(2.0)


def test_the_better_a_pose_is_known_the_more_it_was_chosen_to_fit() -> None:
    # half as wide in six directions; the prior is 1e-5 of the information
    lost = evidence(SIX) - evidence(SIX, information=4 * KNOWN)
    assert lost == pytest.approx(6 * log(2), rel=1e-5)


def test_a_pose_that_was_expected_is_likelier() -> None:
    assert evidence(SIX, log_density=-3.0) - evidence(SIX) == pytest.approx(7.0)


def test_by_count_features_that_fix_the_pose_earn_nothing_and_choices_cost() -> None:
    # twenty detections, six of them met: three fix the pose, among C(20, 3) and as 6·5·4 features
    found = replace(SIX, count=20.0)
    met = log(0.75 / (2.0**2 * 1e-5 * 2 * pi * 0.04))
    ways = lgamma(21) - lgamma(18) - lgamma(4) + log(6 * 5 * 4) + log(2)
    by_count = evidence(found, log_density=-1e9, detection=DetectionModel())
    assert by_count == pytest.approx(6 * met * (1 - 6 / 12) - ways)


def two_cameras_at_right_angles() -> list[Seen]:
    """Both see a px per length unit across; six features, each met exactly by both."""
    J = np.zeros((2, 6, 2, 6))
    J[0, :, 0, 0] = J[0, :, 1, 2] = 1.0
    J[1, :, 0, 1] = J[1, :, 1, 2] = 1.0
    return [replace(SIX, name=str(k), J=J[k]) for k in (0, 1)]


def odds_by_volume(
    found: list[Seen], *, in_space: bool = True, spreads: Floats | None = None
) -> float:
    detection = DetectionModel(by_count=False, in_space=in_space)
    prior = 0.0, np.ones(6)
    return odds_at(found, KNOWN, prior, 200.0, detection, spreads)


def test_a_false_point_in_space_is_one_coincidence_however_many_cameras_see_it() -> None:
    both = two_cameras_at_right_angles()
    # s = 0.4 px: the place is known to s, s and, where both see it, s / √2; a camera sees 1e-5 per
    # px², and points in space are as dense in depth
    density = 1e-5**1.5
    in_space = -log(density * (2 * pi) ** 1.5 * 0.4**3 / 2**0.5)
    alone = 2 * log(0.75 / (1e-5 * 2 * pi * 0.4**2))
    assert in_space < alone
    lost = odds_by_volume(both, in_space=False) - odds_by_volume(both)
    assert lost == pytest.approx(6 * (alone - in_space), rel=1e-3)
    # a third camera beside the first adds the precision of a third look, no third coincidence
    third = odds_by_volume([*both, replace(both[0], name="2")]) - odds_by_volume(both)
    # along x two see it now in place of one, along z three in place of two
    assert third == pytest.approx(6 * (log(2) + log(3 / 2)) / 2, rel=1e-3)


def test_a_camera_that_misses_a_point_misses_it_whatever_it_is() -> None:
    both = two_cameras_at_right_angles()
    third = replace(both[0], name="2", shares=np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]))
    assert odds_by_volume([*both, third]) > odds_by_volume(both)
    met = log(0.75 / (1e-5 * 2 * pi * 0.4**2))
    assert odds_by_volume([*both, third], in_space=False) == pytest.approx(
        odds_by_volume(both, in_space=False) + 3 * met - 3 * log(4), rel=1e-3
    )


def test_a_camera_that_misses_all_of_the_body_is_covered_and_counts_once() -> None:
    both = two_cameras_at_right_angles()
    blind = replace(both[0], name="2", shares=np.zeros(6))
    assert odds_by_volume([*both, blind]) == pytest.approx(odds_by_volume(both))
    # six misses would count 8.3; and what chance puts near the edge of the gate changes nothing
    least = odds_by_volume(both, in_space=False) + DetectionModel().log_blind
    assert odds_by_volume([*both, blind], in_space=False) == pytest.approx(least)
    by_chance = replace(blind, shares=np.eye(6)[0], offsets=np.full((6, 2), 1.6))
    assert odds_by_volume([*both, by_chance], in_space=False) == pytest.approx(least, abs=0.1)


def test_a_point_in_space_is_off_as_far_as_its_place_is_from_the_feature() -> None:
    both = two_cameras_at_right_angles()
    offsets = np.zeros((6, 2))
    offsets[0, 0] = 0.8  # one camera alone knows this direction: two standard deviations
    off = odds_by_volume([replace(both[0], offsets=offsets), both[1]])
    assert odds_by_volume(both) - off == pytest.approx(2.0, rel=1e-3)


def test_a_feature_that_may_be_off_is_met_as_far_as_it_may_be() -> None:
    both = two_cameras_at_right_angles()
    offsets, spreads = np.zeros((6, 2)), np.zeros((1, 6, 3, 3))
    offsets[0, 0] = 0.8  # as above: two standard deviations of 0.4
    spreads[0, 0, 0, 0] = 0.4**2 * 3  # variance four times as large, in this direction alone
    off = [replace(both[0], offsets=offsets), both[1]]
    lost = odds_by_volume(both, spreads=spreads) - odds_by_volume(off, spreads=spreads)
    assert lost == pytest.approx(2.0 / 4, rel=1e-3)
    # what may lie anywhere around tells less where it lies at its place
    assert odds_by_volume(both) - odds_by_volume(both, spreads=spreads) == pytest.approx(
        log(2), rel=1e-3
    )


def test_features_that_may_be_off_tell_less_of_the_pose() -> None:
    both = Matches.stacked([matches_of(*two_cameras_at_right_angles())])
    variances, spreads = np.full((1, 2), S2), np.zeros((1, 6, 3, 3))
    exact = information_of(both, variances)
    np.testing.assert_allclose(information_of(both, variances, spreads), exact)
    spreads[...] = 0.5**2 * np.eye(3)
    # along z both cameras see them: (S2 σ² / 2 + 0.25) each, along x one of them
    found = information_of(both, variances, spreads)[0]
    noise = S2 * 2.0**2
    assert found[2, 2] == pytest.approx(6 / (noise / 2 + 0.25))
    assert found[0, 0] == pytest.approx(6 / (noise + 0.25))


def test_information_of_features_that_nearly_touch_a_camera_is_as_exact_as_of_others() -> None:
    # they move there by 1e7 px a mm, which beside their spread is as if that were all
    J = np.zeros((6, 2, 6))
    J[..., :3] = np.random.default_rng(5).normal(0, 1e7, (6, 2, 3))
    near = Matches.stacked([matches_of(Seen(J, sigma=2.0))])
    spreads = np.broadcast_to(np.eye(3), (1, 6, 3, 3))
    found = information_of(near, np.full((1, 1), S2), spreads)[0]
    # of each feature the two coordinates across its line of sight
    across = sum(np.linalg.pinv(one) @ one for one in J[..., :3])
    np.testing.assert_allclose(found[:3, :3], across, atol=1e-9)


def test_information_is_that_of_least_squares() -> None:
    shares = np.array([1.0, 1.0, 0.5, 1.0, 0.0, 1.0])
    expected = sum(s * J.T @ J / 2.0**2 for s, J in zip(shares, SIX.J, strict=True))
    met = Matches.stacked([matches_of(replace(SIX, shares=shares))])
    np.testing.assert_allclose(information_of(met, np.array([[S2]]))[0], expected / S2)


def test_what_a_cloud_misses_costs_as_much_as_what_one_camera_misses() -> None:
    planes = [replace(SIX, name=name, shares=[1, 1, 1, 1, 1, 0]) for name in ("xy", "yz", "zx")]
    cloud = replace(matches_of(*planes), owners=np.zeros(3, dtype=np.intp))
    model, given = DetectionModel(), (np.full((1, 3), S2), np.array([100.0]))
    _, missed, _ = odds_of(Matches.stacked([cloud]), *given, model)
    assert missed == pytest.approx(log(1 - model.probability))
