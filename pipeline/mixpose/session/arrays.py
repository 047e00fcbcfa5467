"""Values of the session file, as TOML gives them, to arrays of finite numbers."""

from __future__ import annotations

import math
from typing import Any, TypeGuard

import numpy as np

from mixpose.limits import MOST_PIXELS
from mixpose.records import Floats
from mixpose.session.messages import BadKeyError, found

RESOLUTION_FORM = "[width, height], two positive integers"

LARGEST = 1e12  # powers of larger numbers would overflow to infinity unseen
SMALLEST = 1e-12  # of what must be greater than 0; powers of smaller ones would come to 0
_WIDEST = 1_000_000  # px; more than any image library reads


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a value is a finite number (true and false are none)."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return -LARGEST <= value <= LARGEST  # false for NaN, and for integers beyond float64


def limits(value: object) -> str:
    """What to say where a number is beyond the limits that all numbers have; else nothing."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        if LARGEST < abs(value) < math.inf:
            return f"; the largest number is {LARGEST:g}"
        if 0 < value < SMALLEST:
            return f"; the smallest is {SMALLEST:g}"
    return ""


def numbers(value: Any, shape: tuple[int | None, ...], allowed: str) -> Floats:
    """Read nested lists of numbers as a float64 array; a problem points at the first that does not
    fit.

    `shape` has the length of the list at each depth, None for any length but zero; `allowed` is
    what to tell the user.
    """
    if not shape:
        if not is_number(value):
            raise BadKeyError(
                found(value, f"a finite number, as part of {allowed}") + limits(value)
            )
        return np.float64(value)  # type: ignore[return-value]
    length, inner = shape[0], shape[1:]
    if not isinstance(value, list) or not value or (length is not None and len(value) != length):
        raise BadKeyError(found(value, allowed))
    rows = []
    for i, item in enumerate(value):
        try:
            rows.append(numbers(item, inner, allowed))
        except BadKeyError as problem:
            raise BadKeyError(problem.text, i, *problem.key) from problem
    return np.array(rows, dtype=np.float64)


def resolution(value: Any) -> tuple[int, int]:
    """Read the width and height of an image in px."""
    match value:
        case [int(width), int(height)] if not any(isinstance(n, bool) for n in value):
            if 0 < width <= _WIDEST and 0 < height <= _WIDEST:
                if width * height <= MOST_PIXELS:
                    return width, height
                raise BadKeyError(
                    f"found {width} x {height} pixels; allowed: at most {MOST_PIXELS} together"
                )
    raise BadKeyError(found(value, RESOLUTION_FORM))
