"""The command line: `mixpose`."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

WRONG_USAGE = 2
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and leave with its exit status.

    Errors that a user can mend are one line on standard error; ``--debug`` shows the traceback.
    """
    sys.exit(_status(list(sys.argv[1:] if arguments is None else arguments)))


def _status(arguments: list[str]) -> int:
    # the matrices here are small: threads of the linear algebra would wait for each other
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # imported here, so that a program that only looks at this package does not wait for them
    import typer  # noqa: PLC0415

    from mixpose.cli.app import app  # noqa: PLC0415
    from mixpose.errors import MixposeError  # noqa: PLC0415

    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"] or ["--help"]
    try:
        outcome = typer.main.get_command(app).main(
            args=arguments, prog_name="mixpose", standalone_mode=False
        )
    except MixposeError as error:
        if debug:
            raise
        return _fail(str(error), error.exit_status)
    except typer.TyperException as error:
        if debug:
            raise
        from mixpose.cli.usage import usage_message  # noqa: PLC0415

        return _fail(usage_message(error, arguments), WRONG_USAGE)
    except (KeyboardInterrupt, typer.Abort):
        outcome = INTERRUPTED
    except OSError as error:
        if not isinstance(error, BrokenPipeError):
            if debug:
                raise
            _drop_standard_output()
            place = f"{error.filename}: " if error.filename else "output: "
            return _fail(f"{place}cannot be written or read: {error.strerror}", WRONG_USAGE)
        # the reader of a pipe has seen enough; keep Python from complaining when it flushes
        _drop_standard_output()
        return 0
    if outcome == INTERRUPTED:  # which is also what typer makes of a keyboard interrupt
        return _fail("interrupted; everything so far is written", INTERRUPTED)
    return outcome if isinstance(outcome, int) else 0


def _drop_standard_output() -> None:
    """Let what is still in the buffer go nowhere when Python flushes it."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message: str, status: int) -> int:
    line = " ".join(message.split())
    print(f"mixpose: {line}", file=sys.stderr)
    return status
