"""Run one recording of many in a separate process, in a folder that appears when it is complete.

The folder holds the poses, the messages (`LOG`) and the outcome (`STATUS`).  Until it is complete
its name begins with a dot.  If two workers run the same recording, the first folder that is
complete stays.
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

from mixpose.cli.lines import locked_folder, note_path
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
    """One recording of many; plain values only, as it may be sent to another machine."""

    name: str  # of its folder
    session: str  # absolute path
    session_sha256: str  # of its bytes; empty where it cannot be read
    options: tuple[str, ...]  # of ``mixpose run``
    mixpose: str  # version


@dataclass(frozen=True)
class Job(Recording):
    """A recording that is to be run."""

    folder: str  # absolute path of the folder of all recordings
    poses: str  # name of the file with the poses
    shared: bool = False  # whether another worker may run the same job


@dataclass(frozen=True)
class Outcome(Recording):
    """How a recording ended; the content of its status file."""

    state: str
    exit_status: int  # of ``mixpose run``
    frames: Mapping[str, int] = field(default_factory=dict)  # number of poses by status
    bodies: int = 1  # poses per frame
    warnings: int = 0  # in the log
    reason: str | None = None  # why it failed: the last line of the log
    seconds: float = 0.0
    host: str = ""


class Running:
    """The running processes, so that an interrupt reaches all of them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self.stopped = False

    def run(self, command: list[str], folder: Path, log: Path, threads: int) -> int:
        """Run a command and return its status; after an interrupt, start none and return that."""
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
                # an interrupt from the keyboard reaches it through this process only
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
        """Let every process end after its frame, and let no other start."""
        with self._lock:
            self.stopped = True
            for process in self._running:
                if sys.platform != "win32":  # where the keyboard interrupts all processes
                    # SIGTERM, as processes that a script starts in the background ignore SIGINT
                    process.send_signal(signal.SIGTERM)


def outcome_in(folder: Path) -> Outcome | None:
    """Read the status file in a folder; None without a valid one."""
    try:
        content = json.loads((folder / STATUS).read_bytes())
        return Outcome(**{**content, "options": tuple(content["options"])})
    except (OSError, ValueError, TypeError, KeyError):
        return None


def finished(job: Job) -> Outcome | None:
    """Return the earlier outcome of a job if it is done and the job has not changed."""
    outcome = outcome_in(Path(job.folder) / job.name)
    return outcome if outcome and outcome.state == DONE and _is_of(outcome, job) else None


def _is_of(outcome: Outcome, job: Job) -> bool:
    """Test whether an outcome is of the session, options and version of a job."""
    key = (outcome.session_sha256, outcome.options, outcome.mixpose)
    return key == (job.session_sha256, job.options, job.mixpose)


def run_job(job: Job, running: Running | None = None, threads: int = 1) -> Outcome:
    """Run a job unless it is done; an interrupt reaches its process through `running`."""
    missing = _not_shared(job)
    if missing is not None:
        return missing
    part = Path(job.folder) / f".{job.name}.{uuid.uuid4().hex if job.shared else UNFINISHED}"
    try:
        part.mkdir(exist_ok=True)
        with locked_folder(part, Path(job.folder) / job.name):
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
    resumes = _can_resume(part, job)
    log, poses = part / LOG, part / job.poses
    command = [sys.executable, "-m", "mixpose.cli.child", "run", *job.options]
    command += [f"--output={job.poses}", *(["--resume"] if resumes else [])]
    # if this process is killed, the status file still says which job was begun
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
    if resumes and state != FAILED:  # interrupted runs have poses in the file, too
        with suppress(OSError, ValueError, KeyError), poses.open(encoding="ascii") as stream:
            whole = [json.loads(line) for line in stream if line.endswith("\n")]
            frames = dict(Counter(line["status"] for line in whole if line["type"] == "pose"))
    last_line = (lines or ["it said nothing"])[-1].removeprefix("mixpose: ")
    reason = None if status == 0 else last_line
    outcome = replace(
        outcome_of(job, state, 128 - status if status < 0 else status, reason),
        frames=frames,
        bodies=bodies,
        # a run that resumes may repeat warnings of the earlier one
        warnings=sum(line.startswith("mixpose: warning: ") for line in set(lines)),
        seconds=round(time.monotonic() - began, 3),
    )
    if state == DONE:  # nothing remains to be resumed
        note_path(poses).unlink(missing_ok=True)
    write_json(part / STATUS, asdict(outcome))
    return outcome


def _can_resume(part: Path, job: Job) -> bool:
    """Test whether a folder has poses of the same job to resume; else empty it."""
    begun, poses = outcome_in(part), part / job.poses
    is_begun = begun is not None and begun.state == INTERRUPTED and _is_of(begun, job)
    if is_begun and poses.suffix == ".jsonl" and poses.exists():
        return True
    for path in part.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    return False


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Write an indented JSON file as a whole."""
    with appearing_whole(path) as part:
        part.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _put_in_place(part: Path, job: Job, outcome: Outcome) -> Outcome:
    """Rename a complete folder to its final name; poses that are done already stay."""
    place = Path(job.folder) / job.name
    while True:
        earlier, existing = finished(job), outcome_in(place)
        if earlier is not None:
            shutil.rmtree(part, ignore_errors=True)
            return earlier
        if outcome.state == FAILED and existing is not None and existing.state == DONE:
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
    """Return a failure if this machine does not see the folders of the one that made the job."""
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
    """Return the outcome of a job that ended on this machine."""
    values = {entry.name: getattr(job, entry.name) for entry in fields(Recording)}
    host = socket.gethostname()
    return Outcome(**values, state=state, exit_status=exit_status, reason=reason, host=host)
