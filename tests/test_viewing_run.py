"""``run --view`` as people use it: the run, its page, and those who look at it."""

from __future__ import annotations

import gc
import json
import multiprocessing
import os
import signal
import subprocess
import threading
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import assert_one_line, command, wait_until
from report_runs import estimate

from mixpose.errors import SessionError
from mixpose.records import FrameSet
from mixpose.session import load_session

pytest.importorskip("viser")

from page_client import PageClient, open_page, viewed

from mixpose.viewing import Viewer

SYNTHETIC = Path(__file__).parents[1] / "data" / "synthetic"
needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc here")
TWO = SYNTHETIC / "two_cameras" / "session.toml"
RANGES = SYNTHETIC / "range_profiles" / "session.toml"


def until(client: PageClient, words: str) -> str:
    """Listen until the page says something of a frame, and return what it says."""
    for _ in range(1000):
        for status in client.statuses:
            if words in status:
                return status
        client.statuses.clear()
        client.listen(1.0)
    raise AssertionError(f"the page never said {words!r}")


def poses(text: str) -> list[dict[str, Any]]:
    lines = [json.loads(line) for line in text.splitlines()]
    return [{k: v for k, v in line.items() if k != "latency_ms"} for line in lines]


def page_of(process: subprocess.Popen[str]) -> int:
    """The process of the page of a run."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        fields = status.read_text().rpartition(")")[2].split()
        is_page = b"spawn_main" in status.with_name("cmdline").read_bytes()
        if int(fields[1]) == process.pid and is_page:
            found.append(int(status.parent.name))
    (number,) = found
    return number


def test_a_run_steps_as_the_page_says_and_goes_on_when_nobody_looks(tmp_path: Path) -> None:
    with viewed(TWO, "--pause", "--stop", "8") as (process, address):
        with open_page(address) as connection:
            client = PageClient(connection)
            assert "<b>frame 0</b>" in until(client, "<b>frame ")
            client.click("Step")
            assert "2 <span" in until(client, "<b>frame 1</b>")  # poses so far
            client.click("Step")
            until(client, "<b>frame 2</b>")
            assert client.pictures >= 2 * 3  # of each camera
            assert process.poll() is None
        assert process.stdout is not None
        assert process.stderr is not None
        written = process.stdout.read()  # poses, and nothing that the page has to say
        said = process.stderr.read()
        assert process.wait() == 0
    assert said == "mixpose: 8 frames: 8 ok\n"
    assert poses(written) == poses(command("run", TWO, "--stop", "8").stdout)


@needs_proc
def test_a_page_that_dies_takes_no_run_with_it() -> None:
    with viewed(RANGES, "--pause", "--stop", "3") as (process, address):
        with open_page(address) as connection:
            until(PageClient(connection), "<b>frame 0</b>")
            os.kill(page_of(process), signal.SIGKILL)
            assert process.wait() == 0
        assert process.stderr is not None
        assert "the page of --view has ended; the run goes on" in process.stderr.read()


@needs_proc
def test_the_page_stays_after_the_last_frame_but_not_longer_than_the_run() -> None:
    with (
        viewed(RANGES, "--pause", "--stop", "3") as (process, address),
        open_page(address) as connection,
    ):
        client = PageClient(connection)
        until(client, "<b>frame 0</b>")
        client.click("Go on")
        assert "<b>frame 2</b>" in until(client, "done")
        assert process.poll() is None
        page = Path(f"/proc/{page_of(process)}")
        process.kill()
        wait_until(lambda: not page.exists())


def test_a_run_that_is_done_ends_as_soon_as_nobody_looks() -> None:
    with viewed(RANGES, "--stop", "3") as (process, address):
        with open_page(address) as connection:
            until(PageClient(connection), "done")
            assert process.poll() is None
        # at once, where the page would stay for 30 s
        assert process.wait(10) == 0
        assert process.stderr is not None
        assert "the page stays while somebody looks, for 30 s at the most" in process.stderr.read()


def test_an_interrupt_ends_a_run_that_waits_for_its_page() -> None:
    with viewed(RANGES, "--pause", "--stop", "3") as (process, _):
        process.send_signal(signal.SIGINT)
        assert process.wait() == 130
        assert process.stderr is not None
        assert process.stderr.read() == "mixpose: interrupted; everything so far is written\n"


@needs_proc
def test_a_page_that_is_interrupted_while_it_begins_is_gone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said: list[str] = []
    begun: list[int] = []

    def start(thread: threading.Thread) -> None:
        if thread.name.startswith("mixpose page: _receive"):
            begun.extend(child.pid or 0 for child in multiprocessing.active_children())
            raise KeyboardInterrupt
        plain_start(thread)

    plain_start = threading.Thread.start
    monkeypatch.setattr(threading.Thread, "start", start)
    with (
        pytest.raises(KeyboardInterrupt),
        Viewer(load_session(TWO), "0", said.append, on_files=False),
    ):
        raise AssertionError("it has begun")
    assert len(begun) == 1
    wait_until(lambda: not multiprocessing.active_children())
    assert said == []


def test_frames_that_nobody_asks_for_are_left_out() -> None:
    alive: list[weakref.ref[FrameSet]] = []
    with Viewer(load_session(TWO), "0", lambda line: None, on_files=False) as viewer:
        for number in range(2000):
            frame_set = FrameSet(number, None, {})
            alive.append(weakref.ref(frame_set))
            viewer.watch(frame_set, (), estimate(number, np.eye(4)))
        del frame_set
        gc.collect()
        # the newest, for a browser that would come now
        assert [k for k, each in enumerate(alive) if each() is not None] == [1999]


def test_without_its_package_the_page_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mixpose.errors.find_spec", lambda name: None)
    with pytest.raises(SessionError, match=r"needs the package viser; .*'mixpose\[view\]'"):
        Viewer(load_session(TWO), "0", print, on_files=True)


def test_options_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    assert_one_line(command("run", TWO, "--pause"), 2, "--pause", "--view")
    many = command("run", TWO, RANGES, "-o", tmp_path / "many", "--view")
    assert_one_line(many, 2, f"--view: found 2 sessions ({TWO}, {RANGES}), allowed with one only")
    taken = command("run", TWO, "--view", "abc")
    assert_one_line(taken, 2, f"{os.sep}abc: no such session file; after --view allowed are a port")
    with pytest.raises(SessionError, match="--pause: a live source does not wait"):
        Viewer(load_session(TWO), "0", print, on_files=False, paused=True)
