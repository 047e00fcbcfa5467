"""How long `mixpose --help` takes, from the start of the process to its end."""

from __future__ import annotations

import argparse
import subprocess
import sys
from typing import Any

from benchmarks.timing import medians, show


def run(_: argparse.Namespace) -> dict[str, Any]:
    def mixpose_help() -> None:
        command = [sys.executable, "-m", "mixpose", "--help"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)

    def bare_python() -> None:
        subprocess.run([sys.executable, "-c", ""], check=True)

    seconds = medians({"mixpose": mixpose_help, "python": bare_python}, rounds=10)
    print("startup")
    show("mixpose --help, s", seconds["mixpose"], at_most=0.4)
    show("python without anything, s", seconds["python"])
    return {"seconds": seconds["mixpose"], "python_seconds": seconds["python"]}
