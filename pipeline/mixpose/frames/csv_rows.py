"""Rows and cells of CSV files, with the file and the line in every complaint."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NoReturn

from mixpose.errors import RecordingError

# As many digits as a file name may have.
_LARGEST_NUMBER = 10**255

# Characters: a profile of a million bins.
_LONGEST_LINE = 16_000_000


def csv_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Lines, from 1, and cells of a CSV file, one row at a time; blank lines are left out.

    Raises RecordingError if the file cannot be read as text, or a row has more or fewer cells than
    the first.
    """
    width = None
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            # a line that is longer comes in pieces, and has not as many cells as the first
            pieces = iter(partial(file.readline, _LONGEST_LINE), "")
            reader = csv.reader(pieces, skipinitialspace=True)
            for cells in reader:
                if not cells or not (cells[0] or any(map(str.strip, cells))):
                    continue
                if width is None:
                    width = len(cells)
                elif len(cells) != width:
                    raise RecordingError(
                        f"{path}, line {reader.line_num}: found {len(cells)} cells, "
                        f"the first row has {width}"
                    )
                yield reader.line_num, cells
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not a text file in UTF-8") from error
    except csv.Error as error:
        raise RecordingError(f"{path}: not a CSV file: {error}") from error


def header(cells: list[str]) -> tuple[str, ...]:
    """Column names as they are compared: without blanks around them, in small letters."""
    return tuple(cell.strip().casefold() for cell in cells)


def finite(cell: str, path: Path, line: int, column: str) -> float:
    """Read a cell as a finite number, else raise RecordingError."""
    try:
        value = float(cell)
    except ValueError:
        _complain(cell, path, line, column, "a number")
    if not math.isfinite(value):
        _complain(cell, path, line, column, "a finite number")
    return value


def whole(cell: str, path: Path, line: int, column: str) -> int:
    """Read a cell as a whole number (``12`` or ``12.0``), else raise RecordingError."""
    try:
        value = int(cell)
    except ValueError:
        number = finite(cell, path, line, column)
        value = int(number)
        if value != number:
            _complain(cell, path, line, column, "a whole number")
    if abs(value) > _LARGEST_NUMBER:
        _complain(cell, path, line, column, "a number of at most 255 digits")
    return value


def _complain(cell: str, path: Path, line: int, column: str, allowed: str) -> NoReturn:
    found = repr(cell.strip()) if cell.strip() else "an empty cell"
    raise RecordingError(f"{path}, line {line}: {column}: found {found}, allowed is {allowed}")
