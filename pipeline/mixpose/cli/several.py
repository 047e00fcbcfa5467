"""``mixpose run`` on several recordings: each in a process of its own, some at a time.

A process is the same command with one session, so that a recording gives the same poses alone and
among others, and none can disturb another.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from mixpose.cli.notices import say
from mixpose.cli.request import RunRequest
from mixpose.errors import SessionError

USUAL_STEM = "session"
"""Sessions of this name are told apart by their folders."""

_SUFFIXES = {"bop": ".bop.csv"}


def run_sessions(sessions: Sequence[Path], request: RunRequest, workers: int) -> int:
    """Estimate several recordings and write the poses of each to a file of its own.

    Parameters
    ----------
    sessions : sequence of Path
    request : RunRequest
        Its output is a folder, made if it is not there.
    workers : int
        Most recordings at a time.

    Returns
    -------
    int
        The largest exit status of all.

    Raises
    ------
    SessionError
        If there is no folder for the poses, two recordings would write to one file, or an option
        is given that serves a single recording only.
    """
    if request.sources:
        raise SessionError(
            f"--source {request.sources[0]}: found {len(sessions)} sessions, allowed with one only"
        )
    if request.overlay is not None:
        raise SessionError(
            f"--overlay {request.overlay}: found {len(sessions)} sessions, allowed with one only"
        )
    outputs = output_paths(sessions, request)
    commands = [
        _command(session, output, request)
        for session, output in zip(sessions, outputs, strict=True)
    ]
    running = _Processes(_threads_each(workers))
    with ThreadPoolExecutor(workers) as pool:
        try:
            return max(pool.map(running.run, sessions, commands))
        except KeyboardInterrupt:
            running.interrupt()
            raise


def output_paths(sessions: Sequence[Path], request: RunRequest) -> list[Path]:
    """Where the poses of each session go, in a folder that is there afterwards."""
    folder = request.output
    if folder is None:
        raise SessionError(f"-o DIR: missing; {len(sessions)} sessions need a folder for the poses")
    if folder.exists() and not folder.is_dir():
        raise SessionError(
            f"-o {folder}: is a file; {len(sessions)} sessions need a folder for the poses"
        )
    suffix = _SUFFIXES.get(request.format, f".{request.format}")
    owners: dict[str, Path] = {}
    for session in sessions:
        name = (_stem(session) + suffix).casefold()  # some file systems know no capitals
        if name in owners:
            raise SessionError(
                f"{session}: its poses would go to {folder / (_stem(session) + suffix)} like "
                f"those of {owners[name]}; rename one, or run them into different folders"
            )
        owners[name] = session
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise SessionError(f"-o {folder}: cannot be made: {error.strerror}") from error
    return [folder / (_stem(session) + suffix) for session in sessions]


def _stem(session: Path) -> str:
    return session.resolve().parent.name if session.stem == USUAL_STEM else session.stem


def _command(session: Path, output: Path, request: RunRequest) -> list[str]:
    """The command line of a run of one session."""
    chosen = request.selection
    options = [f"--output={output}", f"--format={request.format}", f"--step={chosen.step}"]
    options += [f"--start={chosen.start}"] if chosen.start is not None else []
    options += [f"--stop={chosen.stop}"] if chosen.stop is not None else []
    options += ["--resume"] if request.resume else []
    options += ["--debug"] if request.debug else []
    return [sys.executable, "-m", "mixpose", "run", *options, "--", str(session)]


def _threads_each(workers: int) -> dict[str, str]:
    """Environment in which the processes share the processors."""
    share = max((os.cpu_count() or 1) // workers, 1)
    return {"OPENCV_FOR_THREADS_NUM": str(share), **os.environ}


class _Processes:
    """The processes that run, so that an interrupt reaches all of them."""

    def __init__(self, environment: dict[str, str]) -> None:
        self._environment = environment
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[str]] = set()
        self._stopped = False

    def run(self, session: Path, command: Sequence[str]) -> int:
        """Run a command to its end and pass on what it says; 0 if nothing may start any more."""
        with self._lock:
            if self._stopped:
                return 0
            process = subprocess.Popen(
                command,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                encoding="utf-8",
                errors="replace",
                # an interrupt from the keyboard comes once, through this process
                start_new_session=True,
            )
            self._running.add(process)
        with process:
            assert process.stderr is not None
            for line in process.stderr:
                self._pass_on(session, line)
        with self._lock:
            self._running.discard(process)
        return self._status(session, process.returncode)

    def _pass_on(self, session: Path, line: str) -> None:
        said = line.removeprefix("mixpose: ")
        if said != line and not said.startswith(f"{session}: "):
            line = f"mixpose: {session}: {said}"
        if said != line or not self._stopped:  # one that was still starting ends with a traceback
            sys.stderr.write(line)

    def _status(self, session: Path, returned: int) -> int:
        if returned >= 0 or self._stopped:
            return abs(returned)
        say(f"{session}: ended by signal {-returned}")
        return 128 - returned

    def interrupt(self) -> None:
        """Let every process end after its frame, and no further one start."""
        with self._lock:
            self._stopped = True
            for process in self._running:
                if sys.platform != "win32":  # there the keyboard reaches all by itself
                    process.send_signal(signal.SIGINT)
