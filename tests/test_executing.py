"""Many tasks at once: what becomes of errors, and of tasks that nobody waits for any more."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

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
    assert len(list(tmp_path.iterdir())) < 40


def test_a_cluster_without_its_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executing, "find_spec", lambda _: None)
    with pytest.raises(SessionError, match=r"--scheduler there: needs .* 'mixpose\[dask\]'"):
        executing.on_cluster("there").__enter__()
