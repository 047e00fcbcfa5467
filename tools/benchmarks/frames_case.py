"""What a frame costs beside decoding, in images as people have them and in the laboratory.

Frames are decoded before anything is timed, so that all processor time is that of `mixpose.run`:
extraction, the rest, and the functions of Python that a tracked frame calls.  Scenes are made by
the simulator, or are real recordings of the folder that MIXPOSE_RECORDINGS names.
"""

from __future__ import annotations

import argparse
import cProfile
import os
import pstats
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, TypeAlias
from unittest.mock import patch

import numpy as np
from make_synthetic import RECORDINGS, Recording

import mixpose
from benchmarks.recordings import EYES, session_text, simulated, write_mjpeg, write_session
from benchmarks.timing import PROCESSOR, show
from mixpose import runner
from mixpose.frames import Source
from mixpose.frames.source import SourceKind, selection
from mixpose.records import Estimate, RawFrame
from mixpose.session import Session, load_session
from mixpose.simulation import SimulationOptions

FRAMES, OF_REAL = 20, 600  # frames at most, of scenes that are made and of recordings
RESOLUTION, FOCAL = (1280, 1024), 900.0
MOTION = SimulationOptions(frames=FRAMES, amplitude_translation=30.0)
HAND = SimulationOptions(
    frames=FRAMES, amplitude_translation=25.0, amplitude_rotation_deg=22.0, background=20.0,
    noise=2.0, lamps=1, others=1, occluder=1, mirror=0.4,
)  # fmt: skip
PACKAGE = Path(mixpose.__file__).parent

Scene: TypeAlias = Callable[[Path], Session]


@dataclass(frozen=True)
class Held(Source):
    """A recording whose first frames are decoded already."""

    ahead: ClassVar[int] = 0
    source: Source
    held: tuple[RawFrame, ...]

    @property
    def kind(self) -> SourceKind:
        return self.source.kind

    @property
    def length(self) -> int:
        return len(self.held)

    @property
    def first(self) -> int | None:
        return self.held[0].number if self.held else None

    def describe(self) -> str:
        return self.source.describe()

    def caution(self) -> str | None:
        return self.source.caution()

    def check_times(self, wanted: range) -> None:
        pass

    def frames(
        self, start: int | None = None, stop: int | None = None, step: int = 1
    ) -> Generator[RawFrame, None, None]:
        wanted = selection(start, stop, step, self.first)
        yield from (frame for frame in self.held if frame.number in wanted)


def laboratory(folder: Path) -> Session:
    """Two cameras, eight bright markers in the dark."""
    text = session_text(['"a*.png"', '"b*.png"'], RESOLUTION, FOCAL)
    return simulated(folder / "laboratory", text, MOTION)


def video(folder: Path) -> Session:
    """One camera, the same, as a Motion JPEG video."""
    images = simulated(folder / "images", session_text(['"a*.png"'], RESOLUTION, FOCAL), MOTION)
    write_mjpeg(folder / "a.avi", sorted(images.folder.glob("a*.png")), 50.0)
    return write_session(folder / "video.toml", session_text(['"a.avi"'], RESOLUTION, FOCAL))


def hand(folder: Path) -> Session:
    """Three cameras; spheres before a lamp, another body, a polished table; arms in front."""
    sources = [f'"{name}*.png"' for name in "abc"]
    text = session_text(sources, RESOLUTION, FOCAL, shape='shape = "sphere"\nradius = 6.0')
    return simulated(folder / "hand", text, HAND)


def plate(folder: Path) -> Session:
    """One camera; a flat plate of twelve dark dots, given as points."""
    y, x = np.divmod(np.arange(12), 4)
    dots = 40.0 * np.stack([x - 1.5, np.zeros(12), y - 1.0], axis=1)  # seen along y
    dots[:, ::2] += np.random.default_rng(0).uniform(-9.0, 9.0, (12, 2))  # without symmetry
    text = session_text(['"a*.png"'], RESOLUTION, FOCAL, points=dots.tolist())
    text += 'extract = { polarity = "dark" }\n'
    options = replace(MOTION, background=200.0, brightness=150.0, noise=2.0, spot_sigma=4.0)
    return simulated(folder / "plate", text, options)


def sheet(folder: Path) -> Session:
    """Two cameras; a sheet of 450 dark dots, all alike but four, that is not quite flat."""
    y, x = np.divmod(np.arange(450), 25)
    large = np.isin(x, (8, 16)) & np.isin(y, (5, 12))
    # as bent, by their distance, as those of the real recording
    bent = np.random.default_rng(0).normal(0.0, 1.2, 450)
    dots = np.stack([20.0 * (x - 12.0), bent, 20.0 * (y - 8.5)], axis=1)  # seen along y
    radii = np.where(large, 9.0, 4.0).tolist()
    shape = f'shape = "disk"\nradius = {radii}\nnormals = {[[0, -1, 0]] * 450}'
    sources, size = [f'"{name}*.png"' for name in "ab"], (1920, 1440)
    text = session_text(sources, size, 2600.0, points=dots.tolist(), shape=shape, eyes=EYES[::3])
    text += '[extract]\npolarity = "dark"\n'
    options = replace(MOTION, background=60.0, brightness=150.0, noise=2.0)
    return simulated(folder / "sheet", text, options)


def made(name: str) -> Scene:
    """A recording of data/synthetic, made as it was."""

    def scene(folder: Path) -> Session:
        one: Recording = RECORDINGS[name]
        return simulated(folder / name, one.session, one.options)

    return scene


