"""Options of a simulation beyond the session file, and random numbers keyed by purpose."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from mixpose.errors import SessionError
from mixpose.limits import MOST_DETECTIONS

DEFAULT_FPS = 25.0

Output: TypeAlias = Literal["images", "profiles", "pixels", "lengths"]
"""Output of a sensor: images, range profiles, or a table of detections in px or in lengths."""

Rule: TypeAlias = tuple[float, float, bool, str]

# squares of larger numbers and quotients by smaller ones overflow
_LARGEST, _SMALLEST = 1e12, 1e-12
_MOST_COMPANIONS = 100

# least and largest value, whether it must be a whole number, and the rule in words
_NOT_NEGATIVE: Rule = 0, _LARGEST, False, f"a number of at least 0, at most {_LARGEST:g}"
_POSITIVE_TEXT = f"a number greater than 0, from {_SMALLEST:g} to {_LARGEST:g}"
_POSITIVE: Rule = _SMALLEST, _LARGEST, False, _POSITIVE_TEXT
_PROBABILITY: Rule = 0, 1, False, "a probability from 0 to 1"
_COUNT: Rule = 0, math.inf, True, "a whole number from 0"
_FEW: Rule = 0, _MOST_COMPANIONS, True, f"a whole number from 0 to {_MOST_COMPANIONS}"
_FALSE: Rule = 0, MOST_DETECTIONS, False, f"a number from 0 to {MOST_DETECTIONS}"
_FRAMES: Rule = 1, math.inf, True, "a whole number from 1"
_SIGMA: Rule = 0.1, 1e4, False, "a number of at least 0.1 px, at most 1e4 px"
_SECOND: Rule = 0, 1, False, "seconds from 0 to 1"
_QUALITY: Rule = 1, 100, False, "a quality from 1 to 100"
_ANY: Rule = -_LARGEST, _LARGEST, False, f"a number from {-_LARGEST:g} to {_LARGEST:g}"


_IMAGES: tuple[Output, ...] = ("images",)
_CAMERAS: tuple[Output, ...] = ("images", "pixels")
_ALL: tuple[Output, ...] = get_args(Output)


def _option(default: Any, rule: Rule | None, outputs: tuple[Output, ...] = _ALL) -> Any:
    """Return a field with a default, the rule of its values, and the outputs that it affects."""
    return field(default=default, metadata={"rule": rule, "of": outputs})


@dataclass(frozen=True)
class SimulationOptions:
    """Frames, noise, clutter and motion of a recording; a wrong number is a `SessionError`."""

    frames: int = field(metadata={"rule": _FRAMES})
    seed: int = _option(0, _COUNT)  # the same seed, session and options: the same recording
    fps: float | None = _option(None, _POSITIVE)  # None: that of the session, else 25
    # grey level without features; below 0 the camera clips most of its noise at black
    background: float = _option(10.0, _ANY, _IMAGES)
    noise: float = _option(2.0, _NOT_NEGATIVE, _IMAGES)  # deviation of each pixel, grey levels
    shot_noise: float = _option(0.02, _NOT_NEGATIVE, _IMAGES)  # variance per grey level of signal
    # standard deviation of a feature's spot, px; None: `spot_sigma` of its [extract], else 1.6
    spot_sigma: float | None = _option(None, _SIGMA, _IMAGES)
    brightness: float = _option(170.0, _POSITIVE, _IMAGES)  # peak of a spot, grey levels
    # standard deviation from feature to feature, as a share
    brightness_spread: float = _option(0.1, _NOT_NEGATIVE, ("images", "profiles"))
    # false features per frame and sensor: the integer part always, the fraction by chance
    clutter: float = _option(0.0, _FALSE)
    hidden: float = _option(0.0, _PROBABILITY)  # that a feature is hidden, in each view anew
    hidden_count: int = _option(0, _COUNT)  # features hidden in each view, drawn by chance
    # that a sensor has no frame; in a video or profiles, that its frame has no features
    missing: float = _option(0.0, _PROBABILITY)
    # displace features, in each frame anew, by the spread that the object states; the truth is the
    # pose of the undeformed body
    deform: bool = False
    # largest displacement along each world axis, length units; None: 0.4 times the body's radius
    amplitude_translation: float | None = _option(None, _NOT_NEGATIVE)
    amplitude_rotation_deg: float = _option(20.0, _NOT_NEGATIVE)  # largest about each world axis
    period_s: float = _option(4.0, _POSITIVE)  # of the slow part of the motion
    # standard deviation of detections in a camera's table, px
    pixel_noise: float = _option(0.1, _NOT_NEGATIVE, ("pixels",))
    # of detections in tables of ranges and clouds, length units; None: `sigma` of the sensor's
    # [extract], of clouds a fifth of it
    range_noise: float | None = _option(None, _NOT_NEGATIVE, ("lengths",))
    # standard deviation of a feature's peak in a range profile, length units; None: `spot_sigma`
    # of the sensor's [extract], else one and a half bins
    range_width: float | None = _option(None, _POSITIVE, ("profiles",))
    # height of a peak divided by the standard deviation of the profile's noise
    range_snr: float = _option(30.0, _POSITIVE, ("profiles",))
    # seconds from a camera's first row to its last, and during which a row collects light; None:
    # as the session states
    readout: float | None = _option(None, _SECOND, _CAMERAS)
    exposure: float | None = _option(None, _SECOND, _CAMERAS)
    # by name, seconds of delay that a sensor's times do not contain; else as the session states
    delay: Mapping[str, float] = field(default_factory=dict)
    # seconds from the first sensor to the last, which their tables of times contain
    out_of_step: float = _option(0.0, _NOT_NEGATIVE)
    lamps: int = _option(0, _FEW, _CAMERAS)  # behind the body
    others: int = _option(0, _FEW, _CAMERAS)  # bodies with as many markers
    occluder: int = _option(0, _FEW, _CAMERAS)  # dark bars that swing before the body
    # share of the brightness that a table below the body reflects; 0 without a table
    mirror: float = _option(0.0, _PROBABILITY, _CAMERAS)
    jpeg: int | None = _option(None, _QUALITY, _IMAGES)  # quality of compressed images
    bayer: bool = _option(False, None, _IMAGES)  # images of a colour sensor, interpolated
    turned_camera_deg: float = _option(0.0, _ANY, _CAMERAS)  # of the last one since calibration
    away_from: int | None = _option(None, _COUNT)  # number of frames after which the body is gone

    def __post_init__(self) -> None:
        for option in fields(self):
            value = getattr(self, option.name)
            rule: Rule | None = option.metadata.get("rule")
            if value is None or rule is None:
                continue
            least, most, is_whole, allowed = rule
            is_allowed = math.isfinite(value) and least <= value <= most
            if not is_allowed or (is_whole and value != int(value)):
                raise SessionError(f"simulate: {option.name}: found {value}; allowed: {allowed}")

    def unused(self, outputs: Collection[Output], *, is_exact: bool) -> tuple[str, ...]:
        """Return the names of changed options that affect none of a session's outputs.

        `deform` is unused if the features of the body are exact.
        """
        changed = [item for item in fields(self) if getattr(self, item.name) != item.default]
        idle = [item.name for item in changed if not {*item.metadata.get("of", _ALL)} & {*outputs}]
        return (*idle, "deform") if self.deform and is_exact else tuple(idle)


class Purpose(IntEnum):
    """The purpose of random numbers."""

    MOTION = 1
    ORIENTATION = 2
    BRIGHTNESS = 3
    FRAME = 4
    MISSING = 5
    DEFORMATION = 6
    SCENERY = 7
    TURNED = 8


def generator(seed: int, purpose: Purpose, *key: int) -> np.random.Generator:
    """Return the generator for one purpose; `key` distinguishes frames and sensors."""
    return np.random.default_rng([seed, int(purpose), *key])
