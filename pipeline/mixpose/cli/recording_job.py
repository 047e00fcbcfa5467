"""One recording of many: run in a process of its own, in a folder that appears when it is whole.

The folder holds the poses, what was said (`LOG`) and how it ended (`STATUS`).  While it is made
its name begins with a dot.  A recording that two workers come to do gives one folder: the first to
be whole stays.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

from mixpose.cli.lines import held, note_path
from mixpose.cli.notices import parsed_frames
from mixpose.errors import SessionError
from mixpose.whole_files import appearing_whole

STATUS = "status.json"
LOG = "log.txt"
UNFINISHED = "unfinished"
DONE, FAILED, INTERRUPTED = "done", "failed", "interrupted"

_INTERRUPTED_STATUS = 130


@dataclass(frozen=True)
class Recording:
    """One of many; text only, as it may travel to another machine."""

    name: str  # of its folder
    session: str  # absolute path
    session_sha256: str  # of its bytes; empty where it cannot be read
    options: tuple[str, ...]  # of ``mixpose run``
    mixpose: str  # version


@dataclass(frozen=True)
class Job(Recording):
    """What is to be done."""

    folder: str  # absolute path of that of all recordings
    poses: str  # name of the file with the poses
    shared: bool = False  # whether another worker may come to do the same


@dataclass(frozen=True)
class Outcome(Recording):
    """How a recording ended: what its status file holds."""

    state: str
    exit_status: int  # of ``mixpose run``
    frames: Mapping[str, int] = field(default_factory=dict)  # poses by their status
    bodies: int = 1  # poses of a frame
    warnings: int = 0  # in the log
    reason: str | None = None  # why it failed: the last line of the log
    seconds: float = 0.0
    host: str = ""


class Running:
    """The processes that run, so that an interrupt reaches all of them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self.stopped = False

    def run(self, command: list[str], folder: Path, log: Path, threads: int) -> int:
        """Run a command to its end; an interrupted one's status if none may start any more."""
        with self._lock, log.open("ab") as stream:
            if self.stopped:
                return _INTERRUPTED_STATUS
            process = subprocess.Popen(
                command,
                cwd=folder,
                env={"OPENCV_FOR_THREADS_NUM": str(threads), **os.environ},
                stdin=subprocess.PIPE,  # ends with this process, see `mixpose.cli.child`
                stdout=subprocess.DEVNULL,
                stderr=stream,
                # an interrupt from the keyboard comes once, through this process
                start_new_session=True,
            )
            self._running.add(process)
        try:
            return process.wait()
        finally:
            with self._lock:
                self._running.discard(process)
            if process.poll() is None:
                process.kill()
            assert process.stdin is not None
            process.stdin.close()

    def interrupt(self) -> None:
        """Let every process end after its frame, and no further one start."""
        with self._lock:
            self.stopped = True
            for process in self._running:
                if sys.platform != "win32":  # there the keyboard reaches all by itself
                    # an interrupt is ignored by what a script starts in the background
                    process.send_signal(signal.SIGTERM)


def told(folder: Path) -> Outcome | None:
    """What the status file in a folder says, if there is one."""
    try:
        said = json.loads((folder / STATUS).read_bytes())
        return Outcome(**{**said, "options": tuple(said["options"])})
    except (OSError, ValueError, TypeError, KeyError):
        return None


def finished(job: Job) -> Outcome | None:
    """How a job ended before, if it is done and nothing about it has changed."""
    outcome = told(Path(job.folder) / job.name)
    return outcome if outcome and outcome.state == DONE and _is_of(outcome, job) else None


def _is_of(outcome: Outcome, job: Job) -> bool:
    """Whether an outcome is of the same session, options and version as a job."""
    same = (outcome.session_sha256, outcome.options, outcome.mixpose)
    return same == (job.session_sha256, job.options, job.mixpose)


def run_job(job: Job, running: Running | None = None, threads: int = 1) -> Outcome:
    """Do a job, if it is not done yet; an interrupt reaches its process through `running`."""
    missing = _not_shared(job)
    if missing is not None:
        return missing
    part = Path(job.folder) / f".{job.name}.{uuid.uuid4().hex if job.shared else UNFINISHED}"
    try:
        part.mkdir(exist_ok=True)
        with held(part, Path(job.folder) / job.name):
            outcome = finished(job) or _run_in(part, job, running or Running(), threads)
            if outcome.state != INTERRUPTED:
                outcome = _put_in_place(part, job, outcome)
    except SessionError as error:
        outcome = outcome_of(job, FAILED, 2, str(error))
    except OSError as error:
        reason = f"{error.filename or part}: cannot be written: {error.strerror}"
        outcome = outcome_of(job, FAILED, 2, reason)
    finally:
        if job.shared:
            shutil.rmtree(part, ignore_errors=True)
    return outcome


