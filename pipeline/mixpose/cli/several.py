"""``mixpose run`` on many recordings, here or on a cluster, each in a separate process and folder.

A process runs the same command with one session, so that a recording gives the same poses alone
and among others, and none can disturb another.
"""

from __future__ import annotations

import csv
import glob
import hashlib
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import typer

from mixpose import __version__
from mixpose.cli import recording_job
from mixpose.cli.notices import counted, frames_text, say, warn
from mixpose.cli.recording_job import DONE, FAILED, INTERRUPTED, UNFINISHED, Job, Outcome, run_job
from mixpose.cli.request import SUFFIXES, RunRequest
from mixpose.errors import SessionError, reporting
from mixpose.executing import Executor, in_threads, on_cluster
from mixpose.limits import MOST_BYTES
from mixpose.whole_files import appearing_whole

USUAL_STEM = "session"
"""Sessions of this name are told apart by their folders."""

SUMMARY, TABLE = "summary.json", "summary.csv"

_COLUMNS = ("name", "state", "ok", "ambiguous", "lost", "warnings", "seconds", "reason")
_STATUSES = ("ok", "ambiguous", "lost")


def run(request: RunRequest) -> None:
    """Run one session in this process, or several in separate ones."""
    are_many, written = request.are_many, request.format_name
    if request.labels and written != "jsonl":
        raise SessionError(f"--labels: found --format {written}; allowed: jsonl, which has room")
    if are_many and (request.publish or request.predict is not None):
        raise SessionError(
            "--publish: found several sessions; allowed is one, whose poses receivers take for one "
            "recording"
        )
    if are_many:
        raise typer.Exit(run_sessions(sessions_of(request.sessions), request))
    from mixpose.cli.run import run_session  # noqa: PLC0415 - several run in other processes

    if request.workers > 1:
        warn(f"--workers {request.workers}: one session is one process, frames follow each other")
    run_session(request)


def sessions_of(named: Sequence[str]) -> list[Path]:
    """Return the sessions that files, patterns, or text files with one per line name."""
    sessions: dict[Path, None] = {}
    for text in named:
        path = Path(text)
        if path.suffix == ".txt":
            paths = _listed(path)
        elif glob.has_magic(text) and not path.exists():
            paths = [Path(name) for name in sorted(glob.glob(text, recursive=True))]  # noqa: PTH207
            if not paths:
                raise SessionError(f"{text}: matches no session file")
        else:
            paths = [path]
        sessions.update(dict.fromkeys(name.absolute() for name in paths))
    return list(sessions)


def _listed(path: Path) -> list[Path]:
    """Return the paths that a list names, from the working folder or else from that of the list."""
    try:
        content = _beginning(path)
        lines = content.decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise SessionError(f"{path}: cannot be read: {reason}") from error
    if len(content) > MOST_BYTES:
        raise SessionError(f"{path}: found more than {MOST_BYTES} bytes, as many are allowed")
    names = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not names:
        raise SessionError(f"{path}: names no session; allowed: a session file per line")
    return [named if (named := Path(name)).exists() else path.parent / name for name in names]


def _refuse_alone(sessions: Sequence[Path], request: RunRequest) -> None:
    """Raise SessionError for options that serve a single recording."""
    alone = {"--source": request.source, "--overlay": request.overlay, "--view": request.view}
    alone["--pause"] = "" if request.pause else None
    for option, value in alone.items():
        if not value and value != "":
            continue  # not given; an empty text is the usual port, or an option without a value
        if option == "--view" and not value and not sessions[-1].exists():
            raise SessionError(
                f"{sessions[-1]}: no such session file; after --view allowed are a port, HOST:PORT "
                "or nothing"
            )
        shown = f" {value[0] if isinstance(value, list) else value}".rstrip()
        listed = ", ".join(map(str, sessions[:3])) + (", ..." if len(sessions) > 3 else "")
        raise SessionError(
            f"{option}{shown}: found {len(sessions)} sessions ({listed}), allowed with one only"
        )


def run_sessions(sessions: Sequence[Path], request: RunRequest) -> int:
    """Run all recordings that are not done yet; report each, and return the highest exit status."""
    _refuse_alone(sessions, request)
    folder = _folder(request.poses, len(sessions))
    jobs = _jobs(sessions, folder, request)
    _refuse_others(folder, jobs)
    before = map(recording_job.finished, jobs)
    outcomes = {k: outcome for k, outcome in enumerate(before) if outcome is not None}
    if outcomes:
        say(f"{len(outcomes)} of {len(jobs)} recordings are done already")
    remaining = [k for k in range(len(jobs)) if k not in outcomes]
    try:
        with _doing(request) as (executor, function):
            for place, result in executor.run(function, [jobs[k] for k in remaining]):
                number = remaining[place]
                outcomes[number] = _outcome_of(jobs[number], result)
                say(f"{sessions[number]}: {_line(outcomes[number])}")
    finally:
        ended = [outcomes[k] for k in sorted(outcomes)]
        # remove what killed workers have left of recordings that others finished
        done = {f".{outcome.name}" for outcome in ended if outcome.state == DONE}
        for part in [path for path in folder.glob(".*.*") if path.stem in done]:
            shutil.rmtree(part, ignore_errors=True)
        _write_summary(folder, ended, len(jobs))
    return _say_all(folder, ended)


