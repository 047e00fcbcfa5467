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
    "naming",
    "units",
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
    "naming": set(),
    "units": set(),
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
    "judgement": GROUND | {"sensors", "body", "density", "matching", "objective", "optimise"},
    "tracking": GROUND
    | {"sensors", "body", "density", "matching", "objective", "optimise", "search"}
    | {"fit", "judgement"},
    "frames": GROUND,
    "pictures": GROUND
    | {"sensors", "body", "density", "extraction", "objective", "session"}
    | {"fit", "judgement", "matching", "tracking"},
    "poses": GROUND,
    "publishing": GROUND | {"poses"},
    "session": GROUND | {"sensors", "body", "extraction", "objective", "fit"},
    "simulation": GROUND | {"sensors", "body", "session", "frames"},
    "checking": GROUND
    | {"sensors", "body", "extraction", "objective", "optimise", "search", "fit", "frames"}
    | {"matching", "judgement", "tracking", "session", "simulation", "runner"},
    "runner": GROUND
    | {"sensors", "body", "density", "extraction", "objective", "matching", "tracking"}
    | {"frames", "session"},
    "report": GROUND | {"frames", "pictures", "poses", "runner", "session", "calibration"},
}
MAY_IMPORT["viewing"] = GROUND | {"sensors", "body", "objective", "pictures", "session"}
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
MAY_IMPORT["trajectories"] = GROUND | {"poses"}
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
MAY_IMPORT["learning"] = GROUND | {"sensors", "body", "search", "calibration", "session"}
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


CORE = ("density", "objective", "optimise", "fit", "judgement", "matching", "search", "tracking")
CODE = [
    (str(path.relative_to(ROOT)), node)
    for room in CORE
    for path in sorted((ROOT / room).glob("*.py"))
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
]
FUNCTIONS = [
    (f"{path}:{node.name}", node) for path, node in CODE if isinstance(node, ast.FunctionDef)
]


def called(node: ast.AST) -> set[str]:
    """Names of the functions and methods that are called anywhere in a part of the code."""
    functions = [one.func for one in ast.walk(node) if isinstance(one, ast.Call)]
    return {
        one.attr if isinstance(one, ast.Attribute) else getattr(one, "id", "") for one in functions
    }


def is_determinant(node: ast.AST) -> bool:
    """Whether this is a difference of two products, as a coordinate of a cross product is."""
    if not (isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub)):
        return False
    sides = (node.left, node.right)
    return all(isinstance(one, ast.BinOp) and isinstance(one.op, ast.Mult) for one in sides)


def test_one_function_differentiates_a_projection_by_the_pose() -> None:
    # a turn moves points by a cross product, called by name or written out
    across = {
        name
        for name, node in FUNCTIONS
        if "cross" in called(node) or sum(map(is_determinant, ast.walk(node))) >= 3
    }
    assert across == {
        "objective/projection.py:pose_jacobian",
        "judgement/nonlinear.py:with_wide_turn",  # the arc of the origin by a wide turn
        "search/from_points.py:_meetings",  # lines by their Pluecker coordinates
        "search/poses.py:label_image",  # axes of a plane
        "search/three_points.py:_shape",  # triangles and conics
        "search/three_points.py:depths",
        "search/three_points.py:_cofactors",
        "search/three_points.py:_halves",
        "tracking/motion.py:expected",  # turns per second, of the logarithm of a turn
        "tracking/motion.py:followed",
        "tracking/sizes.py:_scales",  # areas of what is seen
    }
    chained = {name for name, node in FUNCTIONS if "pose_jacobian" in called(node)}
    # frames of which the poses err show one side of the body: it is taken from there again
    own = {"objective/projection.py:_project", "objective/paper.py:_model"}
    assert chained == {*own, "judgement/shape.py:_by_pose"}


def test_one_function_climbs() -> None:
    loops = [
        (name, one)
        for name, node in FUNCTIONS
        for one in ast.walk(node)
        if isinstance(one, ast.For | ast.While)
    ]
    solvers = {"solve", "lstsq", "inv", "pinv", "dposv", "cho_solve", "cholesky"}
    assert {name for name, loop in loops if called(loop) & solvers} == {
        "fit/near.py:_moved",  # how far narrower blurs would lead, where no step is taken
        "objective/terms.py:_model",  # by sensor: amplitudes that are best at a pose
        "objective/terms.py:_mixtures",
    }
    # poses that go on by steps of `ascend`, and that of each branch by its velocity
    assert {name for name, loop in loops if "perturb" in called(loop)} == {
        "tracking/in_motion.py:fit_in_motion",
        "tracking/track.py:predict",
    }
    for name, loop in loops:
        if "perturb" in called(loop) and not name.endswith("predict"):
            assert "least_squares" in called(loop)
    # of SciPy's only assignments, and sums of variances
    optimisers = {
        f"{getattr(node, 'module', '')} {alias.name}"
        for _, node in CODE
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
        if "optimize" in f"{getattr(node, 'module', '')} {alias.name}"
    }
    assert optimisers == {"scipy.optimize linear_sum_assignment", "scipy.optimize nnls"}


def test_one_record_says_which_feature_is_met_by_which_detection() -> None:
    classes = {
        f"{path}:{node.name}": {
            one.target.id
            for one in node.body
            if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name)
        }
        for path, node in CODE
        if isinstance(node, ast.ClassDef)
    }
    record = classes.pop("matching/matches.py:Matches")
    told = {"shares", "offsets", "detections", "met", "missed", "residuals", "squared"}
    assert len(record & told) == 3
    assert {name for name, fields in classes.items() if len(fields & told) > 1} == set()
