"""Densities and objectives on pictures: at the blurs of the fit, each at its place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from checked import counted

import mixpose
from mixpose.body import Body, PointFeature
from mixpose.density import Observation
from mixpose.fit import EstimatorOptions
from mixpose.frames import pair
from mixpose.objective import ObjectiveName, View
from mixpose.pictures.finding import find
from mixpose.pictures.overlay import Part
from mixpose.pictures.plots import Slice, objective_around, objective_picture, ranges_picture
from mixpose.pictures.sheet import _heading, fitted_blurs
from mixpose.pictures.stages import densities_picture, panels_of, shown_box
from mixpose.records import Estimate, FrameSet, PointPattern, RawFrame
from mixpose.rigid import transform
from mixpose.runner import observe, open_sources, run
from mixpose.selection import Selection
from mixpose.sensors import ParallelBeam, RangeSensor

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
TWO_CAMERAS = SYNTHETIC / "two_cameras" / "session.toml"


def test_the_objective_peaks_at_the_pose_in_every_slice_and_map(
    paper_body: Body, parallel_cameras: list[ParallelBeam]
) -> None:
    views = []
    for k, camera in enumerate(parallel_cameras):
        y, _ = camera.project(paper_body.means)
        views.append(View(str(k), camera, Observation(PointPattern(y, np.ones(len(y))), 1.5)))
    levels = [(6.0, 6.0), (1.5, 1.5)]
    slices, maps = objective_around(views, paper_body, np.eye(4), None, EstimatorOptions(), levels)
    assert [one.direction for one in slices] == list(range(6))
    for one in slices:
        assert one.values.shape == (2, len(one.offsets))
        # densities are looked up on grids of a quarter of a blur; a slice ends at 8 of the finest
        coarse, fine = np.abs(one.offsets[one.values.argmax(axis=1)] / one.offsets[-1])
        assert coarse < 0.25 * 4 / 8
        assert fine < 0.25 / 8
        # the coarser level reaches farther
        assert one.values[0].mean() > one.values[1].mean()
    for surface in maps:
        row, column = np.unravel_index(surface.values.argmax(), surface.values.shape)
        assert abs(row - 20) <= 1  # of 41, half a blur apart at most
        assert abs(column - 20) <= 1


def test_slices_of_a_single_free_direction_are_not_covered_by_empty_axes() -> None:
    offsets = np.linspace(-1, 1, 241)
    line = Slice(0, offsets, np.exp(-(offsets**2) / 0.02)[None])
    picture = objective_picture([line], [], [1.0], None, "mm", 800)
    # the curve of the last blur in viridis' dark end, drawn over some 100 px
    dark = (np.abs(picture.astype(int) - picture.min(axis=2, keepdims=True)) > 40).any(axis=2)
    assert np.count_nonzero(dark) > 100


@pytest.mark.parametrize("objective", ["matched", "paper"])
def test_densities_are_those_of_the_blurs_that_the_pose_was_fitted_by(
    objective: ObjectiveName,
) -> None:
    session = mixpose.load_session(TWO_CAMERAS)
    session = replace(session, estimator=replace(session.estimator, objective=objective))
    seen: list[Sequence[View]] = []
    (estimate,) = run(
        session, selection=Selection(5, 6), watch=lambda _, views, __: seen.append(views)
    )
    T, view = estimate.T_world_object, seen[0][0]
    # the start is 3° off: wider blurs than σ_ε come first, and the fit ends at no wider one
    sigmas = fitted_blurs([view], estimate)["left"]
    assert sigmas == sorted(sigmas, reverse=True)
    assert sigmas[0] > 5 * view.observation.sigma >= 5 * sigmas[-1]
    assert T is not None
    y, _ = view.sensor.project(transform(T, session.body.means))
    part, size = Part(2.0, (float(y[0, 0]) - 40, float(y[0, 1]) - 40)), (160, 160)
    observed, twice = panels_of(view, session.body, T, sigmas, session.estimator, part, size)
    assert len(observed) == len(sigmas)
    assert len(twice) == (len(sigmas) if objective == "matched" else 1)
    # around marker 1 at the finest blur there is its detection alone: one of seven, 2-D Gaussian
    sigma = sigmas[-1]
    peak = 1 / 7 / (2 * np.pi * sigma**2)
    # places half a px apart are up to 0.35 px off the peak: exp(−0.35² / 2 · 1.5²) is 2.7 % less;
    # and the grid of g, a quarter of a blur, looks it up as 1 / (4 · 16) less at most
    assert observed[-1].values[78:84, 78:84].max() == pytest.approx(peak, rel=0.045)
    assert twice[-1].values[78:84, 78:84].max() == pytest.approx(peak / 2, rel=0.045)


def test_panels_of_one_kind_have_one_scale(parallel_cameras: list[ParallelBeam]) -> None:
    camera = parallel_cameras[0]
    body = Body("dot", (PointFeature(np.zeros(3)),))
    y, _ = camera.project(body.means)
    view = View("one", camera, Observation(PointPattern(y, np.ones(1)), 2.0))
    picture = densities_picture(view, body, np.eye(4), [6.0, 2.0], EstimatorOptions(), (200, 200))
    title = 34  # px of a title above a panel
    brightness = picture[title : title + 200].astype(float).sum(axis=-1)
    wide, narrow = brightness[:, :200].max(), brightness[:, 204:404].max()
    # a ninth of the peak is darker; each panel scaled to itself would have both alike
    assert wide < 0.9 * narrow
    # below each row its scale
    assert picture.shape[0] > 2 * 200 + 2 * 15
    assert picture.shape[1] == 404


def test_peaks_are_shown_whole_and_titles_hide_nothing_of_them(
    parallel_cameras: list[ParallelBeam],
) -> None:
    camera = parallel_cameras[0]
    body = Body("four", tuple(PointFeature(np.array(at)) for at in np.eye(4, 3) * 5.0))
    y, _ = camera.project(body.means)
    view = View("one", camera, Observation(PointPattern(y, np.ones(4)), 2.0))
    picture = densities_picture(view, body, np.eye(4), [6.0], EstimatorOptions(), (200, 200))
    title, gap = 34, 4
    bar = (picture.shape[0] - 2 * (title + 200) - 3 * gap) // 2
    for first in (0, title + 200 + bar + 2 * gap):
        assert (picture[first : first + title] == 255).all(axis=-1).any()
        panel = picture[first + title : first + title + 200, :200]
        # no letters in it, and at its edges the lowest colour: no peak is cut off there
        assert not (panel == 255).all(axis=-1).any()
        edge = np.concatenate([panel[0], panel[-1], panel[:, 0], panel[:, -1]])
        assert edge.max() < 10
        assert panel.max() > 100
        # the scale below has a white line, two pixels wide, at the power of ten that is in it
        scale = picture[first + title + 200 + gap]
        assert (scale == 255).all(axis=-1).sum() == 2


def test_a_panel_shows_a_detection_where_it_is(parallel_cameras: list[ParallelBeam]) -> None:
    camera, body = parallel_cameras[0], Body("dot", (PointFeature(np.zeros(3)),))
    y = camera.project(body.means)[0] + [0.3, -0.45]
    view = View("one", camera, Observation(PointPattern(y, np.ones(1)), 2.0))
    part, size = Part(3.0, (float(y[0, 0]) - 26.0, float(y[0, 1]) - 19.0)), (160, 120)
    for row in panels_of(view, body, np.eye(4), [2.0], EstimatorOptions(), part, size):
        (panel,) = row
        v, u = np.indices(panel.values.shape)
        middle = [float((panel.values * axis).sum() / panel.values.sum()) for axis in (u, v)]
        # the grid of g, a quarter of a blur, is half a pixel of the sensor wide
        np.testing.assert_allclose(middle, part.places(y[0]), atol=0.2)


def test_where_nothing_was_found_and_no_pose_is_known_something_is_shown(
    parallel_cameras: list[ParallelBeam],
) -> None:
    body, nothing = (
        Body("dot", (PointFeature(np.zeros(3)),)),
        PointPattern(np.zeros((0, 2)), np.zeros(0)),
    )
    view = View("one", parallel_cameras[0], Observation(nothing, 2.0))
    low, high = shown_box(view, body, None, None)
    assert (high - low >= 100).all()


def test_what_was_found_far_from_the_pose_leaves_its_density_black(
    parallel_cameras: list[ParallelBeam],
) -> None:
    body = Body("dot", (PointFeature(np.zeros(3)),))
    far = PointPattern(parallel_cameras[0].project(body.means)[0] + 150.0, np.ones(1))
    view = View("one", parallel_cameras[0], Observation(far, 2.0))
    picture = densities_picture(view, body, np.eye(4), [2.0], EstimatorOptions(), (200, 200))
    assert picture[40:230].max() < 10  # the lowest colour is nearly black


def test_a_pose_that_was_not_fitted_is_shown_at_the_blur_that_judges(
    parallel_cameras: list[ParallelBeam],
) -> None:
    y = np.zeros((1, 2))
    view = View("one", parallel_cameras[0], Observation(PointPattern(y, np.ones(1)), 2.0))
    given = Estimate(6, None, "tracker", "ok", np.eye(4), None, 1.0, {})
    assert fitted_blurs([view], given) == {"one": [2.0]}
    # a sensor that was left out took no part in the fit
    assert fitted_blurs([view], replace(given, blurs=({"two": 9.0},))) == {"one": [2.0]}


def test_directions_that_are_held_have_no_slice(
    paper_body: Body, parallel_cameras: list[ParallelBeam]
) -> None:
    camera = parallel_cameras[0]
    y, _ = camera.project(paper_body.means)
    view = View("one", camera, Observation(PointPattern(y, np.ones(len(y))), 1.5))
    options = EstimatorOptions(free=("x", "rz"))
    slices, maps = objective_around([view], paper_body, np.eye(4), None, options, [(1.5,)])
    assert [one.direction for one in slices] == [0, 5]
    assert [surface.directions for surface in maps] == [(0, 5)]


def test_ranges_and_features_may_be_called_by_what_would_be_a_formula() -> None:
    session = mixpose.load_session(SYNTHETIC / "range_profiles" / "session.toml")
    setup, *_ = (replace(each, name=r"$\q$") for each in session.sensors)
    session = replace(session, sensors=(setup,))
    body = replace(session.body, names=(r"$\q$",))
    frames = next(pair(open_sources(session, {}), 0, 1))
    assert session.start is not None
    T = session.start.T_world_object
    estimate = Estimate(0, None, "six-points", "ok", T, None, 1.0, {})
    found = find(session.sensors, frames.frames, observe(session, frames), body, estimate)
    picture = ranges_picture(found, [[5.0]], body, estimate, "mm", 700, 300)
    assert picture.std() > 3  # something is on it


def test_a_range_sensor_that_found_nothing_and_faces_nothing_has_empty_axes() -> None:
    session = mixpose.load_session(SYNTHETIC / "range_profiles" / "session.toml")
    setup = session.sensors[0]
    assert isinstance(setup.sensor, RangeSensor)
    away = session.body.means - setup.sensor.position
    body = replace(session.body, normals=away / np.linalg.norm(away, axis=1)[:, None])
    frame = RawFrame(0, None, PointPattern(np.zeros((0, 1)), np.zeros(0)))
    session = replace(session, sensors=(setup,))
    views = observe(session, FrameSet(0, None, {setup.name: frame}))
    estimate = Estimate(0, None, "six-points", "ok", np.eye(4), None, 1.0, {})
    found = find(session.sensors, {setup.name: frame}, views, body, estimate)
    assert found[0].expectation is not None
    assert not found[0].expectation.seen.any()
    picture = ranges_picture(found, [[5.0]], body, estimate, "mm", 700, 300)
    assert picture.shape == (300, 700, 3)


@pytest.mark.parametrize("count", [1, 2])
def test_a_sheet_says_whose_pose_it_shows_where_there_are_several_bodies(
    count: int, tmp_path: Path
) -> None:
    session = counted(tmp_path, count)
    lost = Estimate(0, None, "tool", "lost", None, None, 0.0, {})
    one, other = (_heading(session, replace(lost, object=name)) for name in ("tool", "marker"))
    assert (one != other).any() == (count > 1)