@contextmanager
def _doing(request: RunRequest) -> Iterator[tuple[Executor, partial[Outcome]]]:
    """Yield the executor of the jobs, and the function that it calls for each."""
    workers = request.workers
    if request.scheduler is not None:
        with on_cluster(request.scheduler, workers if workers > 1 else None) as cluster:
            yield cluster, partial(run_job)
        return
    running = recording_job.Running()
    share = max((os.cpu_count() or 1) // workers, 1)
    with in_threads(workers) as threads:
        try:
            yield threads, partial(run_job, running=running, threads=share)
        except KeyboardInterrupt:
            running.interrupt()
            raise


def _outcome_of(job: Job, result: Outcome | Exception) -> Outcome:
    if isinstance(result, Outcome):
        return result
    # its workers were lost repeatedly
    reason = f"{type(result).__name__}: {' '.join(str(result).split())}"
    return replace(recording_job.outcome_of(job, FAILED, 3, reason), host="")


def _jobs(sessions: Sequence[Path], folder: Path, request: RunRequest) -> list[Job]:
    suffix = next(end for end, name in SUFFIXES.items() if name == request.format_name)
    return [
        Job(
            session=str(session.absolute()),
            session_sha256=_sha256(session),
            folder=str(folder.absolute()),
            name=name,
            poses=f"poses{suffix}",
            options=_options(request),
            mixpose=__version__,
            shared=request.scheduler is not None,
        )
        for session, name in zip(sessions, names_of(sessions), strict=True)
    ]


def names_of(sessions: Sequence[Path]) -> list[str]:
    """Return distinct names of sessions, of the file or its folder, with more folders as needed."""
    parts = [
        [*session.absolute().parent.parts[1:], *([session.stem] * (session.stem != USUAL_STEM))]
        for session in sessions
    ]
    depths = [1] * len(parts)
    while True:
        names = ["-".join(part[-depth:]) for part, depth in zip(parts, depths, strict=True)]
        counts = Counter(map(str.casefold, names))  # some file systems ignore case
        twins = [k for k, name in enumerate(names) if counts[name.casefold()] > 1]
        shallow = [k for k in twins if depths[k] < len(parts[k])]
        if not shallow:
            return [f"{name}-{k}" if k in twins else name for k, name in enumerate(names)]
        for k in shallow:
            depths[k] += 1


def _options(request: RunRequest) -> tuple[str, ...]:
    values = {"format": request.format_name, "step": request.step}
    values |= {"start": request.start, "stop": request.stop}
    flags = {"allow-code": request.allow_code, "labels": request.labels, "debug": request.debug}
    named = [f"--{name}={value}" for name, value in values.items() if value is not None]
    return (*named, *(f"--{name}" for name, is_on in flags.items() if is_on))


def _sha256(session: Path) -> str:
    with suppress(OSError):
        return hashlib.sha256(_beginning(session)).hexdigest()
    return ""


def _beginning(path: Path) -> bytes:
    """Return the bytes of a file; of too large a file, one more than allowed."""
    with path.open("rb") as file:
        return file.read(MOST_BYTES + 1)


def _folder(folder: Path | None, count: int) -> Path:
    if folder is None:
        raise SessionError(f"-o DIR: missing; {count} sessions need a folder for the poses")
    sessions = counted(count, "session")
    if folder.exists() and not folder.is_dir():
        raise SessionError(f"-o {folder}: is a file; {sessions} need a folder for the poses")
    if not folder.exists() and folder.name.casefold().endswith((*SUFFIXES, ".rrd")):
        raise SessionError(
            f"-o {folder}: found the name of a file; allowed for {sessions}: a folder, in which "
            f"each gets its own; as -o {folder.with_suffix('')}, and --format for the format"
        )
    with reporting(SessionError, f"-o {folder}: cannot be made"):
        folder.mkdir(exist_ok=True)
    return folder


def _refuse_others(folder: Path, jobs: Sequence[Job]) -> None:
    """Raise SessionError if the folder of a job exists and belongs to another session."""
    for job in jobs:
        for name in (job.name, f".{job.name}.{UNFINISHED}"):
            other = recording_job.outcome_in(folder / name)
            if other is not None and Path(other.session).resolve() != Path(job.session).resolve():
                raise SessionError(
                    f"-o {folder}: {name} in it is of {other.session}, not of {job.session}; name "
                    "another folder, or remove that one"
                )


def _line(outcome: Outcome) -> str:
    if outcome.reason is not None:
        return outcome.reason.removeprefix(f"{outcome.session}: ")
    text = frames_text(outcome.frames, outcome.bodies)
    warnings = f"; {counted(outcome.warnings, 'warning')} in its log" if outcome.warnings else ""
    return text + warnings


def _write_summary(folder: Path, outcomes: Sequence[Outcome], total: int) -> None:
    states = Counter(outcome.state for outcome in outcomes)
    summary = {
        "recordings": total,
        "done": states[DONE],
        "failed": states[FAILED],
        "not_done": total - states[DONE] - states[FAILED],
        "results": [asdict(outcome) for outcome in outcomes],
    }
    recording_job.write_json(folder / SUMMARY, summary)
    with appearing_whole(folder / TABLE) as part, part.open("w", encoding="utf-8", newline="") as f:
        table = csv.DictWriter(f, _COLUMNS, extrasaction="ignore", lineterminator="\n")
        table.writeheader()
        for outcome in outcomes:
            counts = {word: outcome.frames.get(word, 0) for word in _STATUSES}
            table.writerow(asdict(outcome) | counts)


def _say_all(folder: Path, outcomes: Sequence[Outcome]) -> int:
    """Print how many recordings are done and failed; return the highest exit status."""
    failed = [outcome for outcome in outcomes if outcome.state == FAILED]
    done = sum(outcome.state == DONE for outcome in outcomes)
    parts = f"{done} done" + (f", {len(failed)} failed" if failed else "")
    say(f"{counted(len(outcomes), 'recording')}: {parts} -> {folder / TABLE}")
    if any(outcome.state == INTERRUPTED for outcome in outcomes):
        raise KeyboardInterrupt
    return max((outcome.exit_status for outcome in outcomes), default=0)
