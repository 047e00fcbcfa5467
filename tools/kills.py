"""Kill runs at random moments, resume them, and compare with runs that nobody disturbed.

    python tools/kills.py [SESSION ...] [--kills 100] [--seed 0]

Each run is killed (SIGKILL) a random moment after it has written a random number of lines, and
resumed, again and again until it ends by itself; then its poses must be those of an undisturbed
run, byte for byte but for the latency.  Without sessions, those of `data/synthetic/` take turns.
"""

from __future__ import annotations

import argparse
import random
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
NAMES = ("two_cameras", "one_camera_video", "parallel_beams", "range_profiles")
LATENCY = re.compile(rb'"latency_ms": [^,}]*')
MOST_LINES = 12  # between two kills
LONGEST_S = 0.05  # from the last of these lines to the kill
PATIENCE_S = 120.0


def run(session: Path, poses: Path, *options: str) -> subprocess.Popen[bytes]:
    """Start a run of a session."""
    command = [sys.executable, "-m", "mixpose", "run", str(session), "-o", str(poses), *options]
    return subprocess.Popen(command, stderr=subprocess.DEVNULL)


def without_latency(poses: Path) -> bytes:
    """The bytes of a poses file that must repeat."""
    return LATENCY.sub(b"", poses.read_bytes())


def killed(process: subprocess.Popen[bytes], poses: Path, rng: random.Random) -> bool:
    """Kill a process when it has written some more; False where it ended before."""
    before = poses.stat().st_size if poses.exists() else 0
    more = before + rng.randint(0, MOST_LINES) * 1000
    deadline = time.monotonic() + PATIENCE_S
    while process.poll() is None and time.monotonic() < deadline:
        if (poses.stat().st_size if poses.exists() else 0) > more:
            break
        time.sleep(0.001)
    time.sleep(rng.uniform(0, LONGEST_S))
    if process.poll() is not None:
        return False
    process.kill()
    process.wait()
    return True


def one_round(session: Path, folder: Path, rng: random.Random, most: int) -> tuple[int, bool]:
    """Kill and resume one run to its end; how many kills it took, and whether it is the same."""
    whole, parts = folder / "whole.jsonl", folder / "parts.jsonl"
    if not whole.exists() and run(session, whole).wait():
        raise RuntimeError(f"{session}: the undisturbed run failed")
    for path in (parts, parts.with_name(f".{parts.name}.state")):
        path.unlink(missing_ok=True)
    kills = 0
    while kills < most and killed(run(session, parts, "--resume"), parts, rng):
        kills += 1
    status = run(session, parts, "--resume").wait()
    return kills, status == 0 and without_latency(parts) == without_latency(whole)


def main() -> int:
    parser = argparse.ArgumentParser(description="Kill runs at random and resume them.")
    parser.add_argument("sessions", nargs="*", type=Path)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    sessions = options.sessions or [SYNTHETIC / name / "session.toml" for name in NAMES]
    rng = random.Random(options.seed)
    kills = rounds = same = 0
    with tempfile.TemporaryDirectory() as folder:
        while kills < options.kills:
            k = rounds % len(sessions)
            place = Path(folder) / str(k)
            place.mkdir(exist_ok=True)
            more, is_same = one_round(sessions[k], place, rng, options.kills - kills)
            kills, rounds, same = kills + more, rounds + 1, same + is_same
            print(f"{sessions[k]}: {more} kills, {'the same' if is_same else 'DIFFERENT'}")
    print(f"{kills} kills in {rounds} runs, {same} of them the same as undisturbed ones")
    return 0 if same == rounds else 1


if __name__ == "__main__":
    sys.exit(main())