def _run_in(part: Path, job: Job, running: Running, threads: int) -> Outcome:
    part.mkdir(exist_ok=True)
    goes_on = _goes_on(part, job)
    log, poses = part / LOG, part / job.poses
    command = [sys.executable, "-m", "mixpose.cli.child", "run", *job.options]
    command += [f"--output={job.poses}", *(["--resume"] if goes_on else [])]
    # what is begun says of what it is, should nothing come to say how it ended
    write_json(part / STATUS, asdict(outcome_of(job, INTERRUPTED, _INTERRUPTED_STATUS)))
    log.touch()
    began = time.monotonic()
    status = running.run([*command, "--", job.session], part, log, threads)
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    if status < 0 and not running.stopped:
        lines.append(f"mixpose: ended by signal {-status}")
    interrupted = status == _INTERRUPTED_STATUS or running.stopped
    state = DONE if status == 0 else INTERRUPTED if interrupted else FAILED
    parsed = [counts for line in lines if (counts := parsed_frames(line))]
    frames, bodies = parsed[-1] if parsed else ({}, 1)
    if goes_on and state != FAILED:
        with suppress(OSError, ValueError, KeyError):
            frames = _statuses_in(poses)
    said = (lines or ["it said nothing"])[-1].removeprefix("mixpose: ")
    reason = None if status == 0 else said
    outcome = replace(
        outcome_of(job, state, 128 - status if status < 0 else status, reason),
        frames=frames,
        bodies=bodies,
        # a run that goes on may say again what the one before it said
        warnings=sum(line.startswith("mixpose: warning: ") for line in set(lines)),
        seconds=round(time.monotonic() - began, 3),
    )
    if state == DONE:  # nothing is left to go on with
        note_path(poses).unlink(missing_ok=True)
    write_json(part / STATUS, asdict(outcome))
    return outcome


def _goes_on(part: Path, job: Job) -> bool:
    """Whether poses of the same job are begun in a folder, which is emptied of all else."""
    begun, poses = told(part), part / job.poses
    is_begun = begun is not None and begun.state == INTERRUPTED and _is_of(begun, job)
    if is_begun and poses.suffix == ".jsonl" and poses.exists():
        return True
    for left in part.iterdir():
        shutil.rmtree(left) if left.is_dir() else left.unlink()
    return False


def _statuses_in(poses: Path) -> dict[str, int]:
    """How many poses of each status a file holds, with those of runs that were interrupted."""
    with poses.open(encoding="ascii") as lines:
        whole = [json.loads(line) for line in lines if line.endswith("\n")]
    return dict(Counter(line["status"] for line in whole if line["type"] == "pose"))


def write_json(path: Path, said: Mapping[str, object]) -> None:
    """Write a file that people may read, too."""
    with appearing_whole(path) as part:
        part.write_text(json.dumps(said, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _put_in_place(part: Path, job: Job, outcome: Outcome) -> Outcome:
    """Give a whole folder its name, unless another worker was faster.

    Poses that are there are not given up for a run that failed.
    """
    place = Path(job.folder) / job.name
    while True:
        before, there = finished(job), told(place)
        if before is not None:
            shutil.rmtree(part, ignore_errors=True)
            return before
        if outcome.state == FAILED and there is not None and there.state == DONE:
            shutil.rmtree(part, ignore_errors=True)
            return replace(outcome, reason=f"{outcome.reason}; {job.name} is as it was before")
        old = place.with_name(f".{job.name}.{uuid.uuid4().hex}")
        with suppress(FileNotFoundError):
            place.rename(old)  # of another session, or failed
        try:
            part.rename(place)
        except OSError:
            if not place.exists():
                raise
            continue
        finally:
            shutil.rmtree(old, ignore_errors=True)
        return outcome


def _not_shared(job: Job) -> Outcome | None:
    """What to say where this machine does not see the folders of the one that asked."""
    missing = [path for path in (job.session, job.folder) if not Path(path).exists()]
    if not missing:
        return None
    reason = f"{missing[0]}: no such file"
    if job.shared:
        reason = (
            f"{missing[0]}: not there on worker {socket.gethostname()}; sessions, recordings and "
            "-o must lie in a folder that all workers see under the same name"
        )
    return outcome_of(job, FAILED, 2, reason)


def outcome_of(job: Job, state: str, exit_status: int, reason: str | None = None) -> Outcome:
    """How a job ended on this machine."""
    same = {one.name: getattr(job, one.name) for one in fields(Recording)}
    host = socket.gethostname()
    return Outcome(**same, state=state, exit_status=exit_status, reason=reason, host=host)
