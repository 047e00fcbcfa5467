"""Validate a session file with pydantic, and turn its errors into one BadKeyError."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from mixpose.session.messages import BadKeyError, Key, did_you_mean, mismatch, nearest, one_of
from mixpose.session.values import limit_hint

_TAG = "model"  # the key that distinguishes the kinds of sensor
_TOP = "the top of the file, before its first [table]"


class _Place(NamedTuple):
    """The place of an error."""

    key: Key  # in the file
    table: type[BaseModel]
    field: FieldInfo | None


def validate(root: type[BaseModel], data: dict[str, Any]) -> Any:
    """Return the validated table of the whole file, or raise BadKeyError for its first error."""
    try:
        return root.model_validate(data)
    except ValidationError as error:
        # unknown keys first: a misspelt one is often the reason why another one is missing
        findings = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    problem = _problem(root, findings[0])
    if len(findings) > 1:
        problem = BadKeyError(f"{problem.text} (and {len(findings) - 1} more)", *problem.key)
    raise problem


def _problem(root: type[BaseModel], finding: ErrorDetails) -> BadKeyError:
    place = _locate(root, finding["loc"])
    kind, value = finding["type"], finding["input"]
    allowed = allowed_for(place.field)
    if kind == "extra_forbidden":
        return BadKeyError(_unknown_key(root, place), *place.key)
    if kind.startswith("union_tag"):
        return _tag_problem(place, value)
    if kind == "missing":
        return BadKeyError(f"missing; allowed: {allowed}", *place.key)
    if kind == "value_error":
        reason = finding["ctx"]["error"]
        if isinstance(reason, BadKeyError):
            return BadKeyError(reason.text, *place.key, *reason.key)
    hint = did_you_mean(value, _literals(place.field)) if kind == "literal_error" else ""
    if kind in ("greater_than_equal", "less_than_equal"):
        hint = limit_hint(value)
    return BadKeyError(mismatch(value, allowed or finding["msg"]) + hint, *place.key)


def _locate(root: type[BaseModel], loc: tuple[str | int, ...]) -> _Place:
    """Follow pydantic's location of an error through the tables, without the tags of unions."""
    key: list[str | int] = []
    table, field = root, None
    choices: list[type[BaseModel]] = [root]
    for step in loc:
        if isinstance(step, int):
            key.append(step)
        elif len(choices) > 1:
            table = next(t for t in choices if step in _literals(t.model_fields[_TAG]))
            choices, field = [table], None
        else:
            table = choices[0] if choices else table
            key.append(step)
            field = table.model_fields.get(step)
            choices = _tables(field.annotation) if field else []
    return _Place(tuple(key), table, field)


def _parts(annotation: Any) -> Iterator[Any]:
    yield annotation
    for part in get_args(annotation):
        yield from _parts(part)


def _tables(annotation: Any) -> list[type[BaseModel]]:
    parts = _parts(annotation)
    return [part for part in parts if isinstance(part, type) and issubclass(part, BaseModel)]


def _literals(field: FieldInfo | None) -> list[str]:
    return [part for part in _parts(field and field.annotation) if isinstance(part, str)]


def allowed_for(field: FieldInfo | None) -> str:
    """Return the text that says what a key may be: its description, else its literals."""
    if field is None:
        return ""
    if field.annotation is bool:
        return "true or false"
    annotated = [getattr(mark, "description", None) for mark in field.metadata]
    descriptions = (text for text in [field.description, *annotated] if text)
    return next(descriptions, one_of(_literals(field)))


def _tag_problem(place: _Place, value: Any) -> BadKeyError:
    """Return the problem of a sensor whose model is unknown or missing."""
    tables = _tables(place.field and place.field.annotation)
    models = [word for table in tables for word in _literals(table.model_fields[_TAG])]
    keys = {key for table in tables for key in table.model_fields}
    if _TAG in value:
        text = mismatch(value[_TAG], one_of(models)) + did_you_mean(value[_TAG], models)
        return BadKeyError(text, *place.key, _TAG)
    for key in value:
        if key not in keys and nearest(key, keys) == _TAG:
            return BadKeyError(f'unknown key; did you mean "{_TAG}"?', *place.key, key)
    return BadKeyError(f"missing; allowed: {one_of(models)}", *place.key, _TAG)


_SENSORS = ("camera", "cameras")  # names of the tables of sensors in other programs' files


def _unknown_key(root: type[BaseModel], place: _Place) -> str:
    """Return a message with the nearest key of the same table, else with tables that have it."""
    key, known = str(place.key[-1]), list(place.table.model_fields)
    homes = _homes(root, key)
    # a key that another table has is more likely misplaced than misspelt
    if len(place.key) == 1 and key.casefold() in _SENSORS:
        return "unknown key; did you mean [[sensor]]? Each camera is one of these"
    close = nearest(key, known, cutoff=0.8) if homes else nearest(key, known)
    if close:
        return f'unknown key; did you mean "{close}"{_if_inverse(key, close)}?'
    home = f"; it is a key of {' or '.join(homes)}" if homes else ""
    return f"unknown key{home}; allowed here: {', '.join(known)}"


def _if_inverse(key: str, close: str) -> str:
    """Return a remark if a key names the inverse of the transform of the `close` key."""
    _, *names = close.split("_")
    if len(names) < 2 or key.lower() != "_".join(["t", *reversed(names)]):
        return ""
    return f", the inverse of it, which maps {names[1]} to {names[0]} coordinates"


def _homes(root: type[BaseModel], key: str) -> list[str]:
    """Return names of the tables that have a key; one name if sensors of all models have it."""
    paths = dict.fromkeys(path for path, _ in _all_tables(root))
    homes = dict.fromkeys(path for path, table in _all_tables(root) if key in table.model_fields)
    models = [path for path in paths if path.startswith("[[sensor]]")]
    if all(model in homes for model in models):
        homes = {("[[sensor]]" if home in models else home): None for home in homes}
    return list(homes)


def _all_tables(table: type[BaseModel], path: str = _TOP) -> Iterator[tuple[str, type[BaseModel]]]:
    yield path, table
    for key, field in table.model_fields.items():
        for inner in (inside := _tables(field.annotation)):
            outer = "" if path == _TOP else path.strip("[]").partition("]")[0] + "."
            name = f"[{outer}{key}]"  # without the model: [sensor.extract]
            if len(inside) > 1:
                name = f"[[{key}]] of model {' or '.join(_literals(inner.model_fields[_TAG]))}"
            yield from _all_tables(inner, name)
