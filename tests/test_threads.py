"""One thread of linear algebra and prompt switching while a frame is computed, not afterwards."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from threading import Barrier, Thread
from typing import Any

import pytest
from threadpoolctl import ThreadpoolController

import mixpose
from mixpose import runner
from mixpose.executing import in_processes
from mixpose.threads import SWITCH_S, one_blas_thread, prompt_switching

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"


def threads() -> set[int]:
    """Threads of the BLAS libraries: of NumPy, SciPy and OpenCV."""
    libraries: Any = ThreadpoolController().select(user_api="blas")
    return {library.num_threads for library in libraries.lib_controllers}


@pytest.fixture
def two_threads() -> Iterator[None]:
    with ThreadpoolController().limit(limits=2, user_api="blas"):
        yield


@pytest.mark.usefixtures("two_threads")
def test_a_frame_is_computed_on_one_thread_and_its_consumer_has_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    inside: list[set[int]] = []
    observe = runner.observe

    def noting(*arguments: Any) -> Any:
        inside.append(threads())
        return observe(*arguments)

    monkeypatch.setattr(runner, "observe", noting)
    watched: list[set[int]] = []
    session = mixpose.load_session(SYNTHETIC / "two_cameras" / "session.toml")
    estimates = mixpose.run(session, watch=lambda *_: watched.append(threads()))
    between = [threads() for _ in islice(estimates, 3)]
    estimates.close()
    assert inside[:3] == [{1}] * 3
    assert watched == between == [{2}] * 3


def test_threads_that_decode_are_let_in_soon_while_a_frame_is_computed_only(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before, inside = sys.getswitchinterval(), list[float]()
    observe = runner.observe

    def noting(*arguments: Any) -> Any:
        inside.append(sys.getswitchinterval())
        return observe(*arguments)

    monkeypatch.setattr(runner, "observe", noting)
    session = mixpose.load_session(SYNTHETIC / "two_cameras" / "session.toml")
    estimates = mixpose.run(session)
    between = [sys.getswitchinterval() for _ in islice(estimates, 2)]
    estimates.close()
    # the interpreter keeps whole microseconds
    assert inside[:2] == pytest.approx([SWITCH_S] * 2, abs=1e-6)
    assert between == [before] * 2


def test_prompt_switching_of_two_that_overlap_leaves_the_interval_as_it_was() -> None:
    before = sys.getswitchinterval()
    entered, left = Barrier(2), Barrier(2)

    def later() -> None:
        with prompt_switching():
            entered.wait(10)
            left.wait(10)

    other = Thread(target=later)
    with prompt_switching():
        other.start()
        entered.wait(10)
    assert sys.getswitchinterval() == before
    left.wait(10)
    other.join()
    assert sys.getswitchinterval() == before


@pytest.mark.usefixtures("two_threads")
def test_an_error_in_a_frame_restores_the_threads() -> None:
    with pytest.raises(ZeroDivisionError), one_blas_thread():
        raise ZeroDivisionError
    assert threads() == {2}


@pytest.mark.usefixtures("two_threads")
def test_frames_of_two_threads_that_overlap_leave_the_threads_as_they_were() -> None:
    entered, left = Barrier(2), Barrier(2)

    def later() -> None:
        with one_blas_thread():
            entered.wait(10)
            left.wait(10)  # the other one, which came first, is outside again

    other = Thread(target=later)
    with one_blas_thread():
        other.start()
        entered.wait(10)
        assert threads() == {1}
    left.wait(10)
    other.join()
    assert threads() == {2}
    with one_blas_thread():
        assert threads() == {1}


def test_processes_that_only_compute_have_one_thread_and_leave_the_environment_alone() -> None:
    before = dict(os.environ)
    text = "[each['num_threads'] for each in __import__('threadpoolctl').threadpool_info()]"
    with in_processes(1) as pool:
        ((_, counts),) = pool.run(eval, [text])
    assert not isinstance(counts, Exception)
    assert counts
    assert {*counts} == {1}
    assert dict(os.environ) == before
