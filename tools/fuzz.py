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
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import cv2
import typer
from fuzzed.mutations import mutated
from fuzzed.recordings import KINDS, with_table

import mixpose
from mixpose.cli import main as command_line
from mixpose.frames.capture import quieten_opencv

LONGEST_S = 10.0
LARGEST_BYTES = 2 * 10**9
PATIENCE_S = 1200.0  # by the clock; `LONGEST_S` is processor time, whatever else the machine does
TOGETHER = 25  # inputs of one fork, which shares what it loads
TOLD = 500  # after so many the figures so far are printed
OUTCOME = "outcome"


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