def recorded(path: str) -> Scene:
    """A real recording."""
    return lambda _: load_session(Path(os.environ["MIXPOSE_RECORDINGS"]) / path)


@dataclass(frozen=True)
class Aim:
    """Milliseconds of processor time that a frame is aimed to take at most."""

    tracked: float | None = None
    first: float | None = None


SCENES: Mapping[str, tuple[Scene, Aim]] = {
    "laboratory, two cameras": (laboratory, Aim(1.2)),
    "laboratory, video": (video, Aim(0.8)),
    "hand scene, three cameras": (hand, Aim(15.0)),
    "real room, two cameras": (made("real_room"), Aim(15.0)),
    "four bodies, two cameras": (made("several_bodies"), Aim(15.0)),
    "plate of dark dots, one camera": (plate, Aim(15.0)),
    "sheet of 450 dots, two cameras": (sheet, Aim(60.0, first=1500.0)),
}
REAL: Mapping[str, tuple[Scene, Aim]] = {
    "box of 72 corners, two tables": (recorded("tag_box/session.toml"), Aim(15.0)),
    "block of 40 corners, one table": (recorded("tag_block/session.toml"), Aim(20.0)),
    "web cams, four tables": (recorded("webcams4_a/session_reference.toml"), Aim()),
    # photographs, of which each is searched for
    "sheet of 450 dots, two photographs": (
        recorded("dots_plate/session.toml"), Aim(first=1500.0),
    ),
}  # fmt: skip


def run(options: argparse.Namespace) -> dict[str, Any]:
    print(f"frames: processor ms of a frame beside decoding, at most {FRAMES} or {OF_REAL} frames")
    scenes = {**SCENES, **(REAL if os.environ.get("MIXPOSE_RECORDINGS") else {})}
    figures: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, (scene, aim) in scenes.items():
            if not options.rows or any(text in name for text in options.rows):
                print(f" {name}")
                frames = FRAMES if name in SCENES else OF_REAL
                figures[name] = told(measured(scene(Path(folder)), frames), aim)
    return figures


def told(figures: dict[str, Any], aim: Aim) -> dict[str, Any]:
    """The figures, printed."""
    aims = {"first_ms": aim.first, "tracked_ms": aim.tracked}
    for key, value in figures.items():
        if isinstance(value, float | int):
            show(key.replace("_", " "), value, at_most=aims.get(key))
    print("  by room, ms:", ", ".join(f"{k} {v:.3g}" for k, v in figures["rooms_ms"].items()))
    return figures


def measured(session: Session, frames: int) -> dict[str, Any]:
    """Milliseconds of the first frame and of those after it, by stage, and calls."""
    opened: dict[str, Source] = {
        name: Held(source, tuple(islice(source.frames(), frames)))
        for name, source in runner.open_sources(session, {}).items()
    }
    extraction: list[float] = []
    observe = runner.observe

    def timed(*arguments: Any) -> Any:
        began = PROCESSOR()
        views = observe(*arguments)
        extraction[-1] += 1e3 * (PROCESSOR() - began)
        return views

    ms, status = list[float](), Counter[str]()
    with patch.object(runner, "observe", timed):
        extraction.append(0.0)
        began = PROCESSOR()
        for estimates in by_frame(session, opened):
            ms.append(1e3 * (PROCESSOR() - began))
            status.update(one.status for one in estimates)
            extraction.append(0.0)
            began = PROCESSOR()
    tracked = float(np.median(ms[1:]))
    calls, shares = profiled(session, opened)
    return {
        "first_ms": ms[0],
        "tracked_ms": tracked,
        "slowest_tracked_ms": max(ms[1:]),
        "extract_ms": float(np.median(extraction[1 : len(ms)])),
        "calls_of_Python": calls / (len(ms) - 1),
        "share_ok": status["ok"] / status.total(),
        "rooms_ms": {room: share * tracked for room, share in shares.items() if share > 0.03},
    }


def by_frame(session: Session, opened: Mapping[str, Source]) -> Iterator[list[Estimate]]:
    """The estimates of each frame."""
    # as many as there are bodies: a look ahead would have the next frame estimated, too
    estimates = runner.run(session, opened=opened)
    while some := list(islice(estimates, len(session.labels))):
        yield some


def profiled(session: Session, opened: Mapping[str, Source]) -> tuple[int, dict[str, float]]:
    """Calls of Python's functions in the frames after the first, and shares of time by room.

    What libraries do belongs to the room that calls them, where it calls them directly.
    """
    frames, profile = by_frame(session, opened), cProfile.Profile(time.process_time)
    next(frames)
    with profile:
        list(frames)
    calls, seconds = 0, Counter[str]()
    for (file, _, _), entry in pstats.Stats(profile).stats.items():  # type: ignore[attr-defined]
        _, count, own, _, callers = entry
        calls += count if file != "~" else 0
        if (room := room_of(file)) is not None:
            seconds[room] += own
        else:
            for (caller, _, _), (_, _, part, _) in callers.items():
                seconds[room_of(caller) or "libraries"] += part
    whole = seconds.total()
    return calls, {room: s / whole for room, s in seconds.most_common()}


def room_of(file: str) -> str | None:
    """The room of mixpose that a file is in."""
    path = Path(file)
    return path.relative_to(PACKAGE).parts[0] if path.is_relative_to(PACKAGE) else None
