"""Units of length."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, TypeAlias

Unit: TypeAlias = Literal["m", "cm", "mm", "um"]

# whole numbers, so that a division rounds only once: 1500 mm are 1.5 m exactly
UNITS_PER_METRE: Mapping[str, float] = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "um": 1e6}


def length_ratio(from_unit: str, to_unit: str) -> float:
    """Return the length of one `from_unit` in `to_unit`: 1000 from "m" to "mm"."""
    return UNITS_PER_METRE[to_unit] / UNITS_PER_METRE[from_unit]
