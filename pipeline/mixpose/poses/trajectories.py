"""Write trajectories of labelled markers as files for programs that study movement.

TRC: tables, read by OpenSim and Cortex,
https://opensimconfluence.atlassian.net/wiki/spaces/OpenSim/pages/53089972
C3D: binary, read by most programs for movement (c3d.org); needs the package `ezc3d`.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate, pairwise
from pathlib import Path
from statistics import median_low
from typing import TextIO

import numpy as np

from mixpose.errors import RecordingError
from mixpose.naming import distinct
from mixpose.poses.poseline import PoseLine
from mixpose.records import Floats, Mask
from mixpose.units import length_ratio

TRC_MARK = "by mixpose"  # in the first line of files that mixpose wrote
MARKS = {"trc": ("PathFileType\t", TRC_MARK), "c3d": ("\x02P", "mixpose")}
"""Beginning of files by format, and a later mark of those that mixpose wrote."""

LAST_FRAME = 2**16 - 2  # numbers from 1, in 16 bits; some readers count one beyond the last
_STAMP_STEP = 1000  # median step of frame numbers from which these are stamps, in us or ns
_LONGEST_GAP = 10**15  # most frames of a gap, more than fit in any file
_MOST_SENSORS = 7  # sensors with a bit that says whether they measured a point
_RESIDUAL_STEPS = 127  # values of a residual, which is a signed byte for some readers
_SCALE_AT = 12  # byte of the header where the scale begins


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Trajectories of N markers over F frames of successive numbers."""

    names: tuple[str, ...]  # N, all different
    places: Floats  # (F, N, 3), in the world; NaN of unknown ones
    residuals: Floats  # (F, N), lengths; NaN of places that no sensor measured
    by_sensor: Mask  # (F, N, L), whether a sensor measured it
    first: int  # number of the first frame
    rate: float  # frames per second
    unit: str  # of lengths

    @property
    def is_known(self) -> Mask:
        """Mask (F, N) of known places."""
        return np.asarray(np.isfinite(self.places[..., 0]))

    @property
    def is_measured(self) -> Mask:
        """Mask (F, N) of places that sensors measured."""
        return np.asarray(np.isfinite(self.residuals))


