"""Frozen records as plain JSON and back, exactly: every bit of every number.

What a record holds may be numbers, text, None, arrays, tuples, named ones too, mappings and further
records.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")

_KIND = "is"


def encode(value: object) -> Any:  # noqa: PLR0911 - a kind of value, a line
    """A record as what `json.dumps` takes; `TypeError` if it holds something else than it may."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        held = {each.name: encode(getattr(value, each.name)) for each in dataclasses.fields(value)}
        return {_KIND: type(value).__name__, **held}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):  # named
        return {_KIND: type(value).__name__, **{k: encode(v) for k, v in value._asdict().items()}}
    if isinstance(value, np.ndarray):
        # sums depend in their last bit on the order in memory
        by_columns = value.flags.f_contiguous and not value.flags.c_contiguous
        return {
            _KIND: "array",
            "dtype": value.dtype.name,
            "shape": list(value.shape),
            "order": "F" if by_columns else "C",
            "values": value.ravel().tolist(),
        }
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {_KIND: "mapping", "items": [[encode(k), encode(v)] for k, v in value.items()]}
    if isinstance(value, tuple | list):
        return [encode(item) for item in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{type(value).__name__}: no record holds this")


def decode(record: type[T], data: Any) -> T:
    """A record from what `encode` made of it, as `json.loads` has it.

    Only what annotations of the outermost record name is ever made.  Raises `ValueError` if the
    data are not those of such a record.
    """
    try:
        found = _decoded(data, _records_in(record, {}))
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"no {record.__name__}: {error}") from error
    if not isinstance(found, record):
        raise ValueError(f"no {record.__name__}: found {type(found).__name__}")
    return found


def _decoded(data: Any, known: Mapping[str, type]) -> Any:
    if isinstance(data, list):
        return tuple(_decoded(item, known) for item in data)
    if not isinstance(data, dict):
        return data
    kind = data[_KIND]
    if kind == "array":
        values = np.array(data["values"], dtype=data["dtype"]).reshape(data["shape"])
        return np.array(values, order=data["order"])
    if kind == "mapping":
        return {_decoded(key, known): _decoded(value, known) for key, value in data["items"]}
    held = {name: _decoded(value, known) for name, value in data.items() if name != _KIND}
    return known[kind](**held)


def _records_in(annotation: Any, known: dict[str, type]) -> dict[str, type]:
    """The records that an annotation names, and those in their fields, by name."""
    named = isinstance(annotation, type) and hasattr(annotation, "_asdict")
    if isinstance(annotation, type) and (named or dataclasses.is_dataclass(annotation)):
        if annotation.__name__ not in known:
            known[annotation.__name__] = annotation
            for hint in typing.get_type_hints(annotation).values():
                _records_in(hint, known)
    elif typing.get_origin(annotation) is not None or isinstance(annotation, types.UnionType):
        for part in typing.get_args(annotation):
            _records_in(part, known)
    return known
