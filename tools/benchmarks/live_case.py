"""From a raw frame in a pipe to its pose at a receiver, and what a receiver that stalls costs.

Writer, run and receiver are processes of their own; they share the steady clock of the machine.
"""

from __future__ import annotations

import argparse
import os
import resource
import socket
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import closing
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.recordings import session_text, simulated
from benchmarks.timing import show
from mixpose.frames import read_image
from mixpose.session import Session
from mixpose.simulation import SimulationOptions

FRAMES, FPS = 500, 100.0
SETTLED = 50
"""Frames after which a run has caught up with what waited while it started."""
RESOLUTION, FOCAL = (640, 480), 700.0
ROUNDS = 5
MOTION = SimulationOptions(
    frames=FRAMES, fps=FPS, amplitude_translation=30.0, amplitude_rotation_deg=10.0
)

# the receiver says of each frame when its pose came
RECEIVER = """
import json, socket, sys, time
receiving = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
receiving.bind(("127.0.0.1", int(sys.argv[1])))
print("ready", flush=True)
while True:
    data, at = receiving.recv(65536), time.monotonic()
    print(json.loads(data).get("frame"), at, flush=True)
"""


def run(_: argparse.Namespace) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        text = session_text(['"image*.png"'], RESOLUTION, FOCAL, fps=FPS)
        session = simulated(folder / "images", text, MOTION)
        images = [read_image(path) for path in sorted(session.folder.glob("image*.png"))]
        late = 1e3 * latencies(session, np.stack(images), folder)
        ratio, seconds = stalled_ratio(session, folder)
    print(
        f"live: one camera of {RESOLUTION[0]}x{RESOLUTION[1]} pixels, {FPS:g} raw frames a second"
    )
    settled = late[SETTLED:]
    figures = {
        "median_ms": float(np.median(settled)),
        "p99_ms": float(np.quantile(settled, 0.99)),
        "first_ms": float(late[:SETTLED].max()),
        "received": len(late),
        "stalled_ratio": ratio,
        "run_s": seconds,
    }
    show("frame in the pipe to pose at a receiver, median, ms", figures["median_ms"], at_most=5)
    show("the same, 99 %", figures["p99_ms"], at_most=15)
    show(f"the longest of the first {SETTLED} frames, while the run starts", figures["first_ms"])
    show("processor time of a run with a receiver that never reads / without", ratio, at_most=1.05)
    return figures


def latencies(session: Session, images: Any, folder: Path) -> Any:
    """Seconds (FRAMES,) from the moment when a frame begins to be written to its pose received."""
    pipe, port = folder / "camera", free_port()
    os.mkfifo(pipe)
    receiver = subprocess.Popen(
        [sys.executable, "-c", RECEIVER, str(port)], stdout=subprocess.PIPE, text=True
    )
    assert receiver.stdout is not None
    receiver.stdout.readline()
    came: dict[str, float] = {}

    def listen() -> None:
        assert receiver.stdout is not None
        for line in receiver.stdout:
            frame, at = line.split()
            came[frame] = float(at)

    listening = threading.Thread(target=listen)
    listening.start()
    name = session.sensors[0].name
    command = [sys.executable, "-m", "mixpose", "run", str(session.path), "-o", os.devnull]
    command += ["--source", f"{name}={pipe}", "--publish", f"udp://127.0.0.1:{port}"]
    process = subprocess.Popen(command)
    sent = write(pipe, images)
    process.wait()
    time.sleep(0.5)
    receiver.terminate()
    listening.join()
    return np.array([came[str(k)] - at for k, at in enumerate(sent) if str(k) in came])


def write(pipe: Path, images: Any) -> list[float]:
    """Write images as a camera gives them; when each began to be written."""
    sent = []
    with pipe.open("wb", buffering=0) as stream:
        height, width = images.shape[1:]
        stream.write(f"YUV4MPEG2 W{width} H{height} F{FPS:g}:1 Ip A1:1 Cmono\n".encode())
        began = time.monotonic()
        for k, image in enumerate(images):
            time.sleep(max(began + k / FPS - time.monotonic(), 0.0))
            sent.append(time.monotonic())
            left = memoryview(b"FRAME\n" + image.tobytes())
            while left:
                left = left[stream.write(left) :]
    return sent


def stalled_ratio(session: Session, folder: Path) -> tuple[float, float]:
    """Processor time of runs that publish to what never reads over that of others, in turns."""
    with closing(socket.create_server(("127.0.0.1", 0), backlog=64)) as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**14)
        url = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        command = [sys.executable, "-m", "mixpose", "run", str(session.path)]
        command += ["-o", str(folder / "poses.jsonl")]
        with_it, without = [], []
        for _ in range(ROUNDS):
            without.append(processor_s(command))
            with_it.append(processor_s([*command, "--publish", url]))
    return median(with_it) / median(without), median(without)


def processor_s(command: list[str]) -> float:
    """Seconds of processor time of a process."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def free_port() -> int:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
