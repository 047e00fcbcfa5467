"""The command line of a process that ends when the one which started it does.

Its standard input is a pipe that nobody writes to: when it ends, whoever held the other end is
gone, killed perhaps, and what this process would go on to write could meet its successor's.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

_GRACE_S = 5.0  # to finish what is open, as after an interrupt


def _end_with_parent() -> None:
    """Wait for the end of standard input, and ask this process to end then."""
    while os.read(sys.stdin.fileno(), 1):
        pass
    # taken like an interrupt, which is ignored by what a script starts in the background
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_GRACE_S)
    os._exit(130)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    from mixpose.cli import main

    main()
