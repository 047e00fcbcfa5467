"""Which key of ``[extract]`` to change where far too few or too many features are found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from mixpose.errors import MixposeError
from mixpose.extraction import METHODS, ExtractOptions, extract
from mixpose.records import Image, PointPattern

_FEW = 0.6  # of the expected features: fewer are too few
_MANY, _MANY_MORE = 5.0, 20  # times as many as expected, and so many more, are too many


def judge(count: float, expected: int) -> str | None:
    """Whether a number of features is "too few" or "too many" for a body; None if neither."""
    if count < min(_FEW * expected, expected - 1):
        return "too few"
    return "too many" if count > _MANY * expected and count > expected + _MANY_MORE else None


def advice(image: Image | None, options: ExtractOptions, expected: int, base: Path) -> str:
    """What to change so that about as many features are found as the body has.

    Each key is tried by itself on one image.

    Parameters
    ----------
    image : image or None
        None where the sensor has detections only: then nothing can be tried.
    options : ExtractOptions
        The options so far.
    expected : int
        Features that the sensor should see.
    base : Path
        Folder of the session, for a function of the user's.
    """
    keys = "polarity, threshold, min_area and max_area"
    if options.method == "corners":
        keys = "threshold"
    elif options.method == "log":
        keys = "polarity, threshold and spot_sigma"
    if image is None:
        return "the table of detections does not fit the body: look at its rows"
    if options.method not in METHODS:
        return f"look at what {options.method} returns"
    trials = [
        (key, value, _found(image, options, {key: value}, base))
        for key, value in _trials(options, image)
    ]
    good = [trial for trial in trials if 0.9 * expected <= trial[2] <= 2 * expected]
    if not good:
        return f"change {keys} in [extract]"
    key, value, count = min(good, key=lambda trial: abs(trial[2] - expected))
    written = f'"{value}"' if isinstance(value, str) else f"{value:g}"
    return f"with {key} = {written} in [extract] it would be {count}"


def _trials(options: ExtractOptions, image: Image) -> list[tuple[str, Any]]:
    polarity = "dark" if options.polarity == "bright" else "bright"
    trials: list[tuple[str, Any]] = [("polarity", polarity), ("threshold", "auto")]
    if options.method == "blobs":
        trials += [("threshold", rule) for rule in ("local", "otsu", "triangle", "li", "sauvola")]
        trials += [("min_area", area) for area in (3.0, 1.0, 10.0, 30.0, 100.0, 300.0)]
        trials += [("max_area", area) for area in (30.0, 100.0, 1000.0) if area > options.min_area]
        trials.append(("method", "log"))
    if options.method == "log":
        trials += [("spot_sigma", width) for width in (3.0, 1.5, 6.0, 12.0)]
    low, high = float(image.min()), float(image.max())
    trials += [("threshold", round(low + share * (high - low), 2)) for share in (0.3, 0.5, 0.7)]
    return [(key, value) for key, value in trials if getattr(options, key) != value]


def _found(image: Image, options: ExtractOptions, changed: dict[str, Any], base: Path) -> int:
    changed_options = replace(options, **changed)
    if changed_options.max_area is not None and (
        changed_options.max_area <= changed_options.min_area
    ):
        return 0
    try:
        pattern = extract(image, changed_options, base=base)
    except MixposeError:
        return 0
    return len(pattern.points) if isinstance(pattern, PointPattern) else 0
