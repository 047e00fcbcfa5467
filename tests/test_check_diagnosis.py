"""What `mixpose check` takes for wrong about a session, by a few frames of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnosed import (
    bare,
    enlarged,
    frames_of,
    inverted,
    poses,
    recorded,
    told,
    with_cameras,
    with_points,
)

import mixpose
from mixpose.body import Body
from mixpose.checking.changes import Change, point_units
from mixpose.checking.evidence import best_pose
from mixpose.checking.geometry import _seen_by_some, geometry_doubts
from mixpose.checking.recordings import survey
from mixpose.checking.rules import DiagnosisRules
from mixpose.checking.trials import Diagnosis, Tried, diagnosis, simplest
from mixpose.records import Estimate, SensorReport
from mixpose.runner import open_sources
from mixpose.selection import Selection
from mixpose.session import Session, load_session
from mixpose.session.setup import Start

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"


@pytest.fixture
def right() -> Session:
    session = load_session(SYNTHETIC / "two_cameras" / "session.toml")
    return replace(session, start=None)


def test_a_right_session_has_nothing_wrong(right: Session) -> None:
    found = diagnosis(right, frames_of(right, recorded(right)))
    assert (found.change, found.explained) == ("", 4)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (
            lambda s: with_points(s, s.body.means * [1, -1, 1]),
            "the body of [object] is mirrored, or seen in a mirror: ",
        ),
        (lambda s: with_points(s, s.body.means / 1000), "with points 1000 times as large"),
        (lambda s: with_points(s, s.body.means / 10), "with points 10 times as large"),
        (lambda s: with_points(s, s.body.means * 1.02), "with points 0.98 times as large"),
        (lambda s: with_cameras(s, inverted), "T_sensor_world of 'left' and 'right' are inverted"),
        (lambda s: with_cameras(s, enlarged), "'left' and 'right' is that of images half as large"),
        (lambda s: with_cameras(s, bare), "distortion of 'left' and 'right' is left out: "),
    ],
    ids=["mirrored", "metres", "cm", "too large", "inverted", "half the matrix", "no distortion"],
)
def test_what_a_session_says_wrong_all_along_is_told(
    right: Session, fault: Callable[[Session], Session], said: str
) -> None:
    bent = with_cameras(right, lambda s: replace(s, distortion=np.array([-0.24, 0.1, 0.0, 0.0])))
    assert said in told(fault(bent), recorded(bent))


def test_one_marker_that_is_measured_wrong_is_named_with_its_place(right: Session) -> None:
    wrong = right.body.means.copy()
    wrong[2] += [3.0, -4.0, 0.0]
    text = told(with_points(right, wrong), recorded(right))
    assert text.startswith(f"marker {right.body.labels[2]} of [object] is measured wrong: ")
    assert "with it 5 mm away" in text


def test_sources_that_are_swapped_are_told(right: Session) -> None:
    seen = recorded(right)
    assert told(right, {"left": seen["right"], "right": seen["left"]}) == (
        "'left' and 'right' are swapped: with the source of each given to the other"
    )


def test_images_that_are_mirrored_are_told_of_all_cameras(right: Session) -> None:
    flipped = {
        name: [y * [-1, 1] + [639, 0] for y in frames] for name, frames in recorded(right).items()
    }
    assert told(right, flipped).startswith("images of 'left' and 'right' are mirrored: ")


def test_one_camera_cannot_tell_its_images_mirrored_from_the_body(right: Session) -> None:
    alone = replace(right, sensors=right.sensors[:1])
    centred = with_cameras(
        alone, lambda s: replace(s, camera_matrix=[[810.0, 0, 319.5], [0, 810, 255.5], [0, 0, 1]])
    )
    mirrored = with_points(centred, centred.body.means * [1, 1, -1])
    text = told(mirrored, recorded(centred))
    assert text.startswith(
        "the body of [object] may be mirrored, or seen in a mirror, or images of 'left' "
        "may be mirrored: with one "
    )


def test_a_calibration_that_two_cameras_share_is_that_of_one_of_them(right: Session) -> None:
    left, other = right.sensors
    camera: Any = left.sensor
    moved = camera.camera_matrix + np.array([[9.0, 0, 17.0], [0, 9.0, -14.0], [0, 0, 0]])
    true = replace(
        right, sensors=(replace(left, sensor=replace(camera, camera_matrix=moved)), other)
    )
    copied: Any = other.sensor
    wrong = replace(
        camera, camera_matrix=copied.camera_matrix, distortion=np.array(copied.distortion)
    )
    given = replace(right, sensors=(replace(left, sensor=wrong), other))
    text = told(given, recorded(true))
    assert text.startswith(
        "the calibration of 'left' is not that of its images, but that of 'right': with about fx = "
    )


def test_calibrations_that_are_swapped_are_told(right: Session) -> None:
    left, other = right.sensors
    camera: Any = left.sensor
    K = camera.camera_matrix * [[1.1], [1.1], [1.0]] + [[0, 0, 25.0], [0, 0, -18.0], [0, 0, 0]]
    unlike = replace(left, sensor=replace(camera, camera_matrix=K))
    true = replace(right, sensors=(unlike, other))
    lens: Any = other.sensor
    swapped = (
        replace(camera, camera_matrix=lens.camera_matrix, distortion=lens.distortion),
        replace(lens, camera_matrix=K, distortion=camera.distortion),
    )
    given = [replace(each, sensor=one) for each, one in zip(right.sensors, swapped, strict=True)]
    assert told(replace(right, sensors=tuple(given)), recorded(true)) == (
        "calibrations of 'left' and 'right' are swapped: with camera_matrix and distortion of each "
        "given to the other"
    )


def test_normals_that_point_inwards_are_told(right: Session) -> None:
    means = right.body.means
    normals = means - means.mean(axis=0)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    outwards = with_points(right, means, normals)
    text = told(with_points(right, means, -normals), recorded(outwards))
    assert text == "normals of [object] are of the wrong sign: with all of them negated"


def test_points_in_another_unit_than_the_start_are_told_of_one_camera(
    right: Session, tmp_path: Path
) -> None:
    left = right.sensors[0]
    rows = [
        f"{f},{u},{v}" for f, frame in enumerate(recorded(right)["left"]) for u, v in frame.tolist()
    ]
    (tmp_path / "left.csv").write_text("\n".join(["frame,u,v", *rows, ""]), encoding="utf-8")
    alone = replace(
        with_points(right, right.body.means / 1000),
        path=tmp_path / "session.toml",
        sensors=(replace(left, source="left.csv", times=None, fps=None),),
        start=Start(poses()[0]),
    )
    sources = open_sources(alone, {})
    surveys = {"left": survey(alone, alone.sensors[0], sources["left"])}
    found = geometry_doubts(alone, sources, surveys)
    assert found.warnings == (
        "points and translation of [start] are in two units of length: with points 1000 times as "
        "large, the body is at [start] in frame 0",
    )


def test_frames_of_fewer_coordinates_than_a_pose_has_are_not_searched(
    right: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three spots in two images are met by some pose of any body, so that they tell nothing."""
    setups = []
    for setup, count in zip(right.sensors, (2, 1), strict=True):
        rows = [f"0,{u},{v}" for u, v in recorded(right)[setup.name][0][:count].tolist()]
        table = tmp_path / f"{setup.name}.csv"
        table.write_text("\n".join(["frame,u,v", *rows, ""]), encoding="utf-8")
        setups.append(replace(setup, source=table.name, times=None, fps=None))
    few = replace(right, path=tmp_path / "session.toml", sensors=tuple(setups))
    sources = open_sources(few, {})
    surveys = {s.name: survey(few, s, sources[s.name]) for s in few.sensors}
    asked: list[object] = []

    def asks(*arguments: object) -> Diagnosis:
        asked.append(arguments)
        return Diagnosis(explained=1)

    monkeypatch.setattr("mixpose.checking.geometry.diagnosis", asks)
    assert geometry_doubts(few, sources, surveys).warnings == ()
    assert not asked
    with (tmp_path / "right.csv").open("a", encoding="utf-8") as table_of_right:
        table_of_right.write("0,300,200\n")  # a fourth: two coordinates more than a pose
    sources = open_sources(few, {})
    surveys = {setup.name: survey(few, setup, sources[setup.name]) for setup in few.sensors}
    geometry_doubts(few, sources, surveys)
    assert len(asked) == 1


