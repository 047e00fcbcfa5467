"""Run the command line in a process that ends together with its parent.

Its standard input is a pipe without data, which ends with the parent.  A child that went on, after
its parent was killed, could write to the same files as a later run.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

_GRACE_S = 5.0  # to finish open files, as after an interrupt


def _end_with_parent() -> None:
    """Wait for the end of standard input, then end this process."""
    while os.read(sys.stdin.fileno(), 1):
        pass
    # handled like an interrupt, which processes that a script starts in the background ignore
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_GRACE_S)
    os._exit(130)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    from mixpose.cli import main

    main()
