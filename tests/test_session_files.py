"""Session and marker files that are wrong as a whole: no TOML, no table, not there."""

from __future__ import annotations

from pathlib import Path

import pytest
from session_lines import message_of, with_lines

from mixpose.errors import SessionError
from mixpose.session import load_session


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b'unit = "mm"\n[object\n', ["not TOML", "line 2"]),
        (b'unit = "mm"\nunit = "m"\n', ["not TOML", "line 2"]),
        (b'unit = "mm"\n# caf\xe9\n', ["not UTF-8", "line 2"]),
        (b"\x00\x01\x02", ["not TOML"]),
        (b"a = " + b"[" * 100_000, ["nested too deeply"]),
        (b"a = " + b"1" * 5000, ["not TOML"]),
        (b"", ["unit: missing"]),
        (b"\x89PNG\r\n\x1a\n\0\0", ["found an image; allowed: a text file in UTF-8"]),
        (b"unit = mm\n", ["line 1", 'allowed: text in quotes, unit = "mm"']),
        (b'unit: "mm"\n', ["line 1", 'allowed: an equals sign, unit = "mm"']),
        ("unit = “mm”\n".encode(), ["line 1", 'allowed: straight quotes, "..."']),
        (b"[[sensor]]\nfps = 29,97\n", ["line 2", "allowed: a decimal point, fps = 29.97"]),
        (b'[[sensor]]\nsource = "C:\\data"\n', ["line 2", "allowed: paths with /"]),
        (b'[[sensor]]\nsource = "C:\\Users"\n', ["line 2", "allowed: paths with /"]),
        (b"[sensor]\n[sensor]\n", ["line 2", "allowed for each of several: [[sensor]]"]),
        (b"[object]\n[[object]]\n", ["line 2", "allowed for each of several: [[object]]"]),
    ],
)
def test_a_file_that_is_no_session(tmp_path: Path, content: bytes, words: list[str]) -> None:
    message = message_of(tmp_path, content)
    assert all(word in message for word in words)


def test_no_file_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=r"none\.toml: no such file"):
        load_session(tmp_path / "none.toml")
    with pytest.raises(SessionError, match="cannot read"):
        load_session(tmp_path)
    with pytest.raises(SessionError, match="not a file name"):
        load_session("a\0b")


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("", ["the file is empty"]),
        ("name,x,y,z\n", ["no markers"]),
        ("a,0,0,0\nb,1,0,0\nc,0,1,0\n", ["line 1", 'found "a,0,0,0"', "name,x,y,z"]),
        ("name;x;y;z\na;0;0;0\n", ["line 1", 'found "name;x;y;z"']),
        ("name,x,y,z,s,t\na,0,0,0,0,0\n", ["line 1", "no, one, three or nine"]),
        ("name,x,y,z\na,0,0,0\nb,1,0\n", ["line 3", "found 3 cells", "4"]),
        ("name,x,y,z\na,0,0,0\nb,1,zero,0\n", ["line 3, column y", 'found "zero"']),
        ("name,x,y,z\na,0,0,0\nb,1,0,nan\n", ["line 3, column z", 'found "nan"']),
        ("name,x,y,z\na,0,0,0\nb,1,0,0\n", ["found 2 features"]),
        (
            "name,x,y,z\nA 1,0,0,0\nB,1,0,0\nA  1,0,1,0\n",
            ["line 4", "found the name 'A 1' again, of line 2"],
        ),
        ("name,x,y,z,s\na,0,0,0,1\nb,1,0,0,-1\nc,0,1,0,1\n", ["sigma[1]", "found -1"]),
    ],
)
def test_a_wrong_marker_file(tmp_path: Path, table: str, words: list[str]) -> None:
    (tmp_path / "m.csv").write_text(table, encoding="utf-8")
    message = message_of(tmp_path, with_lines(points='file = "m.csv"', sigma=""))
    assert message.startswith("object.file: ")
    assert all(word in message for word in words)


def test_spread_in_the_marker_file_and_in_the_session(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text(
        "name,x,y,z,s\na,0,0,0,1\nb,1,0,0,1\nc,0,1,0,1\n", encoding="utf-8"
    )
    message = message_of(tmp_path, with_lines(points='file = "m.csv"'))
    assert message.startswith("object.sigma: stands beside the sigma columns of m.csv")