def numbers_of(lines: Sequence[PoseLine]) -> dict[int, int]:
    """Return the numbers in such a file by frame numbers of pose lines.

    They are the same, unless frames are numbered by stamps: these count from 0, in usual steps of
    their times, or else of the stamps. Gaps stay gaps.
    """
    stamps = sorted({line.frame for line in lines})
    steps = [after - before for before, after in pairwise(stamps)]
    if not steps or median_low(steps) < _STAMP_STEP:
        return {number: number for number in stamps}
    times = {line.frame: line.time_s for line in lines}
    seconds = [time for number in stamps if (time := times[number]) is not None]
    elapsed = [after - before for before, after in pairwise(seconds)]
    if len(seconds) == len(stamps) and min(elapsed) > 0 and math.isfinite(sum(elapsed)):
        usual = median_low(elapsed)
        counts = [round(min(gap / usual, float(_LONGEST_GAP))) for gap in elapsed]
    else:
        step = median_low(steps)
        counts = [(2 * gap + step) // (2 * step) for gap in steps]
    return dict(zip(stamps, accumulate((max(n, 1) for n in counts), initial=0), strict=True))


def rate_of(lines: Sequence[PoseLine], numbers: Mapping[int, int]) -> tuple[float, float] | None:
    """Return frames per second by times of pose lines, and the largest error of a time, in frames.

    `numbers` are those of `numbers_of`. None if lines have no times, or all are of a single frame.
    Raises RecordingError if times do not ascend with the frames.
    """
    times = {line.frame: line.time_s for line in lines if line.time_s is not None}
    if len(times) < 2:
        return None
    known = sorted(times)
    frames = np.array([numbers[frame] - numbers[known[0]] for frame in known], dtype=np.float64)
    seconds = np.array([times[number] for number in known])
    if (np.diff(seconds) <= 0).any():
        k = int(np.argmax(np.diff(seconds) <= 0))
        raise RecordingError(
            f"frame {known[k + 1]} is at {seconds[k + 1]:g} s and the one before it at "
            f"{seconds[k]:g} s; times that ascend are needed: say how many frames a second with "
            "--fps"
        )
    rate = frames[-1] / (seconds[-1] - seconds[0])
    off = np.abs((seconds - seconds[0]) * rate - frames).max()
    return float(rate), float(off)


def write_trc(stream: TextIO, trajectories: Trajectories, called: str) -> None:
    """Write trajectories in mm; the format cannot hold which places sensors measured.

    Unknown coordinates are NaN, as an empty cell would shift the row for readers that split at any
    space. The first line contains the name of the file, `called`.
    """
    frames, markers = trajectories.places.shape[:2]
    # tabs part columns, but some readers split at any white space
    names = distinct(trajectories.names, partial(re.sub, r"\s", "_"))
    rate, first = repr(trajectories.rate), trajectories.first
    axes = [f"{axis}{k + 1}" for k in range(markers) for axis in "XYZ"]
    keys = "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame"
    facts = (rate, rate, frames, markers, "mm", rate, first, frames)
    rows = [
        ("PathFileType", "4", "(X/Y/Z)", f"{called} {TRC_MARK}"),
        (*keys.split(), "OrigNumFrames"),
        facts,
        ("Frame#", "Time", *(cell for name in names for cell in (name, "", ""))),
        ("", "", *axes),
        (),
    ]
    for row in rows:
        stream.write("\t".join(map(str, row)) + "\n")
    places = trajectories.places * length_ratio(trajectories.unit, "mm")
    for k, flat in enumerate(places.reshape(frames, -1).tolist()):
        cells = ("NaN" if np.isnan(value) else f"{value:.6f}" for value in flat)
        time = (first + k) / trajectories.rate
        stream.write("\t".join([str(first + k), f"{time:.9g}", *cells]) + "\n")
    stream.flush()


def write_c3d(path: Path, trajectories: Trajectories) -> bool:
    """Write trajectories in mm, and return whether frame n of mixpose is frame n + 1 there.

    If not, numbers are too large, and frames begin at 1. A measured point has its residual, and the
    bits of those of the first seven sensors that measured it; a point by the pose has the residual
    0 and no bit, as computed points of C3D do; an unknown one has the residual -1. Raises
    RecordingError if there are more frames than a file can number.
    """
    import ezc3d  # noqa: PLC0415 - an optional package

    ratio = length_ratio(trajectories.unit, "mm")
    frames = len(trajectories.places)
    if frames > LAST_FRAME:
        raise RecordingError(
            f"found frames {trajectories.first} to {trajectories.first + frames - 1}, and .c3d "
            f"has room for {LAST_FRAME}; write .trc, or run a part with --start and --stop"
        )
    measured = trajectories.is_measured
    residuals = np.where(measured, trajectories.residuals * ratio, 0.0)
    scale = np.float32(max(float(residuals.max()), 1e-3) / _RESIDUAL_STEPS)
    # a measured residual must not be rounded to 0, which means computed
    residuals = np.where(measured, np.maximum(residuals, 1.5 * scale), 0.0)
    residuals[~trajectories.is_known] = -1.0
    is_numbered = 0 <= trajectories.first <= LAST_FRAME - frames
    file = ezc3d.c3d()
    file.add_parameter("MANUFACTURER", "SOFTWARE", ["mixpose"])
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [trajectories.rate]
    point["UNITS"]["value"] = ["mm"]
    point["LABELS"]["value"] = list(trajectories.names)
    point["SCALE"]["value"] = [-float(scale)]
    file["header"]["points"]["first_frame"] = trajectories.first if is_numbered else 0
    points = np.ones((4, *trajectories.places.shape[1::-1]))
    points[:3] = ratio * trajectories.places.transpose(2, 1, 0)
    file["data"]["points"] = points
    sensors = trajectories.by_sensor[..., :_MOST_SENSORS].transpose(2, 1, 0)
    masks = np.zeros((_MOST_SENSORS, *points.shape[1:]), dtype=np.bool_)
    masks[: len(sensors)] = sensors
    file["data"]["meta_points"]["residuals"] = residuals.T[None]
    file["data"]["meta_points"]["camera_masks"] = masks
    file.write(str(path))
    # ezc3d writes -1 to the header whatever the scale, and readers refuse files with two scales
    with path.open("r+b") as stream:
        stream.seek(_SCALE_AT)
        stream.write(struct.pack("<f", -scale))
    return is_numbered
