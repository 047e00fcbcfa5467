"""Run independent tasks in parallel: in threads, in processes, or on a cluster.

A cluster is one of ``dask.distributed`` (the extra ``[dask]``): ``local`` starts one on this
machine, an address such as ``tcp://head:8786`` names the scheduler of a running one.  It repeats
the tasks of a worker that was lost, so a task must do no harm if it runs twice.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent import futures
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Protocol, TypeVar

from mixpose.errors import SessionError, require_package
from mixpose.threads import keep_one_blas_thread

Task = TypeVar("Task")
Result = TypeVar("Result")

LOCAL = "local"
"""In place of an address: a cluster on this machine."""

PATIENCE_S = 20.0
"""Longest wait for the answer of a scheduler."""


class Executor(Protocol):
    """Runs tasks; an error in one does not stop the others."""

    def run(
        self, function: Callable[[Task], Result], tasks: Sequence[Task]
    ) -> Iterator[tuple[int, Result | Exception]]:
        """Call a function with each task; yield indices with results or errors, as they end."""


class _Pool:
    """Threads or processes of this machine."""

    def __init__(self, pool: futures.Executor) -> None:
        self._pool = pool

    def run(
        self, function: Callable[[Task], Result], tasks: Sequence[Task]
    ) -> Iterator[tuple[int, Result | Exception]]:
        numbers = {self._pool.submit(function, task): k for k, task in enumerate(tasks)}
        for future in futures.as_completed(numbers):
            yield numbers[future], _outcome(future)


class _Cluster:
    """Workers of a scheduler of ``dask.distributed``."""

    def __init__(self, client: Any) -> None:
        self._client = client

    def run(
        self, function: Callable[[Task], Result], tasks: Sequence[Task]
    ) -> Iterator[tuple[int, Result | Exception]]:
        from distributed import as_completed  # noqa: PLC0415 - an extra

        submitted = self._client.map(function, list(tasks), pure=False)
        numbers = {future.key: k for k, future in enumerate(submitted)}
        for future in as_completed(submitted):
            yield numbers[future.key], _outcome(future)


def _outcome(future: Any) -> Any:
    """Return the result of a task that ended, or its error; an interrupt is raised."""
    error = future.exception()
    if error is not None and not isinstance(error, Exception):
        raise error
    return future.result() if error is None else error


@contextmanager
def _pooled(started: futures.Executor) -> Iterator[Executor]:
    """Run tasks in a pool; after an error no further one is started."""
    try:
        yield _Pool(started)
    except BaseException:
        # a second shutdown, as by `with`, would undo the cancelling; running tasks are waited for
        started.shutdown(cancel_futures=True)
        raise
    started.shutdown()


def in_threads(workers: int) -> AbstractContextManager[Executor]:
    """Return an executor with threads as workers, for tasks that mostly wait."""
    return _pooled(futures.ThreadPoolExecutor(workers))


def in_processes(workers: int | None = None) -> AbstractContextManager[Executor]:
    """Return an executor with processes, by default one per processor, for tasks that compute.

    Linear algebra has one thread in each.
    """
    context = multiprocessing.get_context("spawn")
    return _pooled(futures.ProcessPoolExecutor(workers, context, keep_one_blas_thread))


@contextmanager
def on_cluster(scheduler: str, workers: int | None = None) -> Iterator[Executor]:
    """Run tasks on workers of a scheduler at an address, or of a cluster on this machine (`LOCAL`).

    Raises SessionError if ``dask.distributed`` is not installed, or no scheduler answers.
    """
    require_package(f"--scheduler {scheduler}", "distributed", "dask")
    from distributed import Client, LocalCluster  # noqa: PLC0415 - an extra

    if scheduler == LOCAL:
        count = workers or os.cpu_count() or 1
        with (
            LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=None) as cluster,
            Client(cluster) as client,
        ):
            yield _Cluster(client)
        return
    try:
        client = Client(scheduler, timeout=PATIENCE_S)
    except (OSError, ValueError) as error:  # a timeout is an OSError, too
        raise SessionError(
            f"--scheduler {scheduler}: no scheduler answers there; allowed are {LOCAL}, or an "
            "address such as tcp://head:8786, where `dask scheduler` runs"
        ) from error
    with client:
        yield _Cluster(client)


def executor(scheduler: str | None, workers: int | None = None) -> AbstractContextManager[Executor]:
    """Return an executor with processes of this machine, or with the cluster of a scheduler."""
    return in_processes(workers) if scheduler is None else on_cluster(scheduler, workers)
