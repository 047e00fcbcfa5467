"""Extraction by a function of the user's, in a module beside the session file or installed.

The function gets the image (H, W) and the `ExtractOptions`, and returns a `PointPattern`, a
`GridPattern`, or an array of points, (M, 2) for u, v or (M, 3) for u, v, weight.  When only a
window of the image is needed, it gets that window, and its points are moved back.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from mixpose.errors import MixposeError, SessionError
from mixpose.extraction.options import ExtractOptions
from mixpose.extraction.threshold import Window
from mixpose.records import GridPattern, Image, Pattern, PointPattern

UserFunction = Callable[[Image, ExtractOptions], Any]


@lru_cache(maxsize=32)
def load_function(method: str, base: Path | None) -> UserFunction:
    """Import the function of a method "module:function", from the folder `base` before `sys.path`.

    Raises `SessionError` if there is none, or the module cannot be imported.
    """
    module_name, _, function_name = method.partition(":")
    if not all(part.isidentifier() for part in (*module_name.split("."), function_name)):
        raise SessionError(
            f"extract.method: {method!r} is neither a method nor of the form 'module:function'"
        )
    try:
        module = _load_module(module_name, base)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise _failed(method, "cannot be imported", error) from error
        where = "" if base is None else f" in {base} or"
        raise SessionError(
            f"extract.method: {method!r}: no module {module_name!r}{where} in Python's path"
        ) from error
    except Exception as error:
        raise _failed(method, "cannot be imported", error) from error
    function = getattr(module, function_name, None)
    if not callable(function):
        raise SessionError(
            f"extract.method: {method!r}: module {module_name!r} ({module.__file__}) has no"
            f" function {function_name!r}"
        )
    return function  # type: ignore[no-any-return]


def extract_custom(
    image: Image, options: ExtractOptions, window: Window, base: Path | None
) -> Pattern:
    """Return the feature pattern of the user's function in a window of an image.

    The method is "module:function", and `base` the folder of the session file.  Raises
    `SessionError` if it cannot be imported, fails, or returns something else than a pattern.
    """
    function = load_function(options.method, base)
    u0, v0, u1, v1 = window
    try:
        result = function(image[v0:v1, u0:u1], options)
    except MixposeError:
        raise
    except Exception as error:
        raise _failed(options.method, "failed", error) from error
    corner = np.array([u0, v0], dtype=np.float64)
    if isinstance(result, GridPattern):
        return _checked_grid(result, options.method, corner)
    return _checked_points(result, options.method, corner)


def _checked_points(result: object, method: str, corner: np.ndarray[Any, Any]) -> PointPattern:
    if isinstance(result, PointPattern):
        columns: list[object] = [result.points, result.weights]
    else:
        columns = [result]
    try:
        numbers = [np.asarray(column, dtype=np.float64) for column in columns]
    except (TypeError, ValueError):
        raise _wrong(method, f"returned {type(result).__name__}") from None
    points = numbers[0]
    if points.size == 0:
        return PointPattern(np.empty((0, 2)), np.empty(0))
    widths = (2, 3) if len(numbers) == 1 else (2,)
    if points.ndim != 2 or points.shape[1] not in widths:
        raise _wrong(method, f"returned an array of shape {points.shape}")
    if len(numbers) == 2:
        weights = numbers[1]
    else:
        weights = points[:, 2] if points.shape[1] == 3 else np.ones(len(points))
    if weights.shape != (len(points),):
        raise _wrong(method, f"returned {len(points)} points and weights of shape {weights.shape}")
    if not (np.isfinite(points).all() and np.isfinite(weights).all() and (weights > 0).all()):
        raise _wrong(method, "returned NaN, infinite values, or weights that are not positive")
    return PointPattern(points[:, :2] + corner, weights)


def _checked_grid(grid: GridPattern, method: str, corner: np.ndarray[Any, Any]) -> GridPattern:
    values = np.asarray(grid.values)
    if values.ndim != 2 or not np.issubdtype(values.dtype, np.number):
        raise _wrong(method, f"returned grid values of shape {values.shape}")
    origin = np.asarray(grid.origin, dtype=np.float64)
    if origin.shape != (2,) or not np.isfinite(origin).all() or not grid.step > 0:
        raise _wrong(method, f"returned a grid of origin {grid.origin} and step {grid.step}")
    if not np.isfinite(values).all() or values.min(initial=0) < 0:
        raise _wrong(method, "returned NaN, infinite or negative grid values")
    return GridPattern(values.astype(np.float32), origin + corner, float(grid.step))


def _wrong(method: str, what: str) -> SessionError:
    return SessionError(
        f"extract.method: {method!r} {what}; allowed are a PointPattern, a GridPattern, or an"
        " array (M, 2) or (M, 3) of u, v and weight"
    )


def _failed(method: str, what: str, error: Exception) -> SessionError:
    reason = " ".join(str(error).split())
    return SessionError(f"extract.method: {method!r} {what}: {type(error).__name__}: {reason}")


def _load_module(name: str, base: Path | None) -> ModuleType:
    if base is None:
        return importlib.import_module(name)
    folder = base.resolve()
    file = folder / f"{name}.py"
    sys.path.insert(0, str(folder))
    try:
        if not file.is_file():
            return importlib.import_module(name)
        # Not by its bare name, which an installed module or one of another session may have.
        spec = importlib.util.spec_from_file_location(f"mixpose_user_{name}", file)
        if spec is None or spec.loader is None:
            raise ImportError(f"{file} is not a Python module")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
        return module
    finally:
        sys.path.remove(str(folder))
