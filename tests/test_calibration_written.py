"""The calibrated session: all that was found, and all that hangs on it, is in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from calibration_texts import kalibr
from command_line import command
from simulated_rigs import NO_FRAME_HELD_BACK, POINTS, alone, cameras, recording, task_of

from mixpose.calibration import Calibration, Rig, calibrate
from mixpose.calibration.recorded import read_frames
from mixpose.calibration.result import met_detections
from mixpose.calibration.rig import centre_of
from mixpose.calibration.rules import CalibrationRules
from mixpose.calibration.words import in_length, in_world
from mixpose.calibration.writing import calibrated_text
from mixpose.rigid import inverse
from mixpose.session import Session, load_session

FRAMES = 10


def written(session: Session, found: Calibration) -> Session:
    target = session.folder / "calibrated.toml"
    target.write_text(calibrated_text(session, found, target, "0"), encoding="utf-8")
    return load_session(target)


def rig_of(session: Session) -> Rig:
    setups = session.sensors
    return Rig.of([one.name for one in setups], [one.sensor for one in setups], session.body)


def calibrated(session: Session, **options: Any) -> Calibration:
    """From a recording by the session's own sensors."""
    sensors: Any = [one.sensor for one in session.sensors]
    frames = recording(sensors, FRAMES, 0.01)
    task = replace(task_of(sensors, frames, **options), rig=rig_of(session))
    return calibrate(task, NO_FRAME_HELD_BACK, found=alone(sensors, frames))


def text_of(objects: str = "[object]", head: str = "") -> str:
    text = f'unit = "mm"\n{head}\n{objects}\nname = "six"\npoints = {POINTS.tolist()}\n'
    for name, camera in zip(("left", "right"), cameras(2), strict=True):
        text += (
            f'\n[[sensor]]\nname = "{name}"\nmodel = "pinhole"\nsource = "{name}.csv"\nfps = 30\n'
            f"camera_matrix = {camera.camera_matrix.tolist()}\nresolution = [640, 512]\n"
            f"T_sensor_world = {camera.T_sensor_world.tolist()}\n"
        )
    return text


def session_in(folder: Path, text: str) -> Session:
    path = folder / "session.toml"
    path.write_text(text, encoding="utf-8")
    return load_session(path)


def test_a_camera_that_a_calibration_file_places_stays_there_when_its_lens_is_sought(
    tmp_path: Path,
) -> None:
    # what is written hangs on what is sought, not on where it is found
    lenses = {0: ("focal",), 1: ("focal",)}
    found = calibrated(session_in(tmp_path, text_of()), free=lenses)
    (tmp_path / "camchain.yaml").write_text(kalibr(), encoding="utf-8")
    text = text_of().partition("[[sensor]]")[0]
    for camera in ("cam1", "cam0"):
        text += (
            f'[[sensor]]\nname = "{camera}"\nmodel = "pinhole"\nsource = "{camera}.csv"\n'
            f'calibration = {{ file = "camchain.yaml", camera = "{camera}" }}\n'
        )
    session = session_in(tmp_path, text)
    rig = rig_of(session)
    new = written(session, replace(found, before=rig, after=rig))
    for one, other in zip(session.sensors, new.sensors, strict=True):
        old: Any = one.sensor
        np.testing.assert_allclose(other.sensor.T_sensor_world, old.T_sensor_world, atol=1e-6)  # type: ignore[attr-defined]
        np.testing.assert_allclose(other.sensor.camera_matrix, old.camera_matrix, atol=1e-6)  # type: ignore[attr-defined]


def test_a_known_length_scales_all_that_is_written(tmp_path: Path) -> None:
    start = "[start]\nrotation_vector = [0, 0, 0.1]\ntranslation = [1, 2, 3]\ndistance = 30\n"
    tool = '[object]\ntip = [0, 0, -150]\nshape = "sphere"\nradius = 4\n'
    gravity = "gravity = { direction = [0, 0, -1], sigma = 0.5 }"
    session = session_in(tmp_path, text_of(tool + gravity) + start)
    a, b = (centre_of(one.sensor) for one in session.sensors)
    found = calibrated(session, free={})
    new = written(session, in_length(found, f"left:right={2 * np.linalg.norm(b - a)}"))
    for one, other in zip(session.sensors, new.sensors, strict=True):
        # the camera that stays as well
        np.testing.assert_allclose(centre_of(other.sensor), 2 * centre_of(one.sensor), atol=1e-5)
    body, start_of = new.body, new.start
    np.testing.assert_allclose(body.means, 2 * POINTS, atol=1e-6)
    assert body.radii == pytest.approx([8.0] * len(POINTS))
    assert body.tip == pytest.approx([0, 0, -300])
    assert body.gravity is not None
    assert body.gravity.sigma == pytest.approx(1.0)
    assert start_of is not None
    assert session.start is not None
    assert start_of.distance == pytest.approx(60)
    np.testing.assert_allclose(start_of.T_world_object[:3, 3], [2, 4, 6])
    np.testing.assert_allclose(
        start_of.T_world_object[:3, :3], session.start.T_world_object[:3, :3], atol=1e-12
    )


def test_another_world_moves_the_start_and_gravity_with_the_sensors(tmp_path: Path) -> None:
    start = "[start]\nrotation_vector = [0, 0, 0.1]\ntranslation = [1, 2, 3]\n"
    body = "[object]\ngravity = { direction = [0, 0, -1], sigma = 0.5 }"
    session = session_in(tmp_path, text_of(body) + start)
    found = in_world(calibrated(session, free={}), "right")
    new = written(session, found)
    T_old_new = inverse(cameras(2)[1].T_sensor_world)
    assert session.start is not None
    assert new.start is not None
    np.testing.assert_allclose(
        T_old_new @ new.start.T_world_object, session.start.T_world_object, atol=1e-9
    )
    assert new.body.gravity is not None
    np.testing.assert_allclose(
        T_old_new[:3, :3] @ new.body.gravity.direction, [0, 0, -1], atol=1e-9
    )
    for one, other in zip(session.sensors, new.sensors, strict=True):
        T: Any = [each.sensor for each in (one, other)]
        np.testing.assert_allclose(T[1].T_sensor_world, T[0].T_sensor_world @ T_old_new, atol=1e-6)


