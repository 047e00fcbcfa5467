"""The tutorial about publishing, followed: a receiver in one terminal, a run in another one."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import pytest
from command_line import started, wait_until
from test_docs_examples import ROOT, assert_shown, blocks, output_of


def is_taken(port: int) -> bool:
    """Whether somebody receives datagrams there."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return True
    return False


def test_the_first_receiver_prints_what_the_page_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").symlink_to(ROOT / "data", target_is_directory=True)
    (_, first, program), (_, second, commands), (_, third, shown) = list(
        blocks("docs/publishing.md")
    )[:3]
    assert (first, second, third) == ("python", "sh", "text")
    Path("receive.py").write_text(program, encoding="utf-8")
    receive, run = commands.splitlines()
    assert receive == "python receive.py"
    printed = tmp_path / "printed.txt"
    with (
        printed.open("w") as stream,
        started([sys.executable, "receive.py"], stdout=stream) as process,
    ):
        wait_until(lambda: is_taken(9870), by=process)  # else datagrams are lost
        said = output_of(run, capfd)
        wait_until(lambda: len(printed.read_text().splitlines()) >= 61, by=process)
    assert_shown(shown, printed.read_text())
    assert "published to udp://127.0.0.1:9870: 60 poses" in said
