"""A flat CSV table of poses: one row per frame, for spreadsheets and data frames."""

from __future__ import annotations

import csv
from typing import Any, TextIO

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose import rigid
from mixpose.poses.header import Header
from mixpose.poses.writing import PoseWriter, plain, plain_or_none, pose_of
from mixpose.records import Estimate

_UPPER = np.triu_indices(6)

FRAME_COLUMNS = ("frame", "time_s", "object", "status", "unit")
POSE_COLUMNS = (
    *("tx", "ty", "tz", "qx", "qy", "qz", "qw"),
    *("rotvec_x", "rotvec_y", "rotvec_z"),  # radians
)
COVARIANCE_COLUMNS = tuple(
    f"cov_{rigid.TWIST_NAMES[i]}_{rigid.TWIST_NAMES[j]}" for i, j in zip(*_UPPER)
)
SENSOR_COLUMNS = ("used", "explained", "rms")


class CsvWriter(PoseWriter):
    """Writes one row per frame; what a frame does not have is an empty cell.

    Columns: frame, time_s, object, status, unit (where there are identical bodies also instance,
    behind object); the pose as position, quaternion and rotation vector; the upper triangle of its
    covariance, row by row, ``cov_<a>_<b>`` in the axes of `mixpose.rigid`; confidence; score;
    ``<sensor>_used``, ``<sensor>_explained`` and ``<sensor>_rms`` of each sensor, which the header
    names or else the first frame; latency_ms.
    """

    def __init__(self, stream: TextIO, header: Header) -> None:
        super().__init__(stream, header)
        self._rows = csv.writer(stream, lineterminator="\n")
        self._numbered = any(count > 1 for count in header.objects.values())
        self._sensors: tuple[str, ...] | None = None
        if header.sensors:
            self._write_columns(header.sensors)

    def _write(self, estimate: Estimate) -> None:
        if self._sensors is None:
            self._write_columns(tuple(estimate.sensors))
        unknown = set(estimate.sensors) - set(self._sensors or ())
        if unknown:
            raise ValueError(f"frame {estimate.frame}: no columns for sensors {sorted(unknown)}")
        row = [
            estimate.frame,
            plain_or_none(estimate.time_s),
            estimate.object,
            *([estimate.instance] if self._numbered else []),
            estimate.status,
            self._header.unit,
            *_pose_cells(estimate),
            plain_or_none(estimate.confidence),
            plain(1.0 if estimate.score is None else estimate.score),
            *self._sensor_cells(estimate),
            plain(estimate.latency_ms or 0.0),
        ]
        self._rows.writerow(row)  # csv writes None as an empty cell and floats by repr

    def close(self) -> None:
        """Write the column names if no row did, and flush."""
        if self._sensors is None:
            self._write_columns(())
        super().close()

    def _write_columns(self, sensors: tuple[str, ...]) -> None:
        self._sensors = sensors
        of_sensors = [f"{name}_{column}" for name in sensors for column in SENSOR_COLUMNS]
        self._rows.writerow(
            [
                *FRAME_COLUMNS[:3],
                *(["instance"] if self._numbered else []),
                *FRAME_COLUMNS[3:],
                *POSE_COLUMNS,
                *COVARIANCE_COLUMNS,
                "confidence",
                "score",
                *of_sensors,
                "latency_ms",
            ]
        )
        self._stream.flush()

    def _sensor_cells(self, estimate: Estimate) -> list[Any]:
        cells: list[Any] = []
        for name in self._sensors or ():
            report = estimate.sensors.get(name)
            if report is None:
                cells += [None] * len(SENSOR_COLUMNS)
                continue
            cells += [
                "true" if report.used else "false",
                plain_or_none(report.explained),
                plain_or_none(report.rms),
            ]
        return cells


def _pose_cells(estimate: Estimate) -> list[Any]:
    """Cells of the pose and its covariance; empty where there is none."""
    T = pose_of(estimate)
    if T is None:
        return [None] * (len(POSE_COLUMNS) + len(COVARIANCE_COLUMNS))
    turn = rigid.quaternion_xyzw(T)
    numbers = np.concatenate([T[:3, 3], turn, Rotation.from_quat(turn).as_rotvec()])
    cells: list[Any] = plain(numbers)
    if estimate.covariance is None:
        return cells + [None] * len(COVARIANCE_COLUMNS)
    upper: list[Any] = plain(estimate.covariance[_UPPER])
    return cells + upper
