"""Warn of odd keys of a session, and of keys that give far too few or too many features."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from mixpose.body import LookAlike, congruent_parts, of_size
from mixpose.checking.changes import quoted
from mixpose.checking.evidence import estimate_of, without_start
from mixpose.checking.lookalikes import noise_of
from mixpose.checking.placement import Camera, typical_poses
from mixpose.errors import MixposeError
from mixpose.extraction import METHODS, ExtractOptions
from mixpose.frames import files_of
from mixpose.objective import View
from mixpose.records import FrameSet, Image, RawFrame
from mixpose.runner import observe, source_spec
from mixpose.search import is_pointlike
from mixpose.sensors import RangeSensor
from mixpose.session import SensorSetup, Session

_FEW = 0.6  # of the expected features: fewer are too few
_SHARED, _OWN = "in [extract]", "in its own [sensor.extract]"
_ADVISED = re.compile(rf"with (\w+) = (\S+) {re.escape(_SHARED)}")
_MANY, _MANY_MORE = 5.0, 20  # too many is more than this factor of the expected count, and surplus
_OFF_CENTRE = 0.25  # of the image: lenses are centred better, crops and other sizes often are not
_WIDEST = 0.05  # of an image: a wider sigma hides how features of a body lie
_NOISES = 3.0  # standard deviations within which markers of two bodies are congruent
_LEAST = 0.01  # of the smaller body's radius: markers as near are always congruent


def judge(count: float, expected: int, fewest: int | None = None) -> str | None:
    """Say if a count of features is "too few" or "too many"; as few as `fewest` may be in view."""
    least = expected if fewest is None else fewest
    if count < min(_FEW * least, least - 1):
        return "too few"
    return "too many" if count > _MANY * expected and count > expected + _MANY_MORE else None


def advice(
    session: Session, setup: SensorSetup, number: int, image: Image | None, expected: int
) -> str:
    """Say which key to change so that about as many features are found as the sensor should see.

    Each key is tried by itself on one image, and the body is searched for in the features: as many
    as expected may still be clutter, larger or brighter than the body. Without an image, of a table
    of detections, nothing can be tried.
    """
    options = setup.extract
    if image is None:
        return "the table of detections does not fit the body: look at its rows"
    if options.method not in METHODS:
        return f"look at what {options.method} returns"
    frame = RawFrame(number, 0.0, image)  # late sensors need a time; for one frame any will do
    before, _ = _extracted(session, setup, frame, {})
    tried = _trials(options, image)
    trials = [_Trial(k, v, *_extracted(session, setup, frame, {k: v})) for k, v in tried]
    trials = [t for t in trials if t.points >= 0.9 * expected and judge(t.points, expected) is None]
    # "auto" comes first: it adapts to each image, and a number may suit this image alone
    trials.sort(key=lambda trial: (trial.value != "auto", abs(trial.points - expected)))
    if before > expected:
        trials = [trial for trial in trials if trial.points <= 2 * expected]
    # the body has to be found for sure: in clutter a pose may be ambiguous, too
    anywhere = without_start(session)
    sure = (t for t in trials if estimate_of(anywhere, number, t.views).status == "ok")
    chosen = next(sure, None)
    if chosen is None and before < expected and trials:
        chosen = trials[0]  # more features do no harm, even if they do not show the body
    if chosen is not None:
        value = chosen.value
        written = f'"{value}"' if isinstance(value, str) else f"{value:g}"
        where = setup.table_of(chosen.key)
        return f"with {chosen.key} = {written} in {where} it would be {chosen.points}"
    if before > expected:
        by_auto = [trial.points for trial in trials if trial.value == "auto"]
        rule = f', nor with threshold = "auto", which leaves {by_auto[0]}' if by_auto else ""
        return (
            f"with no value tried the body is found for sure{rule}; clutter is allowed for, and "
            "mixpose inspect shows what is found"
        )
    keys = {"corners": "method and threshold", "log": "polarity, threshold and spot_sigma"}
    change = keys.get(options.method, "polarity, threshold, min_area and max_area")
    own_keys = [key for key in re.findall(r"\w+", change) if key in setup.overridden]
    tables = f", {' and '.join(own_keys)} {_OWN}" if own_keys else ""
    is_hidden = before > 0 and session.body.normals is None
    hidden = "; or give normals in [object], if the body hides some of them" if is_hidden else ""
    return f"change {change} {_SHARED}{tables}{hidden}"


def with_own_tables(warnings: Sequence[str], sensors: int) -> list[str]:
    """Advise a sensor's own [sensor.extract] unless all of so many sensors need the same value."""
    values: dict[str, list[str]] = {}
    for warning in warnings:
        if advised := _ADVISED.search(warning):
            values.setdefault(advised[1], []).append(advised[2])
    return [
        warning
        if (advised := _ADVISED.search(warning)) is None
        or values[advised[1]] == sensors * [advised[2]]
        else warning.replace(_SHARED, _OWN)
        for warning in warnings
    ]


