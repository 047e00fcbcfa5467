"""The command line, in a process of its own or in this one, and the one line of its errors."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager, nullcontext, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

from mixpose.cli import main

LONGEST_S = 900.0
"""Ends a test that would wait for ever; no test hangs on how fast a machine is."""


def mixpose(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """The command line in a process of its own, whose start takes half a second."""
    command = [sys.executable, "-m", "mixpose", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd)


def command(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """The command line in this process, where nothing hangs on its being one of its own.

    What libraries write to the streams is caught too; an exception that leaves it fails the test.
    """
    words = [str(argument) for argument in arguments]
    with (
        _caught(1, redirect_stdout) as printed,
        _caught(2, redirect_stderr) as told,
        chdir(cwd) if cwd else nullcontext(),
    ):
        try:
            main(words)
        except SystemExit as ended:
            status = int(ended.code or 0)
    return subprocess.CompletedProcess(words, status, printed[0], told[0])


@contextmanager
def _caught(number: int, redirected: Callable[[Any], Any]) -> Iterator[list[str]]:
    """What is written to a stream: its text, in the end."""
    text: list[str] = []
    before = os.dup(number)
    try:
        with tempfile.TemporaryFile() as file:
            os.dup2(file.fileno(), number)
            with (
                open(number, "w", encoding="utf-8", closefd=False) as stream,
                redirected(stream),
            ):
                yield text
            file.seek(0)
            text.append(file.read().decode("utf-8"))
    finally:
        os.dup2(before, number)
        os.close(before)


@contextmanager
def no_signals_ignored() -> Iterator[None]:
    """Let processes take the signals that this one ignores, as under nohup or behind a `&`."""
    names = [name for name in ("SIGINT", "SIGHUP") if hasattr(signal, name)]
    numbers = [signal.Signals[name] for name in names]
    ignored = [number for number in numbers if signal.getsignal(number) is signal.SIG_IGN]
    for number in ignored:
        signal.signal(number, signal.SIG_DFL)
    try:
        yield
    finally:
        for number in ignored:
            signal.signal(number, signal.SIG_IGN)


@contextmanager
def started(command: list[str], **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A process that goes on while a test does, and is gone after it however it ends.

    One that a failing test left behind would be told of, and fail, any test after it.
    """
    with no_signals_ignored():
        process = subprocess.Popen(command, text=True, **options)
    with process:
        try:
            yield process
        finally:
            process.kill()


def wait_until(condition: Callable[[], bool], *, by: subprocess.Popen[str] | None = None) -> None:
    """Wait for something to become so, as long as the process lives that is to bring it about."""
    deadline = time.monotonic() + LONGEST_S
    while not condition():
        assert by is None or by.poll() is None, f"it ended with {by.returncode} before"
        assert time.monotonic() < deadline, f"not so after {LONGEST_S:g} s"
        time.sleep(0.01)


def has_written(path: Path, size: int = 3000) -> bool:
    """Whether some poses are in a file: a header and a line or two."""
    return path.exists() and path.stat().st_size > size


def lines_of(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


def assert_one_line(result: subprocess.CompletedProcess[str], status: int, *words: str) -> None:
    assert result.returncode == status, result.stderr
    assert len(result.stderr.splitlines()) == 1, result.stderr
    assert "Traceback" not in result.stderr
    for word in words:
        assert word in result.stderr
