"""Put small bugs into the code, one at a time, and see that a test falls to each.

python tools/mutants.py [NAME ...] [--room ROOM] [--json FILE] [--keep-going]
python tools/mutants.py --random N [--seed S] [--room ROOM] [--json FILE] [--keep-going] [--record]

Each mutant of `tools/mutation/` goes into a copy of the files that git tracks, and the tests of
its room run there until the first that fails.  A mutant that no test notices survives: then a test
is missing.  Where the tests are not done in time, by the mutant or by a busy machine, nothing is
known.  The exit status is 1 where one survives or runs out of time, 2 where one cannot be tried.

With `--random`, N mutants are made by the rules of `tools/mutation/rules.py`, and the tests that
execute the changed line run, quick ones first.  Which these are stands in `build/executed`, where
`--record` puts it by coverage (`.[dev]`): first half an hour, then what has changed.  Those of
`tools/mutation/harmless.py` need fall to no test; they are not tried and are counted apart.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).resolve().parent))

from mutation import MUTANTS
from mutation.drawn import ROOMS, chosen_tests, drawn, reason_why_harmless, shares
from mutation.executed import read, record
from mutation.mutant import Mutant, MutationError

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "pipeline/mixpose"

# Globs below `tests`; what is quick comes first, as the first test that fails ends a trial.
TESTS: dict[str, tuple[str, ...]] = {
    "rigid": ("test_rigid.py",),
    "records": ("test_records.py",),
    "units": ("test_session_calibration.py", "test_poses_*.py"),
    "sensors": ("test_sensors.py", "test_sensors_*.py"),
    "body": ("test_body.py",),
    "optimise": ("test_optimise.py",),
    "extraction": ("test_extraction_*.py",),
    "frames": (
        "test_frames_pairing.py",
        "test_frames_t*.py",
        "test_frames_images.py",
        "test_frames_profiles.py",
        "test_frames_video.py",
        "test_frames_*.py",
    ),
    "session": ("test_session_*.py",),
    "poses": ("test_poses_*.py",),
    "publishing": ("test_publishing.py", "test_publishing_*.py"),
    "simulation": ("test_simulation_*.py",),
    "checking": ("test_check_*.py",),
    "design": ("test_design.py",),
    "learning": ("test_learn*.py",),
    "cli": ("test_cli_findings.py", "test_cli_messages.py", "test_cli*.py"),
    "calibration": ("test_calibration*.py",),
    "trajectories": ("test_smooth*.py", "test_align.py", "test_pivot*.py"),
    "runner": ("test_runner_*.py",),
    "density": (
        "test_density_atlas.py",
        "test_density*.py",
        "test_tracking_outliers.py",
    ),
    "objective": ("test_objective_kernel.py", "test_objective*.py"),
    "search": (
        "test_search_evidence.py",
        "test_search_guesses.py",
        "test_search_detections.py",
        "test_search_[!p]*.py",
        "test_search_*.py",
    ),
    "fit": ("test_fit_*.py", "test_fit*.py"),
    "matching": (
        "test_matching*.py",
        "test_judgement.py",
        "test_tracking_outliers.py",
    ),
    "judgement": (
        "test_judgement*.py",
        "test_tracking_outliers.py",
        "test_tracking_starts.py",
        "test_tracking.py",
    ),
    "tracking": (
        "test_tracking_track.py",
        "test_tracking_gating.py",
        "test_tracking_starts.py",
        "test_tracking_delays.py",
        "test_tracking_outliers.py",
        "test_tracking_ranges.py",
        "test_tracking*.py",
        "test_runner_*.py",
    ),
}

# A mutant may make the code go on for ever; no test has failed then.
TIME_LIMIT_S = 900.0
RECORD_LIMIT_S = 300.0  # for a file of tests; those that are not done by then are not known
EXECUTED = ROOT / "build" / "executed"

_FAILED = re.compile(r"^(?:FAILED|ERROR) (tests/\S+?::.*?)(?: - .*)?$", re.MULTILINE)


class OutOfTimeError(Exception):
    """The tests were not done within the time limit."""


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant; `killed_by` is the test that fell to it, None where none did.

    None did as far as is known where the tests ran `out_of_time`.
    """

    name: str
    room: str
    why: str
    killed_by: str | None
    seconds: float
    out_of_time: bool = False
    harmless: str | None = None

    @property
    def verdict(self) -> str:
        if self.killed_by is not None:
            return f"killed by {self.killed_by}"
        if self.harmless is not None:
            return f"harmless, {self.harmless}"
        return "OUT OF TIME" if self.out_of_time else "SURVIVED"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="mutants; all where left out")
    parser.add_argument("--room", action="append", default=[], help=", ".join(TESTS))
    parser.add_argument("--json", type=Path, help="file for the outcomes")
    parser.add_argument("--keep-going", action="store_true", help="go on after a survivor")
    parser.add_argument("--random", type=int, metavar="N", help=f"by rule; rooms: {ROOMS}")
    parser.add_argument("--seed", type=int, default=0, help="other mutants by rule; 0 if left out")
    parser.add_argument("--seconds", type=float, default=90.0, help="of tests for one by rule")
    parser.add_argument("--record", action="store_true", help="anew what tests execute")
    options = parser.parse_args(arguments)
    try:
        if options.random is None:
            mutants = chosen(MUTANTS, options.names, options.room)
            outcomes = tried(ROOT, mutants, keep_going=options.keep_going)
        else:
            outcomes = tried_at_random(ROOT, EXECUTED, options)
            print("\n".join(shares(outcomes)))
    except MutationError as error:
        print(error, file=sys.stderr)
        return 2
    if options.json:
        rows = [asdict(outcome) for outcome in outcomes]
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    harmless = sum(outcome.harmless is not None for outcome in outcomes)
    alive = [each for each in outcomes if each.killed_by is None and each.harmless is None]
    late = sum(outcome.out_of_time for outcome in alive)
    seconds = sum(outcome.seconds for outcome in outcomes)
    print(
        f"{len(outcomes)} mutants, {len(alive) - late} survived, {late} ran out of time, "
        f"{seconds:.0f} s" + (f", {harmless} harmless" if harmless else "")
    )
    return 1 if alive else 0


