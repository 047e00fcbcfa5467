"""The oldest versions that `pyproject.toml` allows, installed and tried.

    python tools/oldest.py [--python python3.11] [--newest] [TEST ...]

Makes an environment with each dependency at its lower bound, or with --newest at the newest there
is, installs mixpose into it and runs some tests there.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
TESTS = ["tests/test_poses_writing.py", "tests/test_session_reading.py", "tests/test_rigid.py",
         "tests/test_frames_tables.py", "tests/test_cli_trust.py", "tests/test_body.py",
         "tests/test_simulation_recording.py", "tests/test_tracking.py",
         "tests/test_frames_video.py", "tests/test_cluster.py"]  # fmt: skip
_BOUND = re.compile(r"^([A-Za-z0-9_.-]+)>=([0-9.]+)")


def lower_bounds() -> list[str]:
    """Constraints that hold every dependency with a lower bound at it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *extras["plots"], *extras["report"], *extras["dask"]]
    found = [_BOUND.match(each) for each in wanted]
    # the oldest of `>=6` is 6.0, not the newest 6
    return [f"{each[1]}=={each[2]}{'' if '.' in each[2] else '.0'}.*" for each in found if each]


def main() -> int:
    parser = argparse.ArgumentParser(description="Try the oldest versions allowed.")
    parser.add_argument("tests", nargs="*", default=TESTS)
    parser.add_argument("--python", default=sys.executable, help="interpreter of the environment")
    parser.add_argument("--newest", action="store_true", help="no bounds: the newest there is")
    options = parser.parse_args()
    bounds = [] if options.newest else lower_bounds()
    print("\n".join(bounds) or "the newest there is")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "bounds.txt").write_text("\n".join(bounds) + "\n", encoding="utf-8")
        subprocess.run([options.python, "-m", "venv", str(folder / "env")], check=True)
        python = str(folder / "env" / "bin" / "python")
        install = [python, "-m", "pip", "install", "-q", "-c", str(folder / "bounds.txt")]
        subprocess.run([*install, f"{ROOT}[report,dask]"], check=True)
        subprocess.run([python, "-m", "pip", "install", "-q", "pytest>=8"], check=True)
        # an old library may use what a new one of its dependencies deprecates
        old = ["-W", "ignore::DeprecationWarning"]
        run = [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", *old, *options.tests]
        return subprocess.run(run, cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
