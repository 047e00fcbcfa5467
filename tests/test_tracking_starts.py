"""What proposers begin with: every prediction, steps of a grid, the search, fewer sensors."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from detections import EIGHT, TRUTH, detect, view_of
from matches import matches_of, of_eight
from numpy.typing import NDArray

from mixpose.body import ASIDE, Body, PointFeature
from mixpose.fit import EstimatorOptions, Fit
from mixpose.judgement import (
    AcceptanceRules,
    DetectionModel,
    NoiseModel,
    ScoredPose,
)
from mixpose.objective import View
from mixpose.rigid import (
    from_rotation_vector,
    perturb,
    rotation_angle_deg,
    transform,
    twist_between,
)
from mixpose.search import SearchBudget, SearchReport, SearchResult, SearchState
from mixpose.sensors import PinholeCamera
from mixpose.tracking import Rules, Track, Tracker
from mixpose.tracking.frame import Frame, Start
from mixpose.tracking.likelihood import likelihood_of
from mixpose.tracking.proposers import (
    look_alikes,
    multistart,
    predicted,
    searched,
)
from mixpose.tracking.refinements import disagreeing
from mixpose.tracking.rules import ProposalRules
from mixpose.tracking.track import Branch

Floats = NDArray[np.float64]

RULES, MODEL = AcceptanceRules(), NoiseModel()
ELSEWHERE = perturb(TRUTH, np.repeat([50.0, 0.5], 3))


def data_of(tracker: Tracker, views: Sequence[View], track: Track | None = None) -> Frame:
    return tracker.data(track or tracker.begin(), 1, None, views)


def test_every_place_where_the_body_may_be_is_a_start() -> None:
    tracker = Tracker.create(EIGHT, EstimatorOptions(), TRUTH)
    branches = tuple(Branch(T, 0.5, np.ones(6)) for T in (TRUTH, ELSEWHERE))
    starts = list(predicted(data_of(tracker, [], Track(branches, frame=0)), []))
    assert len(starts) == 2
    np.testing.assert_allclose(starts[0].T_world_object, TRUTH)
    np.testing.assert_allclose(starts[1].T_world_object, ELSEWHERE)


def grid(columns: int, rows: int) -> Body:
    """Corners of a board of squares 20 wide."""
    places = [(20.0 * i, 20.0 * j, 0.0) for j in range(rows) for i in range(columns)]
    return Body("grid", tuple(PointFeature(np.array(place)) for place in places))


def shifted(T: Floats, step: Floats) -> Floats:
    T_object_aside = np.eye(4)
    T_object_aside[:3, 3] = step
    return np.asarray(T @ T_object_aside)


def board_before(cameras: list[PinholeCamera]) -> Frame:
    """A frame that shows a grid of 35 features."""
    board = grid(7, 5)
    tracker = Tracker.create(board, EstimatorOptions(), TRUTH)
    return data_of(tracker, detect(cameras, board, TRUTH))


def judged_here(data: Frame, T: Floats) -> ScoredPose:
    likelihood, start = likelihood_of(data), Start(T)
    return likelihood.judge(likelihood.fit(start), start)


def test_a_grid_that_has_slipped_is_put_back_along_its_own_axes(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    data = board_before(pinhole_cameras)
    slipped = judged_here(data, shifted(TRUTH, np.array([20.0, 0.0, 0.0])))
    starts = [start.T_world_object for start in look_alikes(data, [slipped])]
    assert min(np.abs(T - TRUTH).max() for T in starts) < 1e-9
    # 30 of 35 at the most are met a step aside of the truth
    assert not list(look_alikes(data, [judged_here(data, TRUTH)]))


@pytest.mark.parametrize("step", [8.0, 25.0, 40.0])
def test_a_grid_that_moves_by_more_than_half_a_step_is_expected_where_it_goes(
    pinhole_cameras: list[PinholeCamera], step: float
) -> None:
    """A row less may be met, and the grid be a step aside; it was not, where it was expected."""
    board = grid(8, 5)
    tracker, one = Tracker.create(board, EstimatorOptions(), TRUTH), pinhole_cameras[:1]
    track, along = tracker.begin(), TRUTH[:3, 0]
    for frame in range(6):
        T = TRUTH.copy()
        T[:3, 3] += (frame - 2) * step * along
        if frame > 2:
            (expected,) = tracker.predictions(track, frame, None)
            assert np.linalg.norm(expected.T_world_object[:3, 3] - T[:3, 3]) < 2
        views = detect(one, board, T, noise=0.05, seed=frame)
        track, estimate = tracker.advance(track, frame, None, views)
        assert estimate.status == "ok"


def test_of_places_of_a_slipped_grid_the_best_is_tried_first_and_then_only_its_own_rivals(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    data = board_before(pinhole_cameras)
    ranked = [judged_here(data, shifted(TRUTH, np.array([20.0, 20.0, 0.0])))]
    assert len(list(look_alikes(data, ranked))) > 1
    starts = []
    for start in look_alikes(data, ranked):
        starts.append(start.T_world_object)
        ranked.insert(0, judged_here(data, start.T_world_object))
    # of the truth there are none
    (first,) = starts
    assert np.abs(first - TRUTH).max() < 1e-9


def test_poses_that_are_as_evident_do_not_take_turns_for_ever(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    board = grid(7, 5)
    data = data_of(
        Tracker.create(board, EstimatorOptions(), TRUTH), detect(pinhole_cameras, board, TRUTH)
    )
    slipped = judged_here(data, shifted(TRUTH, np.array([20.0, 0.0, 0.0])))
    once, ranked = len(list(look_alikes(data, [slipped]))), [slipped]
    for count, _ in enumerate(look_alikes(data, ranked), 1):
        ranked[0] = replace(ranked[0])  # another record that says the same
        assert count <= once


def test_a_board_with_a_row_more_than_there_is_stays_ambiguous_however_it_moves(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    said = Tracker.create(grid(7, 5), EstimatorOptions())
    track, real = said.begin(), grid(7, 4)
    for frame in range(3):
        T = perturb(TRUTH, frame * np.array([8.0, 3.0, -5.0, 0.2, 0.5, 0.3]))
        views = detect(pinhole_cameras, real, T, noise=0.1, seed=frame)
        track, estimate = said.advance(track, frame, None, views)
        assert estimate.status == "ambiguous"
        assert estimate.doubt == ASIDE
        weights = sorted((one.weight for one in estimate.hypotheses), reverse=True)
        # a shift of a row: motion says nothing about which it is
        assert weights[1] > 0.4


@pytest.mark.parametrize("live", [False, True])
def test_the_search_is_told_what_the_session_says(
    live: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, Any] = {}
    stopped, before = SearchState(2, 5), SearchState(1, 3)

    def recorded(views: Sequence[View], body: Body, **told: Any) -> SearchResult:
        asked.update(told)
        return SearchResult([], SearchReport(), stopped)

    monkeypatch.setattr(sys.modules[searched.__module__], "search_frame", recorded)
    budgets = SearchBudget(max_guesses=1234), SearchBudget(max_guesses=12)
    options = EstimatorOptions(free=("x", "y", "rz"), seed=7, search="live" if live else "thorough")
    rules = Rules(search=budgets[0], live=budgets[1])
    tracker = Tracker.create(EIGHT, options, TRUTH, rules=rules)
    data = data_of(tracker, [], replace(tracker.begin(), search=before))
    assert not list(searched(data, []))
    assert asked["seed"] == 7
    assert asked["budget"] is budgets[live]
    assert asked["state"] == (before if live else SearchState())
    assert asked["free"].tolist() == [True, True, False, False, False, True]
    np.testing.assert_allclose(asked["T_reference"], TRUTH)
    assert data.searches[-1][1] == stopped


def test_a_live_search_goes_on_in_the_next_frame_where_it_stopped(
    pinhole_cameras: list[PinholeCamera], monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped = SearchState(2, 5)
    monkeypatch.setattr(
        sys.modules[searched.__module__],
        "search_frame",
        lambda *_, **__: SearchResult([], SearchReport(), stopped),
    )
    tracker = Tracker.create(EIGHT, EstimatorOptions(search="live"))
    views = detect(pinhole_cameras, EIGHT, TRUTH)
    track, estimate = tracker.advance(tracker.begin(), 0, None, views)
    assert estimate.status == "lost"
    assert track.search == stopped


def test_several_starts_are_drawn_from_the_uncertainty_and_are_where_most_is_seen(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    views = detect(pinhole_cameras, EIGHT, TRUTH)
    start = perturb(TRUTH, np.repeat([6.0, 0.05], 3))
    u = np.repeat([9.0, 0.08], 3)
    rules = Rules(proposals=ProposalRules(steps=0))  # as they are drawn
    found = {}
    for seed in (0, 1):
        options = EstimatorOptions(seed=seed)
        tracker = Tracker.create(
            EIGHT, options, start, rotation_deg=np.degrees(0.08), distance=9.0, rules=rules
        )
        found[seed] = [one.T_world_object for one in multistart(data_of(tracker, views), [])]
        assert 2 <= len(found[seed]) <= 5
        twists = [twist_between(start, T) / u for T in found[seed]]
        # none beyond what is drawn from; twists of turns do not quite add up
        assert max(np.abs(one).max() for one in twists) < np.sqrt(3) * 1.05
        # a uniform number of standard deviation 1 is beyond 1/√3 in two of three draws
        assert max(np.abs(one).max() for one in twists) > 1.0
        off = [np.linalg.norm(twist_between(TRUTH, T) / u) for T in found[seed]]
        # 512 poses: the start itself is 1.6 off, and some are nearer
        assert off[0] < 1.6
    assert not np.allclose(found[0][0], found[1][0])


def test_several_starts_that_lead_to_nothing_are_not_fitted(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    views = detect(pinhole_cameras, EIGHT, TRUTH, noise=0.1)
    there = Tracker.create(EIGHT, EstimatorOptions(), TRUTH, rotation_deg=5.0, distance=10.0)
    away = perturb(TRUTH, np.array([40.0, 40.0, 0.0, 0.0, 0.0, 1.5]))
    elsewhere = Tracker.create(EIGHT, EstimatorOptions(), away, rotation_deg=5.0, distance=10.0)
    (found,) = list(multistart(data_of(there, views), []))[:1]
    # the best of them is at the top already, within a tenth of σ_ε of about 1 mm
    assert np.linalg.norm((found.T_world_object - TRUTH)[:3, 3]) < 0.1
    assert list(multistart(data_of(elsewhere, views), [])) == []


def test_of_three_sensors_the_one_whose_residuals_are_far_larger_disagrees() -> None:
    found = [of_eight("0", 8.0), of_eight("1", 8.0, off=0.6), of_eight("2", 8.0)]
    # six times the others' deviation, 36 times their variance
    assert disagreeing(matches_of(*found), RULES, MODEL) == ["1"]
    found[1] = of_eight("1", 8.0, off=0.4)
    assert disagreeing(matches_of(*found), RULES, MODEL) == []
    two = [of_eight("0", 8.0), of_eight("1", 8.0, off=0.9)]
    assert disagreeing(matches_of(*two), RULES, MODEL) == []


def test_a_sensor_that_sees_the_body_elsewhere_disagrees_and_a_covered_one_does_not() -> None:
    agreeing = of_eight("0", 8.0), of_eight("1", 7.0)
    elsewhere = matches_of(*agreeing, of_eight("2", 1.0, unmatched=7.0))
    assert disagreeing(elsewhere, RULES, MODEL) == ["2"]
    covered = matches_of(*agreeing, of_eight("2", 1.0, unmatched=1.0))
    assert disagreeing(covered, RULES, MODEL) == []


def test_a_camera_that_was_bumped_is_left_out_and_named(
    pinhole_cameras: list[PinholeCamera],
) -> None:
    views = bumped(pinhole_cameras)
    tracker = Tracker.create(EIGHT, EstimatorOptions(), TRUTH)
    track, estimate = tracker.advance(tracker.begin(), 0, None, views)
    assert estimate.status == "ok"
    assert estimate.T_world_object is not None
    assert [estimate.sensors[name].used for name in "012"] == [True, True, False]
    # what 0.1 px in two cameras leave
    assert rotation_angle_deg(estimate.T_world_object, TRUTH) < 0.1
    # what it misses is no sign that the body was not met
    assert sorted(track.met_before) == ["0", "1"]


def bumped(cameras: list[PinholeCamera]) -> list[View]:
    """Three cameras, the last of which was turned by a degree, some 15 px, and does not know."""
    third = replace(cameras[0], T_sensor_world=from_aside(cameras[0].T_sensor_world, 0.5))
    bump = from_rotation_vector([0.0, np.radians(1.0), 0.0], np.zeros(3))
    moved = replace(third, T_sensor_world=bump @ third.T_sensor_world)
    views = detect([*cameras, moved], EIGHT, TRUTH, noise=0.1)
    return [*views[:2], replace(views[2], sensor=third)]


def from_aside(T_sensor_world: Floats, angle: float) -> Floats:
    """A camera that looks at the same from another side."""
    there, back = np.eye(4), np.eye(4)
    there[:3, 3], back[:3, 3] = TRUTH[:3, 3], -TRUTH[:3, 3]
    turn = from_rotation_vector([0.0, 0.0, angle], np.zeros(3))
    return np.asarray(T_sensor_world @ there @ turn @ back)


def test_what_is_left_out_counts_as_missed(pinhole_cameras: list[PinholeCamera]) -> None:
    views = bumped(pinhole_cameras)
    tracker = Tracker.create(EIGHT, EstimatorOptions(), TRUTH)
    fit = Fit(TRUTH)

    def lost(in_space: bool) -> float:
        detection = DetectionModel(in_space=in_space)
        judgement = replace(tracker.rules.judgement, detection=detection)
        ruled = replace(tracker, rules=replace(tracker.rules, judgement=judgement))
        data, two = data_of(ruled, views), data_of(ruled, views[:2])
        left_out = likelihood_of(data).judge(fit, Start(TRUTH, left_out={"2": "bumped"}))
        return likelihood_of(two).judge(fit, Start(TRUTH)).log_evidence - left_out.log_evidence

    assert lost(in_space=False) == pytest.approx(-DetectionModel().log_blind)
    # a third camera misses points in space, which two cameras see, whatever they are
    assert lost(in_space=True) == pytest.approx(0.0)
    data, two = data_of(tracker, views), data_of(tracker, views[:2])
    left_out = likelihood_of(data).judge(fit, Start(TRUTH, left_out={"2": "bumped"}))
    alone = likelihood_of(two).judge(fit, Start(TRUTH))
    assert left_out.reports({})["2"].used is False
    assert left_out.measurements == pytest.approx(alone.measurements)


@pytest.mark.parametrize(
    ("cameras", "shown", "moving", "last"),
    [
        # five markers of eight, as something else may show them from this side
        (1, ([0, 1, 2, 3, 4],) * 25, 0.0, "ambiguous"),
        (2, ([0, 1, 2, 3, 4],) * 20, 0.0, "ambiguous"),
        # and not from others
        (1, ([0, 1, 2, 3, 4],) * 25, 1.0, "ok"),
        # a frame that is sure by itself
        (1, ([0, 1, 2, 3, 4], list(range(8))), 1.0, "ok"),
        # and others of them, which that has not
        (1, ([0, 1, 2, 3, 4], [0, 1, 5, 6, 7], [2, 3, 4, 6, 7], [1, 2, 5, 6, 7]), 1.0, "ok"),
    ],
)
def test_what_one_camera_sees_again_and_again_is_not_surer_for_it(
    pinhole_cameras: list[PinholeCamera],
    cameras: int,
    shown: tuple[list[int], ...],
    moving: float,
    last: str,
) -> None:
    tracker = Tracker.create(EIGHT, EstimatorOptions())
    track, statuses = tracker.begin(), []
    for frame, features in enumerate(shown):
        T = perturb(TRUTH, moving * frame * np.array([1.0, 0.5, 0.0, 0.0, 0.0, 0.01]))
        points = pinhole_cameras[0].project(transform(T, EIGHT.means[features]))[0]
        rng = np.random.default_rng(frame)
        points += 0.2 * rng.standard_normal(points.shape)
        false = rng.uniform(points.min(axis=0) - 40, points.max(axis=0) + 40, (2, 2))
        views = [
            view_of("left", pinhole_cameras[0], np.concatenate([points, false])),
            view_of("right", pinhole_cameras[1], np.zeros((0, 2))),
        ]
        track, estimate = tracker.advance(track, frame, 0.04 * frame, views[:cameras])
        statuses.append(estimate.status)
    # one frame is not sure of them
    assert statuses[0] == "ambiguous"
    assert statuses[-1] == last
    assert last == "ok" or set(statuses) == {"ambiguous"}


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("start", [False, True])
def test_of_orientations_that_look_nearly_the_same_that_is_told_which_is_met_most_closely(
    turned: bool, start: bool, pinhole_cameras: list[PinholeCamera]
) -> None:
    # two sides differ by 0.7 mm, which are as many pixels, and detections err by a tenth
    x = (100.0**2 - 99.3**2) / (2 * 132.0)
    points = [(-66.0, 0, 0), (66.0, 0, 0), (x, np.sqrt(100.0**2 - (66.0 + x) ** 2), 0)]
    body = Body("triangle", tuple(PointFeature(np.array(each)) for each in points))
    assert len(body.symmetries) == 2
    assert 0.1 < body.asymmetry < 0.7
    (other,) = (one for one in body.symmetries if rotation_angle_deg(one, np.eye(4)) > 90)
    T = TRUTH @ other if turned else TRUTH
    views = detect(pinhole_cameras, body, T, noise=0.1)
    tracker = Tracker.create(body, EstimatorOptions(), TRUTH if start else None)
    _, told = tracker.advance(tracker.begin(), 0, None, views)
    assert told.status == "ok"
    assert told.T_world_object is not None
    is_other = bool(rotation_angle_deg(told.T_world_object, T) > 90)
    assert is_other is (start and turned)  # a start says which is meant
