"""The command line: `mixpose`."""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from mixpose.limits import MOST_PIXELS
from mixpose.threads import ask_for_one_blas_thread

WRONG_USAGE = 2
INTERRUPTED = 130

AT_ONCE = {"align", "check", "convert", "design", "evaluate", "inspect", "learn", "pivot", "smooth"}
"""Commands that write all of their results at the end."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its status.

    Errors that a user can correct are one line on standard error; ``--debug`` shows the traceback
    before it, and further messages of commands.  Requests to end (SIGTERM, SIGHUP) are handled like
    an interrupt from the keyboard.
    """
    _replace_closed_streams()
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with _signals_as_interrupts():
            status = _status(words)
    except KeyboardInterrupt:  # while the commands were being imported
        status = _interrupted(words)
    except EOFError as error:  # likewise
        status = _fail(cut_message(error), WRONG_USAGE)
    sys.exit(status)


def _replace_closed_streams() -> None:
    # messages are dropped rather than written to standard output; poses cannot be written
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
    if sys.stdout is None:
        sys.stdout = Path(os.devnull).open(encoding="utf-8")  # noqa: SIM115


@contextmanager
def _signals_as_interrupts() -> Iterator[None]:
    """Turn requests to end into interrupts, so that files are closed; keep ignored ones ignored."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    names = ("SIGTERM", "SIGHUP") if threading.current_thread() is threading.main_thread() else ()
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    handled = [number for number in numbers if signal.getsignal(number) == signal.SIG_DFL]
    for number in handled:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number in handled:
            signal.signal(number, signal.SIG_DFL)


def _status(arguments: list[str]) -> int:
    ask_for_one_blas_thread()
    # OpenCV reads it when it is loaded
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))
    # imported here, so that importing this package is fast
    import typer  # noqa: PLC0415

    from mixpose.cli.app import app  # noqa: PLC0415
    from mixpose.cli.help import usage_message, with_values  # noqa: PLC0415
    from mixpose.errors import MixposeError  # noqa: PLC0415

    debug = "--debug" in arguments
    arguments = with_values([word for word in arguments if word != "--debug"] or ["--help"])
    try:
        outcome = typer.main.get_command(app).main(
            args=arguments, prog_name="mixpose", standalone_mode=False, obj=debug
        )
    except MixposeError as error:
        return _fail(str(error), error.exit_status, debug=debug)
    except typer.TyperException as error:
        return _fail(usage_message(error, arguments), WRONG_USAGE, debug=debug)
    except (KeyboardInterrupt, typer.Abort):
        outcome = INTERRUPTED
    except SystemExit as error:
        if not isinstance(error.__context__, BrokenPipeError):
            raise
        # the reader has closed the pipe; keep Python from failing when it flushes
        _drop_standard_output()
        return 0
    except OSError as error:
        _drop_standard_output()
        text = f"{error.filename or 'output'}: cannot be written or read: "
        return _fail(text + (error.strerror or str(error)), WRONG_USAGE, debug=debug)
    if outcome == INTERRUPTED:  # typer returns the same for an interrupt from the keyboard
        return _interrupted(arguments)
    return outcome if isinstance(outcome, int) else 0


def _interrupted(arguments: list[str]) -> int:
    # if the interrupt came during an `exec`, as in the import of a dataclass, Python would end by
    # the signal whatever the status; another `exec` clears this
    exec("")
    written = "" if AT_ONCE & {*arguments[:1]} else "; everything so far is written"
    return _fail(f"interrupted{written}", INTERRUPTED)


def _drop_standard_output() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def cut_message(error: EOFError) -> str:
    """Return one line that names the compiled module that is cut, if one was being imported.

    No command reads standard input, so that an EOFError is always about a cut file.
    """
    for frame, _ in traceback.walk_tb(error.__traceback__):
        path = frame.f_locals.get("bytecode_path")  # as importlib calls it
        if isinstance(path, str):
            return f"{path}: is damaged: {error}; remove this file, Python makes it anew"
    return f"a file ends too early: {error or 'EOFError'}; --debug shows where it was read"


def _fail(message: str, status: int, *, debug: bool = False) -> int:
    from mixpose.cli.notices import say  # noqa: PLC0415

    if debug:
        traceback.print_exc()
    say(" ".join(message.split()))
    return status
