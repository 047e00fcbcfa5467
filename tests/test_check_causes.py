"""Causes that `mixpose check` and the end of a run tell: each by itself, two at once, or none."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from diagnosed import frames_of, recorded, told, with_points

from mixpose.checking import times_as_large
from mixpose.checking.changes import Change
from mixpose.checking.evidence import best_pose
from mixpose.checking.rules import DiagnosisRules
from mixpose.checking.trials import Tried, diagnosis, simplest
from mixpose.checking.values import _calibration
from mixpose.cli.app import CheckRequest
from mixpose.cli.check import check_session
from mixpose.cli.findings import Findings
from mixpose.objective import View
from mixpose.records import Estimate, FrameSet
from mixpose.session import Session, load_session

SESSION = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras" / "session.toml"
RULES = DiagnosisRules()


@pytest.fixture
def right() -> Session:
    return replace(load_session(SESSION), start=None)


def mirrored(session: Session) -> Session:
    return with_points(session, session.body.means * [1, -1, 1])


def explained(count: int, rms: float = 0.1) -> Any:
    return SimpleNamespace(
        poses=[None] * 4,
        met_count=lambda *_: 50.0,
        explained_count=lambda _: count,
        rms=lambda *_: rms,
    )


def test_two_faults_at_once_are_told_together(right: Session) -> None:
    seen = recorded(right)
    swapped = {"left": seen["right"], "right": seen["left"]}
    frames = frames_of(right, swapped)[:2]
    assert diagnosis(mirrored(right), frames).change == (
        "'left' and 'right' are swapped, and the body of [object] is mirrored, or seen in a "
        "mirror: with the source of each given to the other, and with one coordinate of all "
        "points negated"
    )


def test_a_trial_finds_a_pose_of_use_and_spends_nothing_on_others(right: Session) -> None:
    """The right session explains a frame by 70 nats; one that is mirrored by nothing near it."""
    ((number, views), *_) = frames_of(right, recorded(right))
    found, guesses = best_pose(right, right.body, number, views, 10_000, 36.0)
    assert found is not None
    assert found.log_evidence > 36.0
    wrong = mirrored(right)
    other, as_many = best_pose(wrong, wrong.body, number, views, 10_000, 36.0)
    assert (other, as_many > guesses) == (None, True)


def test_what_explains_one_sensor_only_is_no_cause() -> None:
    """It is met ten times as closely, but no frame is explained by it."""
    flipped = Change("images {are} mirrored", "with left and right of them exchanged")
    found = simplest([Tried(flipped, explained(0, 0.02), 100.0)], explained(0, 0.4), RULES)
    assert found.change == ""
    assert simplest([Tried(flipped, explained(1, 0.02), 100.0)], explained(1, 0.4), RULES).change


def test_one_remedy_of_two_causes_is_told_once() -> None:
    tried = [
        Tried(Change(f"T_sensor_world of {name!r} {{is}} off", "with it moved"), explained(4), 90.0)
        for name in ("left", "right")
    ]
    assert simplest(tried, explained(0), RULES).change == (
        "T_sensor_world of 'left' may be off, or T_sensor_world of 'right' may be off: "
        "with it moved"
    )


@pytest.mark.parametrize("name", ["left", "right"])
def test_a_pose_of_a_camera_that_is_left_out_is_told_with_where_it_stands(
    name: str, right: Session
) -> None:
    """820 mm and 46 degrees of the one, 780 mm and 41 of the other, from no start at all."""
    here: Any = {setup.name: setup.sensor for setup in right.sensors}
    here[name] = replace(here[name], T_sensor_world=np.eye(4))
    setups = tuple(replace(setup, sensor=here[setup.name]) for setup in right.sensors)
    text = told(replace(right, sensors=setups), recorded(right))
    assert f"T_sensor_world of {name!r} may be off or left out" in text
    there = {"left": "moved by 780 mm and turned by 41 deg", "right": "820 mm and turned by 46 deg"}
    assert text.endswith(there[name])
    assert "calibration" not in text


def test_a_calibration_is_told_from_a_pose_by_what_each_camera_meets_alone(right: Session) -> None:
    """The other camera's principal point is 7 and 9 px off, which a turn by 0.8 degrees may be."""
    left, other = right.sensors
    camera, lens = cast("Any", left.sensor), cast("Any", other.sensor)
    copied = replace(camera, camera_matrix=lens.camera_matrix, distortion=lens.distortion)
    given = replace(right, sensors=(replace(left, sensor=copied), other))
    text = told(given, recorded(right))
    assert text.startswith(
        "the calibration of 'left' is not that of its images, but that of 'right'"
    )
    fx, cx, cy = (float(each) for each in re.findall(r"= ([0-9.]+)", text))
    # true are 812.4, 322.7, 251.3; four frames of seven markers, each off by 0.1 px
    assert abs(fx - 812.4) < 3
    assert np.hypot(cx - 322.7, cy - 251.3) < 2


