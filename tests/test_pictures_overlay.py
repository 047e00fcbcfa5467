"""Poses drawn on frames: what is drawn where, and what becomes of a run that is drawn."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import mixpose
from mixpose.body import Body, PointFeature
from mixpose.cli import main
from mixpose.errors import SessionError
from mixpose.objective import View
from mixpose.pictures import Part, displayable, draw_pose
from mixpose.pictures.canvas import line_height
from mixpose.pictures.movie import Overlay, VideoSink
from mixpose.pictures.overlay import (
    AXES,
    MEASURED,
    STATUS_COLOURS,
    ellipse_95,
    projected_covariances,
    projected_features,
)
from mixpose.pictures.scene import backdrop, draw_ranges, draw_scene
from mixpose.pictures.signature import is_ours
from mixpose.pictures.stages import fitted
from mixpose.records import Estimate, FrameSet, PointPattern, RawFrame, SensorReport
from mixpose.rigid import CHI2_95, from_parts, from_rotation_vector, perturb, transform
from mixpose.runner import run
from mixpose.selection import Selection
from mixpose.sensors import PinholeCamera, RangeSensor

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
BLACK = np.zeros((1024, 1280, 3), np.uint8)
WHITE = np.full((1024, 1280, 3), 255, np.uint8)


def command(*arguments: str | Path | int) -> int:
    with pytest.raises(SystemExit) as leaving:
        main([str(argument) for argument in arguments])
    return int(str(leaving.value.code))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Four frames of two cameras, free to be spoilt."""
    folder = tmp_path / "recording"
    folder.mkdir()
    shutil.copy(SYNTHETIC / "two_cameras" / "session.toml", folder)
    for n in range(4):
        for side in ("left", "right"):
            shutil.copy(SYNTHETIC / "two_cameras" / f"{side}{n:04d}.png", folder)
    return folder