def chosen(
    mutants: Sequence[Mutant], names: Sequence[str], rooms: Sequence[str]
) -> tuple[Mutant, ...]:
    """The mutants of these names and rooms, all of them where none are given."""
    known = [mutant.name for mutant in mutants]
    for name in names:
        if name not in known:
            raise MutationError(f"no such mutant: {name}; allowed: {', '.join(known)}")
    for room in rooms:
        if room not in TESTS:
            raise MutationError(f"no such room: {room}; allowed: {', '.join(TESTS)}")
    return tuple(
        mutant
        for mutant in mutants
        if (not names or mutant.name in names) and (not rooms or mutant.room in rooms)
    )


def tried(root: Path, mutants: Sequence[Mutant], *, keep_going: bool) -> list[Outcome]:
    """Try mutants on a copy of a repository and say of each what became of it."""
    outcomes: list[Outcome] = []
    with TemporaryDirectory() as folder:
        tree = Path(folder) / "sound"
        copy_tracked(root, tree)
        check_sound(tree, mutants)
        for mutant in mutants:
            outcome = trial(tree, Path(folder) / "mutated", mutant)
            outcomes.append(outcome)
            print(f"{mutant.name}: {outcome.verdict} ({outcome.seconds:.1f} s)", flush=True)
            if outcome.killed_by is None:
                print(f"  {mutant.file}: {mutant.why}", flush=True)
                if not keep_going:
                    break
    return outcomes


def tried_at_random(root: Path, folder: Path, options: argparse.Namespace) -> list[Outcome]:
    """Try mutants by rule on a copy of a repository, by the tests that execute their lines."""
    outcomes: list[Outcome] = []
    with TemporaryDirectory() as place:
        tree = Path(place) / "sound"
        copy_tracked(root, tree)
        mutants = drawn(tree / PACKAGE, options.random, options.seed, options.room)
        if options.record:
            record(tree, PACKAGE, folder, _environment(tree), RECORD_LIMIT_S)
        executed = read(folder, tree, PACKAGE)
        if not executed.seconds:
            raise MutationError(f"{folder}: found no record of what tests execute; add --record")
        for mutant in mutants:
            reason = reason_why_harmless(mutant)
            tests = [] if reason else chosen_tests(mutant, executed, options.seconds)
            outcome = Outcome(mutant.name, mutant.room, mutant.why, None, 0.0, harmless=reason)
            if tests:
                outcome = trial(tree, Path(place) / "mutated", mutant, tests)
            outcomes.append(outcome)
            print(f"{mutant.name}: {outcome.verdict} ({outcome.seconds:.1f} s)", flush=True)
            if outcome.killed_by is None and outcome.harmless is None:
                noticed = f"{len(tests)} tests" if tests else "no test comes here"
                print(f"  {mutant.why} ({noticed})", flush=True)
                if not options.keep_going:
                    break
    return outcomes


