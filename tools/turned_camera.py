"""What two cameras notice of one that stands otherwise than its session says, and what they do not.

    python tools/turned_camera.py

In the recording of two cameras of `data/synthetic/` (40 frames) one is said to be turned about an
axis of its own: x (across), y (down) or z (its line of sight).  Printed are the frames that are ok,
how far off the worst of them is, the squared error per dimension of their covariances (right: 1),
and whether the run warns of anything.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from faults import RECORDING, Change, rewritten, turn

from mixpose.poses.evaluate import evaluate_files
from mixpose.session import load_session

DEGREES = (0.1, 0.3, 1, 3)


def turned(side: str, axis: str, degrees: float) -> Change:
    """A session that says that a camera is turned about an axis of its own."""

    def change(folder: Path) -> None:
        setup = next(s for s in load_session(folder / "session.toml").sensors if s.name == side)
        T = turn(axis, degrees) @ setup.sensor.T_sensor_world  # type: ignore[attr-defined]
        rows = ", ".join(str(row) for row in T.tolist())
        old = rf'(name = "{side}"\n(?:.*\n)*?)rotation_vector = .*\ntranslation = .*\n'
        rewritten((old, rf"\g<1>T_sensor_world = [{rows}]\n"))(folder)

    return change


def cell(side: str, axis: str, degrees: float) -> str:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "recording"
        shutil.copytree(RECORDING, folder)
        turned(side, axis, degrees)(folder)
        command = [sys.executable, "-m", "mixpose", "run", "session.toml", "-o", "poses.jsonl"]
        said = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
        found = evaluate_files(folder / "poses.jsonl", folder / "truth.jsonl")
    warned = "warned" if "warning" in said.stderr else "silent"
    if not found.ok:
        return f"0 ok, {warned}"
    angle, distance = found.rotation_deg, found.translation
    if found.ok < found.frames:
        angle, distance = found.ok_rotation_deg, found.ok_translation
    assert angle is not None
    assert distance is not None
    assert found.nees is not None
    off = f"{angle.max:.2g}°, {distance.max:.2g} mm"
    return f"{found.ok} ok: {off}, squared {found.nees.mean_per_dimension:.2g}, {warned}"


def main() -> None:
    print("| camera, axis | " + " | ".join(f"{degrees}°" for degrees in DEGREES) + " |")
    print("| --- |" + " --- |" * len(DEGREES))
    for side in ("left", "right"):
        for axis in "xyz":
            cells = [cell(side, axis, degrees) for degrees in DEGREES]
            print(f"| {side}, {axis} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
