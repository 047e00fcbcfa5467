"""What pose lines say where something is wrong: explained, rms, status, and how far poses are off.

    python tools/fault_lines.py [CASE ...]

Each case is put into a copy of the recording of two cameras in `data/synthetic/` (40 frames, seven
markers), or into its session.  Means over the frames are of the cameras left and right; positions
(RMS), the squared error per dimension and the deviation (median) are of frames that are ok.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from faults import FAULTS, RECORDING, Change, image, instead, moved, points, rewritten
from turned_camera import turned

from mixpose.poses.evaluate import evaluate_files

PLACE = r"rotation_vector = .*\ntranslation = .*\n"


def longer_focal_length(folder: Path) -> None:
    """By a tenth, of the left camera."""
    rewritten((r"\[\[812\.4, (.*)\], \[0\.0, 811\.9, ", r"[[893.64, \1], [0.0, 893.09, "))(folder)


def numbered_one_too_high(folder: Path) -> None:
    """The images of the right camera; its first frame has none then."""
    instead("right", range(1, 40), lambda k: k - 1)(folder)
    image(folder, "right", 0).unlink()


CASES: dict[str, Change] = {
    "nothing": FAULTS["nothing"].change,
    "one marker measured 5 mm off": moved(3, (3.0, 0.0, 4.0)),
    "one marker measured 2 mm off": FAULTS["marker measured 2 mm wrong"].change,
    "body 1 % too small": points(lambda m: 0.99 * m),
    "left camera turned by 3° about its line of sight": turned("left", "z", 3),
    "right camera turned by 3° about its line of sight": turned("right", "z", 3),
    "left camera turned by 3° about x": turned("left", "x", 3),
    "right camera turned by 1° about y": turned("right", "y", 1),
    "focal length of the left camera 10 % too long": longer_focal_length,
    "T_sensor_world of the right camera left out": rewritten(
        (r'(name = "right"\n(?:.*\n)*?)' + PLACE, r"\g<1>")
    ),
    "body mirrored": FAULTS["body mirrored"].change,
    "images of the right camera numbered one too high": numbered_one_too_high,
}


def row(change: Change) -> list[str]:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "recording"
        shutil.copytree(RECORDING, folder)
        change(folder)
        command = [sys.executable, "-m", "mixpose", "run", "session.toml", "-o", "poses.jsonl"]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        text = (folder / "poses.jsonl").read_text(encoding="utf-8")
        lines = [json.loads(line) for line in text.splitlines()[1:]]
        found = evaluate_files(folder / "poses.jsonl", folder / "truth.jsonl")
    off = found.translation if found.ok == found.frames else found.ok_translation
    deviations = [
        float(np.sqrt(np.trace(np.array(line["covariance"])[:3, :3]) / 3))
        for line in lines
        if line["status"] == "ok"
    ]
    return [
        f"{found.ok} / {found.ambiguous} / {found.lost}",
        " and ".join(_mean(lines, side, "explained") for side in ("left", "right")),
        " and ".join(_mean(lines, side, "rms") for side in ("left", "right")) + " px",
        f"{off.rms:.2g} mm" if off is not None and found.ok else "",
        f"{found.nees.mean_per_dimension:.2g}" if found.nees is not None else "",
        f"{np.median(deviations):.2g} mm" if deviations else "",
    ]


def _mean(lines: list[dict[str, Any]], side: str, key: str) -> str:
    values = [line["sensors"].get(side, {}).get(key) for line in lines]
    known = [value for value in values if value is not None]
    return f"{np.mean(known):.2g}" if known else "none"


def main() -> None:
    unknown = [name for name in sys.argv[1:] if name not in CASES]
    if unknown:
        sys.exit(f"no such case: {unknown[0]}; allowed: {', '.join(CASES)}")
    print("| what is wrong | ok / ambiguous / lost | explained | rms | off | squared | deviation |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name in sys.argv[1:] or CASES:
        cells = [re.sub(r"\s+", " ", each) for each in row(CASES[name])]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
