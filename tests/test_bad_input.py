"""Whatever a file holds: it is read, or one line says what is wrong with it."""

from __future__ import annotations

import string
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from session_lines import LINES, with_lines

from mixpose.errors import MixposeError
from mixpose.frames import SourceSpec, open_source, read_image
from mixpose.frames.containers import missing_bytes
from mixpose.poses.jsonl import read_poses
from mixpose.runner import run
from mixpose.session import load_session

pytest.importorskip("hypothesis")

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

FEW = settings(
    max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck)
)
NUMBERS = st.one_of(
    st.integers(-(10**30), 10**30),
    st.floats(),
    st.sampled_from([0, -1, 1e308, 5e-324, float("nan"), float("inf"), True, "1", ""]),
)
VALUES: Any = st.recursive(NUMBERS, lambda inner: st.lists(inner, max_size=5), max_leaves=12)


def toml(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, bool):
        return "true" if value else "false"
    return f'"{value}"' if isinstance(value, str) else str(value)


def see_one_line(error: MixposeError, beginning: str = "") -> None:
    assert len(str(error).splitlines()) == 1
    assert str(error).startswith(beginning)


@FEW
@given(key=st.sampled_from([k for k, line in LINES.items() if " = " in line]), value=VALUES)
def test_any_value_of_any_key_is_read_or_told(key: str, value: Any) -> None:
    name = LINES[key].splitlines()[-1].partition(" = ")[0]
    *before, _ = LINES[key].splitlines()
    line = "\n".join([*before, f"{name} = {toml(value)}"])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.toml"
        path.write_text(with_lines(**{key.replace(" ", "_"): line}), encoding="utf-8")
        try:
            session = load_session(path)
        except MixposeError as error:
            see_one_line(error, str(path))
        else:
            assert np.isfinite(session.body.means).all()


@FEW
@given(text=st.text(alphabet=string.printable, max_size=200), nested=VALUES)
def test_any_text_for_a_calibration_is_read_or_told(text: str, nested: Any) -> None:
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session.toml"
        session.write_text(with_lines(matrix='calibration = "c.yml"'), encoding="utf-8")
        for content in (
            text,
            f"cam0:\n  intrinsics: {toml(nested)}\n  distortion_model: none\n  {text}",
            f"camera_matrix:\n  data: {toml(nested)}\ndistortion_model: plumb_bob\n",
        ):
            (Path(folder) / "c.yml").write_text(content, encoding="utf-8")
            try:
                load_session(session)
            except MixposeError as error:
                see_one_line(error)


@FEW
@given(rows=st.lists(st.lists(NUMBERS, min_size=2, max_size=4), max_size=8))
def test_any_rows_of_a_table_are_read_or_told(rows: list[list[Any]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        text = "frame,u,v\n" + "".join(",".join(map(str, row)) + "\n" for row in rows)
        (Path(folder) / "t.csv").write_text(text, encoding="utf-8")
        try:
            source = open_source(SourceSpec("c", "t.csv", Path(folder), "camera"))
            numbers = [frame.number for frame in source.frames()]
        except MixposeError as error:
            see_one_line(error)
        else:
            assert numbers == sorted(set(numbers))


@FEW
@given(
    shape=st.lists(st.integers(0, 5), max_size=3),
    kind=st.sampled_from(["f4", "f8", "i2", "u1", "c8", "?", "S3", "M8[s]"]),
    fill=st.sampled_from([0, 1, np.nan, np.inf, 1e300]),
    cut=st.integers(0, 200),
)
def test_any_array_of_profiles_is_read_or_told(
    shape: list[int], kind: str, fill: float, cut: int
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "p.npy"
        with np.errstate(all="ignore"):
            array = np.zeros(shape, kind) if kind[0] in "SM?" else np.full(shape, 0).astype(kind)
            if kind[0] == "f":
                array[...] = fill
        np.save(path, array)
        path.write_bytes(path.read_bytes()[: max(path.stat().st_size - cut, 0)])
        spec = SourceSpec("c", "p.npy", Path(folder), "lateration", range_min=0.0, bin_size=1.0)
        try:
            with np.errstate(all="ignore"):
                for frame in open_source(spec).frames():
                    assert np.isfinite(frame.data.values).all()  # type: ignore[union-attr]
        except MixposeError as error:
            see_one_line(error)


HEADS = [b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"BM", b"II*\0", b"P5 3 3 255\n", b"GIF8"]


@FEW
@given(head=st.sampled_from(HEADS), data=st.binary(max_size=300))
def test_any_bytes_for_an_image_are_read_or_told(head: bytes, data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "i.png"
        path.write_bytes(head + data)
        try:
            assert read_image(path).ndim == 2
        except MixposeError as error:
            see_one_line(error)


BOXES = [b"RIFF\xff\0\0\0AVI ", b"\0\0\0\x18ftypmp42", b"\0\0\0\1mdat", b"\x1a\x45\xdf\xa3", b""]


@FEW
@given(head=st.sampled_from(BOXES), data=st.binary(max_size=300))
def test_any_bytes_for_a_video_are_looked_through(head: bytes, data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "v.avi"
        path.write_bytes(head + data)
        assert missing_bytes(path) >= 0


@FEW
@given(
    key=st.sampled_from(["frame", "status", "T_world_object", "covariance", "sensors", "score"]),
    value=st.recursive(
        st.one_of(st.none(), st.integers(-(10**40), 10**40), st.text(max_size=5),
                  st.floats(allow_nan=False, allow_infinity=False)),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner),
        max_leaves=10,
    ),
)  # fmt: skip
def test_any_value_in_a_pose_line_is_read_or_told(key: str, value: Any) -> None:
    import json

    line = {"frame": 1, "object": "b", "T_world_object": np.eye(4).tolist(), "status": "ok"}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "poses.jsonl"
        path.write_text(json.dumps(line | {key: value}) + "\n", encoding="utf-8")
        try:
            read_poses(path)
        except MixposeError as error:
            see_one_line(error)


@pytest.mark.skipif(sys.platform == "win32", reason="inputs are tried in forks")
def test_mutated_inputs_end_in_one_line_in_time_and_memory() -> None:
    import subprocess

    tool = Path(__file__).resolve().parents[1] / "tools" / "fuzz.py"
    result = subprocess.run(
        [sys.executable, str(tool), "--count", "20", "--seed", "7"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-500:]
    assert result.stdout.startswith("20 mutated inputs: 0 findings")


def test_a_profile_of_one_bin_far_above_all_others_ends_the_run_in_no_traceback(
    tmp_path: Path,
) -> None:
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
    from fuzzed.recordings import KINDS

    KINDS["npy"].make(tmp_path)
    values = np.load(tmp_path / "p.npy")
    values[1] = 0.0
    values[1, 0] = 1e12
    np.save(tmp_path / "p.npy", values)
    statuses = [one.status for one in run(load_session(tmp_path / "session.toml"))]
    assert len(statuses) == 3
