"""C3D: marker trajectories in binary, as most programs for movement read them (c3d.org).

Needs the package `ezc3d`.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from mixpose.errors import RecordingError
from mixpose.poses.header import length_ratio
from mixpose.poses.trajectories import Trajectories

LAST_FRAME = 2**16 - 2
"""Frames are numbered from 1, in 16 bits; some readers count one beyond the last."""

_SENSORS = 7  # that a bit each says of whether they measured a point
_STEPS = 127  # of a residual, which is a signed byte for some readers
_SCALE_AT = 12  # byte of the header where the scale stands


def write_c3d(path: Path, trajectories: Trajectories) -> bool:
    """Write trajectories in mm, and tell whether frame n of mixpose is frame n + 1 there.

    Where numbers are too large for that, frames begin at 1. A measured point has its residual, and
    the bits of the sensors that measured it, of the first seven; one by the pose has the residual 0
    and no bit, as C3D has it for points that are computed; one that is not known the residual -1.
    Raises RecordingError if there are more frames than a file can number.
    """
    import ezc3d  # noqa: PLC0415 - not everybody has it

    ratio = length_ratio(trajectories.unit, "mm")
    frames = len(trajectories.places)
    if frames > LAST_FRAME:
        raise RecordingError(
            f"found frames {trajectories.first} to {trajectories.first + frames - 1}, and .c3d "
            f"has room for {LAST_FRAME}; write .trc, or run a part with --start and --stop"
        )
    measured = trajectories.is_measured
    residuals = np.where(measured, trajectories.residuals * ratio, 0.0)
    scale = np.float32(max(float(residuals.max()), 1e-3) / _STEPS)
    # no measured one may be rounded to 0, which means computed
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
    sensors = trajectories.by_sensor[..., :_SENSORS].transpose(2, 1, 0)
    masks = np.zeros((_SENSORS, *points.shape[1:]), dtype=np.bool_)
    masks[: len(sensors)] = sensors
    file["data"]["meta_points"]["residuals"] = residuals.T[None]
    file["data"]["meta_points"]["camera_masks"] = masks
    file.write(str(path))
    # ezc3d keeps -1 in the header whatever the scale, and readers refuse files of two scales
    with path.open("r+b") as stream:
        stream.seek(_SCALE_AT)
        stream.write(struct.pack("<f", -scale))
    return is_numbered
