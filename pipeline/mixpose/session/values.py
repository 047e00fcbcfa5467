"""Read values of a session file that need more checks than a type; say what is allowed."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal, TypeAlias, TypeGuard

import numpy as np
from pydantic import AfterValidator, Field, GetCoreSchemaHandler
from pydantic_core import core_schema

from mixpose.limits import MOST_PIXELS
from mixpose.records import Floats
from mixpose.rigid import TWIST_NAMES
from mixpose.session.messages import BadKeyError, did_you_mean, mismatch, one_of, under

EXTRACT_METHODS = ("blobs", "corners", "intensity", "log")
THRESHOLDS = ("auto", "otsu", "local", "li", "triangle", "sauvola")

_FUNCTION = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")
_METHOD_ALLOWED = f'{one_of(EXTRACT_METHODS)} or "module:function"'
SIGMA_ALLOWED = "a number, [sx, sy, sz], a 3x3 covariance, or a list with one of these per feature"
RADIUS_ALLOWED = "a length greater than 0, or a list with one per point"
_DELAY_ALLOWED = 'seconds from -1 to 1, or "estimate"'
_FREE_ALLOWED = f"a list of at least one of {one_of(TWIST_NAMES)}, each once"
_SOURCE_ALLOWED = (
    "a glob, a folder, a file or a stream as text, a camera's number, or a list of files"
)
LONGEST_DELAY_S = 1.0
_THRESHOLD_ALLOWED = f"{one_of(THRESHOLDS)} or a grey level"
MATRIX_FORM = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
RESOLUTION_FORM = "[width, height], two positive integers"

LARGEST = 1e12  # powers of larger numbers would silently overflow to infinity
SMALLEST = 1e-12  # of keys greater than 0; powers of smaller numbers would underflow to 0
_WIDEST = 1_000_000  # px; more than any image library reads


@dataclass(frozen=True)
class ReadBy:
    """Annotation of a key: the function that reads its value, and a description of valid values."""

    read: Callable[[Any], Any]
    description: str

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return core_schema.no_info_plain_validator_function(self.read)


def array_of(shape: tuple[int | None, ...], description: str) -> ReadBy:
    """Return the annotation of a key that holds nested lists of numbers, see `numbers`."""
    return ReadBy(partial(numbers, shape=shape, allowed=description), description)


def _read_sensor_name(name: str) -> str:
    if not name.strip() or name != name.strip() or re.search(r"[=/\\\x00-\x1f\x7f]", name):
        raise BadKeyError(
            mismatch(name, 'text without "=", "/" or "\\", not empty, no blanks around it')
        )
    return name


def _read_method(value: Any) -> str:
    if isinstance(value, str) and (value in EXTRACT_METHODS or _FUNCTION.fullmatch(value)):
        return value
    raise BadKeyError(mismatch(value, _METHOD_ALLOWED) + did_you_mean(value, EXTRACT_METHODS))


def _read_threshold(value: Any) -> str | float:
    if isinstance(value, str) and value in THRESHOLDS:
        return value
    if is_number(value):
        return float(value)
    raise BadKeyError(mismatch(value, _THRESHOLD_ALLOWED) + did_you_mean(value, THRESHOLDS))


def _read_source(value: Any) -> str | tuple[str, ...]:
    if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        return f"camera:{value}"
    texts = value if isinstance(value, list) else [value]
    if not texts or not all(isinstance(text, str) and text.strip() for text in texts):
        raise BadKeyError(mismatch(value, _SOURCE_ALLOWED))
    return tuple(texts) if isinstance(value, list) else str(value)


def _read_delay(value: Any) -> float | Literal["estimate"]:
    if value == "estimate":
        return "estimate"
    if not is_number(value) or not -LONGEST_DELAY_S <= value <= LONGEST_DELAY_S:
        raise BadKeyError(mismatch(value, _DELAY_ALLOWED))
    return float(value)


def _read_free(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not value:
        raise BadKeyError(mismatch(value, _FREE_ALLOWED))
    for i, name in enumerate(value):
        if name not in TWIST_NAMES:
            raise BadKeyError(mismatch(name, one_of(TWIST_NAMES)), i)
        if name in value[:i]:
            raise BadKeyError(mismatch(value, _FREE_ALLOWED) + f'; "{name}" stands there twice')
    return tuple(name for name in TWIST_NAMES if name in value)


SensorName: TypeAlias = Annotated[
    str, AfterValidator(_read_sensor_name), Field(description="a name for the sensor, as text")
]
"""Valid as NAME in NAME=PATH."""
Method: TypeAlias = Annotated[str | None, ReadBy(_read_method, _METHOD_ALLOWED)]
Threshold: TypeAlias = Annotated[str | float | None, ReadBy(_read_threshold, _THRESHOLD_ALLOWED)]
Source: TypeAlias = Annotated[str | tuple[str, ...], ReadBy(_read_source, _SOURCE_ALLOWED)]
Delay: TypeAlias = Annotated[float | Literal["estimate"], ReadBy(_read_delay, _DELAY_ALLOWED)]
Free: TypeAlias = Annotated[tuple[str, ...], ReadBy(_read_free, _FREE_ALLOWED)]


def read_resolution(value: Any) -> tuple[int, int]:
    """Read the width and height of an image in px."""
    match value:
        case [int(width), int(height)] if not any(isinstance(n, bool) for n in value):
            if 0 < width <= _WIDEST and 0 < height <= _WIDEST:
                if width * height <= MOST_PIXELS:
                    return width, height
                raise BadKeyError(
                    f"found {width} x {height} pixels; allowed: at most {MOST_PIXELS} together"
                )
    raise BadKeyError(mismatch(value, RESOLUTION_FORM))


Resolution: TypeAlias = Annotated[tuple[int, int] | None, ReadBy(read_resolution, RESOLUTION_FORM)]


def is_number(value: object) -> TypeGuard[int | float]:
    """Test whether a value is a number within ±LARGEST (true and false are no numbers)."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return -LARGEST <= value <= LARGEST  # false for NaN, and for integers beyond float64


def as_number(text: str) -> float:
    """Return the number that a text states; NaN if it is no number."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def limit_hint(value: object) -> str:
    """Return a hint that a number is too large or too small for any key; else an empty text."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        if LARGEST < abs(value) < math.inf:
            return f"; the largest number is {LARGEST:g}"
        if 0 < value < SMALLEST:
            return f"; the smallest is {SMALLEST:g}"
    return ""


def numbers(value: Any, shape: tuple[int | None, ...], allowed: str) -> Floats:
    """Read nested lists of numbers as a float64 array; raise BadKeyError at the first bad item.

    `shape` has the length of the lists at each depth, None for any length but zero; `allowed` says
    in the message what is allowed.
    """
    if not shape:
        if not is_number(value):
            raise BadKeyError(
                mismatch(value, f"a finite number, as part of {allowed}") + limit_hint(value)
            )
        return np.float64(value)  # type: ignore[return-value]
    length, inner = shape[0], shape[1:]
    if not isinstance(value, list) or not value or (length is not None and len(value) != length):
        raise BadKeyError(mismatch(value, allowed))
    rows = [under(i)(numbers)(item, inner, allowed) for i, item in enumerate(value)]
    return np.array(rows, dtype=np.float64)