def searches_of(monkeypatch: pytest.MonkeyPatch, guesses: float) -> list[int]:
    """Numbers of the frames that are searched, where a search by a change takes so many guesses."""
    searched: list[int] = []
    search = best_pose

    def counted(session: Session, body: Body, number: int, *more: Any) -> Any:
        searched.append(number)
        return search(session, body, number, *more)[0], guesses * (len(more) > 1)

    monkeypatch.setattr("mixpose.checking.trials.best_pose", counted)
    return searched


def test_no_more_frames_are_searched_when_guesses_are_used_up(
    right: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    searched = searches_of(monkeypatch, 1.1 * DiagnosisRules().all_guesses)
    swapped = recorded(right)
    swapped["left"], swapped["right"] = swapped["right"], swapped["left"]
    assert told(right, swapped) == ""
    assert searched == [0, 1, 2, 3, 0]  # as the session is, and by the first change


def test_the_change_that_leads_is_tried_in_all_frames(
    right: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    searched = searches_of(monkeypatch, 0.09 * DiagnosisRules().all_guesses)
    mirrored = with_points(right, right.body.means * [1, -1, 1])
    assert told(mirrored, recorded(right)).startswith(
        "the body of [object] is mirrored, or seen in a mirror: "
    )
    # the session as it is, as many changes as there are guesses for, the best of them to the end
    assert searched == [0, 1, 2, 3, *12 * [0], 1, 2, 3]


def test_changes_that_gain_far_less_drop_out_after_a_frame(
    right: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    searched = searches_of(monkeypatch, 0)
    told(with_points(right, right.body.means * [1, -1, 1]), recorded(right))
    assert searched.count(0) > 10  # all changes try the first frame
    assert searched.count(3) <= 4  # hardly any the last


def test_points_of_another_unit_have_markers_of_that_unit(right: Session) -> None:
    spheres = replace(right.body, shape="sphere", radii=np.full(7, 6.0))
    larger = next(point_units(spheres)).body(spheres)
    np.testing.assert_allclose(larger.means, 1000 * spheres.means)
    assert larger.radii is not None
    np.testing.assert_allclose(larger.radii, 6000.0)


def test_a_feature_met_by_chance_outweighs_no_evidence() -> None:
    def explained(count: int, met: float, rms: float) -> Any:
        return SimpleNamespace(
            poses=[None] * 4,
            met_count=lambda *_: met,
            explained_count=lambda _: count,
            rms=lambda *_: rms,
        )

    smaller = Change("the body {is} of another size", "with it smaller", values=1)
    before = explained(4, 50.0, 0.7)
    one_less = [Tried(smaller, explained(4, 49.0, 0.02), 100.0)]
    assert "is of another size" in simplest(one_less, before, DiagnosisRules()).change
    # what meets far less is near a few detections, as a body that is far too small
    far_less = [Tried(smaller, explained(4, 40.0, 0.02), 100.0)]
    assert simplest(far_less, before, DiagnosisRules()).change == ""


def test_of_changes_that_explain_about_as_much_the_simplest_is_told() -> None:
    def explained(count: int, rms: float) -> Any:
        return SimpleNamespace(
            poses=[None] * 4,
            met_count=lambda *_: 50.0,
            explained_count=lambda _: count,
            rms=lambda *_: rms,
        )

    other_size = Change("the body {is} of another size", "with it larger", values=1)
    elsewhere = Change("a camera {is} elsewhere", "with it moved", values=6)
    rules, before = DiagnosisRules(), explained(0, 0.6)
    tried = [
        Tried(elsewhere, explained(4, 0.1), 105.0),
        Tried(other_size, explained(4, 0.1), 100.0),
    ]
    assert simplest(tried, before, rules).change.startswith("the body is of another size")
    # far more is worth more values
    tried[0] = tried[0]._replace(gain=130.0)
    assert simplest(tried, before, rules).change.startswith("a camera is elsewhere")


def test_a_pose_that_one_of_several_cameras_shows_is_no_session_without_a_warning() -> None:
    def said(**shares: float) -> str:
        sensors = {name: SensorReport(share > 0, share, None) for name, share in shares.items()}
        return _seen_by_some(Estimate(91, None, "board", "ok", np.eye(4), None, 0.5, sensors))

    assert said(a=0.9, b=0.8) == ""
    assert said(a=0.9, b=0.0, c=0.0).startswith(
        "frame 91: 'a' alone shows the body where 'b' and 'c' do not see it"
    )
    assert said(a=0.9, b=0.9, c=0.0).startswith(
        "frame 91: 'a' and 'b' alone show the body where 'c' does not see it"
    )


@pytest.mark.filterwarnings("error")
def test_a_body_far_larger_than_what_is_seen_is_searched_for_without_a_remark(
    right: Session,
) -> None:
    larger = with_points(right, right.body.means * 1000)
    (estimate,) = mixpose.run(larger, selection=Selection(0, 1))
    assert estimate.status != "ok"


def test_corners_that_are_taken_for_spots_are_told(recordings: Path, tmp_path: Path) -> None:
    # centres of a chessboard's dark squares lie as a part of its corners do, half a square aside
    source = recordings / "stereo_chessboard"
    for path in (*source.glob("*.jpg"), *source.glob("*.yml")):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    content = (source / "session.toml").read_text()
    extract = content.index("[extract]")
    kept = content[extract:].replace('method = "corners"', "").replace("sigma = 2.0", "")
    for polarity in ("bright", "dark"):
        changed = kept.replace("[extract]", f'[extract]\npolarity = "{polarity}"')
        (tmp_path / "session.toml").write_text(content[:extract] + changed)
        session = load_session(tmp_path / "session.toml")
        sources = open_sources(session, {})
        surveys = {s.name: survey(session, s, sources[s.name]) for s in session.sensors}
        (warning, *_) = geometry_doubts(session, sources, surveys).warnings
        assert 'corners and no spots: with method = "corners" in [extract]' in warning
