"""Many recordings on a local dask.distributed cluster, one of whose workers is killed midway.

    python tools/cluster_trial.py [--recordings 30] [--workers 3] [--frames 40] [--throughput]

Tables of detections are simulated, run by `mixpose run --scheduler ADDRESS` while a worker is
killed, and compared with what a run of each by itself writes, byte for byte but for the latency.
With --throughput, one worker and two take turns on the same recordings, and the median of the
ratios of their times is told.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

from kills import without_latency

from mixpose.session import load_session
from mixpose.simulation import SimulationOptions, simulate

ROUNDS = 3  # of the measurement of throughput
PATIENCE_S = 300.0

SESSION = """unit = "mm"
[object]
name = "body"
points = [[0, -25, -43.3], [100, -25, -43.3], [0, 61.6, -93.3], [100, 111.6, -6.7], [60, 25, 43.3]]
[[sensor]]
name = "left"
model = "pinhole"
source = "left.csv"
fps = 30
camera_matrix = [[900, 0, 639.5], [0, 900, 511.5], [0, 0, 1]]
resolution = [1280, 1024]
rotation_vector = [0, 0, 0]
translation = [0, 0, 900]
[[sensor]]
name = "right"
model = "pinhole"
source = "right.csv"
fps = 30
camera_matrix = [[900, 0, 639.5], [0, 900, 511.5], [0, 0, 1]]
resolution = [1280, 1024]
rotation_vector = [0, 1.0, 0]
translation = [0, 0, 900]
"""


def mixpose(*arguments: str | Path) -> list[str]:
    """The command line of mixpose."""
    return [sys.executable, "-m", "mixpose", *map(str, arguments)]


def make_recordings(folder: Path, count: int, frames: int) -> list[Path]:
    """Sessions with tables of their own, simulated."""
    plan = folder / "plan.toml"
    plan.write_text(SESSION, encoding="utf-8")
    session, sessions = load_session(plan), []
    for k in range(count):
        place = folder / f"recording{k:03d}"
        simulate(session, place, SimulationOptions(frames=frames, seed=k, clutter=1.0))
        sessions.append(place / "session.toml")
    return sessions


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and workers of one thread each: its address and their processes."""
    file = folder / "scheduler.json"
    file.unlink(missing_ok=True)
    started = [_dask("scheduler", "--port", "0", "--scheduler-file", str(file), "--no-dashboard")]
    try:
        deadline = time.monotonic() + PATIENCE_S
        while not file.exists() or not file.read_text(encoding="utf-8").strip():
            if time.monotonic() > deadline or started[0].poll() is not None:
                raise RuntimeError("no scheduler came up")
            time.sleep(0.05)
        address = json.loads(file.read_text(encoding="utf-8"))["address"]
        options = ("--nthreads", "1", "--no-nanny", "--no-dashboard")
        started += [_dask("worker", address, *options) for _ in range(workers)]
        yield address, started[1:]
    finally:
        for process in started:
            process.kill()
            process.wait()


def _dask(what: str, *options: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", f"distributed.cli.dask_{what}", *options]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def done_in(folder: Path) -> list[str]:
    """Names of the recordings that are done."""
    return sorted(path.parent.name for path in folder.glob("[!.]*/status.json"))


def run_and_kill(sessions: list[Path], folder: Path, workers: int) -> tuple[int, int]:
    """Run recordings on a cluster and kill a worker midway: exit status, and how many were done."""
    poses = folder / "poses"
    with cluster(folder, workers) as (address, processes):
        command = mixpose("run", *sessions, "-o", poses, "--scheduler", address)
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + PATIENCE_S
        while len(done_in(poses)) < len(sessions) // 3 and process.poll() is None:
            if time.monotonic() > deadline:
                raise RuntimeError("the cluster does nothing")
            time.sleep(0.02)
        midway = len(done_in(poses))
        processes[0].kill()
        return process.wait(PATIENCE_S), midway


def same_alone(session: Path, poses: Path, folder: Path) -> bool:
    """Whether poses are those of a run of their session by itself."""
    alone = folder / "alone.jsonl"
    subprocess.run(mixpose("run", session, "-o", alone), check=True, capture_output=True)
    return without_latency(alone) == without_latency(poses)


def throughput(sessions: list[Path], folder: Path) -> float:
    """Median over rounds of the time of one worker over that of two."""
    ratios = []
    for k in range(ROUNDS):
        times = []
        for workers in (1, 2):
            with cluster(folder, workers) as (address, _):
                poses = folder / f"poses_{k}_{workers}"
                began = time.monotonic()
                command = mixpose("run", *sessions, "-o", poses, "--scheduler", address)
                subprocess.run(command, check=True, capture_output=True)
                times.append(time.monotonic() - began)
        ratios.append(times[0] / times[1])
        print(f"one worker {times[0]:.1f} s, two workers {times[1]:.1f} s: {ratios[-1]:.2f}")
    return median(ratios)


def main() -> int:
    parser = argparse.ArgumentParser(description="Many recordings on a local cluster.")
    parser.add_argument("--recordings", type=int, default=30)
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--throughput", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sessions = make_recordings(folder, options.recordings, options.frames)
        if options.throughput:
            print(f"median: {throughput(sessions, folder):.2f} times as fast with two workers")
            return 0
        status, midway = run_and_kill(sessions, folder, options.workers)
        found = done_in(folder / "poses")
        same = sum(
            same_alone(session, folder / "poses" / session.parent.name / "poses.jsonl", folder)
            for session in sessions
            if session.parent.name in found
        )
    count = len(sessions)
    print(
        f"{count} recordings, {options.workers} workers, one killed when {midway} were done: exit "
        f"status {status}, {len(found)} results, {same} the same as alone"
    )
    return 0 if (status, len(found), same) == (0, count, count) else 1


if __name__ == "__main__":
    sys.exit(main())
