"""How things are timed, and how figures are printed beside what is aimed at."""

from __future__ import annotations

import gc
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

Task: TypeAlias = Callable[[], Any]
Clock: TypeAlias = Callable[[], float]

WALL: Clock = time.perf_counter

# For computing in one thread: a busy machine interrupts long tasks, not short ones, and only the
# time on the wall shows it.  Where nothing interrupts, both clocks agree.  The one of Windows ticks
# 64 times a second only.
PROCESSOR: Clock = time.perf_counter if sys.platform == "win32" else time.process_time


def medians(
    tasks: Mapping[str, Task],
    *,
    rounds: int,
    calls: int = 1,
    warm_up: int = 1,
    clock: Clock = WALL,
) -> dict[str, float]:
    """Median seconds of a call of each task.

    The tasks take turns, so that whatever else the machine does falls on all of them alike, and
    ratios of the medians hold on a machine that is not idle.

    Parameters
    ----------
    tasks : mapping of str to callable
    rounds : int
        Turns of each task.
    calls : int
        Calls per turn, for tasks that are short against the clock.
    warm_up : int
        Turns before those that count.
    clock : callable
        `WALL` or `PROCESSOR`.
    """
    seconds: dict[str, list[float]] = {name: [] for name in tasks}
    gc.collect()
    gc.disable()
    try:
        for turn in range(-warm_up, rounds):
            for name, task in tasks.items():
                began = clock()
                for _ in range(calls):
                    task()
                if turn >= 0:
                    seconds[name].append((clock() - began) / calls)
    finally:
        gc.enable()
    return {name: float(np.median(each)) for name, each in seconds.items()}


def slope(sizes: Sequence[float], seconds: Sequence[float]) -> float:
    """Slope of time over size, both in logarithms: 1 for proportional, 2 for quadratic."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def show(
    text: str, value: float, *, at_most: float | None = None, at_least: float | None = None
) -> None:
    """Print a figure, and whether it is what is aimed at."""
    aim = ""
    if at_most is not None:
        aim = f"  at most {at_most:g}" + ("" if value <= at_most else "  MISSED")
    if at_least is not None:
        aim = f"  at least {at_least:g}" + ("" if value >= at_least else "  MISSED")
    print(f"  {text:58} {value:10.4g}{aim}", flush=True)
