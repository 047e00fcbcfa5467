"""Write poses in the formats of other programs, and list all formats by name.

CSV: a row per frame, for spreadsheets and data frames.
TUM: ``time tx ty tz qx qy qz qw``, metres; `evo` opens them,
https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
BOP: ``scene_id,im_id,obj_id,score,R,t,time``; the BOP toolkit opens them,
https://bop.felk.cvut.cz/challenges/bop-challenge-2020/#howtoparticipate
ROS 2: geometry_msgs/msg/PoseWithCovarianceStamped as YAML, as by ``ros2 topic echo``;
``ros2 topic pub --yaml-file`` publishes it,
https://docs.ros.org/en/rolling/p/geometry_msgs/msg/PoseWithCovarianceStamped.html
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import combinations_with_replacement as pairs
from typing import Any, TextIO

import numpy as np
from scipy.spatial.transform import Rotation

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.header import Header
from mixpose.poses.jsonl import JsonlWriter
from mixpose.poses.writing import PoseWriter, plain, pose_of
from mixpose.records import Estimate
from mixpose.units import UNITS_PER_METRE

ONE_TRAJECTORY = ("tum", "ros")  # formats whose files hold one body each
FRAME_COLUMNS = ("frame", "time_s", "object", "status", "unit")
POSE_COLUMNS = (
    *("tx", "ty", "tz", "qx", "qy", "qz", "qw"),
    *("rotvec_x", "rotvec_y", "rotvec_z"),  # radians
)
COVARIANCE_COLUMNS = tuple(f"cov_{a}_{b}" for a, b in pairs(rigid.TWIST_NAMES, 2))
TIP_COLUMNS = ("tip_x", "tip_y", "tip_z", *(f"tip_cov_{a}_{b}" for a, b in pairs("xyz", 2)))
SENSOR_COLUMNS = ("used", "explained", "rms")
TUM_COLUMNS = "# time tx ty tz qx qy qz qw, in s and m, by mixpose"
BOP_COLUMNS = "scene_id,im_id,obj_id,score,R,t,time"
_LARGEST_SECOND = 2**31 - 1  # builtin_interfaces/Time holds seconds in an int32


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
            "confidence": plain(estimate.confidence),
            "score": plain(1.0 if estimate.score is None else estimate.score),
            "latency_ms": plain(estimate.latency_ms or 0.0),
        }
        if self._numbered:
            row["instance"] = estimate.instance
        if self._header.tips and estimate.tip is not None:
            C = estimate.tip_covariance
            upper = [] if C is None else plain(C[np.triu_indices(3)])
            row |= zip(TIP_COLUMNS, [*plain(estimate.tip), *upper])
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
    T = pose_of(estimate)
    if T is None:
        return {}
    turn = rigid.quaternion_xyzw(T)
    numbers = np.concatenate([T[:3, 3], turn, Rotation.from_quat(turn).as_rotvec()])
    cells = dict(zip(POSE_COLUMNS, plain(numbers), strict=True))
    if estimate.covariance is not None:
        upper = plain(estimate.covariance[np.triu_indices(6)])
        cells |= zip(COVARIANCE_COLUMNS, upper, strict=True)
    return cells


class TumWriter(PoseWriter):
    """Writes one line per frame that has a pose; lost frames are left out."""

    def __init__(self, stream: TextIO, header: Header) -> None:
        super().__init__(stream, header, TUM_COLUMNS)

    def _write(self, estimate: Estimate) -> None:
        T = pose_of(estimate)
        if T is None:
            return
        time = self._time_of(estimate, "tum")
        position = plain(T[:3, 3] / UNITS_PER_METRE[self._header.unit])
        turn = plain(rigid.quaternion_xyzw(T))
        self._stream.write(" ".join(repr(value) for value in [time, *position, *turn]) + "\n")


class BopWriter(PoseWriter):
    """Writes one row per frame that has a pose; lost frames are left out.

    R (row by row) and t (mm) are those of `T_world_object`; the toolkit expects object to camera:
    give it estimates relative to a camera (`estimates.relative_to`). `time` is the duration of the
    estimate in seconds, or -1 if it was not measured. Objects of the header are numbered from
    `obj_id` on; names missing there follow as they occur.
    """

    def __init__(
        self, stream: TextIO, header: Header, *, scene_id: int = 0, obj_id: int = 1
    ) -> None:
        super().__init__(stream, header, BOP_COLUMNS)
        self._mm_per_unit = 1000.0 / UNITS_PER_METRE[header.unit]
        self._scene_id, self._first_obj_id = scene_id, obj_id
        self._obj_ids = {name: obj_id + k for k, name in enumerate(header.objects)}

    def _write(self, estimate: Estimate) -> None:
        obj_id = self._obj_ids.setdefault(estimate.object, self._first_obj_id + len(self._obj_ids))
        T = pose_of(estimate)
        if T is None:
            return
        latency_ms = estimate.latency_ms
        seconds = latency_ms / 1000.0 if latency_ms and latency_ms > 0 else -1.0
        cells = (
            str(self._scene_id),
            str(estimate.frame),
            str(obj_id),
            repr(plain(1.0 if estimate.score is None else estimate.score)),
            " ".join(map(repr, plain(T[:3, :3].ravel()))),
            " ".join(map(repr, plain(T[:3, 3] * self._mm_per_unit))),
            repr(plain(seconds)),
        )
        self._stream.write(",".join(cells) + "\n")


class RosWriter(PoseWriter):
    """Writes a YAML document per frame that has a pose; lost frames are left out.

    Metres and radians, relative to `frame_id`. The covariance of mixpose has the order and axes of
    the message already; it is written row by row in m², m·rad and rad², or as 36 zeros, which mean
    "unknown". A comment in front of each message names its frame and status.
    """

    def __init__(self, stream: TextIO, header: Header, *, frame_id: str = "world") -> None:
        import yaml  # noqa: PLC0415 - only this format needs it

        super().__init__(stream, header)
        dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # the former is four times as fast
        self._yaml_of = partial(yaml.dump, Dumper=dumper, sort_keys=False)
        self._frame_id = frame_id

    def _write(self, estimate: Estimate) -> None:
        if pose_of(estimate) is None:
            return
        seconds = self._time_of(estimate, "ros")
        message = pose_message(estimate, self._header.unit, seconds, self._frame_id)
        header, pose = message["header"], {"pose": message["pose"]}
        self._stream.write(
            f"# frame {estimate.frame}, {estimate.status}\n"
            "header:\n"
            "  stamp:\n"
            f"    sec: {header['stamp']['sec']}\n"
            f"    nanosec: {header['stamp']['nanosec']}\n"
            f"  frame_id: {json.dumps(header['frame_id'])}\n"
            f"{self._yaml_of(pose)}---\n"
        )


def pose_message(
    estimate: Estimate, unit: str, seconds: float, frame_id: str = "world"
) -> dict[str, Any]:
    """Return a geometry_msgs/msg/PoseWithCovarianceStamped as a dict, in metres and radians.

    The estimate must have a pose, in `unit`, relative to `frame_id`. Raises RecordingError if the
    message cannot hold the time.
    """
    T, per_metre = estimate.T_world_object, UNITS_PER_METRE[unit]
    assert T is not None, "lost frames have no message"
    if abs(seconds) > _LARGEST_SECOND:
        raise RecordingError(
            f"frame {estimate.frame}: time {seconds:.15g} s is beyond what format 'ros' can say, "
            f"{_LARGEST_SECOND} s; give the sensors times in seconds"
        )
    second, nanosecond = divmod(round(1e9 * seconds), 10**9)
    covariance = np.zeros((6, 6)) if estimate.covariance is None else estimate.covariance
    scale = np.array([1 / per_metre] * 3 + [1.0] * 3)
    return {
        "header": {"stamp": {"sec": second, "nanosec": nanosecond}, "frame_id": frame_id},
        "pose": {
            "pose": {
                "position": dict(zip("xyz", plain(T[:3, 3] / per_metre))),
                "orientation": dict(zip("xyzw", plain(rigid.quaternion_xyzw(T)))),
            },
            "covariance": plain((covariance * np.outer(scale, scale)).ravel()),
        },
    }


# called with a text stream and a `Header`; BOP and ROS have further options
FORMATS: Mapping[str, Callable[..., PoseWriter]] = {
    "jsonl": JsonlWriter,
    "csv": CsvWriter,
    "tum": TumWriter,
    "bop": BopWriter,
    "ros": RosWriter,
}
