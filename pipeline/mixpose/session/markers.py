"""Marker tables: ``name,x,y,z`` and optionally the spread of each marker."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mixpose.records import Floats
from mixpose.session.messages import BadKeyError, found, in_file
from mixpose.session.text_files import as_text, read_bytes
from mixpose.session.values import is_number

_HEADER = ["name", "x", "y", "z"]
_SIGMA_COLUMNS = (0, 1, 3, 9)

LEARNT_COLUMNS = ("deviation_x", "deviation_y", "deviation_z", "frames")
"""Columns of a table that `mixpose learn` wrote: how well markers are known, for people."""


@dataclass(frozen=True)
class Markers:
    """What a marker table holds."""

    points: Floats  # (N, 3)
    # per marker a number, [sx, sy, sz] or a 3x3 covariance, as the key ``sigma`` has them; None
    # where the table has no such columns
    sigma: list[Any] | None
    names: tuple[str, ...] = ()  # of the markers, where the file has names
    # (N, 3), outward directions of flat markers, where the file has them
    normals: Floats | None = None


def read_markers(path: Path) -> Markers:
    """Read a marker table; problems name line and column.

    It is a CSV file with the header ``name,x,y,z``, followed by no column, one (σ), three (σ along
    x, y and z) or nine (the covariance, row by row). The columns in which ``mixpose learn`` says
    how well markers are known may stand there, too.
    """
    content = read_bytes(path)
    with in_file(path.name):
        reader = csv.reader(io.StringIO(as_text(content), newline=""), skipinitialspace=True)
        try:
            rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
        except csv.Error as error:
            raise BadKeyError(f"line {reader.line_num}: {error}") from error
        if not rows:
            raise BadKeyError("the file is empty; allowed: a header name,x,y,z and a row per point")
        header = [cell.strip() for cell in rows[0][1]]
        _check_header(header)
        values = np.array([_numbers_of(row, line, header) for line, row in rows[1:]])
        values = values[:, : len(header) - 1 - _learnt(header)] if len(values) else values
    if not len(values):
        raise BadKeyError(f"{path.name}: found no markers below the header")
    names = tuple(row[0].strip() for _, row in rows[1:])
    return Markers(values[:, :3], _sigma_of(values[:, 3:]), names)


def _check_header(header: list[str]) -> None:
    names = [name.lower() for name in header]
    if names[:4] != _HEADER or len(names) - 4 - _learnt(header) not in _SIGMA_COLUMNS:
        raise BadKeyError(
            f"line 1: {found(','.join(header), 'name,x,y,z and then no, one, three or nine')} "
            "columns of sigma"
        )


def _learnt(header: list[str]) -> int:
    """How many columns at the end are those of a body that was learnt."""
    return len(LEARNT_COLUMNS) if tuple(header[-len(LEARNT_COLUMNS) :]) == LEARNT_COLUMNS else 0


def _numbers_of(row: list[str], line: int, header: list[str]) -> list[float]:
    if len(row) != len(header):
        raise BadKeyError(f"line {line}: found {len(row)} cells; allowed: {len(header)} as above")
    values = []
    for cell, column in zip(row[1:], header[1:], strict=True):
        try:
            value = float(cell)
        except ValueError:
            value = float("nan")
        if not is_number(value):
            raise BadKeyError(
                f"line {line}, column {column}: {found(cell.strip(), 'a finite number')}"
            )
        values.append(value)
    return values


def _sigma_of(columns: Floats) -> list[Any] | None:
    match columns.shape[1]:
        case 0:
            return None
        case 1:
            return [row[0] for row in columns.tolist()]
        case 3:
            return list(columns.tolist())
        case _:
            return list(columns.reshape(-1, 3, 3).tolist())
