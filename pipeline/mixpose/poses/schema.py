"""The JSON Schema (draft 2020-12) of pose lines, for programs that read or check them."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any


def schema() -> dict[str, Any]:
    """The schema of one line of a poses file, as a JSON object."""
    found: dict[str, Any] = json.loads(schema_text())
    return found


def schema_text() -> str:
    """The schema as it stands in ``pose-lines.schema.json``."""
    return files("mixpose.poses").joinpath("pose-lines.schema.json").read_text(encoding="utf-8")