class _Trial(NamedTuple):
    """A key with another value, and the features found with it."""

    key: str
    value: Any
    points: int
    views: list[View]


def _trials(options: ExtractOptions, image: Image) -> list[tuple[str, Any]]:
    polarity = "dark" if options.polarity == "bright" else "bright"
    trials: list[tuple[str, Any]] = [("polarity", polarity), ("threshold", "auto")]
    if options.method == "blobs":
        trials += [("threshold", rule) for rule in ("local", "otsu", "triangle", "li", "sauvola")]
        trials += [("min_area", area) for area in (3.0, 1.0, 10.0, 30.0, 100.0, 300.0)]
        trials += [("max_area", area) for area in (30.0, 100.0, 1000.0) if area > options.min_area]
        trials += [("method", "log"), ("method", "corners")]
    if options.method == "corners":
        trials = [("threshold", "auto"), ("method", "blobs")]
    if options.method == "log":
        trials += [("spot_sigma", width) for width in (3.0, 1.5, 6.0, 12.0)]
    low, high = float(image.min()), float(image.max())
    trials += [("threshold", round(low + share * (high - low), 2)) for share in (0.3, 0.5, 0.7)]
    return [(key, value) for key, value in trials if getattr(options, key) != value]


def _extracted(
    session: Session, setup: SensorSetup, frame: RawFrame, changed: dict[str, Any]
) -> tuple[int, list[View]]:
    """Count the points of one sensor with changed options, and return its views; 0 on an error."""
    options, views = replace(setup.extract, **changed), list[View]()
    if options.max_area is None or options.max_area > options.min_area:
        alone = replace(session, sensors=(replace(setup, extract=options),))
        with suppress(MixposeError):
            views = observe(alone, FrameSet(frame.number, frame.time_s, {setup.name: frame}))
    observations = [view.observation for view in views]
    return sum(seen.found for seen in observations if seen.points is not None), views


def key_warnings(session: Session) -> list[str]:
    """Warn of calibrations, widths and lines, for a session with the sizes of recorded images."""
    return [*_off_centre(session), *_too_wide(session), *_lines_as_points(session)]


def _off_centre(session: Session) -> Iterator[str]:
    """Warn of principal points far from the middle: a calibration of images of another size."""
    for setup in session.sensors:
        sensor = setup.sensor
        if not isinstance(sensor, Camera) or sensor.resolution is None:
            continue
        size = np.array(sensor.resolution)
        cx, cy = sensor.camera_matrix[:2, 2]
        if (np.abs((cx, cy) - (size - 1) / 2) > _OFF_CENTRE * size).any():
            yield (
                f"sensor {setup.name!r}: the principal point cx = {cx:g}, cy = {cy:g} is far from "
                f"the middle of its images of {size[0]}x{size[1]} px: is the calibration of images "
                "of another size, and camera_matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]?"
            )


def _too_wide(session: Session) -> Iterator[str]:
    """Warn of a sigma wider than the whole body, or than a twentieth of an image."""
    ranges, images = list[SensorSetup](), list[SensorSetup]()
    for setup in session.sensors:
        sigma, resolution = setup.extract.sigma, setup.resolution
        if isinstance(setup.sensor, RangeSensor) and sigma > session.body.radius:
            ranges.append(setup)
        elif setup.sensor.dimension == 2 and resolution and sigma > _WIDEST * max(resolution):
            images.append(setup)
    radius = f"{session.body.radius:.2g} {session.unit}"
    whole = f"the body, whose features lie within {radius}: set it to about what ranges err by"
    part = "a twentieth of the image: set it to several times what features err by, 1.5 px or so"
    for wide, unit, what in ((ranges, session.unit, whole), (images, "px", part)):
        if not wide:
            continue
        more = f" and {len(wide) - 1} more" if len(wide) > 1 else ""
        widest = max(wide, key=lambda setup: setup.extract.sigma)
        width, where = f"{widest.extract.sigma:g} {unit}", widest.table_of("sigma")
        yield f"sensor {wide[0].name!r}{more}: sigma = {width} in {where} is wider than {what}"


