"""Read marker tables, ``name,x,y,z`` and optionally spreads of markers, and other systems' bodies.

NDI's .rom (SROM): a binary file of 752 bytes with up to 20 markers, in mm. Little-endian: "NDI", a
checksum at byte 4 (the sum of all bytes after it), the number of markers at byte 28, positions as
three float32 each from byte 72.
Vicon's .vsk: XML in which positions of markers name parameters, in mm; a rigid body is one segment.
AsterTrack's .obj: a mesh in metres. Each face of a group whose name contains "marker", or of a file
without groups, is a flat marker at the centre of the face, with the normal of the face.
"""

from __future__ import annotations

import csv
import io
import struct
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mixpose.records import Floats
from mixpose.session.messages import BadKeyError, in_file, mismatch, under
from mixpose.session.text_files import as_text, read_bytes
from mixpose.session.values import as_number, is_number
from mixpose.units import Unit, length_ratio

_ALLOWED = "a CSV file name,x,y,z[,sigma...], NDI's .rom, Vicon's .vsk or AsterTrack's .obj"

NDI_MARK = b"NDI\0"
_CHECKSUM, _SUMMED_FROM, _COUNT, _POSITIONS = 4, 6, 28, 72
_MOST_NDI = 20
_VICON_TARGET = "TargetLocalPointToWorldPoint"
_HEADER = ["name", "x", "y", "z"]
_SIGMA_COLUMNS = (0, 1, 3, 9)
# columns of `mixpose learn` for the user, not used here: how well markers are known
LEARNT_COLUMNS = ("deviation_x", "deviation_y", "deviation_z", "frames")


def read_marker_file(path: Path, unit: Unit) -> Markers:
    """Read a table of markers in `unit`, or the body of another program, converted to `unit`."""
    suffix = path.suffix.lower()
    if suffix in (".yaml", ".yml", ".json", ".xml", ".stl"):
        raise BadKeyError(mismatch(path.name, _ALLOWED))
    content = read_bytes(path)
    read, stated = READERS.get(suffix, (read_table, unit))
    with in_file(path.name):
        if suffix not in READERS and content.startswith(NDI_MARK):
            raise BadKeyError("is an NDI body: rename it, to end in .rom")
        markers = read(content)
        for number in markers.points.ravel().tolist():
            if not is_number(number):
                raise BadKeyError(mismatch(number, "finite coordinates of markers"))
    return replace(markers, points=markers.points * length_ratio(stated, unit))


def read_rom(content: bytes) -> Markers:
    """Read the markers of an NDI tool; raise BadKeyError if the file is no .rom or damaged."""
    if not content.startswith(NDI_MARK):
        raise BadKeyError('not an NDI .rom file, which begins with "NDI"')
    if len(content) < _POSITIONS + 12 * _MOST_NDI:
        raise BadKeyError(f"found {len(content)} bytes; an NDI .rom file has 752: it is cut short")
    (stated,) = struct.unpack_from("<H", content, _CHECKSUM)
    if sum(content[_SUMMED_FROM:]) & 0xFFFF != stated:
        raise BadKeyError("its checksum is wrong: the file is damaged; export it again")
    (count,) = struct.unpack_from("<I", content, _COUNT)
    if not 1 <= count <= _MOST_NDI:
        raise BadKeyError(f"found {count} markers; allowed: 1 to {_MOST_NDI}")
    positions = np.frombuffer(content, "<f4", 3 * count, _POSITIONS).reshape(count, 3)
    return Markers(positions.astype(np.float64), None, tuple("ABCDEFGHIJKLMNOPQRST"[:count]))


