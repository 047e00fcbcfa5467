"""Write poses in formats of benchmarks: TUM trajectories and BOP result tables.

TUM: ``time tx ty tz qx qy qz qw``, metres; `evo` opens them,
https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
BOP: ``scene_id,im_id,obj_id,score,R,t,time``; the BOP toolkit opens them,
https://bop.felk.cvut.cz/challenges/bop-challenge-2020/#howtoparticipate
"""

from __future__ import annotations

from typing import TextIO

from mixpose import rigid
from mixpose.poses.header import Header
from mixpose.poses.writing import PoseWriter, Stamps, plain, pose_of
from mixpose.records import Estimate
from mixpose.units import UNITS_PER_METRE

TUM_COLUMNS = "# time tx ty tz qx qy qz qw, in s and m, by mixpose"
BOP_COLUMNS = "scene_id,im_id,obj_id,score,R,t,time"


class TumWriter(PoseWriter):
    """Writes one line per frame that has a pose; lost frames are left out."""

    def __init__(self, stream: TextIO, header: Header) -> None:
        super().__init__(stream, header, TUM_COLUMNS)
        self._stamps = Stamps(stream, "tum")

    def _write(self, estimate: Estimate) -> None:
        T = pose_of(estimate)
        if T is None:
            return
        time = self._stamps.time_of(estimate)
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
        self._scene_id = scene_id
        self._first_obj_id = obj_id
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
