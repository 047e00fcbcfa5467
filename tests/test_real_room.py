"""The recording with the faults of real rigs: what its session tells is what poses need."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mixpose.rigid import twist_between
from mixpose.runner import run
from mixpose.session import load_session

FOLDER = Path(__file__).resolve().parents[1] / "data" / "synthetic" / "real_room"


def errors(session: Path) -> NDArray[np.float64]:
    """Distances in mm of the poses that are ok from the true ones."""
    lines = (FOLDER / "truth.jsonl").read_text(encoding="ascii").splitlines()[1:]
    truth = {line["frame"]: np.array(line["T_world_object"]) for line in map(json.loads, lines)}
    return np.array(
        [
            np.linalg.norm(twist_between(one.T_world_object, truth[one.frame])[:3])
            for one in run(load_session(session))
            if one.status == "ok" and one.T_world_object is not None
        ]
    )


def test_spheres_rolling_shutters_and_a_late_camera_are_what_the_session_says(
    tmp_path: Path,
) -> None:
    told = errors(FOLDER / "session.toml")
    # a lamp, another body, a table and an arm are before the cameras in all 20 frames
    assert len(told) >= 18
    # 0.02 mm where no marker is cut by the arm or another; such a frame is off by ten times as much
    assert np.median(told) < 0.04
    text = (FOLDER / "session.toml").read_text(encoding="utf-8")
    for key in ("readout = 0.02\n", "delay = 0.005\n", 'shape = "sphere"\n', "radius = 6.0\n"):
        text = text.replace(key, "")
    for name in ("left", "right"):
        text = text.replace(f'"{name}*.jpg"', json.dumps(str(FOLDER / f"{name}*.jpg")))
    untold = tmp_path / "session.toml"
    untold.write_text(text, encoding="utf-8")
    assert np.median(errors(untold)) > 10 * np.median(told)
