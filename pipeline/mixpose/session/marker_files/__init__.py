"""Bodies as other systems store them: a module per format, and the list of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from mixpose.session.arrays import is_number
from mixpose.session.marker_files.astertrack import read_astertrack
from mixpose.session.marker_files.ndi import NDI_MARK, read_rom
from mixpose.session.marker_files.vicon import read_vsk
from mixpose.session.markers import Markers, read_markers
from mixpose.session.messages import BadKeyError, found, in_file
from mixpose.session.setup import Unit, scale_between
from mixpose.session.text_files import read_bytes

__all__ = ["READERS", "read_marker_file"]

READERS: dict[str, tuple[Callable[[bytes], Markers], Unit]] = {
    ".rom": (read_rom, "mm"),
    ".vsk": (read_vsk, "mm"),
    ".obj": (read_astertrack, "m"),
}
"""By ending: what reads a file, and the unit that its format fixes."""

_ALLOWED = "a CSV file name,x,y,z[,sigma...], NDI's .rom, Vicon's .vsk or AsterTrack's .obj"


def read_marker_file(path: Path, unit: Unit) -> Markers:
    """Read the body of another program, or a table of markers, whose lengths are in `unit`
    already.
    """
    suffix = path.suffix.lower()
    if suffix in (".yaml", ".yml", ".json", ".xml", ".stl"):
        raise BadKeyError(found(path.name, _ALLOWED))
    content = read_bytes(path)
    if suffix not in READERS:
        with in_file(path.name):
            if content.startswith(NDI_MARK):
                raise BadKeyError("is an NDI body: rename it, to end in .rom")
        return read_markers(path)
    read, stated = READERS[suffix]
    with in_file(path.name):
        markers = read(content)
        for number in markers.points.ravel().tolist():
            if not is_number(number):
                raise BadKeyError(found(number, "finite coordinates of markers"))
    return replace(markers, points=markers.points * scale_between(stated, unit))
