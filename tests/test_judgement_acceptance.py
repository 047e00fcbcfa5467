"""From judged poses to a status: what is told, what is sure, and what is the same pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from detections import ALL_FREE, EIGHT, TRUTH, detect
from matches import Seen, matches_of, scored
from numpy.typing import NDArray

from mixpose.body import Body, PointFeature
from mixpose.judgement import (
    AcceptanceRules,
    Alternative,
    NoiseModel,
    ScoredPose,
    beliefs,
    convinces,
    decide,
    has_two_agreeing,
    insert,
    nearest_alike,
)
from mixpose.matching import AssociationRules, ErrorRules, Matches, associate
from mixpose.objective import View, matched_objective
from mixpose.rigid import from_rotation_vector, perturb, transform
from mixpose.sensors import PinholeCamera, RangeSensor

Floats = NDArray[np.float64]

RULES = AcceptanceRules()


def sensor(name: str, met: float, expected: float = 8.0, unseen: float = 0.0) -> Seen:
    """A camera that meets all of eight features by the same share."""
    shares = np.full(8, met / 8)
    return Seen(
        np.zeros((8, 2, 6)), name, shares=shares, sigma=1.5, expected=expected, unseen=unseen
    )


def scored_with(coverage: float = 1.0, measurements: float = 32.0) -> ScoredPose:
    """By two cameras, out of whose views is what they do not cover."""
    met = measurements / 4
    seen = [sensor(name, met, met, met / coverage - met) for name in "01"]
    return scored(TRUTH, *seen)


def matched_to(*sensors: Seen) -> ScoredPose:
    """A pose with all else as `SURE` has it."""
    return scored(TRUTH, *sensors)


SURE = scored_with()
ELSEWHERE = perturb(TRUTH, np.repeat([90.0, 0.8], 3))
CORNERS = ((50.0, 50.0, 0.0), (-50.0, 50.0, 0.0), (-50.0, -50.0, 0.0), (50.0, -50.0, 0.0))
SQUARE = Body("square", tuple(PointFeature(np.array(corner)) for corner in CORNERS))


def status(*ranked: ScoredPose) -> str:
    return decide(ranked, ALL_FREE, RULES).status


@pytest.mark.parametrize("axis", [[1.0, 0.0, 0.0], [0.6, 0.0, 0.8], [0.58, -0.58, 0.57]])
@pytest.mark.parametrize(("deviation_deg", "expected"), [(7.6, "ok"), (7.7, "ambiguous")])
def test_how_widely_a_turn_may_be_open_does_not_depend_on_where_its_axis_points(
    deviation_deg: float, expected: str, axis: list[float]
) -> None:
    """15 degrees either way are 1.96 of 7.65."""
    along = np.array(axis) / np.linalg.norm(axis)
    covariance = np.diag([1.0] * 3 + [1e-6] * 3)
    covariance[3:, 3:] += np.radians(deviation_deg) ** 2 * np.outer(along, along)
    assert status(replace(SURE, covariance=covariance)) == expected


@pytest.mark.parametrize(("belief", "expected"), [(0.0009, "ok"), (0.0011, "ambiguous")])
def test_a_rival_of_more_than_one_in_a_thousand_makes_a_frame_ambiguous(
    belief: float, expected: str
) -> None:
    odds = np.log(belief / (1 - belief))
    rival = replace(SURE, T_world_object=ELSEWHERE, log_evidence=50.0 + odds)
    assert beliefs([SURE.log_density, rival.log_density])[1] == pytest.approx(belief)
    assert status(SURE, rival) == expected


def test_all_that_may_be_instead_of_a_pose_adds_up_to_what_it_is_doubted_by() -> None:
    # a pose of which clutter has odds of 1 in 4000, a rival as well, and the mirror image twice
    best = replace(SURE, log_evidence=np.log(4000.0))
    rival = replace(SURE, T_world_object=ELSEWHERE, log_evidence=0.0)
    verdict = decide([best, rival], ALL_FREE, RULES)
    assert verdict.confidence == pytest.approx(1 / (1 + 2 / 4000))
    assert (verdict.status, verdict.doubt) == ("ok", "")
    doubted = verdict.doubted([Alternative("mirror image", np.log(2 / 4000))])
    assert doubted.confidence == pytest.approx(1 / (1 + 4 / 4000))
    assert doubted.status == "ok"  # 0.999001
    doubted = doubted.doubted([Alternative("bent", np.log(1 / 4000))])
    assert doubted.confidence == pytest.approx(1 / (1 + 5 / 4000))
    assert (doubted.status, doubted.doubt) == ("ambiguous", "")  # none alone is too likely
    doubted = doubted.doubted([Alternative("turned")])
    assert doubted.confidence == pytest.approx(1 / (2 + 5 / 4000))
    assert doubted.doubt == "turned"


def test_a_lost_frame_has_no_confidence() -> None:
    assert decide([], ALL_FREE, RULES).confidence == 0


def test_a_rival_that_is_not_possible_by_itself_still_casts_doubt() -> None:
    # too few coordinates to fix a pose
    rival = replace(scored_with(measurements=4.0), T_world_object=ELSEWHERE)
    verdict = decide([SURE, rival], ALL_FREE, RULES)
    assert verdict.status == "ambiguous"
    assert [one for one, _ in verdict.kept] == [SURE]


@pytest.mark.parametrize(
    ("log_evidence", "expected"), [(7.1, "ok"), (6.9, "ambiguous"), (1.5, "ambiguous")]
)
def test_a_pose_is_sure_from_odds_of_a_thousand(log_evidence: float, expected: str) -> None:
    assert status(replace(SURE, log_evidence=log_evidence)) == expected


@pytest.mark.parametrize(("log_evidence", "expected"), [(-1.3, "ambiguous"), (-1.5, "lost")])
def test_a_pose_is_told_that_is_one_feature_short_of_even_odds(
    log_evidence: float, expected: str
) -> None:
    # a feature that is missed costs ln(1/4)
    assert status(replace(SURE, log_evidence=log_evidence)) == expected


def test_coordinates_too_few_to_fix_a_pose_are_lost() -> None:
    assert status(scored_with(measurements=5.9)) == "lost"


def test_a_turn_that_is_hardly_known_is_not_sure() -> None:
    # 95 %: 1.96 standard deviations are 13.7 and 15.7 degrees
    for deviation_deg, expected in ((7.0, "ok"), (8.0, "ambiguous")):
        covariance = np.diag([1e-6] * 5 + [np.radians(deviation_deg) ** 2])
        verdict = decide([replace(SURE, covariance=covariance)], ALL_FREE, RULES)
        told = "" if expected == "ok" else "what is met leaves it open how the body is turned"
        assert (verdict.status, verdict.doubt) == (expected, told)


@pytest.mark.parametrize(("spread_deg", "expected"), [(7.0, "ok"), (8.0, "ambiguous")])
def test_ranges_that_leave_a_wide_sector_of_turns_are_not_sure(
    spread_deg: float, expected: str
) -> None:
    # 95 %: 1.96 standard deviations are 13.7 and 15.7 degrees
    spread = np.array([0.01, 0.01, 0.01, 0.0, 0.0, np.radians(spread_deg)])
    assert status(replace(SURE, spread=spread)) == expected


def test_a_prediction_that_meets_too_little_of_the_body_does_not_convince() -> None:
    # a grid of 7 by 5 that slipped by a step meets 28 of 35 in one direction, 30 in the other; a
    # body of 8 with more than two missed may have slipped
    for met, expected in ((5.9, False), (6.1, True)):
        assert convinces(matched_to(sensor("0", met)), ALL_FREE, RULES) is expected


def test_a_covered_camera_does_not_take_away_what_two_others_agree_on() -> None:
    judged = matched_to(sensor("0", 8.0), sensor("1", 7.0), sensor("2", 1.0))
    assert judged.coverage == pytest.approx(16 / 24)
    assert convinces(judged, ALL_FREE, RULES)


def test_features_that_face_a_camera_out_of_its_view_are_not_covered() -> None:
    seen = matches_of(sensor("0", 4.0, expected=4.0, unseen=4.0))
    assert seen.coverage == pytest.approx([0.5])
    assert seen.measurements == pytest.approx([8.0])


def matched(views: list[View]) -> Matches:
    """The body at its true pose."""
    objective = matched_objective(views, EIGHT, [view.observation.sigma for view in views])
    return associate(objective, TRUTH, AssociationRules(), ErrorRules().narrowest)


def test_ranges_give_one_coordinate_each(range_sensors: list[RangeSensor]) -> None:
    views = detect(range_sensors, EIGHT, TRUTH, sigma=0.5)
    found = matched(views)
    assert found.met.min() > 0
    assert found.measurements == pytest.approx(found.met)


def test_poses_that_look_the_same_are_one_and_the_more_evident_is_kept() -> None:
    turned = TRUTH @ SQUARE.symmetries[1]
    worse = replace(SURE, T_world_object=turned, log_evidence=20.0)
    for first, second in ((SURE, worse), (worse, SURE)):
        ranked = [first]
        insert(ranked, second, SQUARE, ALL_FREE, RULES)
        assert ranked == [SURE]
    insert(ranked, replace(SURE, T_world_object=ELSEWHERE), SQUARE, ALL_FREE, RULES)
    assert len(ranked) == 2


@pytest.mark.parametrize(("odds", "widened"), [(0.0, 0.5), (-3.0, 0.0474), (-6.0, 1 / 22.458)])
def test_a_pose_covers_those_that_it_stands_for(odds: float, widened: float) -> None:
    # 4 deviations apart: by as much as the other is believed, or to 99.9 % of six directions
    covariance = np.diag(np.full(6, 1e-4))
    best = replace(SURE, covariance=covariance)
    moved = perturb(TRUTH, np.array([0.04, 0, 0, 0, 0, 0]))
    other = replace(best, T_world_object=moved, log_evidence=best.log_evidence + odds)
    ranked = [best]
    insert(ranked, other, EIGHT, ALL_FREE, RULES)
    (told,) = ranked
    expected = covariance.copy()
    expected[0, 0] += widened * 0.04**2
    np.testing.assert_allclose(told.covariance, expected, rtol=1e-3)


def test_a_pose_that_stands_for_one_known_less_well_is_known_no_better() -> None:
    # the mean of both covariances about the one that is told, by what each is believed
    covariance, lasting = np.diag(np.full(6, 1e-4)), np.diag(np.full(6, 2e-5))
    best = replace(SURE, covariance=covariance, persistent=lasting)
    moved = perturb(TRUTH, np.array([0.04, 0, 0, 0, 0, 0]))
    wide = replace(best, covariance=9 * covariance, persistent=9 * lasting)
    ranked = [best]
    insert(ranked, replace(wide, T_world_object=moved), EIGHT, ALL_FREE, RULES)
    expected = 5 * covariance
    expected[0, 0] += 0.5 * 0.04**2
    np.testing.assert_allclose(ranked[0].covariance, expected, rtol=1e-3)
    np.testing.assert_allclose(ranked[0].persistent, 5 * lasting, rtol=1e-3)


def test_what_is_not_believed_to_one_in_a_thousand_widens_nothing() -> None:
    best = replace(SURE, covariance=np.diag(np.full(6, 1e-4)))
    moved = perturb(TRUTH, np.array([0.04, 0, 0, 0, 0, 0]))
    ranked = [best]
    insert(ranked, replace(best, T_world_object=moved, log_evidence=40.0), EIGHT, ALL_FREE, RULES)
    np.testing.assert_array_equal(ranked[0].covariance, best.covariance)


def test_of_poses_that_look_the_same_the_one_turned_least_is_told() -> None:
    about = TRUTH @ from_rotation_vector([0.02, 0.01, 0.03], [1.0, 0, 0])
    for symmetry in SQUARE.symmetries:
        told = nearest_alike(about @ symmetry, SQUARE, TRUTH)
        np.testing.assert_allclose(told, about, atol=1e-6)


def test_belief_goes_by_the_odds() -> None:
    rival = replace(SURE, log_evidence=50.0 - np.log(3))
    assert beliefs([SURE.log_density, rival.log_density]) == pytest.approx([0.75, 0.25])


def test_a_rival_that_pays_by_count_is_as_far_from_what_was_expected() -> None:
    # as evident against clutter, but for the motion that it would have made: e²⁰ of odds
    rival = replace(SURE, T_world_object=ELSEWHERE, by_count=20.0)
    assert status(SURE, rival) == "ok"
    assert status(SURE, replace(rival, by_count=0.0)) == "ambiguous"


def test_two_cameras_of_which_one_sees_half_of_the_body_cover_three_quarters(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    views = detect(pinhole_cameras, EIGHT, TRUTH)
    y, _ = pinhole_cameras[1].project(transform(TRUTH, EIGHT.means))
    narrow = replace(pinhole_cameras[1], resolution=(int(np.median(y[:, 0])), 1024))
    views = [views[0], *detect([narrow], EIGHT, TRUTH)]
    assert matched(views).coverage == pytest.approx([1.0, 0.5])


@pytest.mark.parametrize(("behind", "kept"), [(6.0, "fine"), (8.0, "bent")])
def test_of_one_pose_residuals_as_before_are_likelier_than_larger_ones(
    behind: float, kept: str
) -> None:
    # in either order, as a pose of another place never is
    bent = replace(SURE, residual_ratio=20.0, proposer="bent")
    fine = replace(
        SURE, residual_ratio=0.5, log_evidence=SURE.log_evidence - behind, proposer="fine"
    )
    for pair in ((bent, fine), (fine, bent)):
        ranked: list[ScoredPose] = []
        for one in pair:
            insert(ranked, one, SQUARE, ALL_FREE, RULES)
        assert [one.proposer for one in ranked] == [kept]
    ranked = [replace(fine, T_world_object=ELSEWHERE)]
    insert(ranked, bent, SQUARE, ALL_FREE, RULES)
    assert [one.proposer for one in ranked] == ["bent", "fine"]


def test_what_is_likelier_clutter_stands_for_no_evident_pose() -> None:
    # by residuals as before it would, as those of the evident one are seven nats unlikely
    evident = replace(SURE, residual_ratio=12.0, log_evidence=1.8)
    few = replace(SURE, residual_ratio=0.0, log_evidence=-5.0)
    for first, second in ((evident, few), (few, evident)):
        ranked = [first]
        insert(ranked, second, EIGHT, ALL_FREE, RULES)
        assert [one.log_evidence for one in ranked] == [1.8]


@pytest.mark.parametrize(
    ("met", "off", "ratio", "expected"),
    [
        (8, 0.3, 0.5, True),
        (4, 0.3, 0.5, True),
        (3, 0.3, 0.5, False),  # less than half of the body
        (8, 0.45, 0.5, False),  # beyond 3.5 deviations of 0.1, which is more than the other has
        (8, 0.3, 1.5, False),  # farther off than chance: a pose between what the two see
    ],
)
def test_two_sensors_agree_where_both_meet_most_of_the_body_as_closely_as_chance_has_it(
    met: int, off: float, ratio: float, expected: bool
) -> None:
    J = np.zeros((8, 2, 6))
    shares = np.repeat([1.0, 0.0], [met, 8 - met])
    exact = Seen(J, "0", offsets=0.02), Seen(J, "1", offsets=off, shares=shares)
    pose = replace(scored(TRUTH, *exact), residual_ratio=ratio)
    assert has_two_agreeing(pose, AcceptanceRules(), NoiseModel()) == expected
