"""Optimisers: they know a function of a few numbers and never see an image."""

from __future__ import annotations

from mixpose.optimise.newton import Ascent, NewtonOptions, ascend, ascend_together

__all__ = ["Ascent", "NewtonOptions", "ascend", "ascend_together"]
