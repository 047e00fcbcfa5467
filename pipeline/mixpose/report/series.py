"""Arrange the poses of a run, and their errors, as arrays over frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.evaluate import errors_to_truth
from mixpose.poses.jsonl import PoseFile
from mixpose.poses.poseline import PoseLine
from mixpose.records import Floats, Mask, Status

Texts: TypeAlias = NDArray[np.str_]

SIGMAS_95 = 1.96
"""Half-width of the interval that contains 95 % of a Gaussian, in standard deviations."""

_HALF_TURN_DEG = 180.0
_DECIMALS_DEG = 7  # rounding errors of a held rotation should not show


@dataclass(frozen=True)
class Series:
    """A run over its n frames, ascending; NaN where a frame has no value."""

    object: str
    label: str  # of the body in pose lines
    unit: str  # of lengths; "units" if the file does not state it
    frames: tuple[int, ...]  # numbers from file names may be longer than an int64
    x: Floats  # (n,) abscissa of frames: times in s, or frame numbers if times are missing
    x_label: str
    breaks: Mask  # (n,) whether more frame numbers than usual are missing before a frame
    status: Texts  # (n,)
    position: Floats  # (n, 3)
    turn_deg: Floats  # (n, 3) rotation vectors from `T_reference`, in world axes, degrees
    # (n, 6) of 95 % bands, length units and degrees; infinite if open, as beyond half a turn
    half_width: Floats
    T_reference: Floats  # (4, 4) the first pose that is "ok", else the first pose
    score: Floats  # (n,)
    latency_ms: Floats  # (n,)
    rms: Mapping[str, Floats]  # (n,) by sensor; NaN in lost frames too
    explained: Mapping[str, Floats]  # likewise
    # (n,) by sensor and feature: infinite if not met, NaN if not in view or the frame is lost
    residuals: Mapping[str, Mapping[str, Floats]]


@dataclass(frozen=True)
class Errors:
    """Errors against the truth at the frames of a `Series`; NaN without pose or truth."""

    rotation_deg: Floats  # (n,)
    distance: Floats  # (n,)
    position: Floats  # (n, 3) of the true pose that the pose was compared with, modulo symmetries
    turn_deg: Floats  # (n, 3) of the true pose, as in `Series`


def series_of(file: PoseFile) -> Series:
    """Arrange the lines of a poses file by frame; raise a `RecordingError` for several objects."""
    lines = sorted(file.poses, key=lambda line: line.frame)
    names = sorted({line.label for line in lines})
    if len(names) > 1:
        raise RecordingError(
            f"{file.path}: holds poses of {', '.join(map(repr, names))}; a series is of one body"
        )
    no_pose = np.full((4, 4), np.nan)
    poses = [no_pose if line.T_world_object is None else line.T_world_object for line in lines]
    T = np.array(poses, dtype=np.float64).reshape(-1, 4, 4)
    status = np.array([line.status for line in lines], dtype=np.str_)
    T_reference = _reference(T, status)
    frames = tuple(line.frame for line in lines)
    times = _numbers([line.time_s for line in lines])
    timed = len(lines) > 0 and bool(np.all(np.isfinite(times)))
    sensors = list(dict.fromkeys(name for line in lines for name in line.sensors))
    return Series(
        object=lines[0].object if lines else "",
        label=names[0] if names else "",
        unit=file.unit or "units",
        frames=frames,
        x=times if timed else np.array(frames, dtype=np.float64),
        x_label="time, s" if timed else "frame",
        breaks=_breaks(frames),
        status=status,
        position=T[:, :3, 3],
        turn_deg=turns_deg(T, T_reference),
        half_width=_half_widths(lines, T, T_reference),
        T_reference=T_reference,
        score=_numbers([line.score for line in lines]),
        latency_ms=_numbers([line.latency_ms for line in lines]),
        rms={name: _of_sensor(lines, name, "rms") for name in sensors},
        explained={name: _of_sensor(lines, name, "explained") for name in sensors},
        residuals={name: _of_features(lines, name) for name in sensors},
    )


def errors_of(series: Series, poses: PoseFile, truth: PoseFile) -> Errors:
    """Return errors of all frames modulo symmetries; `RecordingError` if poses are incomparable."""
    errors = errors_to_truth(poses, truth)
    by_frame = {error.frame: error.twist for error in errors if error.object == series.label}
    missing = np.full(6, np.nan)
    listed = [by_frame.get(frame) for frame in series.frames]
    twists = np.array([missing if twist is None else twist for twist in listed]).reshape(-1, 6)
    position = series.position - twists[:, :3]
    turned = np.full_like(position, np.nan)
    known = np.isfinite(twists[:, 0])
    pose = Rotation.from_rotvec(np.radians(series.turn_deg[known]))
    true_turn = Rotation.from_rotvec(twists[known, 3:]).inv() * pose
    turned[known] = np.degrees(true_turn.as_rotvec())
    return Errors(
        rotation_deg=np.degrees(np.linalg.norm(twists[:, 3:], axis=1)),
        distance=np.linalg.norm(twists[:, :3], axis=1),
        position=position,
        turn_deg=turned,
    )


def turns_deg(T: Floats, T_reference: Floats) -> Floats:
    """Return rotation vectors (n, 3) from a reference to poses (n, 4, 4), world axes, degrees."""
    turns = np.full((len(T), 3), np.nan)
    known = np.isfinite(T[:, 0, 0])
    if known.any():
        turns[known] = np.degrees(rigid.twist_between(T_reference, T[known])[:, 3:])
    return np.round(turns, _DECIMALS_DEG)


def jumps_of_turns(turn_deg: Floats) -> Mask:
    """Return a mask (n,) of frames before which a rotation vector wraps at half a turn."""
    with np.errstate(invalid="ignore"):
        far = np.linalg.norm(np.diff(turn_deg, axis=0), axis=1) > _HALF_TURN_DEG
    return np.concatenate([np.zeros(min(len(turn_deg), 1), dtype=bool), far])


def frame_ranges(series: Series, status: Status) -> list[tuple[int, int]]:
    """Return the first and last frame of all stretches of consecutive frames with a status."""
    ranges: list[tuple[int, int]] = []
    goes_on = False
    for frame, is_break, value in zip(series.frames, series.breaks, series.status, strict=True):
        if value == status:
            first = ranges.pop()[0] if goes_on and not is_break else frame
            ranges.append((first, frame))
        goes_on = value == status
    return ranges


def _reference(T: Floats, status: Texts) -> Floats:
    """Return the first pose (4, 4) that is "ok", else the first pose, else the identity."""
    for wanted in (status == "ok", status != "lost"):
        if wanted.any():
            return np.asarray(T[np.argmax(wanted)])
    return np.eye(4)


def _numbers(values: list[float | None]) -> Floats:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _of_sensor(lines: list[PoseLine], name: str, what: str) -> Floats:
    """Return a value of a sensor per frame; NaN in lost frames, where it rates a rejected pose."""
    reports = [None if line.status == "lost" else line.sensors.get(name) for line in lines]
    return _numbers([getattr(report, what, None) for report in reports])


def _of_features(lines: list[PoseLine], name: str) -> dict[str, Floats]:
    """Return a sensor's residuals (n,) by feature."""
    residuals: dict[str, Floats] = {}
    for k, line in enumerate(lines):
        if line.status == "lost" or name not in line.sensors:
            continue
        for feature, residual in line.sensors[name].residuals.items():
            values = residuals.setdefault(feature, np.full(len(lines), np.nan))
            values[k] = np.inf if residual is None else residual
    return residuals


