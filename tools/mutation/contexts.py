"""Plugin of pytest, under `coverage run`: names the lines of each test after it.

What the fixtures of a test execute is named after its whole file, as other tests of that file may
look at what they made.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from coverage import Coverage


def _name(context: str) -> None:
    measured: Any = Coverage.current()
    measured.switch_context(context)


def pytest_configure() -> None:
    """Have processes that tests start measured, this one being measured already."""
    os.environ["COVERAGE_PROCESS_START"] = os.environ["TO_MEASURE"]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[None]:
    _name(item.nodeid.partition("::")[0])
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    _name(item.nodeid)
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Iterator[None]:
    _name(item.nodeid.partition("::")[0])
    return (yield)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Append what a test took to `seconds.jsonl`, so that quick tests can come first."""
    if report.when == "call" and report.passed:
        with Path("seconds.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps([report.nodeid, report.duration]) + "\n")
