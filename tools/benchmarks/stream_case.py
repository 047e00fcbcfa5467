"""Frames per second of a whole run while tracking, against decoding alone with the same threads."""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from benchmarks.recordings import session_text, simulated, write_mjpeg, write_session
from benchmarks.timing import medians, show
from mixpose.cli.output import Output
from mixpose.cli.run import header_of
from mixpose.frames import pair
from mixpose.records import Estimate, FrameSet
from mixpose.runner import begin, observe, open_sources
from mixpose.runner import run as run_session
from mixpose.session import Session
from mixpose.simulation import SimulationOptions
from mixpose.threads import prompt_switching

FRAMES = 200
RESOLUTION = (1280, 1024)
FOCAL = 900.0
FPS = 50.0
AIMS = {"png": 0.9, "video": 0.8, "two_cameras_png": 0.9}


def run(_: argparse.Namespace) -> dict[str, Any]:
    figures: dict[str, Any] = {}
    with recordings() as sessions:
        for name, session in sessions.items():
            print(f"stream: {name}, {FRAMES} frames of {RESOLUTION[0]}x{RESOLUTION[1]}")
            figures |= {f"{name}_{key}": value for key, value in measured(session).items()}
            show("frames/s of the run / of decoding alone", figures[f"{name}_ratio"],
                 at_least=AIMS[name])  # fmt: skip
    return figures


def measured(session: Session) -> dict[str, float]:
    """Milliseconds per frame of a run, of decoding alone, and of each stage by itself."""
    seconds = medians(
        {"run": lambda: whole_run(session), "decoding": lambda: decode(session)}, rounds=3
    )
    stages = stage_times(session)
    ms = {name: 1e3 * s / FRAMES for name, s in (seconds | stages).items()}
    for name, value in ms.items():
        show(f"{name}, ms per frame", value)
    return {"ratio": seconds["decoding"] / seconds["run"], **{f"{k}_ms": v for k, v in ms.items()}}


@contextmanager
def recordings() -> Iterator[dict[str, Session]]:
    """One recording of two cameras as PNG, and its first camera alone as PNG and as a video."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        text = session_text(['"left*.png"', '"right*.png"'], RESOLUTION, FOCAL, fps=FPS)
        options = SimulationOptions(frames=FRAMES, amplitude_translation=30.0)
        two = simulated(folder / "two", text, options)
        write_mjpeg(folder / "left.avi", sorted(two.folder.glob("left*.png")), FPS)
        png = session_text(['"two/left*.png"'], RESOLUTION, FOCAL, fps=FPS)
        video = session_text(['"left.avi"'], RESOLUTION, FOCAL, fps=FPS)
        yield {
            "png": write_session(folder / "png.toml", png),
            "video": write_session(folder / "video.toml", video),
            "two_cameras_png": two,
        }


def whole_run(session: Session) -> list[Estimate]:
    """What `mixpose run` does, with a file that keeps nothing."""
    estimates = []
    with (
        prompt_switching(),
        closing(run_session(session)) as frames,
        Output(Path(os.devnull), "jsonl", header_of(session)) as output,
    ):
        for estimate in frames:
            output.write(estimate)
            estimates.append(estimate)
    assert [e.status for e in estimates] == ["ok"] * FRAMES, "this measures tracking"
    return estimates


def decode(session: Session) -> list[FrameSet]:
    """Only read the frames, ahead as a run does."""
    last: list[FrameSet] = []
    count = 0
    with closing(pair(open_sources(session, {}))) as frames:
        for frame in frames:
            last = [frame]
            count += 1
    assert count == FRAMES
    return last


def stage_times(session: Session) -> dict[str, float]:
    """Seconds of each stage over all frames, one after the other, without reading ahead."""
    sources = open_sources(session, {})
    sets = list(pair(open_sources(session, {})))
    observed = [observe(session, each) for each in sets]

    def read() -> None:
        for source in sources.values():
            for _ in source.frames():
                pass

    def extract() -> None:
        for each in sets:
            observe(session, each)

    def estimate() -> list[Estimate]:
        tracker, track = begin(session)
        found = []
        for each, views in zip(sets, observed, strict=True):
            track, one = tracker.advance(track, each.number, each.time_s, views)
            found.append(one)
        return found

    estimates = estimate()

    def write() -> None:
        with Output(Path(os.devnull), "jsonl", header_of(session)) as output:
            for each in estimates:
                output.write(each)

    tasks = {"stage_decode": read, "stage_extract": extract, "stage_estimate": estimate,
             "stage_write": write}  # fmt: skip
    return medians(tasks, rounds=1, warm_up=0)
