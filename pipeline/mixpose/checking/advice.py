"""Which key of ``[extract]`` to change where far too few or too many features are found."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from mixpose.errors import MixposeError
from mixpose.extraction import METHODS, ExtractOptions
from mixpose.fit import free_mask
from mixpose.objective import View
from mixpose.records import Floats, FrameSet, Image, PointPattern, RawFrame
from mixpose.runner import begin, observe
from mixpose.session import SensorSetup, Session

_FEW = 0.6  # of the expected features: fewer are too few
_SHARED, _OWN = "in [extract]", "in its own [sensor.extract]"
_ADVISED = re.compile(rf"with (\w+) = (\S+) {re.escape(_SHARED)}")
_MANY, _MANY_MORE = 5.0, 20  # times as many as expected, and so many more, are too many


def judge(count: float, expected: int, fewest: int | None = None) -> str | None:
    """Whether features are "too few" or "too many" for a body, `fewest` of which may be seen."""
    least = expected if fewest is None else fewest
    if count < min(_FEW * least, least - 1):
        return "too few"
    return "too many" if count > _MANY * expected and count > expected + _MANY_MORE else None


def advice(
    session: Session, setup: SensorSetup, number: int, image: Image | None, expected: int
) -> str:
    """What to change so that about as many features are found as the sensor should see of the body.

    Each key is tried by itself on one image, and the body is looked for in what is found then: as
    many features as it has may be clutter that is larger or brighter than it. Where the sensor has
    detections and no image, nothing can be tried.
    """
    options = setup.extract
    if image is None:
        return "the table of detections does not fit the body: look at its rows"
    if options.method not in METHODS:
        return f"look at what {options.method} returns"
    frame = RawFrame(number, None, image)
    before = len(_points(_found(session, setup, frame, {})))
    trials = []
    for key, value in _trials(options, image):
        views = _found(session, setup, frame, {key: value})
        count = len(_points(views))
        if 0.9 * expected <= count <= 2 * expected:
            trials.append(_Trial(key, value, count, views))
    trials.sort(key=lambda trial: abs(trial.found - expected))
    chosen = _with_the_body(session, number, trials)
    if chosen is None and before < expected and trials:
        chosen = trials[0]  # what finds more loses nothing, even where the body cannot be told
    if chosen is not None:
        value = chosen.value
        written = f'"{value}"' if isinstance(value, str) else f"{value:g}"
        return f"with {chosen.key} = {written} {_SHARED} it would be {chosen.found}"
    if before > expected:
        return (
            "none of the values tried leaves what can be the body; clutter is allowed for, and "
            "mixpose inspect shows what is found"
        )
    keys = {"corners": "threshold", "log": "polarity, threshold and spot_sigma"}
    usual = "polarity, threshold, min_area and max_area"
    return f"change {keys.get(options.method, usual)} in [extract]"


def told_apart(warnings: Sequence[str]) -> list[str]:
    """Warnings about sensors, where two that want unlike values of a key each get their own."""
    values: dict[str, set[str]] = {}
    for warning in warnings:
        if advised := _ADVISED.search(warning):
            values.setdefault(advised[1], set()).add(advised[2])
    return [
        warning.replace(_SHARED, _OWN)
        if (advised := _ADVISED.search(warning)) and len(values[advised[1]]) > 1
        else warning
        for warning in warnings
    ]


class _Trial(NamedTuple):
    """A key with another value, and what is found with it."""

    key: str
    value: Any
    found: int
    views: list[View]


def _with_the_body(session: Session, number: int, trials: Sequence[_Trial]) -> _Trial | None:
    """The first trial in which the body is found for sure; clutter may be ambiguous, too."""
    # where all directions are free, the body may be anywhere in the frame
    start = None if free_mask(session.estimator).all() else session.start
    for trial in trials:
        tracker, track = begin(replace(session, start=start))
        _, estimate = tracker.advance(track, number, None, trial.views)
        if estimate.status == "ok":
            return trial
    return None


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


def _found(
    session: Session, setup: SensorSetup, frame: RawFrame, changed: dict[str, Any]
) -> list[View]:
    """What the sensor alone finds in a frame with other options; nothing where they are wrong."""
    options = replace(setup.extract, **changed)
    if options.max_area is not None and options.max_area <= options.min_area:
        return []
    alone = replace(session, sensors=(replace(setup, extract=options),))
    try:
        return observe(alone, FrameSet(frame.number, None, {setup.name: frame}))
    except MixposeError:
        return []


def _points(views: Sequence[View]) -> Floats:
    """The features found, where they are points."""
    patterns = [view.observation.pattern for view in views]
    found = [each.points for each in patterns if isinstance(each, PointPattern)]
    return np.concatenate(found) if found else np.zeros((0, 2))
