"""The recordings in data/synthetic are those that tools/make_synthetic.py writes."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from mixpose.frames import read_image
from mixpose.poses.jsonl import read_poses
from mixpose.rigid import rotation_angle_deg
from mixpose.session import load_session
from mixpose.simulation import simulate

ROOT = Path(__file__).resolve().parents[1]
NAMES = [
    *("camera_and_ranges", "one_camera_video", "parallel_beams", "range_profiles", "real_room"),
    *("several_bodies", "two_cameras"),
]


def _tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "make_synthetic", ROOT / "tools/make_synthetic.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


TOOL = _tool()


def test_every_recording_is_there_and_all_are_small() -> None:
    assert sorted(TOOL.RECORDINGS) == NAMES
    assert sorted(path.name for path in TOOL.FOLDER.iterdir() if path.is_dir()) == NAMES
    sizes = [path.stat().st_size for path in TOOL.FOLDER.rglob("*") if path.is_file()]
    assert sum(sizes) < 6_000_000


@pytest.mark.parametrize("name", NAMES)
def test_the_first_frames_come_out_anew(name: str, tmp_path: Path) -> None:
    recording = TOOL.RECORDINGS[name]
    draft = tmp_path / "session.toml"
    draft.write_text(recording.session, encoding="utf-8", newline="\n")
    out, kept = tmp_path / "out", TOOL.FOLDER / name
    simulate(load_session(draft), out, replace(recording.options, frames=2))
    assert (out / "session.toml").read_bytes() == (kept / "session.toml").read_bytes()
    new, old = (read_poses(folder / "truth.jsonl").poses for folder in (out, kept))
    assert len(old) == recording.options.frames * len(load_session(draft).labels)
    for one, other in zip(new, old, strict=False):
        assert one.T_world_object is not None
        assert other.T_world_object is not None
        np.testing.assert_allclose(one.T_world_object, other.T_world_object, atol=1e-9)
    for path in (*out.glob("*.png"), *out.glob("*.jpg")):
        assert np.array_equal(read_image(path), read_image(kept / path.name))
    for path in out.glob("*.npy"):
        np.testing.assert_allclose(np.load(path), np.load(kept / path.name)[:2], atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_motion_can_be_followed_and_starts_are_near_but_not_exact(name: str) -> None:
    session = load_session(TOOL.FOLDER / name / "session.toml")
    truth = read_poses(TOOL.FOLDER / name / "truth.jsonl")
    for one in session.objects:
        for label in one.labels:
            found = [pose.T_world_object for pose in truth.poses if pose.label == label]
            poses = np.array(found)
            middles = poses[:, :3, :3] @ one.body.means.mean(axis=0) + poses[:, :3, 3]
            assert np.linalg.norm(np.diff(middles, axis=0), axis=1).max() <= 5.1
            assert rotation_angle_deg(poses[:-1], poses[1:]).max() <= 3.0
            assert rotation_angle_deg(poses[:1], poses).max() > 15
    if session.start is not None:
        T = session.start.T_world_object
        assert 2 <= rotation_angle_deg(T, poses[0]) <= 3.1
        assert 1 <= np.linalg.norm(T[:3, 3] - poses[0, :3, 3]) <= 8


@pytest.mark.parametrize("name", NAMES)
def test_only_the_object_of_the_paper_looks_alike_in_several_poses(name: str) -> None:
    session = load_session(TOOL.FOLDER / name / "session.toml")
    is_of_the_paper = session.body.name == "six-points"
    assert len(session.body.symmetries) == (6 if is_of_the_paper else 1)
