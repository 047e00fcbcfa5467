"""AsterTrack's .obj: a mesh in metres, in which each face of a marker group is a flat marker.

A marker is at the middle of its face and looks along the face's normal.  Groups are those whose
name has "marker" in it; a file without groups has nothing but markers.
"""

from __future__ import annotations

import numpy as np

from mixpose.records import Floats
from mixpose.session.arrays import is_number
from mixpose.session.markers import Markers
from mixpose.session.messages import BadKeyError, found
from mixpose.session.text_files import as_text


def read_astertrack(content: bytes) -> Markers:
    """Read the flat markers of an AsterTrack target. Raises BadKeyError naming the line."""
    vertices: list[list[float]] = []
    faces: list[tuple[str, int, list[int]]] = []
    group = ""
    for number, line in enumerate(as_text(content).splitlines(), start=1):
        word, *cells = line.split() or [""]
        if word == "v":
            vertices.append(_coordinates(cells, number))
        elif word in ("g", "o"):
            group = " ".join(cells)
        elif word == "f":
            faces.append((group, number, _corners(cells, number)))
    if not vertices or not faces:
        raise BadKeyError("found no vertices (v) and faces (f), as a Wavefront .obj has them")
    groups = list(dict.fromkeys(group for group, _, _ in faces))
    of_markers = [name for name in groups if "marker" in name.lower()]
    if not of_markers and groups != [""]:
        raise BadKeyError(
            f"found the groups {', '.join(groups)[:60]}; allowed: markers in groups whose name "
            'has "Marker" in it'
        )
    found_faces = [face for face in faces if not of_markers or face[0] in of_markers]
    placed = [_centre_and_normal(np.array(vertices), *face[1:]) for face in found_faces]
    points, normals = (np.array(part) for part in zip(*placed, strict=True))
    names = tuple(str(k + 1) for k in range(len(points)))
    return Markers(points, None, names, normals)


def _coordinates(cells: list[str], line: int) -> list[float]:
    try:
        values = [float(cell) for cell in cells[:3]]
    except ValueError:
        values = []
    if len(values) != 3 or not all(map(is_number, values)):
        raise BadKeyError(f"line {line}: {found(' '.join(cells), 'v x y z')}")
    return values


def _corners(cells: list[str], line: int) -> list[int]:
    try:
        corners = [int(cell.partition("/")[0]) for cell in cells]
    except ValueError:
        corners = []
    if len(corners) < 3:
        raise BadKeyError(f"line {line}: {found(' '.join(cells), 'f and three corners or more')}")
    return corners


def _centre_and_normal(vertices: Floats, line: int, corners: list[int]) -> tuple[Floats, Floats]:
    count = len(vertices)
    places = [corner - 1 if corner > 0 else count + corner for corner in corners]
    if not all(0 <= place < count for place in places):
        raise BadKeyError(f"line {line}: names a vertex that is not there; the file has {count}")
    ring = vertices[places]
    # twice the area of the face along its normal, by the corners' order
    across = np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0)
    length = np.linalg.norm(across)
    if not length > 0:
        raise BadKeyError(f"line {line}: found a face without area")
    return ring.mean(axis=0), np.asarray(across / length)
