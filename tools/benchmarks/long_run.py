"""A process of the case `memory`: run a session, print the resident size after some frames in MB.

python tools/benchmarks/long_run.py SESSION.toml COUNT...
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from mixpose.cli.output import Output
from mixpose.cli.run import header_of
from mixpose.runner import run
from mixpose.session import load_session


def resident_mb(process: int | str = "self") -> float:
    """What a process holds."""
    pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def main() -> None:
    session = load_session(sys.argv[1])
    counts = {int(text) for text in sys.argv[2:]}
    with Output(Path(os.devnull), "jsonl", header_of(session)) as output:
        for count, estimate in enumerate(run(session), 1):
            if estimate.status != "ok":
                raise RuntimeError(f"frame {estimate.frame} is {estimate.status}: not tracking")
            output.write(estimate)
            if count in counts:
                print(resident_mb())


if __name__ == "__main__":
    main()