def _breaks(frames: Sequence[int]) -> Mask:
    """Return a mask of frames before which more numbers are missing than usual in the file."""
    steps = np.array([0, *(after - before for before, after in pairwise(frames))], dtype=np.float64)
    usual = np.median(steps[1:]) if len(steps) > 1 else 1.0
    return np.asarray(steps[: len(frames)] > 1.5 * usual)


def _half_widths(lines: list[PoseLine], T: Floats, T_reference: Floats) -> Floats:
    """Return half-widths (n, 6) of 95 % bands of position and turn, as in `Series`."""
    widths = np.full((len(lines), 6), np.nan)
    turns = np.radians(turns_deg(T, T_reference))
    for i, line in enumerate(lines):
        if line.covariance is None or line.T_world_object is None:
            continue
        J = np.eye(6)
        J[3:, 3:] = rotation_vector_jacobian(turns[i])
        variances = np.diag(J @ line.covariance @ J.T)
        widths[i] = SIGMAS_95 * np.sqrt(np.maximum(variances, 0.0))
    widths[:, 3:] = np.round(np.degrees(widths[:, 3:]), _DECIMALS_DEG)
    widths[:, 3:][widths[:, 3:] > 180.0] = np.inf
    return widths


def rotation_vector_jacobian(vector: Floats) -> Floats:
    """Return the change (3, 3) of a rotation vector, at most π, by a small turn in world axes.

    Inverse of the left Jacobian of SO(3): J. Solà et al., A micro Lie theory for state estimation
    in robotics, 2018, equation 146.
    """
    x, y, z = vector
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = max(float(np.linalg.norm(vector)), 1e-9)  # at less, the share loses all digits
    share = 1 / angle**2 - 1 / (2 * angle * np.tan(angle / 2))
    return np.asarray(np.eye(3) - across / 2 + share * across @ across)
