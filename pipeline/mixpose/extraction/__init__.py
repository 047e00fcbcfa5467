"""Feature extraction: from an image to a feature pattern.

One file per method; another method is another file and a line in `METHODS`.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import cast

import numpy as np

from mixpose.errors import RecordingError, SessionError
from mixpose.extraction.blobs import extract_all, extract_blobs
from mixpose.extraction.corners import extract_corners
from mixpose.extraction.custom import extract_custom, load_function
from mixpose.extraction.intensity import extract_intensity
from mixpose.extraction.laplacian import extract_log
from mixpose.extraction.options import ExtractOptions
from mixpose.extraction.threshold import RULES, Window
from mixpose.records import Image, Pattern, PointPattern

__all__ = ["METHODS", "ExtractOptions", "Window", "check_options", "extract", "extract_together"]

METHODS: dict[str, Callable[[Image, ExtractOptions, Window], Pattern]] = {
    "blobs": extract_blobs,
    "corners": extract_corners,
    "intensity": extract_intensity,
    "log": extract_log,
}

IMAGE_TYPES = (np.uint8, np.uint16, np.float32)


def extract(
    image: Image,
    options: ExtractOptions,
    *,
    window: Window | None = None,
    base: Path | None = None,
) -> Pattern:
    """Extract the feature pattern g0 of an image.

    Parameters
    ----------
    image : (H, W) uint8, uint16 or float32
        Grey values; pixel centres have integer coordinates.
    options : ExtractOptions
    window : (u0, v0, u1, v1), optional
        Box of pixels to search, u1 and v1 exclusive; the part of it outside of the image is
        ignored.  Features that its border cuts are not found.
    base : Path, optional
        Folder that holds the module of a method "module:function".

    Returns
    -------
    PointPattern or GridPattern
        In pixels of the whole image.  Without features an empty PointPattern, points (0, 2).

    Raises
    ------
    SessionError
        If an option is wrong, or the user's function is.
    RecordingError
        If the image is of another type, or holds NaN or infinite values.
    """
    return extract_together({"": (image, options, window)}, base=base)[""]


def extract_together(
    images: Mapping[str, tuple[Image, ExtractOptions, Window | None]], *, base: Path | None = None
) -> dict[str, Pattern]:
    """Extract the patterns of several images, as `extract`; blobs of all in fewer calls."""
    patterns: dict[str, Pattern] = {}
    blobs: dict[str, tuple[Image, ExtractOptions, Window]] = {}
    for name, (raw, options, window) in images.items():
        check_options(options)
        image = _checked(raw)
        height, width = image.shape
        u0, v0, u1, v1 = (0, 0, width, height) if window is None else window
        box = (max(int(u0), 0), max(int(v0), 0), min(int(u1), width), min(int(v1), height))
        method = METHODS.get(options.method)
        if box[0] >= box[2] or box[1] >= box[3]:
            patterns[name] = PointPattern(np.empty((0, 2)), np.empty(0))
        elif method is extract_blobs:
            blobs[name] = (image, options, box)
        elif method is None:
            patterns[name] = extract_custom(image, options, box, base)
        else:
            patterns[name] = method(image, options, box)
    return patterns | dict(zip(blobs, extract_all(list(blobs.values())), strict=True))


def check_options(options: ExtractOptions, *, base: Path | None = None) -> None:
    """Check options before the first image; with a `base`, import "module:function", too.

    Raises `SessionError` if one is wrong: a line with the key, what was found and what is allowed.
    """
    if options.method not in METHODS:
        _check_custom(options.method, base)
    if options.polarity not in ("bright", "dark"):
        raise SessionError(
            f'extract.polarity: {options.polarity!r}; allowed are "bright" and "dark"'
        )
    _check_threshold(options)
    if not (_is_number(options.min_area) and options.min_area >= 0):
        raise SessionError(f"extract.min_area: {options.min_area!r}; allowed are px from 0 on")
    most = options.max_area
    if most is not None and not (_is_number(most) and most >= options.min_area):
        raise SessionError(
            f"extract.max_area: {most!r}; allowed are px from min_area = {options.min_area:g} on"
        )
    if not (_is_number(options.sigma) and options.sigma > 0):
        raise SessionError(f"extract.sigma: {options.sigma!r}; allowed are numbers above 0")


def _check_custom(method: str, base: Path | None) -> None:
    if ":" not in method:
        similar = difflib.get_close_matches(method, METHODS, n=1)
        hint = f" (did you mean {similar[0]!r}?)" if similar else ""
        raise SessionError(
            f"extract.method: {method!r} is unknown{hint}; allowed are"
            f" {', '.join(repr(name) for name in METHODS)} and 'module:function' for your own"
        )
    if base is not None:
        load_function(method, base)


def _check_threshold(options: ExtractOptions) -> None:
    threshold = options.threshold
    rules = ("auto",) if options.method in ("corners", "log") else RULES
    if isinstance(threshold, str) and threshold not in rules:
        raise SessionError(
            f"extract.threshold: {threshold!r} with method {options.method!r}; allowed are"
            f" {', '.join(repr(rule) for rule in rules)} and a grey level"
        )
    if not isinstance(threshold, str) and not _is_number(threshold):
        raise SessionError(f"extract.threshold: {threshold!r} is not a grey level")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _checked(image: Image) -> Image:
    """Check an image, and return it in a layout for OpenCV."""
    if image.ndim != 2 or image.dtype not in IMAGE_TYPES:
        raise RecordingError(
            f"an image of shape {image.shape} and type {image.dtype}; allowed are grey images"
            " (height, width) of uint8, uint16 or float32"
        )
    # Infinite values are at one end of the range, and NaN at both.
    ends = (image.min(), image.max()) if image.size and image.dtype == np.float32 else ()
    if not all(math.isfinite(end) for end in ends):
        raise RecordingError("an image holds NaN or infinite values; give them a grey value")
    return cast("Image", np.ascontiguousarray(image))