def test_a_body_in_double_brackets_is_put_where_it_was(tmp_path: Path) -> None:
    session = session_in(tmp_path, text_of("[[object]]"))
    found = calibrated(session, body_free=True)
    new = written(session, found)
    np.testing.assert_allclose(new.body.means, found.after.points, rtol=1e-8, atol=1e-8)
    assert (new.body.means != POINTS).any()


def test_markers_keep_their_names_when_their_places_are_sought(tmp_path: Path) -> None:
    names = ("base", "tip", "left", "right", "mast", 'the "far" one')
    session = session_in(tmp_path, text_of())
    found = calibrated(session, body_free=True)
    rows = [
        f'"{n.replace(chr(34), chr(34) * 2)}",{x},{y},{z}' for n, (x, y, z) in zip(names, POINTS)
    ]
    (tmp_path / "six.csv").write_text("\n".join(["name,x,y,z", *rows]), encoding="utf-8")
    text = text_of().replace(f"points = {POINTS.tolist()}", 'file = "six.csv"')
    new = written(session_in(tmp_path, text), found)
    assert new.body.labels == names
    np.testing.assert_allclose(new.body.means, found.after.points, rtol=1e-8, atol=1e-8)


def test_a_known_length_scales_bodies_that_were_not_looked_at(tmp_path: Path) -> None:
    (tmp_path / "wand.csv").write_text("name,x,y,z\na,0,0,0\nb,9,0,0\nc,0,7,0\n")
    segments = [[[0, 0, 5], [50, 0, 5]], [[0, 0, 5], [0, 60, 5]]]
    others = f'[[object]]\nname = "wand"\nfile = "wand.csv"\nsegments = {segments}\n\n'
    text = text_of("[[object]]").replace("[[sensor]]", f"{others}[[sensor]]", 1)
    session = session_in(tmp_path, text)
    a, b = (centre_of(one.sensor) for one in session.sensors)
    found = in_length(calibrated(session, free={}), f"left:right={2 * np.linalg.norm(b - a)}")
    for one, other in zip(session.objects, written(session, found).objects, strict=True):
        np.testing.assert_allclose(other.body.nodes.points, 2 * one.body.nodes.points, atol=1e-6)


def test_a_known_length_scales_what_a_calibration_may_be_off_by(tmp_path: Path) -> None:
    error = "calibration_error = { focal = 0.001, position = 0.25 }\n"
    text = text_of().replace("resolution", f"{error}resolution", 1)
    session = session_in(tmp_path, text)
    a, b = (centre_of(one.sensor) for one in session.sensors)
    found = in_length(calibrated(session, free={}), f"left:right={2 * np.linalg.norm(b - a)}")
    changed = written(session, found).sensors[0].calibration_error
    assert changed is not None
    assert changed.position == pytest.approx(0.5)
    assert changed.focal == 0.001


def rows_of(numbers: list[int]) -> str:
    rng = np.random.default_rng(0)
    rows = [
        f"{n},{k / 30},{u:.2f},{v:.2f}"
        for k, n in enumerate(numbers)
        for u, v in rng.uniform(0, 500, (4, 2))
    ]
    return "frame,time_s,u,v\n" + "\n".join(rows) + "\n"


@pytest.mark.parametrize("runs", [False, True])
@pytest.mark.parametrize(
    "numbers",
    [range(2000), range(0, 20_000, 10), range(10**18, 10**18 + 2000 * 33_333_333, 33_333_333)],
    ids=["counted", "with gaps", "stamps"],
)
def test_frames_of_long_recordings_are_taken_evenly_whatever_their_numbers(
    tmp_path: Path, numbers: range, runs: bool
) -> None:
    text = text_of().partition('[[sensor]]\nname = "right"')[0].replace("fps = 30\n", "")
    session = session_in(tmp_path, text)
    (tmp_path / "left.csv").write_text(rows_of([*numbers]), encoding="utf-8")
    rules = CalibrationRules(most_candidates=10_000)
    frames = read_frames(session, {}, rules, lambda *_: None, runs=runs, known=None)
    assert len(frames) == rules.most_read // 8 * 8
    places = [numbers.index(frame.number) for frame in frames]
    assert (places[0], places[-1]) == (0, 1999)
    assert max(np.diff(places)) <= (2000 / len(frames) + 1) * (8 if runs else 1)


def test_numbers_longer_than_those_of_numpy_are_looked_at(tmp_path: Path) -> None:
    session = session_in(tmp_path, text_of())
    for name in ("left", "right"):
        rows = rows_of([10**20 + k for k in range(20)])
        (tmp_path / f"{name}.csv").write_text(rows, encoding="utf-8")
    checked = command("check", session.path)
    assert checked.returncode in (0, 1)
    assert "frames 100000000000000000000-" in checked.stdout
    pairs = SimpleNamespace(frame=np.array([0, 1]), feature=np.array([0, 1]), y=np.zeros((2, 2)))
    rows_met: Any = SimpleNamespace(pairs=pairs, residual=np.zeros((2, 2)))
    adjusted: Any = SimpleNamespace(weighted=[(rows_met, np.ones(2))])
    assert met_detections(adjusted, [10**20, 3])[0].frame.tolist() == [np.iinfo(np.intp).max, 3]
