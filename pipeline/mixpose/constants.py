"""Define tunable numbers as fields of frozen dataclasses, each with the reason for its value.

`docs/constants.md` is made from these fields.
"""

from __future__ import annotations

from dataclasses import field
from typing import TypeVar

T = TypeVar("T")


def constant(value: T, why: str) -> T:
    """Return a field with a default and its reason: a derivation, a test or a measured row."""
    return field(default=value, metadata={"why": why})
