"""Settings of threads while a frame is computed, restored afterwards.

Linear algebra gets one: the matrices of a frame are small, so that threads of a BLAS library wait
for each other far longer than they compute, above all if other programs keep the processor busy.
Threads that decode the next frames get the interpreter soon.
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
"""Longest wait of a decoding thread for the interpreter; Python's own 5 ms is a whole frame.

Timers of an operating system add some 50 µs: a wait takes 0.2 ms with 1e-4, 0.12 with this and 0.10
with 1e-6, which interrupts computing threads more often.
"""

_LIMITING, _SWITCHING = Lock(), Lock()


def ask_for_one_blas_thread() -> None:
    """Start this process with one BLAS thread, unless the environment says otherwise.

    It affects libraries that are not loaded yet, and saves creating threads.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def keep_one_blas_thread() -> None:
    """Limit linear algebra to one thread for the lifetime of this process."""
    import numpy as np  # noqa: F401, PLC0415 - the limit holds for loaded libraries only
    import scipy.linalg  # noqa: F401, PLC0415
    from threadpoolctl import threadpool_limits  # noqa: PLC0415

    threadpool_limits(limits=1, user_api="blas")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit linear algebra of NumPy, SciPy and OpenCV to one thread inside the context.

    Entering and leaving takes some 10 µs on an idle machine, and 2 if the limit is one already.  It
    is a limit of the whole process, so only the first of several threads that compute frames at
    once sets and restores it: else the last one would restore the limit set by another.
    """
    if not _LIMITING.acquire(blocking=False):
        yield
        return
    try:
        # one by one: creating a limiter of threadpoolctl takes four times as long
        limited = [(lib, count) for lib in _libraries() if (count := lib.num_threads) != 1]
        for lib, _ in limited:
            lib.set_num_threads(1)
        try:
            yield
        finally:
            for lib, count in limited:
                lib.set_num_threads(count)
    finally:
        _LIMITING.release()


@cache
def _libraries() -> Any:
    """Return the loaded BLAS libraries, searched once as that takes milliseconds."""
    from threadpoolctl import ThreadpoolController  # noqa: PLC0415 - the command line starts here

    return ThreadpoolController().select(user_api="blas").lib_controllers


@contextmanager
def prompt_switching() -> Iterator[None]:
    """Let the threads that decode wait less for the one that estimates.

    They wait for the interpreter several times a frame, after every call of OpenCV and of the
    operating system.  The interval is that of the whole process, so only the first of several
    contexts, at once or nested, sets and restores it.
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
