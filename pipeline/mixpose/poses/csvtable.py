"""Write poses as a flat CSV table: a row per frame, for spreadsheets and data frames."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from itertools import combinations_with_replacement as pairs
from typing import Any, TextIO

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose import rigid
from mixpose.poses.header import Header
from mixpose.poses.writing import PoseWriter, plain, pose_of
from mixpose.records import Estimate

FRAME_COLUMNS = ("frame", "time_s", "object", "status", "unit")
POSE_COLUMNS = (
    *("tx", "ty", "tz", "qx", "qy", "qz", "qw"),
    *("rotvec_x", "rotvec_y", "rotvec_z"),  # radians
)
COVARIANCE_COLUMNS = tuple(f"cov_{a}_{b}" for a, b in pairs(rigid.TWIST_NAMES, 2))
TIP_COLUMNS = ("tip_x", "tip_y", "tip_z", *(f"tip_cov_{a}_{b}" for a, b in pairs("xyz", 2)))
SENSOR_COLUMNS = ("used", "explained", "rms")


class CsvWriter(PoseWriter):
    """Writes a row per frame; values that a frame lacks are empty cells.

    Columns: `FRAME_COLUMNS` (with identical bodies also instance, behind object), `POSE_COLUMNS`,
    the upper triangle of the covariance, row by row, in the axes of `mixpose.rigid`; if a body has
    a tip `TIP_COLUMNS`; confidence; score; `SENSOR_COLUMNS` of each sensor named by the header, or
    else by the first frame; latency_ms.
    """

    def __init__(self, stream: TextIO, header: Header) -> None:
        super().__init__(stream, header)
        self._numbered = any(count > 1 for count in header.objects.values())
        self._rows = self._with_header(header.sensors) if header.sensors else None

    def _with_header(self, sensors: Sequence[str]) -> csv.DictWriter[str]:
        """Write the names of the columns, and return the writer of rows."""
        of_sensors = [f"{name}_{column}" for name in sensors for column in SENSOR_COLUMNS]
        numbered = ["instance"] if self._numbered else []
        columns = [*FRAME_COLUMNS[:3], *numbered, *FRAME_COLUMNS[3:], *POSE_COLUMNS]
        columns += [*COVARIANCE_COLUMNS, *(TIP_COLUMNS if self._header.tips else ())]
        columns += ["confidence", "score", *of_sensors, "latency_ms"]
        rows = csv.DictWriter(self._stream, columns, lineterminator="\n")
        rows.writeheader()
        self._stream.flush()
        return rows

    def _write(self, estimate: Estimate) -> None:
        self._rows = self._rows or self._with_header(tuple(estimate.sensors))
        row = {
            "frame": estimate.frame,
            "time_s": plain(estimate.time_s),
            "object": estimate.object,
            "status": estimate.status,
            "unit": self._header.unit,
            **_pose_cells(estimate),
            **(_tip_cells(estimate) if self._header.tips else {}),
            "confidence": plain(estimate.confidence),
            "score": plain(1.0 if estimate.score is None else estimate.score),
            "latency_ms": plain(estimate.latency_ms or 0.0),
        }
        if self._numbered:
            row["instance"] = estimate.instance
        for name, report in estimate.sensors.items():
            row[f"{name}_used"] = "true" if report.used else "false"
            row[f"{name}_explained"] = plain(report.explained)
            row[f"{name}_rms"] = plain(report.rms)
        columns = set(self._rows.fieldnames)
        unknown = [name for name in estimate.sensors if f"{name}_used" not in columns]
        if unknown:
            raise ValueError(f"frame {estimate.frame}: no columns for sensors {sorted(unknown)}")
        self._rows.writerow(row)  # csv writes None as an empty cell and floats by repr

    def close(self) -> None:
        """Write the column names if there was no row, and flush."""
        self._rows = self._rows or self._with_header(())
        super().close()


def _pose_cells(estimate: Estimate) -> dict[str, Any]:
    """Return the cells of the pose and its covariance, as far as the estimate has them."""
    T = pose_of(estimate)
    if T is None:
        return {}
    turn = rigid.quaternion_xyzw(T)
    numbers = np.concatenate([T[:3, 3], turn, Rotation.from_quat(turn).as_rotvec()])
    cells = dict(zip(POSE_COLUMNS, plain(numbers), strict=True))
    if estimate.covariance is not None:
        cells |= zip(
            COVARIANCE_COLUMNS, plain(estimate.covariance[np.triu_indices(6)]), strict=True
        )
    return cells


def _tip_cells(estimate: Estimate) -> dict[str, Any]:
    """Return the cells of the tip, if the estimate has one."""
    tip, C = estimate.tip, estimate.tip_covariance
    upper = [] if C is None else plain(C[np.triu_indices(3)])
    return {} if tip is None else dict(zip(TIP_COLUMNS, [*plain(tip), *upper]))
