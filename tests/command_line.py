"""The command line as a subprocess, and what its one line of an error must be."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

LONGEST_S = 900.0
"""Ends a test that would wait for ever; no test hangs on how fast a machine is."""


def mixpose(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "mixpose", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd)


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
