"""What to simulate, beyond what the session file says."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import TypeAlias

from mixpose.errors import SessionError

DEFAULT_FPS = 25.0

Rule: TypeAlias = tuple[Callable[[float], bool], str]

_NOT_NEGATIVE: Rule = (lambda value: value >= 0, "a number of at least 0")
_POSITIVE: Rule = (lambda value: value > 0, "a number greater than 0")
_PROBABILITY: Rule = (lambda value: 0 <= value <= 1, "a probability from 0 to 1")
_COUNT: Rule = (lambda value: value >= 0 and value == int(value), "a whole number from 0")
_FRAMES: Rule = (lambda value: value >= 1 and value == int(value), "a whole number from 1")
_ANY: Rule = (lambda value: True, "a number")

_RULES: dict[str, Rule] = {
    "frames": _FRAMES,
    "seed": _COUNT,
    "fps": _POSITIVE,
    "background": _ANY,
    "noise": _NOT_NEGATIVE,
    "shot_noise": _NOT_NEGATIVE,
    "spot_sigma": (lambda value: value >= 0.1, "a number of at least 0.1 px"),
    "brightness": _POSITIVE,
    "brightness_spread": _NOT_NEGATIVE,
    "clutter": _NOT_NEGATIVE,
    "hidden": _PROBABILITY,
    "hidden_count": _COUNT,
    "missing": _PROBABILITY,
    "amplitude_translation": _NOT_NEGATIVE,
    "amplitude_rotation_deg": _NOT_NEGATIVE,
    "period_s": _POSITIVE,
    "pixel_noise": _NOT_NEGATIVE,
    "range_noise": _NOT_NEGATIVE,
    "range_width": _POSITIVE,
    "range_snr": _POSITIVE,
    "readout": _NOT_NEGATIVE,
    "exposure": _NOT_NEGATIVE,
    "out_of_step": _NOT_NEGATIVE,
    "lamps": _COUNT,
    "others": _COUNT,
    "occluder": _COUNT,
    "mirror": _PROBABILITY,
    "jpeg": (lambda value: 1 <= value <= 100, "a quality from 1 to 100"),
    "turned_camera_deg": _ANY,
    "away_from": _COUNT,
}


@dataclass(frozen=True)
class SimulationOptions:
    """Frames, noise, clutter and motion of a simulated recording.

    Attributes
    ----------
    frames : int
        Number of frames.
    seed : int
        The same seed, session and options give the same recording.
    fps : float or None
        Frames per second; None takes that of the session, or else 25.
    background : float
        Grey level without features; below 0 the camera clips most of its noise at black.
    noise : float
        Standard deviation of the Gaussian noise of every pixel, grey levels.
    shot_noise : float
        Variance of the shot noise per grey level of signal.
    spot_sigma : float or None
        Standard deviation of a feature's spot, px; None is `spot_sigma` of the sensor's
        ``[extract]`` where that is given, else 1.6.
    brightness : float
        Peak of a feature's spot above the background, grey levels.
    brightness_spread : float
        Standard deviation of the brightness from feature to feature, as a share of it.
    clutter : float
        False features per frame and sensor: the whole part always, the rest by chance.
    hidden : float
        Probability that a feature is hidden, in each view anew.
    hidden_count : int
        Features hidden in each view for certain, chosen by chance.
    missing : float
        Probability that a sensor has no frame.  A video or a table of profiles cannot lack one:
        there it is a frame without features.
    deform : bool
        Whether features are displaced, in each frame anew, by the spread that the object states.
        The truth remains the pose of the undeformed body.
    amplitude_translation : float or None
        Largest displacement along each world axis, length units; None is 0.4 times the
        radius of the body.
    amplitude_rotation_deg : float
        Largest turn about each world axis.
    period_s : float
        Time in which the slow part of the motion comes round, more or less.
    pixel_noise : float
        Standard deviation of detections in a camera's table, px.
    range_noise : float or None
        Standard deviation of detections in tables of ranges and clouds, length units; None is
        `sigma` of its ``[extract]``, of clouds a fifth of it.
    range_width : float or None
        Standard deviation of a feature's peak in a range profile, length units; None is
        `spot_sigma` of the sensor's ``[extract]`` where that is given, else one and a half bins.
    range_snr : float
        Height of a peak divided by the standard deviation of the profile's noise.

    readout, exposure : float or None
        Seconds from the first row of a camera to its last, and for which a row collects light;
        None is what the session states of each camera.
    delay : mapping of str to float
        Seconds that sensors are late without knowing, by name; the others are as late as the
        session states.
    out_of_step : float
        Seconds by which sensors differ that have tables of times, as these say: the last is this
        much later than the first.
    lamps, others, occluder : int
        Lamps behind the body; other bodies with as many markers; dark bars that swing before it.
    mirror : float
        Brightness of mirror images in a table below the body, as a share; 0 without one.
    jpeg : int or None
        Quality of the compression that images went through.
    bayer : bool
        Whether images come from a colour sensor, its colours interpolated.
    turned_camera_deg : float
        By which the last camera was turned after its calibration.
    away_from : int or None
        Number of frames after which the body is gone.

    Raises
    ------
    SessionError
        If a number is not allowed.
    """

    frames: int
    seed: int = 0
    fps: float | None = None
    background: float = 10.0
    noise: float = 2.0
    shot_noise: float = 0.02
    spot_sigma: float | None = None
    brightness: float = 170.0
    brightness_spread: float = 0.1
    clutter: float = 0.0
    hidden: float = 0.0
    hidden_count: int = 0
    missing: float = 0.0
    deform: bool = False
    amplitude_translation: float | None = None
    amplitude_rotation_deg: float = 20.0
    period_s: float = 4.0
    pixel_noise: float = 0.1
    range_noise: float | None = None
    range_width: float | None = None
    range_snr: float = 30.0
    readout: float | None = None
    exposure: float | None = None
    delay: Mapping[str, float] = field(default_factory=dict)
    out_of_step: float = 0.0
    lamps: int = 0
    others: int = 0
    occluder: int = 0
    mirror: float = 0.0
    jpeg: int | None = None
    bayer: bool = False
    turned_camera_deg: float = 0.0
    away_from: int | None = None

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if value is None or one.name not in _RULES:
                continue
            is_allowed, allowed = _RULES[one.name]
            if not (math.isfinite(value) and is_allowed(value)):
                raise SessionError(f"simulate: {one.name}: found {value}; allowed: {allowed}")
