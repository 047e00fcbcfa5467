"""Long runs of the command line: memory and processor time per frame, block by block.

    python tools/endurance.py [tables] [video] [--frames N] [--json FILE]

`tables` are detections of two cameras, 50,000 frames with a false one in each; `video` is an hour
of 160x120 px at 25 frames a second, 90,000 frames.  Each is run by `mixpose run`; what its process
holds and how much processor time it has taken is read from outside while the poses appear.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from benchmarks.long_run import resident_mb
from benchmarks.recordings import (
    EYES,
    MARKERS,
    session_text,
    simulated,
    write_mjpeg,
    write_session,
)
from benchmarks.search_cases import looking_at
from scipy.spatial.transform import Rotation

from mixpose.simulation import SimulationOptions

BLOCKS = 10
RESOLUTION, FOCAL, NOISE_PX = (640, 480), 900.0, 0.1
SMALL, SMALL_FOCAL, DIFFERENT, FPS = (160, 120), 340.0, 50, 25.0


@dataclass(frozen=True)
class Kind:
    """A recording and how many frames it has."""

    make: Callable[[Path, int], Path]
    frames: int


def tables(folder: Path, frames: int) -> Path:
    """Two cameras' tables of detections of a body that sways."""
    rng = np.random.default_rng(0)
    phase = np.arange(frames)[:, None] * [0.013, 0.017, 0.023]
    turns = Rotation.from_rotvec([0.2, -0.3, 0.4] + 0.15 * np.sin(phase))
    places = 20 * np.sin(1.3 * phase)
    points = np.einsum("kij,nj->kni", turns.as_matrix(), np.array(MARKERS)) + places[:, None]
    centre = (np.array(RESOLUTION) - 1) / 2
    for name, eye in zip(("left", "right"), EYES, strict=True):
        T = looking_at(np.array(eye), np.zeros(3))
        seen = points @ T[:3, :3].T + T[:3, 3]
        uv = FOCAL * seen[..., :2] / seen[..., 2:] + centre
        uv = np.concatenate([uv, rng.uniform(0, RESOLUTION, (frames, 1, 2))], axis=1)
        uv += rng.normal(0, NOISE_PX, uv.shape)
        numbers = np.repeat(np.arange(frames), uv.shape[1])
        rows = np.column_stack([numbers, uv.reshape(-1, 2)])
        header = "frame,u,v"
        np.savetxt(
            folder / f"{name}.csv",
            rows,
            fmt=("%d", "%.3f", "%.3f"),
            delimiter=",",
            header=header,
            comments="",
        )
    text = session_text(['"left.csv"', '"right.csv"'], RESOLUTION, FOCAL)
    return write_session(folder / "session.toml", text).path


def video(folder: Path, frames: int) -> Path:
    """A video of few images, which goes to and fro over them."""
    text = session_text(['"image*.png"'], SMALL, SMALL_FOCAL, fps=FPS)
    options = SimulationOptions(
        frames=DIFFERENT, spot_sigma=1.0, amplitude_translation=5.0, amplitude_rotation_deg=5.0
    )
    images = sorted(simulated(folder / "short", text, options).folder.glob("image*.png"))
    there_and_back = images + images[-2:0:-1]
    shown = [there_and_back[k % len(there_and_back)] for k in range(frames)]
    write_mjpeg(folder / "hour.avi", shown, FPS)
    text = session_text(['"hour.avi"'], SMALL, SMALL_FOCAL, fps=FPS)
    return write_session(folder / "session.toml", text).path


KINDS = {"tables": Kind(tables, 50_000), "video": Kind(video, 90_000)}


def processor_s(process: int) -> float:
    """Processor time that a process has taken."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def endured(session: Path, frames: int) -> dict[str, list[float]]:
    """Run a session: frames, MB and processor ms per frame of each block."""
    poses = session.parent / "poses.jsonl"
    command = [sys.executable, "-m", "mixpose", "run", str(session), "-o", str(poses)]
    found: dict[str, list[float]] = {"frames": [], "mb": [], "ms": []}
    done, before = -1, (0, 0.0)
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        while not poses.exists() and process.poll() is None:
            time.sleep(0.05)
        with poses.open("rb") as lines:
            while process.poll() is None:
                done += lines.read().count(b"\n")
                if done - before[0] >= 0.98 * frames // BLOCKS:
                    now = processor_s(process.pid)
                    size = resident_mb(process.pid)
                    found["frames"].append(done)
                    found["mb"].append(size)
                    found["ms"].append(1000 * (now - before[1]) / (done - before[0]))
                    print(
                        f"  {done:6} frames  {size:7.1f} MB  {found['ms'][-1]:.3f} ms", flush=True
                    )
                    before = (done, now)
                time.sleep(0.2)
        assert process.stderr is not None
        print(process.stderr.read().strip().splitlines()[-1])
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description="Long runs.")
    parser.add_argument("kinds", nargs="*", help=", ".join(KINDS))
    parser.add_argument("--frames", type=int, help="in place of 50,000 and 90,000")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    unknown = {*options.kinds} - {*KINDS}
    if unknown:
        parser.error(f"no such kind: {sorted(unknown)[0]}")
    results = {}
    for name in options.kinds or KINDS:
        kind = replace(KINDS[name], frames=options.frames or KINDS[name].frames)
        print(f"{name}: {kind.frames} frames")
        with tempfile.TemporaryDirectory() as folder:
            results[name] = endured(kind.make(Path(folder), kind.frames), kind.frames)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