@pytest.mark.parametrize(
    ("factor", "text"),
    [
        (1.002, "1.002"),
        (0.99802, "0.998"),
        (1.00037, "1.00037"),
        (0.980392, "0.98"),
        (0.952381, "0.952"),
        (1.25, "1.25"),
        (3.14159, "3.14"),
    ],
)
def test_a_size_is_told_to_two_digits_of_what_is_wrong_with_it(factor: float, text: str) -> None:
    assert times_as_large(factor) == f"{text} times as large"


def test_two_changes_together_change_body_and_cameras_of_a_session(right: Session) -> None:
    larger = Change("a", "b", body=lambda body: with_points(right, body.means * 2).body)
    sides = {s.name: s.sensor for s in right.sensors}
    swap = Change(
        "c",
        "d",
        lambda views: [
            replace(v, sensor=sides["left" if v.name == "right" else "right"]) for v in views
        ],
    )
    both = larger.and_also(swap)
    changed = both.apply(right, frames_of(right, recorded(right))[0][1])
    np.testing.assert_allclose(changed.body.means, 2 * right.body.means)
    assert [s.sensor for s in changed.sensors] == [s.sensor for s in right.sensors[::-1]]
    assert (both.what, both.remedy) == ("a, and c", "b, and d")


def test_what_follows_from_the_cause_is_not_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of points in metres the body is 0.2 px wide, without an orientation that could be seen."""
    session = load_session(SESSION)
    rows = str((session.body.means / 1000).tolist())
    text = SESSION.read_text(encoding="utf-8")
    before, after = text.split("points = [", 1)[0], text.split("\n]\n", 1)[1]
    path = tmp_path / "session.toml"
    text = f"{before}points = {rows}\n{after}"
    path.write_text(text.replace('source = "', f'source = "{SESSION.parent}/'), encoding="utf-8")
    check_session(CheckRequest(path, quick=True))
    warnings = [row for row in capsys.readouterr().out.splitlines() if row.startswith("warning")]
    assert len(warnings) == 1
    assert "with points 1000 times as large, 4 of 4 frames are explained" in warnings[0]


@pytest.mark.parametrize("sensors", [1, 2])
def test_where_the_body_is_another_one_it_is_said_that_no_frame_is_explained(
    sensors: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No single change mends it; of one camera nothing contradicts it either."""
    rows = np.random.default_rng(5).uniform(-90, 90, (7, 3)).round(1).tolist()
    text = SESSION.read_text(encoding="utf-8")
    before, after = text.split("points = [", 1)[0], text.split("\n]\n", 1)[1]
    parts = f"{before}points = {rows}\n{after}".split("[[sensor]]")
    path = tmp_path / "session.toml"
    text = re.sub(r"\[start\]\n(?:[^\[\n].*\n)*", "", "[[sensor]]".join(parts[: 1 + sensors]))
    path.write_text(text.replace('source = "', f'source = "{SESSION.parent}/'), encoding="utf-8")
    check_session(CheckRequest(path, quick=True))
    out = capsys.readouterr().out
    assert "the body is not found, by the session as it is or with any one change of it" in out
    assert "warnings  none" not in out


@pytest.mark.parametrize(("status", "told_of"), [("lost", True), ("ambiguous", False)])
def test_frames_that_are_lost_ask_for_the_cause_as_those_in_doubt_do(
    status: Any, told_of: bool, right: Session
) -> None:
    """Those that are ambiguous without a doubt are as the sensors see them."""
    session = mirrored(right)
    findings = Findings(session)
    for number, views in frames_of(session, recorded(right))[:3]:
        found: list[View] = list(views)
        pose = None if status == "lost" else np.eye(4)
        estimate = Estimate(number, None, session.labels[0], status, pose, None, 0.0, {})
        findings.watch(FrameSet(number, None, {}), found, estimate)
        findings.add(estimate)
    causes = findings.causes()
    assert len(causes) == told_of
    for line in causes:
        assert line.startswith("the body of [object] is mirrored, or seen in a mirror: ")
        assert line.endswith(", frames that are not ok would be ok")


def test_cameras_that_all_have_one_calibration_copied_none(right: Session) -> None:
    """As cameras of one kind have, of which a third one is beside two here."""
    left, other = right.sensors
    lens = cast("Any", other.sensor)
    one = replace(
        cast("Any", left.sensor), camera_matrix=lens.camera_matrix, distortion=lens.distortion
    )
    both = [replace(left, sensor=one), other]
    for cameras, copied in ((both, True), ([*both, replace(other, name="third")], False)):
        found = _calibration(cameras[0], cameras)
        assert ("but that of 'right'" in found.what) == copied
