"""Errors that a user can mend: one base class, one line each.

A message says what was found, what is allowed and what to do.  The command line prints it without
a traceback and exits with `exit_status`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec


class MixposeError(Exception):
    """Base of every error that mixpose raises on purpose."""

    exit_status = 2


class SessionError(MixposeError):
    """The session file, an option or an argument is wrong."""


class RecordingError(MixposeError):
    """A recording (images, video, table, poses file) cannot be read."""

    exit_status = 3


@contextmanager
def reporting(kind: type[MixposeError], what: str) -> Iterator[None]:
    """Raise an OSError inside as an error of mixpose that says what cannot be done, and why."""
    try:
        yield
    except OSError as error:
        raise kind(f"{what}: {error.strerror}") from error


def require_package(what: str, package: str, extra: str, more: str = "") -> None:
    """Raise a SessionError that names the extra to install if a package is missing."""
    if find_spec(package.removesuffix("-sdk")) is None:
        raise SessionError(
            f"{what}: needs the package {package}; install it with: "
            f"python -m pip install 'mixpose[{extra}]'{more}"
        )


def require_plots(what: str) -> None:
    """Raise a SessionError if matplotlib is missing, which `what` needs."""
    try:
        import matplotlib.figure  # noqa: F401, PLC0415 - an extra
    except ImportError as error:
        raise SessionError(
            f"{what} matplotlib, which is not installed; pip install 'mixpose[plots]'"
        ) from error
