"""Progress of long work, on standard error."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from mixpose.calibration.task import Progress
from mixpose.cli.notices import say

_TIMED = 4  # frames by which it is told how long the search takes
_FOUND_BEFORE_S = 2e-3  # what takes less was found by a search that was cut off


@contextmanager
def watched() -> Iterator[Progress]:
    """Progress: a bar on a terminal; and how long the search will take, before it does."""
    last: dict[str, float] = {}
    took: dict[str, list[float]] = {}

    def expect(stage: str, done: int, total: int) -> None:
        if not stage.startswith("searching") or total <= 20:
            return
        now = time.perf_counter()
        step, last[stage] = now - last.get(stage, now), now
        steps = took.setdefault(stage, [])
        if step < _FOUND_BEFORE_S or len(steps) == _TIMED:
            return
        steps.append(step)
        if len(steps) == _TIMED:
            left, each = total - done, sum(steps) / _TIMED
            say(f"{left} frames of cameras left to search, about {_duration(each * left)}")

    if not sys.stderr.isatty():
        yield expect
        return
    from rich.console import Console  # noqa: PLC0415 - only where it is shown
    from rich.progress import Progress as Bar  # noqa: PLC0415

    with Bar(console=Console(stderr=True), transient=True) as bar:
        tasks: dict[str, object] = {}

        def show(stage: str, done: int, total: int) -> None:
            expect(stage, done, total)
            if stage not in tasks:
                for other in tasks.values():
                    bar.update(other, visible=False)  # type: ignore[arg-type]
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done, total=total)  # type: ignore[arg-type]

        yield show


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
