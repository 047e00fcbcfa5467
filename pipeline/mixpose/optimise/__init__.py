"""Terms of an objective and their ascent: functions of a few numbers, never an image."""

from __future__ import annotations

from mixpose.optimise.ascent import Ascent, NewtonOptions, ascend
from mixpose.optimise.term import Quadratic, Sum, Term

__all__ = ["Ascent", "NewtonOptions", "Quadratic", "Sum", "Term", "ascend"]
