"""How a tunable number is written down: a field of a frozen dataclass that says why it is so.

`docs/constants.md` is made from these fields.
"""

from __future__ import annotations

from dataclasses import field
from typing import TypeVar

T = TypeVar("T")


def constant(value: T, why: str) -> T:
    """A field with a default and the reason for it: a derivation, a test or a measured row."""
    return field(default=value, metadata={"why": why})