def _lines_as_points(session: Session) -> Iterator[str]:
    """Warn of cameras that extract points, though a body has segments."""
    bodies = [model.body.name for model in session.objects if not is_pointlike(model.body)]
    cameras = [
        setup.name
        for setup in session.sensors
        if setup.sensor.unit == "px" and setup.extract.method != "intensity"
    ]
    if bodies and cameras:
        yield (
            f"{quoted(bodies)}: segments are seen as lines of grey values, and {quoted(cameras)} "
            f'{"gives" if len(cameras) == 1 else "give"} points: set method = "intensity" in '
            "[extract], of images, or give the ends of the lines as points"
        )


def shared_source_warnings(session: Session, replaced: Mapping[str, str]) -> list[str]:
    """Warn of sensors that read the same recording; `replaced` has other recordings, by sensor."""
    read = {
        setup.name: {
            os.path.realpath(place) if os.path.exists(place) else place  # noqa: PTH110 - or an address
            for place in files_of(source_spec(session, setup, replaced.get(setup.name)))
        }
        for setup in session.sensors
    }
    warnings = []
    for (a, files_a), (b, files_b) in combinations(read.items(), 2):
        if both := files_a & files_b:
            first = os.path.basename(min(both))  # noqa: PTH119 - of an address too
            files = first if len(both) == 1 else f"{len(both)} files ({first}, ...)"
            warnings.append(
                f"sensors {a!r} and {b!r} read the same recording, {files}: give each its own "
                "source"
            )
    return warnings


def shared_part_warnings(session: Session) -> list[str]:
    """Warn of bodies that are congruent within the noise, as a whole or in large parts."""
    warnings = list[str]()
    if len(session.objects) < 2:
        return warnings
    noise = _noise_length(session)
    # one camera alone does not see the size of a body
    is_alone = len(session.sensors) == 1 and session.sensors[0].model in ("pinhole", "fisheye")
    for body, other in combinations([model.body for model in session.objects], 2):
        factor = body.radius / other.radius if is_alone else 1.0
        for size in dict.fromkeys((1.0, round(factor, 9))):
            resized = other if size == 1 else of_size(other, size)
            least = _LEAST * min(body.radius, resized.radius)
            reach = max(least, _NOISES * noise, body.spread, resized.spread)
            parts = congruent_parts(body, resized, reach)
            if parts and (size == 1 or len(parts[0].features) == len(body) == len(other)):
                warnings.append(_text(parts[0], session.unit, size))
                break
    return warnings


def _noise_length(session: Session) -> float:
    """Return the noise of a marker in the world, near a typical pose, by the best sensor."""
    lengths = []
    for setup in session.sensors:
        if setup.sensor.dimension == 1:
            lengths.append(noise_of(setup))
            continue
        if any(s.sensor.dimension == 2 and s.resolution is None for s in session.sensors):
            continue
        for T in typical_poses(session, 1)[:1]:
            _, J, seen = setup.sensor.linearise(session.body.means @ T[:3, :3].T + T[:3, 3])
            if seen.all():
                lengths.append(noise_of(setup) / max(float(np.linalg.norm(J[0], 2)), 1e-12))
    return min(lengths, default=0.0)


def _text(part: LookAlike, unit: str, size: float) -> str:
    body, other = part.body, part.other
    pairs = ", ".join(
        f"{body.labels[i]} like {other.labels[j]}"
        for i, j in zip(part.features, part.partners, strict=True)
    )
    off = part.off if part.off > 1e-9 * body.radius else 0.0  # less is a rounding error
    if len(part.features) == len(body) == len(other):
        resized, remedy = "", "give one [[object]] with count"
        if size != 1:
            resized, remedy = f", {size:.3g} times as large,", "add a sensor"
        return (
            f"the bodies {body.name!r} and {other.name!r}{resized} are congruent to {off:.2g} "
            f"{unit} (markers {pairs}): nothing tells them apart; {remedy}, or move a marker"
        )
    return (
        f"{len(part.features)} markers of {body.name!r} lie like {len(part.features)} of "
        f"{other.name!r} to {off:.2g} {unit} ({pairs}): where the others are hidden the one may be "
        "the other; expect ambiguous frames, or move a marker"
    )
