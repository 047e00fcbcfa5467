"""The published schema of pose lines, against what is written and what must not be."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from mixpose.cli import main
from mixpose.poses.schema import schema

jsonschema = pytest.importorskip("jsonschema")
SESSION = Path(__file__).parents[1] / "data" / "synthetic" / "two_cameras" / "session.toml"


def refuse(constant: str) -> None:
    raise ValueError(f"{constant} is no JSON")


def is_valid(line: str) -> bool:
    try:
        value = json.loads(line, parse_constant=refuse)
    except ValueError:
        return False
    return bool(jsonschema.Draft202012Validator(schema()).is_valid(value))


@pytest.fixture(scope="module")
def lines(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    path = tmp_path_factory.mktemp("run") / "poses.jsonl"
    with pytest.raises(SystemExit):
        main(["run", str(SESSION), "-o", str(path), "--stop", "6"])
    found: list[dict[str, Any]] = [json.loads(line) for line in path.read_text().splitlines()]
    assert len(found) == 7
    return found


def test_schema_is_one() -> None:
    jsonschema.Draft202012Validator.check_schema(schema())


def test_every_line_of_a_run_is_valid(lines: list[dict[str, Any]]) -> None:
    assert [is_valid(json.dumps(line)) for line in lines] == [True] * 7


def lost(pose: dict[str, Any]) -> None:
    pose.update(status="lost", T_world_object=None, quaternion_xyzw=None, covariance=None)


def test_lost_frame_and_frame_without_time_or_covariance_are_valid(
    lines: list[dict[str, Any]],
) -> None:
    pose = lines[1] | {"time_s": None, "covariance": None}
    assert is_valid(json.dumps(pose))
    lost(pose)
    assert is_valid(json.dumps(pose))


@pytest.mark.parametrize(
    "spoil",
    [
        lambda pose: pose.update(score=float("nan")),
        lambda pose: pose.update(latency_ms=float("inf")),
        lambda pose: pose.update(T_world_object=None),
        lambda pose: pose.update(quaternion_xyzw=None),
        lambda pose: pose.update(status="lost"),
        lambda pose: pose.update(status="good"),
        lambda pose: pose.pop("covariance"),
        lambda pose: pose.pop("status"),
        lambda pose: pose.update(covariance=pose["covariance"][:5]),
        lambda pose: pose["covariance"][2].pop(),
        lambda pose: pose["T_world_object"].pop(),
        lambda pose: pose["T_world_object"][3].__setitem__(0, 0.5),
        lambda pose: pose.update(quaternion_xyzw=[0, 0, 1]),
        lambda pose: pose.update(frame="3"),
        lambda pose: pose.update(frame=3.5),
        lambda pose: pose["sensors"]["left"].pop("used"),
        lambda pose: pose.update(type="header"),
        lambda pose: pose.pop("type"),
    ],
)
def test_wrong_pose_is_not_valid(
    spoil: Callable[[dict[str, Any]], object], lines: list[dict[str, Any]]
) -> None:
    pose = json.loads(json.dumps(lines[2]))
    assert is_valid(json.dumps(pose))
    spoil(pose)
    assert not is_valid(json.dumps(pose))


def test_number_beyond_a_double_is_not_valid(lines: list[dict[str, Any]]) -> None:
    line = json.dumps(lines[1] | {"time_s": 12345.5})
    assert is_valid(line)
    assert not is_valid(line.replace("12345.5", "1e999"))


@pytest.mark.parametrize("key", ["unit", "format", "version"])
def test_header_without_its_facts_is_not_valid(lines: list[dict[str, Any]], key: str) -> None:
    header = dict(lines[0])
    del header[key]
    assert not is_valid(json.dumps(header))


def test_command_prints_the_schema(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["schema"])
    assert json.loads(capfd.readouterr().out) == schema()