def copy_tracked(root: Path, tree: Path) -> None:
    """Copy what git tracks, as it stands in the working tree."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=root, check=True, capture_output=True, text=True
    )
    for name in filter(None, listed.stdout.split("\0")):
        if (root / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, tree / name)


def check_sound(tree: Path, mutants: Sequence[Mutant]) -> None:
    """See that the texts of all mutants are there, and that the tests pass without them.

    Raises
    ------
    MutationError
    """
    for mutant in mutants:
        mutant.mutated(_source(tree, mutant).read_text(encoding="utf-8"))
    imported = subprocess.run(
        [sys.executable, "-c", "import mixpose; print(mixpose.__file__)"],
        cwd=tree,
        env=_environment(tree),
        check=True,
        capture_output=True,
        text=True,
    ).stdout.strip()
    if not Path(imported).resolve().is_relative_to(tree.resolve()):
        raise MutationError(f"{imported} is imported in place of the copy in {tree}")
    tests = _unique(name for each in mutants for name in tests_of(tree, each))
    try:
        failed = first_failure(tree, tests)
    except OutOfTimeError as error:
        raise MutationError(f"without any mutant, {error}; choose fewer mutants") from error
    if failed is not None:
        raise MutationError(f"{failed} fails without any mutant; mend this first")


def trial(tree: Path, copy: Path, mutant: Mutant, tests: Sequence[str] = ()) -> Outcome:
    """Run some tests, or those of a mutant's room, on a copy of a tree with the mutant in it.

    Where some tests are named, a mutant with which these cannot be collected is killed too.
    """
    began = time.perf_counter()
    killed_by, late = None, False
    shutil.copytree(tree, copy)
    try:
        source = _source(copy, mutant)
        source.write_text(mutant.mutated(source.read_text(encoding="utf-8")), encoding="utf-8")
        for compiled in (source.parent / "__pycache__").glob(f"{source.stem}.*.pyc"):
            compiled.unlink()
        try:
            killed_by = first_failure(copy, tests or tests_of(copy, mutant))
        except OutOfTimeError:
            late = True
        except MutationError as error:
            if tests and _collected(tree, tests):
                killed_by = "the import of its module"
            else:
                raise MutationError(f"{mutant.name}: {error}") from error
    finally:
        shutil.rmtree(copy)
    seconds = time.perf_counter() - began
    return Outcome(mutant.name, mutant.room, mutant.why, killed_by, seconds, late)


def tests_of(tree: Path, mutant: Mutant) -> list[str]:
    """Files of tests for a mutant, its own first and then those of its room."""
    patterns = [*mutant.tests, *TESTS[mutant.room]]
    found = [path for pattern in patterns for path in sorted((tree / "tests").glob(pattern))]
    return _unique(f"tests/{path.name}" for path in found)


def first_failure(tree: Path, tests: Sequence[str]) -> str | None:
    """The first test that fails in a tree, None where all pass.

    Raises
    ------
    MutationError
        If the tests cannot be run, as where a module cannot be imported.
    OutOfTimeError
        If they are not done within `TIME_LIMIT_S`.
    """
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-x", "-q", "-rfE"]
    try:
        done = subprocess.run(
            [*command, "--tb=no", *tests],
            cwd=tree,
            env=_environment(tree),
            check=False,
            capture_output=True,
            text=True,
            timeout=TIME_LIMIT_S,
        )
    except subprocess.TimeoutExpired as error:
        raise OutOfTimeError(f"the tests are not done after {TIME_LIMIT_S:g} s") from error
    if done.returncode == 0:
        return None
    failed = _FAILED.search(done.stdout)
    if done.returncode != 1 or failed is None:
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-3:]
        raise MutationError(f"the tests do not run: {' / '.join(last)}")
    return failed[1]


def _collected(tree: Path, tests: Sequence[str]) -> bool:
    """Whether all of some tests are there."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-q", "--collect-only"]
    environment = _environment(tree)
    done = subprocess.run(
        [*command, *tests], cwd=tree, env=environment, check=False, capture_output=True
    )
    return done.returncode == 0


def _source(tree: Path, mutant: Mutant) -> Path:
    return tree / PACKAGE / mutant.file


def _environment(tree: Path) -> dict[str, str]:
    """That of this process, with the package of the tree and without what differs by machine."""
    environment = {k: v for k, v in os.environ.items() if k != "MIXPOSE_RECORDINGS"}
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    return environment | threads | {"PYTHONPATH": str(tree / "pipeline")}


def _unique(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))


if __name__ == "__main__":
    sys.exit(main())
