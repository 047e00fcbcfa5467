"""Threads while a frame is computed, and as before afterwards.

Linear algebra has one: the matrices of a frame are small.  Threads of a BLAS library that share
their work wait for each other far longer than they compute, above all where other programs keep
the processor busy.  Those that decode the next frames are let in soon.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock
from typing import Any

SWITCH_S = 2e-5
"""After so long a thread that has decoded is let on; Python's own 5 ms is a whole frame.

Timers of an operating system add some 50 µs: a wait takes 0.2 ms with 1e-4, 0.12 with this and 0.10
with 1e-6, where threads that compute are interrupted more often.
"""

_LIMITING, _SWITCHING = Lock(), Lock()


def ask_for_one_blas_thread() -> None:
    """Let this process begin with one thread, where nobody said otherwise.

    It holds for libraries that are not loaded yet, and saves the making of threads.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def keep_one_blas_thread() -> None:
    """Keep this process, which only computes, from ever sharing linear algebra among threads."""
    import numpy as np  # noqa: F401, PLC0415 - what is loaded later is not limited
    import scipy.linalg  # noqa: F401, PLC0415
    from threadpoolctl import threadpool_limits  # noqa: PLC0415

    threadpool_limits(limits=1, user_api="blas")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Keep NumPy, SciPy and OpenCV from sharing linear algebra among threads.

    Entering and leaving takes some 10 µs on an idle machine, and 2 where there is one already.  The
    limit is one of the whole process, so where frames are computed in several threads at once only
    the first sets and restores it: if each did, the last one would restore the limit of another.
    """
    if not _LIMITING.acquire(blocking=False):
        yield
        return
    try:
        # one by one: a limiter of threadpoolctl takes four times as long to make
        shared = [(one, count) for one in _libraries() if (count := one.num_threads) != 1]
        for one, _ in shared:
            one.set_num_threads(1)
        try:
            yield
        finally:
            for one, count in shared:
                one.set_num_threads(count)
    finally:
        _LIMITING.release()


@cache
def _libraries() -> Any:
    """The BLAS libraries that are loaded; looking for them takes milliseconds."""
    from threadpoolctl import ThreadpoolController  # noqa: PLC0415 - the command line starts here

    return ThreadpoolController().select(user_api="blas").lib_controllers


@contextmanager
def prompt_switching() -> Iterator[None]:
    """Let the threads that decode wait less for the one that estimates.

    What they wait for is the interpreter, some times a frame: after every call of OpenCV and of the
    operating system.  As the interval is one of the whole process, only the first of several that
    run at once, or inside each other, sets and restores it.
    """
    if not _SWITCHING.acquire(blocking=False):
        yield
        return
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
        _SWITCHING.release()
