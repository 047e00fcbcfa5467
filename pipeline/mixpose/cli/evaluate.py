"""``mixpose evaluate``."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from mixpose.poses.evaluate import evaluate_files
from mixpose.poses.report import as_dict, as_table


def evaluate_poses(poses: Path, truth: Path, *, as_json: bool) -> None:
    """Print the errors of a poses file against a truth file, as a table or as JSON."""
    evaluation = evaluate_files(poses, truth)
    text = json.dumps(as_dict(evaluation), indent=2) if as_json else as_table(evaluation)
    sys.stdout.write(text.rstrip("\n") + "\n")