def read_vsk(content: bytes) -> Markers:
    """Read the markers of a Vicon subject; raise BadKeyError if it is not a rigid body."""
    text = as_text(content)
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise BadKeyError("found a DOCTYPE or ENTITY, which a .vsk file does not have")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise BadKeyError(f"not XML: {error}") from error
    if root.tag != "KinematicModel":
        raise BadKeyError(mismatch(f"<{root.tag}>", "<KinematicModel>, as a Vicon .vsk begins"))
    parameters = {p.get("NAME", ""): p.get("VALUE", "") for p in root.iter("Parameter")}
    targets = list(root.iter(_VICON_TARGET))
    segments = {target.get("SEGMENT") for target in targets}
    if len(segments) > 1:
        raise BadKeyError(
            f"found markers on {len(segments)} segments; allowed: a rigid body, which is one"
        )
    if not targets:
        raise BadKeyError(f"found no markers ({_VICON_TARGET}) in it")
    names = tuple(target.get("MARKER", f"{k + 1}") for k, target in enumerate(targets))
    points = []
    for target, name in zip(targets, names, strict=True):
        with under("marker", name):
            points.append(_position(target.get("POSITION", ""), parameters))
    return Markers(np.array(points), None, names)


def _position(text: str, parameters: dict[str, str]) -> list[float]:
    """Return the three coordinates that numbers, or names of parameters in quotes, stand for."""
    values = []
    for word in text.split():
        name = word.strip("'\"")
        if name != word and name not in parameters:
            raise BadKeyError(f'found no parameter "{name}"')
        try:
            values.append(float(parameters.get(name, name)))
        except ValueError as error:
            raise BadKeyError(mismatch(parameters.get(name, name), "a number")) from error
    if len(values) != 3:
        raise BadKeyError(mismatch(text, "POSITION with three coordinates"))
    return values


def read_astertrack(content: bytes) -> Markers:
    """Read the flat markers of an AsterTrack target; raise BadKeyError that names the line."""
    vertices: list[list[float]] = []
    faces: list[tuple[str, int, list[int]]] = []
    group = ""
    for number, line in enumerate(as_text(content).splitlines(), start=1):
        word, *cells = line.split() or [""]
        if word == "v":
            vertices.append([as_number(cell) for cell in cells[:3]])
            if len(vertices[-1]) != 3 or not all(map(is_number, vertices[-1])):
                raise BadKeyError(f"line {number}: {mismatch(' '.join(cells), 'v x y z')}")
        elif word in ("g", "o"):
            group = " ".join(cells)
        elif word == "f":
            # negative corners count back from the face, behind which further vertices may come
            corners = [k if k > 0 else len(vertices) + k + 1 for k in _corners(cells, number)]
            faces.append((group, number, corners))
    if not vertices or not faces:
        raise BadKeyError("found no vertices (v) and faces (f), as a Wavefront .obj has them")
    groups = list(dict.fromkeys(group for group, *_ in faces))
    of_markers = [name for name in groups if "marker" in name.lower()]
    if not of_markers and groups != [""]:
        raise BadKeyError(
            f"found the groups {', '.join(groups)[:60]}; allowed: markers in groups whose name "
            'has "Marker" in it'
        )
    marker_faces = [face for face in faces if not of_markers or face[0] in of_markers]
    placed = [_centre_and_normal(np.array(vertices), *face[1:]) for face in marker_faces]
    points, normals = (np.array(part) for part in zip(*placed, strict=True))
    names = tuple(str(k + 1) for k in range(len(points)))
    return Markers(points, None, names, normals)


def _corners(cells: list[str], line: int) -> list[int]:
    try:
        corners = [int(cell.partition("/")[0]) for cell in cells]
    except ValueError:
        corners = []
    if len(corners) < 3:
        text = mismatch(" ".join(cells), "f and three corners or more")
        raise BadKeyError(f"line {line}: {text}")
    return corners


