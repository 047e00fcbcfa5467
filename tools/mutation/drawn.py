"""Mutants by rule: drawn at random from the rooms, the same ones from the same seed."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Protocol

from mutation.executed import Executed
from mutation.harmless import GUARDED, HARMLESS
from mutation.mutant import Mutant, MutationError
from mutation.rules import Change, changes

ROOMS = (
    "calibration",
    "session",
    "search",
    "design",
    "executing",
    "runner",
    "tracking",
    "poses",
    "cli",
    "report",
    "pictures",
    "frames",
    "simulation",
    "learning",
    "trajectories",
    "publishing",
    "checking",
)

# Numbers in them place and draw things on a page.
LAYOUT = ("pictures/*", "report/drawing.py", "report/figures.py", "design/plot.py")


@dataclass(frozen=True)
class Drawn(Mutant):
    """A change by rule as a mutant, with where it is in the text of its file.

    Attributes
    ----------
    change : Change
    old, new : str
        Its line without and with it.
    """

    change: Change = Change(0, 0, "", 0, None)
    old: str = ""
    new: str = ""

    def mutated(self, text: str) -> str:
        if _piece(text, self.change) != self.before:
            raise MutationError(f"{self.name}: {self.file} is not what it was; draw anew")
        return _with(text, self.change)


def drawn(package: Path, number: int, seed: int, rooms: Sequence[str] = ()) -> list[Drawn]:
    """Mutants of some rooms, or of all `ROOMS`, which take turns; distinct, in a random order.

    Raises
    ------
    MutationError
        If there is no such room.
    """
    for room in rooms:
        if room not in ROOMS:
            raise MutationError(f"no such room: {room}; allowed: {', '.join(ROOMS)}")
    rng = random.Random(seed)
    heaps = [list(_possible(package, room)) for room in ROOMS if not rooms or room in rooms]
    for heap in heaps:
        rng.shuffle(heap)
    found: list[tuple[str, str, Change]] = []
    while len(found) < number and any(heaps):
        found.extend(heap.pop() for heap in heaps if heap)
    return [_mutant(*each) for each in found[:number]]


def chosen_tests(mutant: Drawn, executed: Executed, seconds: float) -> list[str]:
    """Tests that execute the line of a mutant, as many as take some seconds, one at least.

    Where it is executed on import, these are all that execute anything of its module.  Those that
    are named after its room come first, then quick ones.
    """
    line, reach = (mutant.change.line, mutant.change.line), mutant.change.reach
    within = (line, reach) if reach else (None,)
    tests = executed.tests(mutant.file, within)
    named = [test for test in tests if test.startswith(f"tests/test_{mutant.room}")]
    chosen: list[str] = []
    for test in dict.fromkeys([*named, *tests]):
        seconds -= executed.seconds[test]
        if chosen and seconds < 0:
            break
        chosen.append(test)
    return chosen


def reason_why_harmless(mutant: Drawn) -> str | None:
    """Why a mutant need fall to no test, None where it should."""
    if mutant.new.count("strict=False") > mutant.old.count("strict=False"):
        return GUARDED
    known = {(each.file, each.old, each.new): each.reason for each in HARMLESS}
    return known.get((mutant.file, mutant.old, mutant.new))


class Verdict(Protocol):
    """What became of a mutant."""

    @property
    def room(self) -> str: ...
    @property
    def killed_by(self) -> str | None: ...
    @property
    def harmless(self) -> str | None: ...
    @property
    def out_of_time(self) -> bool: ...


def shares(outcomes: Sequence[Verdict]) -> list[str]:
    """A table of Markdown: mutants of each room that were drawn and what became of them."""
    titles = "| room | drawn | killed | harmless | out of time | survived |"
    rows = [titles, "| --- |" + " ---: |" * 5]
    names = [room for room in ROOMS if any(one.room == room for one in outcomes)]
    for name in [*names, "all"]:
        those = [one for one in outcomes if name in {one.room, "all"}]
        killed = sum(one.killed_by is not None for one in those)
        harmless = sum(one.harmless is not None for one in those)
        late = sum(one.out_of_time for one in those)
        left = len(those) - killed - harmless - late
        rows.append(f"| {name} | {len(those)} | {killed} | {harmless} | {late} | {left} |")
    return rows


def candidates(package: Path, room: str) -> Iterator[Drawn]:
    """All mutants by rule of a room, a module or a folder of them."""
    return (_mutant(*each) for each in _possible(package, room))


def _possible(package: Path, room: str) -> Iterator[tuple[str, str, Change]]:
    """What they are made of: the file and its text, and the change."""
    for path in sorted([*package.glob(f"{room}.py"), *(package / room).rglob("*.py")]):
        file = path.relative_to(package).as_posix()
        text = path.read_text(encoding="utf-8")
        numbers = not any(PurePosixPath(file).match(pattern) for pattern in LAYOUT)
        for change in changes(text, numbers=numbers):
            yield file, text, change


def _mutant(file: str, text: str, change: Change) -> Drawn:
    before = _piece(text, change)
    lines, other = text.splitlines(), _with(text, change).splitlines()
    old, new = lines[change.line - 1].strip(), other[change.line - 1].strip()
    name = f"{file}:{change.line}: {_short(before)} -> {_short(change.after)}"
    return Drawn(name, file, before, change.after, f"{old}  ->  {new}", (), change, old, new)


def _piece(text: str, change: Change) -> str:
    return text.encode()[change.start : change.end].decode()


def _with(text: str, change: Change) -> str:
    data = text.encode()
    return (data[: change.start] + change.after.encode() + data[change.end :]).decode()


def _short(piece: str) -> str:
    return piece.partition("\n")[0] or "nothing"
