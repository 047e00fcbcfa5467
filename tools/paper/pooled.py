"""Many independent pieces of work, in order, with a progress bar on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from rich.console import Console
from rich.progress import Progress

from mixpose.executing import executor

Task = TypeVar("Task")
Result = TypeVar("Result")


def in_order(
    function: Callable[[Task], Result], tasks: Sequence[Task], title: str, scheduler: str | None
) -> list[Result]:
    """What a function returns for each task; the first failure ends all.

    On a cluster the workers must be able to import the modules of this folder.
    """
    console = Console(stderr=True)
    results: dict[int, Result] = {}
    with (
        Progress(console=console, disable=not console.is_terminal) as progress,
        executor(scheduler) as pool,
    ):
        bar = progress.add_task(title, total=len(tasks))
        for number, result in pool.run(function, tasks):
            if isinstance(result, Exception):
                raise result
            results[number] = result
            progress.advance(bar)
    return [results[number] for number in range(len(tasks))]
