"""Give the JSON Schema (draft 2020-12) of pose lines, for programs that read or check them."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any


def schema() -> dict[str, Any]:
    """Return the schema of a line of a poses file, as a JSON object."""
    parsed: dict[str, Any] = json.loads(schema_text())
    return parsed


def schema_text() -> str:
    """Return the text of ``pose-lines.schema.json``."""
    return files("mixpose.poses").joinpath("pose-lines.schema.json").read_text(encoding="utf-8")
