"""The packages that are installed: a wheel and a source distribution, with all that they need."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SESSION = ROOT / "data" / "synthetic" / "range_profiles" / "session.toml"

pytest.importorskip("hatchling")


def built(source: Path, kind: str, folder: Path) -> Path:
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(folder)]
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    (package,) = folder.iterdir()
    return package


# distributions whose modules have other names
NAMES = {"cv2": "opencv-python-headless", "yaml": "pyyaml", "skimage": "scikit-image",
         "rerun": "rerun-sdk", "dask": "distributed", "pythonosc": "python-osc",
         "paho": "paho-mqtt"}  # fmt: skip


def required(words: Iterable[str]) -> set[str]:
    """Distributions of requirements, as `pydantic-core` of `pydantic_core>=2`."""
    found = (re.match(r"[\w.-]+", word) for word in words)
    return {name[0].lower().replace("_", "-") for name in found if name}


def imported(path: Path) -> Iterator[tuple[str, bool]]:
    """Modules that a module imports, and whether it does so whenever it is imported itself."""
    waiting: list[tuple[ast.AST, bool]] = [(ast.parse(path.read_text(encoding="utf-8")), True)]
    while waiting:
        node, at_once = waiting.pop()
        if isinstance(node, ast.Import):
            yield from ((alias.name, at_once) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module, at_once
            yield from ((f"{node.module}.{alias.name}", at_once) for alias in node.names)
        typing = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        later = typing or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        waiting += [(child, at_once and not later) for child in ast.iter_child_nodes(node)]


def test_whatever_is_imported_is_declared_and_what_is_extra_only_where_it_is_needed() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    always = required(project["dependencies"])
    extras = project["optional-dependencies"]
    extra = required(word for name in extras if name != "dev" for word in extras[name])
    files = list((ROOT / "pipeline" / "mixpose").rglob("*.py"))
    used: set[str] = set()
    # modules that cannot be imported without an extra, and those that a module needs at once
    with_extra: set[str] = set()
    needed: dict[str, set[str]] = {}
    for path in files:
        parts = path.relative_to(ROOT / "pipeline").with_suffix("").parts
        name = ".".join(parts).removesuffix(".__init__")
        needed[name] = set()
        for module, at_once in imported(path):
            top = module.partition(".")[0]
            if top == "mixpose" and at_once:
                needed[name].add(module)
            if top in sys.stdlib_module_names or top == "mixpose":
                continue
            distribution = NAMES.get(top, top.replace("_", "-"))
            assert distribution in always | extra, f"{path} imports {module}"
            used.add(distribution)
            if at_once and distribution not in always:
                with_extra.add(name)
    page = {f"mixpose.viewing.{name}" for name in ("page", "scene", "server")}
    assert with_extra == {"mixpose.rerun_file"} | page
    assert not [name for name in needed if name not in with_extra and needed[name] & with_extra]
    assert used == (always | extra) - {"mixpose"}  # and nothing is declared that nobody imports


def test_the_source_distribution_has_what_is_under_version_control_and_nothing_else(
    tmp_path: Path,
) -> None:
    root = tmp_path / "root"
    kept = ["pyproject.toml", ".gitignore", "README.md", "LICENSE", "CHANGELOG.md",
            "CONTRIBUTING.md", ".pre-commit-config.yaml", ".ci/run", "data/a.png", "docs/index.md",
            "pipeline/mixpose/__init__.py", "tests/test_a.py", "tools/a.py"]  # fmt: skip
    left = [".hypothesis/examples/a", ".mypy_cache/a", "notes.txt", "out/poses.jsonl",
            "poses.jsonl", "tests/__pycache__/a.pyc", "tests/.hypothesis/a"]  # fmt: skip
    for name in [*kept, *left]:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        there = ROOT / name
        text = there.read_text(encoding="utf-8") if name in kept and there.is_file() else "a = 1\n"
        (root / name).write_text(text, encoding="utf-8")
    with tarfile.open(built(root, "sdist", tmp_path / "sdist")) as archive:
        found = {name.partition("/")[2] for name in archive.getnames()}
    assert found == {*kept, "PKG-INFO"}
    # each folder and file at the top of the checkout is named
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    top = {name.partition("/")[0] for name in listed.stdout.splitlines()}
    assert top <= {name.partition("/")[0] for name in kept}


def test_a_wheel_made_from_the_source_distribution_runs_by_itself(tmp_path: Path) -> None:
    source = built(ROOT, "sdist", tmp_path / "sdist")
    with tarfile.open(source) as archive:
        archive.extractall(tmp_path / "source", filter="data")
    (unpacked,) = (tmp_path / "source").iterdir()
    wheel = built(unpacked, "wheel", tmp_path / "wheel")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "installed")
    files = {path.name for path in (tmp_path / "installed" / "mixpose").rglob("*")}
    assert {"py.typed", "pose-lines.schema.json", "body.html.j2"} <= files
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "installed")}
    for arguments in (["--version"], ["schema"], ["run", str(SESSION), "--stop", "1"]):
        result = subprocess.run(
            [sys.executable, "-m", "mixpose", *arguments],
            cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert result.returncode == 0, result.stderr
    where = subprocess.run(
        [sys.executable, "-c", "import mixpose; print(mixpose.__file__)"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert where.stdout.startswith(str(tmp_path / "installed"))
