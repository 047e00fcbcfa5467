"""Many tasks at once: what becomes of errors, and of tasks that nobody waits for any more."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

from mixpose import executing
from mixpose.errors import SessionError
from mixpose.executing import Executor, in_processes, in_threads


class GoneError(Exception):
    """The caller has gone."""


def leave_after_one(
    executor: Executor, function: Callable[[Any], Any], tasks: Sequence[Any]
) -> None:
    next(iter(executor.run(function, tasks)))
    raise GoneError


def test_the_error_of_a_task_is_its_result_and_the_others_go_on() -> None:
    with in_threads(2) as executor:
        results = dict(executor.run(int, ["7", "x", "8"]))
    assert (results[0], results[2]) == (7, 8)
    assert isinstance(results[1], ValueError)


def test_an_interrupt_within_a_task_is_no_result() -> None:
    def interrupted(_: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), in_threads(1) as executor:
        list(executor.run(interrupted, [0]))


def test_tasks_that_have_not_begun_are_dropped_where_the_caller_fails() -> None:
    begun: list[int] = []

    def slow(k: int) -> None:
        begun.append(k)
        time.sleep(0.02)

    with pytest.raises(GoneError), in_threads(1) as executor:
        leave_after_one(executor, slow, range(200))
    assert len(begun) < 200


def test_processes_drop_what_has_not_begun_too(tmp_path: Path) -> None:
    tasks = [["sh", "-c", f"sleep 0.05; : > {tmp_path / str(k)}"] for k in range(40)]
    with pytest.raises(GoneError), in_processes(1) as executor:
        leave_after_one(executor, subprocess.call, tasks)
    for process in multiprocessing.active_children():
        process.join()
    assert len(list(tmp_path.iterdir())) < 40


def test_a_cluster_without_its_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mixpose.errors.find_spec", lambda _: None)
    with pytest.raises(SessionError, match=r"--scheduler there: needs .* 'mixpose\[dask\]'"):
        executing.on_cluster("there").__enter__()


class Future:
    """A task that is done, as a scheduler has it."""

    def __init__(self, key: str, function: Callable[[Any], Any], task: Any) -> None:
        self.key, self._result = key, None
        self._error: BaseException | None = None
        try:
            self._result = function(task)
        except BaseException as error:
            self._error = error

    def exception(self) -> BaseException | None:
        return self._error

    def result(self) -> Any:
        return self._result


class Client:
    """Stands for a client of a scheduler: takes equal tasks for one where these are pure."""

    def __init__(self, cluster: Any, **_: Any) -> None:
        self.cluster = cluster

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None: ...

    def map(self, function: Callable[[Any], Any], tasks: list[Any], *, pure: bool) -> list[Future]:
        keys = map(str, tasks if pure else range(len(tasks)))
        return [Future(key, function, task) for key, task in zip(keys, tasks, strict=True)]


@pytest.fixture
def distributed(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    """Stands for the package."""
    package = MagicMock(Client=Client, as_completed=reversed)
    monkeypatch.setitem(sys.modules, "distributed", package)
    monkeypatch.setattr("mixpose.errors.find_spec", lambda _: True)
    return package


@pytest.mark.parametrize(
    ("workers", "processors", "expected"), [(3, 5, 3), (None, 5, 5), (None, None, 1)]
)
def test_a_local_cluster_has_a_worker_of_one_thread_for_each_processor(
    workers: int | None,
    processors: int | None,
    expected: int,
    distributed: MagicMock,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: processors)
    with executing.executor(executing.LOCAL, workers):
        ((), options) = distributed.LocalCluster.call_args
    assert (options["n_workers"], options["threads_per_worker"]) == (expected, 1)


@pytest.mark.usefixtures("distributed")
def test_equal_tasks_have_a_result_each_also_on_a_cluster() -> None:
    with executing.executor(executing.LOCAL) as executor:
        results = dict(executor.run(int, ["7", "x", "7"]))
    assert (results[0], results[2]) == (7, 7)
    assert isinstance(results[1], ValueError)


@pytest.mark.usefixtures("distributed")
def test_an_interrupt_on_a_cluster_is_no_result() -> None:
    def interrupted(_: str) -> int:
        raise KeyboardInterrupt

    with executing.executor(executing.LOCAL) as executor, pytest.raises(KeyboardInterrupt):
        list(executor.run(interrupted, ["7"]))