@pytest.mark.parametrize("ground", [BLACK, WHITE], ids=["dark", "bright"])
def test_rings_lie_around_the_projected_features_and_stand_out(
    ground: NDArray[np.uint8], paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    camera = pinhole_cameras[0]
    picture = draw_pose(ground, camera, paper_body, np.eye(4), status="ok")
    y, _, seen = projected_features(camera, paper_body, np.eye(4))
    assert seen.all()
    colour = np.array(STATUS_COLOURS["ok"])
    for u, v in np.round(y).astype(int):
        patch = picture[v - 20 : v + 21, u - 20 : u + 21].astype(int)
        # the ring in its own colour, its rim black: one of the two is seen on any ground
        assert (np.abs(patch - colour).max(axis=-1) < 60).sum() > 20
        assert (patch.max(axis=-1) < 60).any()
    assert not np.array_equal(picture, ground)


def test_no_axis_is_drawn_over_a_name_nor_over_its_own_letter() -> None:
    K = np.array([[800.0, 0, 640], [0, 800, 512], [0, 0, 1]])
    camera = PinholeCamera(K, np.zeros(5), (1280, 1024), np.eye(4))
    body = Body("axes", tuple(PointFeature(at) for at in np.eye(4, 3, -1) * 200))
    # its z axis, and less of its x axis, goes all around in the image
    tilted = from_rotation_vector([np.pi / 2, 0.0, 0.0], np.zeros(3))
    names = []
    for turn in np.arange(8) * np.pi / 4:
        T = from_rotation_vector([0.0, 0.0, turn], [0.0, 0.0, 600.0]) @ tilted
        picture = draw_pose(BLACK, camera, body, T, colour=(255, 255, 255))
        # the name of the feature at the origin, to the upper right of its ring
        names.append((picture[480:508, 650:675] == 255).all(axis=-1).sum())
        for k in (0, 2):
            ends = np.stack([np.zeros(3), 0.5 * body.radius * np.eye(3)[k]])
            start, end = camera.project(transform(T, ends))[0]
            length, along = float(np.linalg.norm(end - start)), end - start
            # its letter stands beyond the end
            v, u = np.nonzero((picture == AXES[k][1]).all(axis=-1))
            away = np.stack([u, v], axis=1) - start
            assert (away @ along / length - length > 6).sum() > 20
            # nor is the axis drawn over the feature at the origin, nor over its ring
            assert np.linalg.norm(away, axis=1).min() > 15
    assert min(names) > 0.9 * max(names) > 20


def test_the_frame_that_is_drawn_on_stays_as_it_is(
    paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    ground = BLACK.copy()
    draw_pose(ground, pinhole_cameras[0], paper_body, np.eye(4), np.eye(6), "ok", 3)
    assert not ground.any()


def test_a_lost_frame_gets_its_status_and_no_features(
    paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    picture = draw_pose(BLACK, pinhole_cameras[0], paper_body, None, status="lost", frame=7)
    rows, columns = np.nonzero(picture.any(axis=-1))
    assert len(rows) > 50
    assert rows.max() < 60
    assert 0.25 * line_height(picture) < columns.min() < columns.max() < 400  # with a margin


def test_a_resized_part_of_the_frame_has_its_marks_where_the_features_went(
    paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    # the middle of the pixel (10, 20), three times as large, is three pixels wide
    assert Part(3.0, (10.0, 20.0)).places(np.array([10.0, 20.0])).tolist() == [1.0, 1.0]
    assert Part(0.5).places(np.array([0.5, 0.5])).tolist() == [0.0, 0.0]
    # 200 by 50 pixels fit into a square by their width, in the middle of its height
    wide = fitted((np.array([10.0, 20.0]), np.array([209.0, 69.0])), (100, 100))
    assert (wide.zoom, wide.corner) == (0.5, (10.0, -55.0))


def test_projected_covariances_are_those_of_drawn_poses(
    paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    camera, T = pinhole_cameras[0], np.eye(4)
    generator = np.random.default_rng(0)
    root = generator.normal(size=(6, 6)) * np.repeat([0.05, 5e-4], 3)[:, None]
    covariance = root @ root.T
    twists = generator.multivariate_normal(np.zeros(6), covariance, size=20_000)
    drawn, _ = camera.project(transform(perturb(T, twists), paper_body.means))
    sampled = np.array([np.cov(drawn[:, i].T) for i in range(len(paper_body))])
    propagated = projected_covariances(camera, paper_body, T, covariance)
    # 20 000 samples leave 1 % per entry
    assert np.abs(propagated - sampled).max() < 0.05 * np.abs(sampled).max()


@pytest.mark.parametrize("of_images", [True, False])
def test_a_body_that_is_small_in_its_frame_is_drawn_larger_in_a_corner(of_images: bool) -> None:
    session = mixpose.load_session(SYNTHETIC / "two_cameras" / "session.toml")
    camera: Any = session.sensors[0].sensor
    setup = replace(session.sensors[0], sensor=replace(camera, T_sensor_world=np.eye(4)))
    alone = replace(session, sensors=(setup,))

    def drawn(distance: float) -> NDArray[np.uint8]:
        T = from_parts(np.eye(3), np.array([0.0, 0.0, distance]))
        points = setup.sensor.project(transform(T, session.body.means))[0]
        image = np.full((512, 640), 40, np.uint8)
        for u, v in np.rint(points).astype(int):
            image[v, u] = 250
        data = image if of_images else PointPattern(points, np.ones(len(points)))
        frames = FrameSet(0, None, {setup.name: RawFrame(0, None, data)})
        one = Estimate(0, None, session.labels[0], "ok", T, None, 1.0, {})
        return draw_scene(alone, frames, one)

    # the body is amid the frame; 0.4 of its shorter side have it once more, in the lower left
    green = np.array(STATUS_COLOURS["ok"], dtype=np.int64)
    far, near = (drawn(distance)[-380:-20, 20:380] for distance in (4000.0, 1500.0))
    marked = [(np.abs(one - green) < 40).all(axis=2).sum() for one in (far, near)]
    # seven rings of at least as many pixels each
    assert marked[0] > 7 * 20
    assert marked[1] == 0


def test_the_ellipse_holds_95_percent() -> None:
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    outline = ellipse_95(covariance)
    squared = np.einsum("ni,ij,nj->n", outline, np.linalg.inv(covariance), outline)
    np.testing.assert_allclose(squared, CHI2_95[2])
    samples = np.random.default_rng(1).multivariate_normal([0, 0], covariance, 50_000)
    inside = np.einsum("ni,ij,nj->n", samples, np.linalg.inv(covariance), samples) < CHI2_95[2]
    assert inside.mean() == pytest.approx(0.95, abs=0.005)


def test_large_ellipses_are_drawn_and_infinite_ones_are_not(
    paper_body: Body, pinhole_cameras: list[PinholeCamera]
) -> None:
    camera = pinhole_cameras[0]
    plain = draw_pose(BLACK, camera, paper_body, np.eye(4), None, "ok")
    sharp = draw_pose(BLACK, camera, paper_body, np.eye(4), 1e-8 * np.eye(6), "ok")
    vague = draw_pose(BLACK, camera, paper_body, np.eye(4), np.diag([100.0] * 3 + [0.0] * 3), "ok")
    unknown = draw_pose(BLACK, camera, paper_body, np.eye(4), np.diag([np.inf] * 6), "ok")
    assert np.array_equal(plain, sharp)
    assert np.array_equal(plain, unknown)
    assert (vague != plain).any(axis=-1).sum() > 1000


def test_a_few_small_spots_in_a_dark_frame_are_white_and_the_rest_is_not_black() -> None:
    frame = np.full((1200, 1600), 6, np.uint8)
    frame[::2] = 9
    frame[600:605, 800:805] = 70
    frame[100:105, 300:305] = 60
    picture = displayable(frame)
    assert picture[602, 802].tolist() == [255, 255, 255]
    assert picture[102, 302, 0] > 220
    assert 20 < picture[700:720, 100:120].mean() < 120


def test_dark_spots_on_a_bright_frame_stay_dark() -> None:
    frame = np.full((480, 640), 250, np.uint8)
    frame[100:106, 100:106] = 120
    picture = displayable(frame)
    assert picture[103, 103, 0] == 0
    assert picture[300, 300, 0] == 255


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.float32])
def test_an_even_frame_of_any_type_is_shown_without_a_fault(kind: type) -> None:
    assert displayable(np.full((40, 50), 3, kind)).shape == (40, 50, 3)


def test_a_run_is_watched_frame_by_frame_and_finds_the_same_poses(recording: Path) -> None:
    session = mixpose.load_session(recording / "session.toml")
    watched: list[tuple[int, list[str], list[str], int]] = []

    def watch(frame_set: FrameSet, views: Sequence[View], estimate: Estimate) -> None:
        names = [view.name for view in views]
        watched.append((frame_set.number, list(frame_set.frames), names, estimate.frame))

    plain = list(run(session))
    seen: list[Estimate] = []
    for estimate in run(session, watch=watch):
        assert len(watched) == len(seen) + 1  # before the estimate is handed out
        seen.append(estimate)
    assert watched == [(n, ["left", "right"], ["left", "right"], n) for n in range(4)]
    for one, other in zip(plain, seen, strict=True):
        assert np.array_equal(one.T_world_object, other.T_world_object)  # type: ignore[arg-type]


def test_a_folder_gets_a_picture_per_frame_and_resume_goes_on(recording: Path) -> None:
    session, poses, folder = recording / "session.toml", recording / "p.jsonl", recording / "seen"
    assert command("run", session, "-o", poses, "--overlay", folder, "--stop", 2) == 0
    first = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert sorted(first) == ["overlay_000000.png", "overlay_000001.png"]
    assert command("run", session, "-o", poses, "--overlay", folder, "--resume") == 0
    assert sorted(path.name for path in folder.iterdir()) == [
        f"overlay_{n:06d}.png" for n in range(4)
    ]
    assert (folder / "overlay_000000.png").stat().st_mtime_ns == first["overlay_000000.png"]
    picture = cv2.imread(str(folder / "overlay_000003.png"))
    assert picture is not None
    assert picture.shape == (512, 2 * 640 + 4, 3)


def test_a_new_run_replaces_the_pictures_of_the_last(recording: Path) -> None:
    session, folder = recording / "session.toml", recording / "seen"
    assert command("run", session, "-o", recording / "p.jsonl", "--overlay", folder) == 0
    (folder / "notes.txt").write_text("mine", encoding="utf-8")
    arguments = ("-o", recording / "p.jsonl", "--overlay", folder, "--start", 3)
    assert command("run", session, *arguments) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["notes.txt", "overlay_000003.png"]


@pytest.mark.parametrize("suffix", [".mp4", ".avi", ".mkv"])
def test_a_video_has_every_frame_at_the_recordings_rate_and_may_be_rewritten(
    suffix: str, recording: Path
) -> None:
    video = recording / f"seen{suffix}"
    for _ in range(2):  # the second time over its own
        arguments = ("-o", recording / "p.jsonl", "--overlay", video)
        assert command("run", recording / "session.toml", *arguments) == 0
    assert is_ours(video)
    capture = cv2.VideoCapture(str(video))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(25, abs=0.1)
    count = 0
    while capture.read()[0]:
        count += 1
    assert count == 4


def test_frames_that_are_missing_at_the_beginning_do_not_slow_a_video(tmp_path: Path) -> None:
    sink = VideoSink(tmp_path / "seen.avi")
    for frame in (0, 4, 5, 6, 7):
        sink.add(np.zeros((48, 64, 3), np.uint8), frame, frame / 25)
    sink.close()
    capture = cv2.VideoCapture(str(tmp_path / "seen.avi"))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(25, abs=0.1)
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 5


@pytest.mark.parametrize(
    ("overlay", "options", "words"),
    [
        ("seen.mp4", ["--resume"], "cannot go on in a video; name a folder"),
        ("seen.gif", [], "found the extension .gif, allowed are .mp4, .mkv, .avi"),
        ("nowhere/seen.mp4", [], "there is no folder"),
        ("film.mp4", [], "holds something that mixpose did not write"),
        (".", [], "holds left0000.png, which mixpose did not write"),
    ],
)
def test_a_place_for_the_overlay_that_will_not_do_is_one_line(
    overlay: str,
    options: list[str],
    words: str,
    recording: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (recording / "film.mp4").write_bytes(b"somebody's film")
    poses = recording / "p.jsonl"
    session = recording / "session.toml"
    assert command("run", session, "-o", poses, "--overlay", recording / overlay, *options) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    assert words in error
    assert not poses.exists()
    assert (recording / "film.mp4").read_bytes() == b"somebody's film"


def test_ranges_are_drawn_as_strips_of_one_size(tmp_path: Path) -> None:
    session = mixpose.load_session(SYNTHETIC / "range_profiles" / "session.toml")
    with Overlay(session, tmp_path / "seen") as overlay:
        estimates = list(run(session, selection=Selection(0, 2), watch=overlay.watch))
    pictures = [cv2.imread(str(path)) for path in sorted((tmp_path / "seen").iterdir())]
    assert len(pictures) == len(estimates) == 2
    shapes = {picture.shape for picture in pictures if picture is not None}
    assert shapes == {(36 + 3 * (130 + 4), 960, 3)}


def test_ranges_of_a_body_far_away_are_drawn_apart() -> None:
    points = ((0.2, 0.15, 0.0), (-0.1, 0.14, 0.0), (-0.07, -0.14, 0.0))
    body = Body("trolley", tuple(PointFeature(np.array(point)) for point in points))
    ranges = PointPattern(np.array([[63.67], [63.98], [64.06]]), np.ones(3))
    lost = Estimate(0, None, "trolley", "lost", None, None, 0.0, {})
    strip = draw_ranges("anchor", ranges, RangeSensor(np.zeros(3)), body, lost)
    bars = np.flatnonzero((strip[70] == MEASURED).all(axis=-1))
    places = [group.mean() for group in np.split(bars, np.flatnonzero(np.diff(bars) > 1) + 1)]
    # the body is 0.45 across, so that the scale goes by whole units: 63 to 65 on 928 px
    assert np.diff(places) == pytest.approx([0.31 * 464, 0.08 * 464], abs=2)


def test_a_sensor_without_a_frame_keeps_its_place_in_the_picture(recording: Path) -> None:
    session = mixpose.load_session(recording / "session.toml")
    scenes: list[NDArray[np.uint8]] = []

    def watch(frame_set: FrameSet, views: Sequence[View], estimate: Estimate) -> None:
        alone = replace(frame_set, frames={"left": frame_set.frames["left"]})
        scenes.extend(draw_scene(session, one, estimate) for one in (frame_set, alone))

    list(run(session, selection=Selection(0, 1), watch=watch))
    whole, half = scenes
    assert whole.shape == half.shape
    assert np.array_equal(whole[:, :640], half[:, :640])
    assert not np.array_equal(whole[:, 644:], half[:, 644:])


def test_a_camera_of_no_known_size_has_room_for_what_it_found() -> None:
    session = mixpose.load_session(SYNTHETIC / "two_cameras" / "session.toml")
    setup = replace(session.sensors[0], resolution=None)
    for points, size in ((np.array([[905.0, 705.0]]), (776, 996)), (np.empty((0, 2)), (480, 640))):
        frame = RawFrame(0, None, PointPattern(points, np.ones(len(points))))
        assert backdrop(setup, frame, None)[0].shape[:2] == size


def test_a_folder_that_cannot_be_written_is_an_error_of_one_line(tmp_path: Path) -> None:
    session = mixpose.load_session(SYNTHETIC / "two_cameras" / "session.toml")
    overlay = Overlay(session, tmp_path / "seen")
    (tmp_path / "seen").write_text("in the way", encoding="utf-8")
    lost = Estimate(0, None, "tracker", "lost", None, None, 0.0, {"left": SensorReport(False)})
    with pytest.raises(SessionError, match=re.escape("seen: cannot be written")):
        overlay.watch(FrameSet(0, None, {}), [], lost)


def test_all_pictures_of_a_camera_without_a_resolution_are_of_one_size(tmp_path: Path) -> None:
    session = mixpose.load_session(SYNTHETIC / "two_cameras" / "session.toml")
    setup = replace(session.sensors[0], resolution=None)
    session = replace(session, sensors=(setup,))
    folder = tmp_path / "seen"
    with Overlay(session, folder) as overlay:
        for number, far in enumerate((400.0, 905.0, 200.0)):
            pattern = PointPattern(np.array([[far, far]]), np.ones(1))
            frame_set = FrameSet(number, None, {setup.name: RawFrame(number, None, pattern)})
            lost = Estimate(number, None, session.labels[0], "lost", None, None, 0.0, {})
            overlay.watch(frame_set, [], lost)
    pictures = [cv2.imread(str(path)) for path in folder.iterdir()]
    assert len({one.shape for one in pictures if one is not None}) == 1
    assert len(pictures) == 3
