"""Frames of a report: of a body that is small in its image the surroundings are shown."""

from __future__ import annotations

import base64
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from report_runs import RECORDING, estimate, write

from mixpose.poses.jsonl import read_poses
from mixpose.report.overlays import Shot, overlay_frames
from mixpose.report.series import series_of
from mixpose.rigid import inverse, transform
from mixpose.session import load_session

WIDTH, HEIGHT = 640, 512


def shot_of_left(folder: Path, away: float) -> tuple[Shot, float]:
    """What the first frame of the left camera is shown as, with a pose that much farther away.

    And the larger of the shares of the image's width and height that the body's points span.
    """
    session, truth = load_session(RECORDING / "session.toml"), read_poses(RECORDING / "truth.jsonl")
    sensor = session.sensors[0].sensor
    T_sensor_world: np.ndarray = sensor.T_sensor_world  # type: ignore[attr-defined]
    assert truth.poses[0].T_world_object is not None
    T_sensor_object = T_sensor_world @ truth.poses[0].T_world_object
    T_sensor_object[:3, 3] *= away
    T = inverse(T_sensor_world) @ T_sensor_object
    poses = read_poses(write(folder / "p.jsonl", [estimate(0, T)], RECORDING / "session.toml"))
    ((frame,), notices) = overlay_frames(session, poses, series_of(poses), None)
    assert not notices
    y, seen = sensor.project(transform(T, session.body.means))
    assert seen.all()
    return frame.shots[0], float((np.ptp(y, axis=0) / [WIDTH, HEIGHT]).max())


def test_poses_are_drawn_on_the_recording_that_the_run_read(tmp_path: Path) -> None:
    session, truth = load_session(RECORDING / "session.toml"), read_poses(RECORDING / "truth.jsonl")
    T = truth.poses[0].T_world_object
    assert T is not None
    (tmp_path / "tuesday").mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
    cv2.imwrite(str(tmp_path / "tuesday" / "left0000.png"), noise)
    named = write(tmp_path / "p.jsonl", [estimate(0, T)], RECORDING / "session.toml")

    def shown(**sources: str) -> tuple[dict[str, float], list[str]]:
        poses = read_poses(named)
        poses = replace(poses, header={**poses.header, "sources": sources})
        frames, notices = overlay_frames(session, poses, series_of(poses), None)
        return {shot.sensor: brightness(shot) for frame in frames for shot in frame.shots}, notices

    found, notices = shown(left=str(tmp_path / "tuesday"))
    assert not notices
    assert found["left"] > 100
    assert found["right"] < 50
    # a recording that is gone is no reason to show another one, nor is a stream
    found, (notice,) = shown(left=str(tmp_path / "wednesday"))
    assert found.keys() == {"right"}
    assert "recording of left cannot be read again" in notice
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        assert shown(left=str(tmp_path / "pipe")) == (found, [])
    if Path("/dev/null").exists():
        assert shown(left="/dev/null") == (found, [])  # a device, as cameras are
    for live in ("udp://there:1234", "camera:0"):
        assert shown(left=live) == (found, [])


def brightness(shot: Shot) -> float:
    jpeg = np.frombuffer(base64.b64decode(shot.uri.partition(",")[2]), np.uint8)
    image = cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return float(image.mean())


@pytest.mark.parametrize(("away", "least"), [(1.0, None), (2.0, None), (20.0, 120 / WIDTH)])
def test_the_part_that_is_shown_is_twice_as_large_as_the_body_and_no_grains(
    away: float, least: float | None, tmp_path: Path
) -> None:
    shot, spanned = shot_of_left(tmp_path, away)
    share = 2 * spanned if least is None else least
    assert (2 * spanned < 120 / WIDTH) == (least is not None)
    assert shot.is_part
    # whole pixels of the camera, of the share's width
    assert shot.zoom == pytest.approx(min(720 / np.ceil(share * WIDTH), 4.0), rel=0.02)
    assert shot.width / shot.zoom == pytest.approx(share * WIDTH, abs=1.5)
    assert shot.height / shot.width == pytest.approx(HEIGHT / WIDTH, rel=0.02)