def _centre_and_normal(vertices: Floats, line: int, corners: list[int]) -> tuple[Floats, Floats]:
    count = len(vertices)
    places = [corner - 1 for corner in corners]
    if not all(0 <= place < count for place in places):
        raise BadKeyError(f"line {line}: names a vertex that is not there; the file has {count}")
    ring = vertices[places]
    # the normal by the order of the corners, as long as twice the area of the face
    normal = np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0)
    length = np.linalg.norm(normal)
    if not length > 0:
        raise BadKeyError(f"line {line}: found a face without area")
    return ring.mean(axis=0), np.asarray(normal / length)


READERS: dict[str, tuple[Callable[[bytes], Markers], Unit]] = {
    ".rom": (read_rom, "mm"),
    ".vsk": (read_vsk, "mm"),
    ".obj": (read_astertrack, "m"),
}
"""Reader and unit of each format, by the ending of its files."""


@dataclass(frozen=True)
class Markers:
    """The contents of a marker table."""

    points: Floats  # (N, 3)
    sigma: list[Any] | None  # one per marker, as in the key ``sigma``; None without such columns
    names: tuple[str, ...] = ()  # of the markers, if the file has names
    normals: Floats | None = None  # (N, 3), outward, if the file has flat markers


def read_table(content: bytes) -> Markers:
    """Read a marker table, a CSV file; raise BadKeyError that names line and column.

    After ``name,x,y,z`` the header has no column, one (σ), three (σ along x, y and z) or nine (the
    covariance, row by row), and may end with `LEARNT_COLUMNS`.
    """
    reader = csv.reader(io.StringIO(as_text(content), newline=""), skipinitialspace=True)
    try:
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise BadKeyError(f"line {reader.line_num}: {error}") from error
    if not rows:
        raise BadKeyError("the file is empty; allowed: a header name,x,y,z and a row per point")
    header = [cell.strip() for cell in rows[0][1]]
    words = [name.lower() for name in header]
    if words[:4] != _HEADER or len(words) - 4 - _learnt(header) not in _SIGMA_COLUMNS:
        text = mismatch(",".join(header), "name,x,y,z and then no, one, three or nine")
        raise BadKeyError(f"line 1: {text} columns of sigma")
    if len(rows) == 1:
        raise BadKeyError("found no markers below the header")
    values = np.array([_numbers_of(row, line, header) for line, row in rows[1:]])
    values = values[:, : len(header) - 1 - _learnt(header)]
    names = _names_of([(line, row[0]) for line, row in rows[1:]])
    spreads, shapes = values[:, 3:], {1: (-1,), 3: (-1, 3), 9: (-1, 3, 3)}
    sigma = spreads.reshape(shapes[spreads.shape[1]]).tolist() if spreads.size else None
    return Markers(values[:, :3], sigma, names)


def _learnt(header: list[str]) -> int:
    """Return the number of `LEARNT_COLUMNS` at the end of a header: all or none."""
    return len(LEARNT_COLUMNS) if tuple(header[-len(LEARNT_COLUMNS) :]) == LEARNT_COLUMNS else 0


def _names_of(cells: list[tuple[int, str]]) -> tuple[str, ...]:
    """Return the names in cells with line numbers; raise BadKeyError if two are the same."""
    lines: dict[str, int] = {}
    for line, cell in cells:
        name = " ".join(cell.split())
        if name and lines.setdefault(name, line) != line:
            raise BadKeyError(
                f"line {line}: found the name {name!r} again, of line {lines[name]}; allowed: a "
                "name of its own for each marker, or none"
            )
    return tuple(cell.strip() for _, cell in cells)


def _numbers_of(row: list[str], line: int, header: list[str]) -> list[float]:
    if len(row) != len(header):
        raise BadKeyError(f"line {line}: found {len(row)} cells; allowed: {len(header)} as above")
    values = []
    for cell, column in zip(row[1:], header[1:], strict=True):
        value = as_number(cell)
        if not is_number(value):
            raise BadKeyError(
                f"line {line}, column {column}: {mismatch(cell.strip(), 'a finite number')}"
            )
        values.append(value)
    return values
