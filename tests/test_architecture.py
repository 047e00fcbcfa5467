"""Rooms know only what is below them, and the public interface is complete."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import mixpose

ROOT = Path(mixpose.__file__).parent

# Each room with the rooms it may import from; rooms of one floor do not know each other.
GROUND = {"errors", "rigid", "records", "selection", "constants", "threads"} | {
    "encoding",
    "limits",
    "whole_files",
}
MAY_IMPORT: dict[str, set[str]] = {
    "errors": set(),
    "rigid": {"records"},
    "records": set(),
    "selection": set(),
    "constants": set(),
    "threads": set(),
    "encoding": set(),
    "limits": set(),
    "executing": GROUND,
    "whole_files": set(),
    "sensors": GROUND,
    "body": GROUND,
    "density": GROUND,
    "extraction": GROUND,
    "optimise": GROUND,
    "objective": GROUND | {"sensors", "body", "density", "optimise"},
    "matching": GROUND | {"sensors", "body", "density", "objective"},
    "search": GROUND
    | {"sensors", "body", "density", "matching", "objective", "optimise", "judgement"},
    "fit": GROUND | {"sensors", "body", "density", "matching", "objective", "optimise"},
    "judgement": GROUND | {"sensors", "body", "density", "matching", "objective"},
    "tracking": GROUND
    | {"sensors", "body", "density", "matching", "objective", "optimise", "search"}
    | {"fit", "judgement"},
    "frames": GROUND,
    "pictures": GROUND
    | {"sensors", "body", "density", "extraction", "objective", "session"}
    | {"fit", "judgement", "matching", "tracking"},
    "poses": GROUND,
    "session": GROUND | {"sensors", "body", "extraction", "objective", "fit"},
    "simulation": GROUND | {"sensors", "body", "session", "frames"},
    "checking": GROUND
    | {"sensors", "body", "extraction", "objective", "optimise", "search", "fit", "frames"}
    | {"session", "simulation", "runner"},
    "runner": GROUND
    | {"sensors", "body", "density", "extraction", "objective", "matching", "tracking"}
    | {"frames", "session"},
    "importing": GROUND | {"session"},
    "report": GROUND | {"frames", "pictures", "poses", "runner", "session", "calibration"},
}
MAY_IMPORT["design"] = GROUND | {
    "executing",
    "sensors",
    "body",
    "objective",
    "judgement",
    "fit",
    "checking",
    "session",
    "simulation",
    "runner",
}
MAY_IMPORT["rerun_file"] = GROUND | {
    "sensors",
    "body",
    "density",
    "frames",
    "poses",
    "session",
    "runner",
}
MAY_IMPORT["calibration"] = GROUND | {
    "sensors",
    "body",
    "density",
    "objective",
    "search",
    "fit",
    "tracking",
    "frames",
    "session",
    "runner",
}
EDGE = {"cli", "__init__", "__main__"}


def room_of(path: Path) -> str:
    return path.relative_to(ROOT).with_suffix("").parts[0]


def imported_rooms(path: Path) -> set[str]:
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the room"
            names = [node.module or ""]
            if node.module == "mixpose":
                names = [f"mixpose.{alias.name}" for alias in node.names]
        rooms |= {name.split(".")[1] for name in names if name.startswith("mixpose.")}
    return rooms


MODULES = sorted(ROOT.rglob("*.py"))


def test_every_room_has_its_place_in_the_house() -> None:
    assert {room_of(path) for path in MODULES} == set(MAY_IMPORT) | EDGE


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_module_imports_what_lies_above_it(path: Path) -> None:
    room = room_of(path)
    if room in EDGE:
        return
    assert imported_rooms(path) <= MAY_IMPORT[room] | {room}


def test_simulation_of_the_truth_does_not_know_how_it_is_estimated() -> None:
    above = {"density", "objective", "fit", "judgement", "tracking", "optimise", "runner"}
    for path in (ROOT / "simulation").glob("*.py"):
        rooms = imported_rooms(path)
        assert not rooms & above
        text = path.read_text(encoding="utf-8")
        assert "mixpose.extraction" not in text or "mixpose.extraction.options" in text


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_file_is_too_long_to_be_one_room(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 420


def test_public_names_are_complete_and_lead_somewhere() -> None:
    for name in mixpose.__all__:
        assert getattr(mixpose, name) is not None
    assert set(mixpose._HOMES) | {"__version__"} == set(mixpose.__all__)


@pytest.mark.parametrize("module", ["mixpose", "mixpose.cli.app", "mixpose.cli.several"])
def test_what_only_starts_work_imports_nothing_heavy(module: str) -> None:
    code = f"import sys, {module}; print(sorted({{'cv2', 'numpy', 'scipy'}} & set(sys.modules)))"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"
