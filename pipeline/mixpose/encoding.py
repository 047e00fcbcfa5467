"""Encode frozen records as plain JSON and decode them exactly: every bit of every number.

Records may hold numbers, text, None, arrays, tuples and named tuples, mappings and further records.
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


def encode(value: object) -> Any:  # noqa: PLR0911 - one return per kind of value
    """Return a record as `json.dumps` takes it; raise `TypeError` if it holds anything else."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value)]
        return {_KIND: type(value).__name__, **{k: encode(getattr(value, k)) for k in names}}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):  # a named tuple
        return {_KIND: type(value).__name__, **{k: encode(v) for k, v in value._asdict().items()}}
    if isinstance(value, np.ndarray):
        # the order in memory changes the last bit of sums
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
    """Return the record from what `encode` made of it, as `json.loads` returns that.

    Only types in the annotations of the outermost record are ever created.  Raises `ValueError` if
    the data are not those of such a record.
    """
    try:
        decoded = _decoded(data, _records_in(record, {}))
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"no {record.__name__}: {error}") from error
    if not isinstance(decoded, record):
        raise ValueError(f"no {record.__name__}: found {type(decoded).__name__}")
    return decoded


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
    fields = {name: _decoded(value, known) for name, value in data.items() if name != _KIND}
    return known[kind](**fields)


def _records_in(annotation: Any, known: dict[str, type]) -> dict[str, type]:
    """Collect the records that an annotation names, and those in their fields, by name."""
    is_named = isinstance(annotation, type) and hasattr(annotation, "_asdict")
    if isinstance(annotation, type) and (is_named or dataclasses.is_dataclass(annotation)):
        if annotation.__name__ not in known:
            known[annotation.__name__] = annotation
            for hint in typing.get_type_hints(annotation).values():
                _records_in(hint, known)
    elif typing.get_origin(annotation) is not None or isinstance(annotation, types.UnionType):
        for part in typing.get_args(annotation):
            _records_in(part, known)
    return known
