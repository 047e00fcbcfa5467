"""The table of markers that a session reads."""

from __future__ import annotations

import csv
import io

from mixpose.learning.adjusting import Learnt
from mixpose.learning.telling import digits_of
from mixpose.session.marker_files import LEARNT_COLUMNS

MARK = ",".join(LEARNT_COLUMNS)
"""By which mixpose knows the tables that it wrote."""


def table_text(learnt: Learnt) -> str:
    """A row per marker: name, coordinates, their deviations, and frames in which it was seen."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["name", "x", "y", "z", *LEARNT_COLUMNS])
    digits = digits_of(learnt)
    for name, point, deviation, frames in zip(
        learnt.names, learnt.points, learnt.deviations, learnt.frames, strict=True
    ):
        numbers = [f"{value + 0.0:.{digits}f}" for value in (*point, *deviation)]
        writer.writerow([name, *numbers, int(frames)])
    return stream.getvalue()
