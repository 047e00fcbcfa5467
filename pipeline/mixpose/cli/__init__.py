"""The command line: `mixpose`."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from mixpose.limits import MOST_PIXELS
from mixpose.threads import ask_for_one_blas_thread

WRONG_USAGE = 2
INTERRUPTED = 130

# commands that write what they found when they have all of it
_AT_ONCE = {
    "align",
    "check",
    "convert",
    "design",
    "evaluate",
    "inspect",
    "learn",
    "pivot",
    "smooth",
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and leave with its exit status.

    Errors that a user can mend are one line on standard error; ``--debug`` shows the traceback
    before it, and what a command has to say beyond its results.  A request to end (SIGTERM, SIGHUP)
    is taken like an interrupt from the keyboard.
    """
    _replace_closed_streams()
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with _ended_like_interrupted():
            status = _status(words)
    except KeyboardInterrupt:  # while the commands were being imported
        status = _interrupted(words)
    except EOFError as error:  # likewise
        from mixpose.cli.cut import cut_message  # noqa: PLC0415

        status = _fail(cut_message(error), WRONG_USAGE)
    sys.exit(status)


def _replace_closed_streams() -> None:
    """Put something in the place of streams that whoever started this has closed."""
    # messages then go nowhere, rather than to standard output; poses cannot be written
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
    if sys.stdout is None:
        sys.stdout = Path(os.devnull).open(encoding="utf-8")  # noqa: SIM115


@contextmanager
def _ended_like_interrupted() -> Iterator[None]:
    """Let requests to end finish what is open, as an interrupt does; ignored ones stay so."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    names = ("SIGTERM", "SIGHUP") if threading.current_thread() is threading.main_thread() else ()
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    taken = [number for number in numbers if signal.getsignal(number) == signal.SIG_DFL]
    for number in taken:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


def _status(arguments: list[str]) -> int:
    ask_for_one_blas_thread()
    # OpenCV looks at it when it is loaded
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))
    # imported here, so that a program that only looks at this package does not wait for them
    import typer  # noqa: PLC0415

    from mixpose.cli.app import app  # noqa: PLC0415
    from mixpose.cli.usage import with_values  # noqa: PLC0415
    from mixpose.errors import MixposeError  # noqa: PLC0415

    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"] or ["--help"]
    arguments = with_values(arguments)
    try:
        outcome = typer.main.get_command(app).main(
            args=arguments, prog_name="mixpose", standalone_mode=False, obj=debug
        )
    except MixposeError as error:
        _show_traceback(debug)
        return _fail(str(error), error.exit_status)
    except typer.TyperException as error:
        _show_traceback(debug)
        from mixpose.cli.usage import usage_message  # noqa: PLC0415

        return _fail(usage_message(error, arguments), WRONG_USAGE)
    except (KeyboardInterrupt, typer.Abort):
        outcome = INTERRUPTED
    except SystemExit as error:
        if not isinstance(error.__context__, BrokenPipeError):
            raise
        # the reader of a pipe has seen enough; keep Python from complaining when it flushes
        _drop_standard_output()
        return 0
    except OSError as error:
        _show_traceback(debug)
        _drop_standard_output()
        place = f"{error.filename}: " if error.filename else "output: "
        reason = error.strerror or str(error)
        return _fail(f"{place}cannot be written or read: {reason}", WRONG_USAGE)
    if outcome == INTERRUPTED:  # which is also what typer makes of a keyboard interrupt
        return _interrupted(arguments)
    return outcome if isinstance(outcome, int) else 0


def _interrupted(arguments: list[str]) -> int:
    # where the interrupt fell into an `exec`, as of a dataclass that was being imported, Python
    # would end by the signal whatever the status; the next `exec` makes it forget that
    exec("")
    written = "" if _AT_ONCE & {*arguments[:1]} else "; everything so far is written"
    return _fail(f"interrupted{written}", INTERRUPTED)


def _show_traceback(wanted: bool) -> None:
    if wanted:
        import traceback  # noqa: PLC0415

        traceback.print_exc()


def _drop_standard_output() -> None:
    """Let what is still in the buffer go nowhere when Python flushes it."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message: str, status: int) -> int:
    from mixpose.cli.notices import say  # noqa: PLC0415

    say(" ".join(message.split()))
    return status
