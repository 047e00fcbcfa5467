"""Several bodies in session files and in files of poses."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mixpose
from mixpose import rigid
from mixpose.cli.app import ConvertRequest
from mixpose.cli.convert import convert_poses
from mixpose.cli.output import written_paths
from mixpose.errors import SessionError
from mixpose.poses.evaluate import evaluate
from mixpose.poses.header import Header
from mixpose.poses.jsonl import PoseFile, read_poses, resume_point
from mixpose.poses.report import as_dict, as_table
from mixpose.poses.schema import schema
from mixpose.poses.writers import FORMATS
from mixpose.records import Estimate, Status
from mixpose.session import Session, load_session

jsonschema = pytest.importorskip("jsonschema")

TOOL = "points = [[0, 0, 0], [10, 0, 0], [0, 20, 0], [0, 0, 30]]"
START = "rotation_vector = [0, 0, 0]\ntranslation = [0, 0, 900]"
CAMERA = """
[[sensor]]
name = "left"
model = "pinhole"
source = "left.csv"
camera_matrix = [[800, 0, 640], [0, 800, 512], [0, 0, 1]]
"""
HEADER = Header("mm", None, None, "0.1.0", 0, objects={"tool": 1, "rod": 2})
BODIES = (("tool", None), ("rod", 0), ("rod", 1))


def session_of(folder: Path, text: str) -> Session:
    path = folder / "session.toml"
    path.write_text(f'unit = "mm"\n{text}{CAMERA}')
    return load_session(path)


def at(x: float) -> np.ndarray:
    return rigid.from_rotation_vector([0.0, 0.0, 0.0], [x, 0.0, 0.0])


def estimate(frame: int, body: tuple[str, int | None], x: float, status: Status = "ok") -> Estimate:
    name, instance = body
    T = at(x) if status != "lost" else None
    return Estimate(frame, None, name, status, T, None, 1.0, {}, instance=instance)


def three_bodies(frames: int) -> list[Estimate]:
    return [estimate(f, body, 100.0 * k) for f in range(frames) for k, body in enumerate(BODIES)]


def written(name: str, estimates: list[Estimate]) -> str:
    stream = io.StringIO()
    writer = FORMATS[name](stream, HEADER)
    for one in estimates:
        writer.write(one)
    writer.close()
    return stream.getvalue()


def file_of(folder: Path, name: str, estimates: list[Estimate]) -> PoseFile:
    path = folder / name
    path.write_text(written("jsonl", estimates))
    return read_poses(path)


def test_one_table_is_one_body_and_an_array_is_several(tmp_path: Path) -> None:
    one = session_of(tmp_path, f'[object]\nname = "tool"\n{TOOL}\n[start]\n{START}')
    assert one.labels == ("tool",)
    assert one.start is not None
    several = session_of(
        tmp_path,
        f'[[object]]\nname = "tool"\n{TOOL}\n[object.start]\n{START}\n'
        f'[[object]]\nname = "rod"\ncount = 2\n{TOOL.replace("30", "35")}',
    )
    assert several.labels == ("tool", "rod-0", "rod-1")
    assert several.start is not None
    assert several.other_objects[0].start is None
    assert several.with_only("rod").labels == ("rod",)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f'[[object]]\nname = "a"\n{TOOL}\n[[object]]\nname = "a"\n{TOOL}', 'found "a"'),
        (
            f'[[object]]\nname = "a"\n{TOOL}\n[[object]]\nname = "b"\n{TOOL}\n[start]\n{START}',
            "[object.start]",
        ),
        (f'[object]\nname = "a"\n{TOOL}\n[object.start]\n{START}\n[start]\n{START}', "beside"),
        (f'[object]\nname = "a"\ncount = 0\n{TOOL}', "object.count: found 0"),
        (f'[[object]]\nname = "a"\n{TOOL}\n[[object]]\nname = "b"', 'object["b"].points: missing'),
    ],
)
def test_wrong_bodies_are_told_by_key(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(SessionError) as caught:
        session_of(tmp_path, text)
    assert said in str(caught.value)


def test_lines_of_identical_bodies_have_a_number_and_come_back(tmp_path: Path) -> None:
    file = file_of(tmp_path, "poses.jsonl", three_bodies(2))
    assert [line.label for line in file.poses] == 2 * ["tool", "rod-0", "rod-1"]
    assert file.header["objects"] == {"tool": 1, "rod": 2}
    lines = [json.loads(line) for line in file.path.read_text().splitlines()]
    assert "instance" not in lines[1]
    for line in lines:
        jsonschema.validate({**line, "session": "s", "session_sha256": 64 * "a"}, schema())
    rows = list(csv.DictReader(io.StringIO(written("csv", three_bodies(1)))))
    assert [(row["object"], row["instance"]) for row in rows] == [
        ("tool", ""),
        ("rod", "0"),
        ("rod", "1"),
    ]
    bop = written("bop", three_bodies(1)).splitlines()[1:]
    assert [row.split(",")[2] for row in bop] == ["1", "2", "2"]


def test_a_run_goes_on_after_the_last_frame_that_has_all_bodies(tmp_path: Path) -> None:
    path = tmp_path / "poses.jsonl"
    whole = written("jsonl", three_bodies(2))
    path.write_text(written("jsonl", three_bodies(3)[:-1]))
    reached = resume_point(path, HEADER)
    assert reached is not None
    assert (reached.frame, reached.lines, reached.size) == (1, 3, len(whole))
    path.write_text(written("jsonl", three_bodies(1)[:2]))
    assert resume_point(path, HEADER) is None


def test_a_trajectory_of_each_body_goes_to_a_file_of_its_own(tmp_path: Path) -> None:
    file = file_of(tmp_path, "poses.jsonl", three_bodies(2))
    convert_poses(ConvertRequest(file.path, tmp_path / "out.tum"))
    found = {path.name for path in tmp_path.glob("*.tum")}
    assert found == {"out.tool.tum", "out.rod-0.tum", "out.rod-1.tum"}
    last = (tmp_path / "out.rod-1.tum").read_text().splitlines()[-1]
    assert last == "1.0 0.2 0.0 0.0 0.0 0.0 0.0 1.0"
    convert_poses(ConvertRequest(file.path, tmp_path / "one.tum", object="rod-0"))
    assert (tmp_path / "one.tum").read_text().splitlines()[2].startswith("0.0 0.1 ")


def test_a_file_per_body_is_needed_from_two_bodies_on() -> None:
    path = Path("out/poses.tum")
    assert written_paths(path, "tum", ["tool"]) == [path]
    names = [each.name for each in written_paths(path, "tum", ["tool", "cup/1"])]
    assert names == ["poses.tool.tum", "poses.cup_1.tum"]
    assert written_paths(path, "jsonl", ["tool", "cup"]) == [path]


def test_names_that_files_take_alike_are_told_apart(tmp_path: Path) -> None:
    labels = ("a.b", "a_b", "A_B", "a_b_1")
    names = [each.name for each in written_paths(Path("t.tum"), "tum", labels)]
    assert names == ["t.a_b_3.tum", "t.a_b.tum", "t.A_B_2.tum", "t.a_b_1.tum"]
    estimates = [replace(each, instance=None) for each in three_bodies(1)[:2]]
    alike = [replace(one, object=name) for one, name in zip(estimates, labels, strict=False)]
    file = file_of(tmp_path, "poses.jsonl", alike)
    for _ in range(2):  # the second time over its own
        convert_poses(ConvertRequest(file.path, tmp_path / "t.tum"))
    assert {path.name for path in tmp_path.glob("*.tum")} == {"t.a_b.tum", "t.a_b_2.tum"}


def test_numbers_of_identical_bodies_are_assigned_once(tmp_path: Path) -> None:
    truth = file_of(tmp_path, "truth.jsonl", three_bodies(10))
    number = {0: 1, 1: 0, None: None}
    other = [replace(one, instance=number[one.instance]) for one in three_bodies(10)]
    found = evaluate(file_of(tmp_path, "poses.jsonl", other), truth)
    assert found.swaps is not None
    assert found.swaps.count == 0
    assert found.translation is not None
    assert found.translation.max == 0.0
    assert list(found.bodies) == ["tool", "rod-0", "rod-1"]


@pytest.mark.parametrize(("status", "announced"), [("ok", 0), ("ambiguous", 2), ("lost", 2)])
def test_bodies_that_change_places_are_counted(
    tmp_path: Path, status: Status, announced: int
) -> None:
    truth = file_of(tmp_path, "truth.jsonl", three_bodies(10))
    places = {(None, False): 0, (0, False): 1, (1, False): 2, (None, True): 0}
    places |= {(0, True): 2, (1, True): 1}
    poses = [
        estimate(f, body, 100.0 * places[body[1], f > 5], status if f == 6 else "ok")
        for f in range(10)
        for body in BODIES
    ]
    found = evaluate(file_of(tmp_path, "poses.jsonl", poses), truth)
    assert found.swaps is not None
    assert (found.swaps.count, found.swaps.announced) == (2, announced)
    # six of ten frames decide which number is which: the others are 100 mm off
    assert found.bodies["rod-0"].translation is not None
    assert found.bodies["rod-0"].translation.max == pytest.approx(100.0)
    assert as_dict(found)["swaps"] == {"count": 2, "announced": announced}
    assert f"2 swaps, {announced} of them announced" in as_table(found)


def test_wrong_poses_that_are_near_neither_body_are_no_swap(tmp_path: Path) -> None:
    # together they are nearer to each other's bodies, by 870 to 930 mm, and neither clearly so
    wrong: dict[tuple[int, int | None], float] = {(5, 0): 1000.0, (5, 1): 170.0}
    usual = {None: 0.0, 0: 100.0, 1: 200.0}
    poses = [
        estimate(f, body, wrong.get((f, body[1]), usual[body[1]]))
        for f in range(10)
        for body in BODIES
    ]
    truth = file_of(tmp_path, "truth.jsonl", three_bodies(10))
    found = evaluate(file_of(tmp_path, "poses.jsonl", poses), truth)
    assert found.swaps is not None
    assert found.swaps.count == 0


def test_of_identical_bodies_all_have_the_directions_held_that_the_first_starts_with(
    tmp_path: Path,
) -> None:
    """Two tools on a plane: the second begins nowhere, and lies as high and as level."""
    points = np.array([[0.0, 0, 0], [52, 6, 10], [-35, 38, -12], [-30, -46, 15], [36, 30, 42]])
    K, rows = np.array([[800.0, 0, 640], [0, 800.0, 512], [0, 0, 1]]), ["frame,u,v"]
    truth = [rigid.from_rotation_vector([0, 0, 0.1], [-100.0, 0, 900])]
    truth.append(rigid.from_rotation_vector([0, 0, 0.9], [130.0, 50.0, 900]))
    for frame in range(3):
        seen = np.concatenate([rigid.transform(place, points) for place in truth])
        y = seen[:, :2] / seen[:, 2:] * K[0, 0] + K[:2, 2]
        rows += [f"{frame},{u:.3f},{v:.3f}" for u, v in y]
    (tmp_path / "left.csv").write_text("\n".join(rows) + "\n")
    head = f'[[object]]\nname = "tool"\ncount = 2\npoints = {points.tolist()}\n'
    start = "[object.start]\nrotation_vector = [0, 0, 0]\ntranslation = [-100, 0, 900]\n"
    session = session_of(tmp_path, head + start + '[estimator]\nfree = ["x", "y", "rz"]\n')
    for one in mixpose.run(session):
        assert one.T_world_object is not None
        away = [np.abs(one.T_world_object - place).max() for place in truth]
        assert away[one.instance or 0] < 0.5


def test_symmetries_of_a_truth_in_another_unit_are_none_that_exchange_bodies(
    tmp_path: Path,
) -> None:
    def file(name: str, unit: str, length: float, *, turned: bool) -> PoseFile:
        half = rigid.from_rotation_vector([0, 0, np.pi], [200.0 * length, 0, 0])
        lines = []
        for frame in range(20):
            for number in (0, 1):
                T = at(length * (230.0 * number + 3 * frame))
                away = turned and frame % 3 == 0
                T = T @ half if away and not number else T
                status: Status = "lost" if away and number else "ok"
                pose = None if status == "lost" else T
                lines.append(
                    Estimate(frame, None, "b", status, pose, None, 1.0, {}, instance=number)
                )
        path = tmp_path / name
        header = Header(unit, None, None, "0.1.0", 0, symmetries={"b": np.array([np.eye(4), half])})
        with path.open("w", encoding="utf-8") as stream:
            writer = FORMATS["jsonl"](stream, header)
            for line in lines:
                writer.write(line)
        return read_poses(path)

    poses = file("poses.jsonl", "mm", 1.0, turned=True)
    for unit, length in (("mm", 1.0), ("m", 1e-3)):
        found = evaluate(poses, file("truth.jsonl", unit, length, turned=False))
        assert found.swaps is not None
        assert found.swaps.count == 0
