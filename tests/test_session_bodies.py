"""Bodies of other programs: NDI's .rom, Vicon's .vsk, AsterTrack's .obj."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest
from session_lines import message_of, with_lines

from mixpose.records import Floats
from mixpose.session.marker_files import Markers, read_marker_file
from mixpose.session.messages import BadKeyError

POINTS = np.array([[0, 0, 0], [0, 30, 40], [0, 0, 90], [10, -45, 40.0]])


def rom(points: Floats) -> bytes:
    """752 bytes: mark, checksum, ..., count at 28, positions at 72."""
    content = bytearray(752)
    content[:4] = b"NDI\0"
    struct.pack_into("<I", content, 28, len(points))
    struct.pack_into(f"<{points.size}f", content, 72, *points.ravel())
    content[700] = 7
    struct.pack_into("<H", content, 4, sum(content[6:]) & 0xFFFF)
    return bytes(content)


def vsk(points: Floats, segment: str = "body") -> str:
    parameters, targets = "", ""
    for k, point in enumerate(points):
        words = []
        for axis, value in zip("xyz", point, strict=True):
            parameters += f'<Parameter NAME="body_m{k}_{axis}" VALUE="{value}" PRIOR="0"/>'
            words.append(f"'body_m{k}_{axis}'")
        targets += (
            f'<TargetLocalPointToWorldPoint MARKER="m{k}" POSITION="{" ".join(words)}" '
            f'SEGMENT="{segment if k else "body"}"/>'
        )
    return (
        '<?xml version="1.0" encoding="UTF-8" standalone="no"?><KinematicModel VERSION="3.2">'
        f"<Parameters>{parameters}</Parameters><TargetSet><Targets>{targets}</Targets></TargetSet>"
        "</KinematicModel>"
    )


# a flat square marker about (1, 2, 3) cm that looks along +z, one about (5, 0, 0) along +x, and
# a face of the body itself
OBJ = """# a target
v 0.008 0.018 0.03
v 0.012 0.018 0.03
v 0.012 0.022 0.03
v 0.008 0.022 0.03
v 0.05 -0.002 -0.002
v 0.05 0.002 -0.002
v 0.05 0.002 0.002
v 0.05 -0.002 0.002
v 0.0 0.0 0.0
vn 0 0 1
g FlatMarker1
f 1//1 2//1 3//1 4//1
f -5 -4 -3 -2
g Base
f 1 5 9
"""


def read(folder: Path, name: str, content: str | bytes) -> Markers:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_marker_file(path, "mm")


def test_an_ndi_tool(tmp_path: Path) -> None:
    markers = read(tmp_path, "tool.rom", rom(POINTS))
    np.testing.assert_array_equal(markers.points, POINTS)
    assert markers.names == ("A", "B", "C", "D")
    metres = read_marker_file(tmp_path / "tool.rom", "m")
    np.testing.assert_allclose(metres.points, POINTS / 1000, rtol=1e-15)


def test_a_vicon_subject(tmp_path: Path) -> None:
    markers = read(tmp_path, "subject.vsk", vsk(POINTS))
    np.testing.assert_array_equal(markers.points, POINTS)
    assert markers.names == ("m0", "m1", "m2", "m3")


def test_an_astertrack_target_has_a_marker_for_each_face_of_its_groups(tmp_path: Path) -> None:
    markers = read(tmp_path, "target.obj", OBJ)
    np.testing.assert_allclose(markers.points, [[10, 20, 30], [50, 0, 0]], atol=1e-12)
    assert markers.normals is not None
    np.testing.assert_allclose(markers.normals, [[0, 0, 1], [1, 0, 0]], atol=1e-12)


def test_negative_corners_of_a_face_count_back_from_its_own_line(tmp_path: Path) -> None:
    square = "v 0 {z} 0\nv 0 {z} 0.01\nv 0.01 {z} 0.01\nv 0.01 {z} 0\nf -4 -3 -2 -1\n"
    content = "g FlatMarkers\n" + square.format(z=0) + square.format(z=0.05)
    markers = read(tmp_path, "target.obj", content)
    np.testing.assert_allclose(markers.points, [[5, 0, 5], [5, 50, 5]], atol=1e-9)


WRONG = [
    ("a.rom", b"NID\0" + bytes(748), "not an NDI .rom file"),
    ("a.rom", rom(POINTS)[:300], "found 300 bytes; an NDI .rom file has 752"),
    ("a.rom", rom(POINTS)[:80] + b"\x01" + rom(POINTS)[81:], "checksum is wrong"),
    ("a.rom", rom(np.zeros((0, 3))), "found 0 markers"),
    ("a.rom", rom(np.arange(63.0).reshape(21, 3)), "found 21 markers; allowed: 1 to 20"),
    ("a.rom", rom(np.full((3, 3), np.nan)), "finite coordinates"),
    ("a.csv", rom(POINTS), "rename it, to end in .rom"),
    ("a.vsk", "<KinematicModel", "not XML"),
    ("a.vsk", "<Skeleton/>", 'found "<Skeleton>"'),
    ("a.vsk", "<KinematicModel/>", "found no markers"),
    ("a.vsk", '<!DOCTYPE a [<!ENTITY b "c">]><KinematicModel/>', "DOCTYPE"),
    ("a.vsk", vsk(POINTS, "arm"), "markers on 2 segments"),
    ("a.vsk", vsk(POINTS).replace('NAME="body_m1_y"', 'NAME="n"'), 'no parameter "body_m1_y"'),
    ("a.vsk", vsk(POINTS).replace('VALUE="30.0"', 'VALUE="far"'), 'found "far"'),
    ("a.obj", "nothing\n", "found no vertices"),
    ("a.obj", OBJ.replace("0.05 0.002 -0.002", "0.05 x 0"), "line 7: found"),
    ("a.obj", OBJ.replace("f 1//1 2//1 3//1 4//1", "f 1 2"), "line 13: found"),
    ("a.obj", OBJ.replace("f 1//1", "f 99//1"), "line 13: names a vertex that is not there"),
    ("a.obj", OBJ.replace("f 1//1 2//1", "f 3//1 3//1"), "line 13: found a face without area"),
    ("a.obj", OBJ.replace("FlatMarker1", "Lid"), "found the groups Lid, Base"),
    ("a.yaml", "points: []\n", "allowed: a CSV file"),
]


@pytest.mark.parametrize(("name", "content", "words"), WRONG)
def test_a_wrong_body_file_is_told_in_one_line(
    tmp_path: Path, name: str, content: str | bytes, words: str
) -> None:
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    message = message_of(tmp_path, with_lines(points=f'file = "{name}"', sigma=""))
    assert message.startswith("object.file: ")
    assert words in message


def test_every_real_body_file_is_read_or_refused_in_one_line() -> None:
    root = Path(os.environ.get("MIXPOSE_RECORDINGS", "")) / "body_files"
    if not os.environ.get("MIXPOSE_RECORDINGS") or not root.is_dir():
        pytest.skip("MIXPOSE_RECORDINGS names no folder of recordings")
    counts: dict[str, int] = {}
    for path in root.iterdir():
        if path.name == "README.md":
            continue
        try:
            counts[path.name] = len(read_marker_file(path, "mm").points)
        except BadKeyError as error:
            counts[path.name] = -len(error.text.splitlines())
    assert counts == {
        "astertrack_Target_Sparse.obj": 7,
        "crazyflie_marker_configurations.yaml": -1,
        "ndi_8700339.rom": 4,
        "tams_bottle.yaml": -1,
        "vicon_anchors_1.vsk": 6,
        "vicon_apriltags_1_part2.vsk": 6,
    }
    tool = read_marker_file(root / "ndi_8700339.rom", "mm").points
    expected = [[0.0, 0, 0], [0, 28.59, 41.02], [0, 0, 88], [0, -44.32, 40.45]]
    np.testing.assert_allclose(tool, np.array(expected), atol=1e-5)  # float32
