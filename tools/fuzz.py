"""Mutated inputs: each must end in one clear line, in seconds, and without taking all memory.

    python tools/fuzz.py [KIND ...] [--count 20000] [--seed 0] [--keep DIR]

Session files, calibrations, tables of markers, detections and times, profiles, images, videos and
poses are flipped, cut, doubled, nested, filled with absurd numbers and exchanged for each other,
and given to the command line, some inputs to a fork.  A finding is a traceback, a crash, an exit
status other than 0, 2 and 3, more than one line that is no warning, more than 10 s of processor
time, or more than 2 GB.  The mutator knows nothing of the code that it runs through; `atheris`
would, but it cannot see into the decoders of OpenCV and FFmpeg, where most of these bytes go.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import io
import json
import os
import pkgutil
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import typer

import mixpose
from mixpose.cli import main as command_line
from mixpose.frames.quiet import quieten_opencv

LONGEST_S = 10.0
LARGEST_BYTES = 2 * 10**9
PATIENCE_S = 1200.0  # by the clock; `LONGEST_S` is processor time, whatever else the machine does
TOGETHER = 25  # inputs of one fork, which shares what it loads
TOLD = 500  # after so many the figures so far are printed
OUTCOME = "outcome"
SESSION = """unit = "mm"
[object]
name = "body"
{body}
[start]
rotation_vector = [0, 0, 0]
translation = [0, 0, 900]
[[sensor]]
name = "c"
{sensor}
"""
BODY = [[0, 0, 0], [100, 0, 0], [0, 120, 0], [-80, -60, 90], [60, 70, 20]]
POINTS = f"points = {BODY}"
PLACES = ((160.0, 120.0), (193.5, 120.0), (160.0, 160.1), (135.6, 101.7), (179.6, 142.9))
CAMERA = """model = "pinhole"
source = "{source}"
resolution = [320, 240]
camera_matrix = [[300, 0, 160], [0, 300, 120], [0, 0, 1]]
distortion = [0.1, 0.01, 0, 0]"""
TOKENS = [
    b"nan", b"inf", b"-inf", b"1e400", b"-1", b"0", b"99999999999999999999", b"1e308", b"5e-324",
    b"[" * 3000, b"{" * 3000, b"&a [*a, *a]", b"*a", b"\x00", b"\xff\xfe", b'"', b"'''", b"\n\n",
    b",", b"<!ENTITY", b"!!python/object:os.system", b"true", b"null", b"../../../dev/zero", b"\r",
    b"65535", b"2147483647", b"-2147483648", b"4294967296", b"%s%n", b"1" * 5000,
]  # fmt: skip


@dataclass(frozen=True)
class Kind:
    """A whole recording, the file in it that is mutated, and what is run on it."""

    make: Callable[[Path], None]
    file: str
    arguments: tuple[str, ...] = ("run", "session.toml", "--stop", "2", "-o", "poses.jsonl")


def spots(seed: int) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    picture = np.full((240, 320), 12, np.uint8)
    noise = np.random.default_rng(seed).integers(0, 4, picture.shape)
    for u, v in PLACES:
        cv2.circle(picture, (round(u) + seed, round(v)), 2, 200, -1)
    return (picture + noise).astype(np.uint8)


def session(folder: Path, sensor: str, body: str = POINTS) -> None:
    text = SESSION.format(body=body, sensor=sensor)
    (folder / "session.toml").write_text(text, encoding="utf-8")


def detections(folder: Path) -> None:
    rows = [f"{k},{u + k},{v},1" for k in range(3) for u, v in PLACES]
    (folder / "t.csv").write_text("frame,u,v,weight\n" + "\n".join(rows) + "\n", encoding="utf-8")


def with_table(folder: Path) -> None:
    detections(folder)
    session(folder, CAMERA.format(source="t.csv"))


def with_times(folder: Path) -> None:
    detections(folder)
    (folder / "times.csv").write_text("frame,time_s\n0,0.1\n1,0.2\n2,0.3\n", encoding="utf-8")
    session(folder, CAMERA.format(source="t.csv") + '\ntimes = "times.csv"')


def with_markers(name: str, content: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        detections(folder)
        (folder / name).write_text(content, encoding="utf-8")
        session(folder, CAMERA.format(source="t.csv"), f'file = "{name}"')

    return make


def with_calibration(name: str, content: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        detections(folder)
        (folder / name).write_text(content, encoding="utf-8")
        text = f'model = "pinhole"\nsource = "t.csv"\ncalibration = "{name}"'
        session(folder, text)

    return make


def with_images(suffix: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        for k in range(2):
            cv2.imwrite(str(folder / f"i{k}{suffix}"), spots(k))
        session(folder, CAMERA.format(source=f"i*{suffix}"))

    return make


def with_video(name: str, codec: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        code = cv2.VideoWriter.fourcc(*codec)
        video = cv2.VideoWriter(str(folder / name), code, 25.0, (320, 240))
        for k in range(4):
            video.write(cv2.cvtColor(spots(k), cv2.COLOR_GRAY2BGR))
        video.release()
        session(folder, CAMERA.format(source=name))

    return make


def with_profiles(name: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        bins = np.arange(300.0)[None, :, None]
        lengths = np.linalg.norm(np.add(BODY, [0, 0, 900]), axis=1) - 800
        values = np.exp(-((bins - lengths - 2 * np.arange(3)[:, None, None]) ** 2) / 8).sum(axis=2)
        if name.endswith(".npy"):
            np.save(folder / name, values.astype(np.float32))
        else:
            np.savetxt(folder / name, values, delimiter=",", fmt="%.4f")
        sensor = f'model = "lateration"\nsource = "{name}"\nposition = [0, 0, 0]\nrange_min = 800\n'
        sensor += "bin_size = 1.0\n[sensor.extract]\nsigma = 3.0"
        # one range tells one direction; all six would make each input take seconds
        session(folder, sensor + '\n[estimator]\nfree = ["z"]')

    return make


def with_poses(folder: Path) -> None:
    line = (
        '{"type": "pose", "frame": %d, "time_s": 0.1, "object": "body", "status": "ok", '
        '"T_world_object": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]], "score": 0.5, '
        '"sensors": {"c": {"used": true, "explained": 0.5, "rms": 0.1}}, "hypotheses": []}\n'
    )
    header = '{"type": "header", "format": "mixpose-poses", "version": 1, "unit": "mm"}\n'
    text = header + "".join(line % k for k in range(3))
    (folder / "poses.jsonl").write_text(text, encoding="utf-8")


OPENCV = """%YAML:1.0
---
image_width: 320
image_height: 240
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 300., 0., 160., 0., 300., 120., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0.1, 0.01, 0., 0., 0. ]
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [0.1, 0.01, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [300.0, 300.0, 160.0, 120.0]
  resolution: [320, 240]
"""
ROS = """image_width: 320
image_height: 240
camera_matrix:
  rows: 3
  cols: 3
  data: [300, 0, 160, 0, 300, 120, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, 0.01, 0, 0, 0]
"""
MARKERS = (
    "name,x,y,z,sigma\na,0,0,0,.1\nb,100,0,0,.1\nc,0,120,0,.1\nd,-80,-60,90,.1\ne,60,70,20,0\n"
)

KINDS: dict[str, Kind] = {
    "session": Kind(with_table, "session.toml"),
    "check": Kind(with_table, "session.toml", ("check", "session.toml", "--quick")),
    "simulate": Kind(
        with_table, "session.toml", ("simulate", "session.toml", "-o", "out", "--frames", "1")
    ),
    "table": Kind(with_table, "t.csv"),
    "times": Kind(with_times, "times.csv"),
    "markers": Kind(with_markers("m.csv", MARKERS), "m.csv"),
    "opencv": Kind(with_calibration("c.yml", OPENCV), "c.yml"),
    "kalibr": Kind(with_calibration("c.yaml", KALIBR), "c.yaml"),
    "ros": Kind(with_calibration("c.yaml", ROS), "c.yaml"),
    "png": Kind(with_images(".png"), "i0.png"),
    "jpg": Kind(with_images(".jpg"), "i0.jpg"),
    "bmp": Kind(with_images(".bmp"), "i0.bmp"),
    "tif": Kind(with_images(".tif"), "i0.tif"),
    "avi": Kind(with_video("v.avi", "MJPG"), "v.avi"),
    "mp4": Kind(with_video("v.mp4", "mp4v"), "v.mp4"),
    "mkv": Kind(with_video("v.mkv", "mp4v"), "v.mkv"),
    "npy": Kind(with_profiles("p.npy"), "p.npy"),
    "profile": Kind(with_profiles("p.csv"), "p.csv"),
    "poses": Kind(with_poses, "poses.jsonl", ("convert", "poses.jsonl", "-o", "poses.csv")),
    "truth": Kind(with_poses, "poses.jsonl", ("evaluate", "poses.jsonl", "poses.jsonl")),
}


def mutated(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """A mutation of some bytes: one to four changes."""
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        at = rng.randrange(len(data) + 1)
        end = min(len(data), at + rng.choice([1, 2, 4, 8, 40, 400]))
        change = rng.randrange(9)
        if change == 0 and data:  # flip a bit
            place = rng.randrange(len(data))
            data = data[:place] + bytes([data[place] ^ 1 << rng.randrange(8)]) + data[place + 1 :]
        elif change == 1:
            data = data[:at]
        elif change == 2:
            data = data[:at] + data[end:]
        elif change == 3:
            data = data[:at] + data[at:end] * rng.choice([2, 3, 100]) + data[end:]
        elif change == 4:
            data = data[:at] + rng.choice(TOKENS) + data[at:]
        elif change == 5:
            data = data[:at] + rng.choice(TOKENS) + data[end:]
        elif change == 6:
            data = data[:at] + rng.randbytes(rng.choice([1, 4, 16])) + data[end:]
        elif change == 7:
            data = number_changed(data, rng)
        else:
            data = rng.choice(others)
    return data


def number_changed(data: bytes, rng: random.Random) -> bytes:
    """Another number in place of one of a text."""
    digits = [k for k, byte in enumerate(data[:100_000]) if 48 <= byte <= 57]
    if not digits:
        return data
    at = end = rng.choice(digits)
    while end < len(data) and 48 <= data[end] <= 57:
        end += 1
    return data[:at] + rng.choice(TOKENS) + data[end:]


@dataclass(frozen=True)
class Ended:
    """How the command line ended on an input."""

    code: int
    seconds: float
    size: int


def ends_of(folders: Sequence[Path], arguments: Sequence[tuple[str, ...]]) -> list[Ended]:
    """Run the command line on inputs, one after the other in one fork, or more where one dies."""
    found: list[Ended] = []
    while len(found) < len(folders):
        left = slice(len(found), len(folders))
        child = os.fork()
        if child == 0:
            _run_in_child(folders[left], arguments[left])
        with _alarm(PATIENCE_S, child):
            _, status, usage = os.wait4(child, 0)
        for folder in folders[left]:
            if not (folder / OUTCOME).exists():  # it died of this one
                code = -os.WTERMSIG(status) if os.WIFSIGNALED(status) else 99
                found.append(Ended(code, usage.ru_utime + usage.ru_stime, usage.ru_maxrss))
                break
            found.append(Ended(*json.loads((folder / OUTCOME).read_text(encoding="utf-8"))))
    return found


def _run_in_child(folders: Sequence[Path], arguments: Sequence[tuple[str, ...]]) -> None:
    cv2.setNumThreads(1)
    for folder, each in zip(folders, arguments, strict=True):
        os.chdir(folder)
        for stream, name in ((1, "stdout"), (2, "stderr")):
            descriptor = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(descriptor, stream)
            os.close(descriptor)
        began = time.process_time()
        most = int(began + LONGEST_S) + 2
        resource.setrlimit(resource.RLIMIT_CPU, (most, resource.RLIM_INFINITY))
        code = 99
        try:
            command_line(each)
        except SystemExit as left:
            code = int(left.code or 0)
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        outcome = json.dumps([code, time.process_time() - began, size])
        (folder / OUTCOME).write_text(outcome, encoding="utf-8")
    os._exit(0)


class _alarm:  # noqa: N801 - used as a function
    """Kill a child that does not end."""

    def __init__(self, seconds: float, child: int) -> None:
        self._seconds, self._child = seconds, child

    def __enter__(self) -> None:
        signal.signal(signal.SIGALRM, lambda *_: os.kill(self._child, signal.SIGKILL))
        signal.setitimer(signal.ITIMER_REAL, self._seconds)

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0)


def fault(folder: Path, ended: Ended) -> str | None:
    """What is wrong with how an input ended."""
    text = (folder / "stderr").read_text(encoding="utf-8", errors="replace")
    lines = [one for one in text.splitlines() if not one.startswith("mixpose: warning: ")]
    if ended.code < 0:
        return f"signal {-ended.code} after {ended.seconds:.0f} s"
    if ended.code not in (0, 2, 3) or "Traceback" in text:
        return f"exit status {ended.code}"
    if ended.code and len(lines) != 1:
        return f"{len(lines)} lines"
    if ended.seconds > LONGEST_S:
        return f"{ended.seconds:.0f} s"
    return f"{ended.size / 1e6:.1f} GB" if ended.size * 1024 > LARGEST_BYTES else None


@dataclass
class Count:
    """What came of the inputs so far."""

    done: int = 0
    slowest: float = 0.0
    largest: int = 0
    found: list[str] = field(default_factory=list)

    def text(self) -> str:
        kinds = dict(Counter(line.split()[0] for line in self.found))
        return (
            f"{self.done} mutated inputs: {len(self.found)} findings {kinds}; the slowest took "
            f"{self.slowest:.1f} s, the largest {self.largest / 1e6:.2f} GB"
        )


def fuzz(
    kinds: list[str], count: int, seed: int, keep: Path | None, until: float | None = None
) -> Count:
    """Try mutated inputs."""
    quieten_opencv()
    rng = random.Random(seed)
    total = Count()
    with tempfile.TemporaryDirectory() as name:
        whole = {kind: Path(name) / kind for kind in kinds}
        for kind, folder in whole.items():
            folder.mkdir()
            KINDS[kind].make(folder)
        contents = {kind: (whole[kind] / KINDS[kind].file).read_bytes() for kind in kinds}
        others = [*contents.values(), b"", b"\x89PNG\r\n\x1a\n", b"\n" * 5000]
        while total.done < count and (until is None or time.monotonic() < until):
            numbers = range(total.done, min(total.done + TOGETHER, count))
            chosen = [kinds[k % len(kinds)] for k in numbers]
            folders = [Path(name) / f"input{k}" for k in numbers]
            for kind, folder in zip(chosen, folders, strict=True):
                shutil.copytree(whole[kind], folder)
                data = mutated(contents[kind], others, rng)
                (folder / KINDS[kind].file).write_bytes(data)
            ends = ends_of(folders, [KINDS[kind].arguments for kind in chosen])
            for k, kind, folder, ended in zip(numbers, chosen, folders, ends, strict=True):
                see(total, f"{kind} {k}", folder, ended, keep)
                shutil.rmtree(folder)
            if total.done % TOLD < TOGETHER:
                print(total.text(), flush=True)
    return total


def see(total: Count, name: str, folder: Path, ended: Ended, keep: Path | None) -> None:
    """Count an input, and tell it where it is a finding."""
    total.done += 1
    total.slowest = max(total.slowest, ended.seconds)
    total.largest = max(total.largest, ended.size)
    wrong = fault(folder, ended)
    if wrong is None:
        return
    text = (folder / "stderr").read_text(encoding="utf-8", errors="replace")
    total.found.append(f"{name}: {wrong}: {text.strip()[-300:]}")
    print(total.found[-1], flush=True)
    if keep is not None:
        shutil.copytree(folder, keep / name.replace(" ", ""), dirs_exist_ok=True)


def warm_up() -> None:
    """Import everything once, before the first fork: a fork then takes some 10 ms."""
    for module in pkgutil.walk_packages(mixpose.__path__, "mixpose."):
        if module.name not in ("mixpose.__main__", "mixpose.rerun_file"):
            importlib.import_module(module.name)
    with tempfile.TemporaryDirectory() as name:
        with_table(Path(name))
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()), suppress(SystemExit):
            command_line(["check", f"{name}/session.toml", "--quick"])
    typer.main.get_command = cache(typer.main.get_command)  # made anew for each input otherwise
    gc.collect()
    gc.freeze()  # a collection in the fork would copy every page


def main() -> int:
    parser = argparse.ArgumentParser(description="Mutated inputs.")
    parser.add_argument("kinds", nargs="*", help=", ".join(KINDS))
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, help="stop after so long")
    parser.add_argument("--keep", type=Path, help="folder for the inputs of findings")
    options = parser.parse_args()
    unknown = {*options.kinds} - {*KINDS}
    if unknown:
        parser.error(f"no such kind: {sorted(unknown)[0]}")
    kinds = options.kinds or list(KINDS)
    until = None if options.minutes is None else time.monotonic() + 60 * options.minutes
    warm_up()
    total = fuzz(kinds, options.count, options.seed, options.keep, until)
    print(total.text())
    return 1 if total.found else 0


if __name__ == "__main__":
    sys.exit(main())
