"""Faults in a recording: no wrong pose is ok, and the run names what is at fault."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matches import Seen, scored

from mixpose.cli.findings import Stretches
from mixpose.judgement import AcceptanceRules, NoiseModel, is_seen_elsewhere
from mixpose.session import load_session

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

from faults import FAULTS, Fault, instead, moved, outcome, rewritten

from mixpose.records import Floats

RULES, MODEL = AcceptanceRules(), NoiseModel()
QUIET = np.array(
    [0.01, 100.0]
)  # squares and degrees of freedom: offsets of 0.01 σ: far below what is put in below


@pytest.mark.parametrize(
    "name",
    ["black for 5 frames", "frame doubled", "marker gone", "marker measured 2 mm wrong"],
)
def test_a_fault_makes_no_pose_wrong_and_is_named(name: str, tmp_path: Path) -> None:
    found = outcome(FAULTS[name], tmp_path / "recording")
    assert found.wrong == 0
    assert found.is_named, found.said
    assert found.right >= 39  # of 40


@pytest.mark.parametrize(
    ("name", "right"),
    [
        ("bumped by 0.5° about y from frame 20", 20),
        ("frozen for 5 frames", 10),
        ("torn for 5 frames", 10),
    ],
)
def test_a_camera_that_begins_to_disagree_with_the_other_makes_no_pose_wrong_and_is_named(
    name: str, right: int, tmp_path: Path
) -> None:
    found = outcome(FAULTS[name], tmp_path / "recording", stop=right + 5)
    assert found.wrong == 0
    assert found.is_named, found.said
    assert found.right >= right


@pytest.mark.parametrize(
    ("name", "frames", "right"),
    [
        ("frames missing", 17, 17),
        ("sensor drops out and returns", 31, 31),
        ("frozen for 20 frames", 24, 10),
        ("saturated for 5 frames", 16, 16),
        ("black all along", 6, 6),
        ("bumped by 3° about y from frame 20", 25, 20),
        ("marker falls off", 31, 31),
        ("marker moves on the body", 40, 36),
        ("marker measured 20 mm wrong", 12, 12),
        ("another camera's calibration", 4, 0),
    ],
)
def test_other_frames_stay_right_beside_a_fault(
    name: str, frames: int, right: int, tmp_path: Path
) -> None:
    found = outcome(FAULTS[name], tmp_path / "recording", stop=frames)
    assert found.wrong == 0
    assert found.right >= right
    assert found.is_named, found.said


def test_a_marker_is_called_by_the_name_that_its_table_has(tmp_path: Path) -> None:
    def named(folder: Path) -> None:
        FAULTS["marker measured 20 mm wrong"].change(folder)
        path = folder / "session.toml"
        body = load_session(path).body
        rows = [f"m{k},{x},{y},{z}" for k, (x, y, z) in enumerate(body.means.tolist())]
        rows[3] = rows[3].replace("m3", "tip")
        table = "\n".join(["name,x,y,z", *rows, ""])
        (folder / "markers.csv").write_text(table, encoding="utf-8")
        rewritten((r"^points = .*$", 'file = "markers.csv"'))(folder)

    found = outcome(Fault(named, "^marker tip is met in none"), tmp_path / "recording", stop=12)
    assert (found.right, found.is_named) == (12, True), found.said


def test_a_marker_that_is_so_far_off_that_it_is_missed_in_the_end_is_not_called_gone(
    tmp_path: Path,
) -> None:
    off = Fault(moved(2, (0, 0, 5)), "^marker 3 is met .* mm off in .* measured wrong")
    found = outcome(off, tmp_path / "recording")
    assert found.wrong == 0
    assert found.is_named, found.said


def test_a_recording_without_faults_gives_rise_to_no_remark(tmp_path: Path) -> None:
    found = outcome(FAULTS["nothing"], tmp_path / "recording")
    assert (found.right, found.said) == (40, [])


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("left and right swapped", "'left' and 'right' are swapped"),
        ("body mirrored", "the body of [object] is mirrored"),
        ("points in metres", "with points 1000 times as large"),
        ("translations in metres", "with points a thousandth as large"),
        ("mirrored image", "images of 'right' are mirrored"),
        ("T_sensor_world inverted", "T_sensor_world of 'left' and 'right' are inverted"),
        ("T_sensor_world of one inverted", "T_sensor_world of 'right' is inverted"),
        ("body 5 % too large", "with points 0.952 times as large"),
    ],
)
def test_what_is_given_wrong_all_along_is_told_by_what_is_seen(
    name: str, said: str, tmp_path: Path
) -> None:
    # none convinces: it searches in each of them; three tell, where two could be by chance
    found = outcome(FAULTS[name], tmp_path / "recording", stop=3)
    assert found.right == found.wrong == 0
    assert any(said in line for line in found.said), found.said


def test_one_cameras_files_given_for_both_are_told_by_their_names(tmp_path: Path) -> None:
    found = outcome(FAULTS["one camera's files given for both"], tmp_path / "recording", stop=2)
    assert found.right == found.wrong == 0
    said = "'left' and 'right' read the same recording"
    assert any(said in line for line in found.said), found.said


def test_a_camera_that_is_a_frame_late_is_told_from_one_that_is_bumped(tmp_path: Path) -> None:
    found = outcome(FAULTS["one frame late"], tmp_path / "recording", stop=8)
    assert found.wrong == 0
    assert found.is_named, found.said


def test_a_camera_that_is_a_frame_late_is_told_where_the_body_rests_at_first(
    tmp_path: Path,
) -> None:
    def rested(folder: Path) -> None:
        # while nothing moves, a late camera agrees
        instead("left", range(1, 40), lambda k: max(k - 4, 0))(folder)
        instead("right", range(1, 40), lambda k: max(k - 5, 0))(folder)

    found = outcome(Fault(rested, "'right' is a frame late"), tmp_path / "recording", stop=12)
    assert found.ambiguous == 7  # all in which it moves
    assert found.is_named, found.said


def test_a_body_that_is_one_per_cent_too_small_is_named(
    tmp_path: Path,
) -> None:
    found = outcome(FAULTS["body 1 % too small"], tmp_path / "recording", stop=12)
    assert found.wrong == 0
    (said,) = found.said
    assert "with points 1.01 times as large" in said


def sensor(name: str, offsets: Floats, J: Floats, met: Floats, count: float) -> Seen:
    unmatched = max(count - float(met.sum()), 0.0)
    return Seen(J, name, offsets, met, count=count, unmatched_nearby=unmatched)


def is_missed(
    sensors: Sequence[Seen], before: Floats = QUIET, agreed: bool = True, variance: float = 1e-4
) -> bool:
    pose = scored(np.eye(4), *sensors)
    judged = replace(pose, variances=np.full(len(sensors), variance))
    return is_seen_elsewhere(judged, before, agreed, RULES, MODEL)


@pytest.fixture
def jacobians() -> Floats:
    return np.random.default_rng(0).normal(size=(3, 7, 2, 6))


def seen(jacobians: Floats, shifts: list[float], noise: float = 0.01) -> list[Seen]:
    """Sensors that each see the body at a pose of their own."""
    rng = np.random.default_rng(1)
    found = []
    for k, shift in enumerate(shifts):
        twist = shift * np.array([1.0, -1.0, 0.5, 0.3, 0.2, -0.6])
        offsets = jacobians[k] @ twist + noise * rng.normal(size=(7, 2))
        found.append(sensor(str(k), offsets, jacobians[k], np.ones(7), 7.0))
    return found


def test_a_sensor_that_never_met_the_body_but_sees_as_much_is_not_believed(
    jacobians: Floats,
) -> None:
    one, _ = seen(jacobians, [0.0, 0.0])
    blind = sensor("1", np.zeros((7, 2)), jacobians[1], np.zeros(7), 5.0)
    assert is_missed([one, blind], np.zeros(2), False)
    empty = sensor("1", np.zeros((7, 2)), jacobians[1], np.zeros(7), 1.0)
    assert not is_missed([one, empty], np.zeros(2), False)
    # once they agreed, what is seen elsewhere may be anything
    assert not is_missed([one, empty])


@pytest.mark.parametrize("agreed", [False, True])
def test_what_a_sensor_meets_far_off_by_the_noise_of_the_frame_it_may_see_elsewhere(
    jacobians: Floats, agreed: bool
) -> None:
    one, _ = seen(jacobians, [0.0, 0.0])
    met = np.array([1.0] * 4 + [0.0] * 3)
    rng = np.random.default_rng(2)
    far, close = (
        sensor("1", met[:, None] * size * rng.choice([-1.0, 1.0], (7, 2)), jacobians[1], met, 7.0)
        for size in (0.9, 0.02)
    )
    assert is_missed([one, far], np.zeros(2), agreed)
    # more than half of the body, as closely as the other sensor
    assert not is_missed([one, close], np.zeros(2), agreed)
    # or as the noise of the frame has it
    assert not is_missed([one, far], np.zeros(2), agreed, variance=0.2)
    # features of a body that gives way may be met off
    judged = replace(scored(np.eye(4), one, far), variances=np.full(2, 1e-4))
    rules = np.zeros(2), agreed, RULES, MODEL
    assert is_seen_elsewhere(judged, *rules)
    assert not is_seen_elsewhere(judged, *rules, is_exact=False)


def test_one_sensor_of_four_is_not_believed_where_others_see_as_much_elsewhere(
    jacobians: Floats,
) -> None:
    one, other = seen(jacobians, [0.0, 0.0])
    blind = sensor("2", np.zeros((7, 2)), jacobians[1], np.zeros(7), 5.0)
    empty = sensor("3", np.zeros((7, 2)), jacobians[2], np.zeros(7), 0.0)
    for agreed in (False, True):
        assert is_missed([one, blind, replace(blind, name="1"), empty], agreed=agreed)
        # two that agree outvote it, and blind ones say nothing
        assert not is_missed([one, other, blind, empty], agreed=agreed)
        assert not is_missed([one, empty, replace(empty, name="1")], agreed=agreed)


def test_stretches_are_told_with_the_longest_first_in_the_order_of_the_run() -> None:
    stretches = Stretches()
    for place, frame in [(0, 3), (1, 4), (5, 10), (9, 20), (10, 22), (11, 23), (20, 50)]:
        stretches.add(frame, place)
    assert stretches.text() == "3 to 4, 10, 20 to 23 and 1 more"
    assert (stretches.count, stretches.longest, stretches.last_place) == (7, 3, 20)
