"""Write and read poses as JSON lines, and find where an interrupted run goes on."""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TextIO

from mixpose import rigid
from mixpose.errors import MixposeError, RecordingError, SessionError, reporting
from mixpose.limits import MOST_BYTES
from mixpose.poses.header import COVARIANCE, FORMAT, VERSION, Header
from mixpose.poses.poseline import PoseLine, parse_header, parse_pose
from mixpose.poses.writing import PoseWriter, plain, pose_of
from mixpose.records import Estimate, Floats, Label

_NUMBERS = re.compile(r"([-+0-9.eE]+ ){7}[-+0-9.eE]+")  # a line of a .tum trajectory


class JsonlWriter(PoseWriter):
    """Writes a header line, unless it resumes a file that has one, and a line per frame.

    Lines are ASCII (other characters are escaped), so that the bytes do not depend on the locale.
    """

    def __init__(self, stream: TextIO, header: Header, *, resume: bool = False) -> None:
        super().__init__(stream, header, "" if resume else header_text(header))

    def _write(self, estimate: Estimate) -> None:
        # a single call for the whole line, so that an interruption rarely leaves half of it
        self._stream.write(json.dumps(pose_line(estimate), allow_nan=False) + "\n")


def header_text(header: Header) -> str:
    """Return the first line of a poses file, without a line end."""
    return json.dumps(header_line(header), allow_nan=False)


def header_line(header: Header) -> dict[str, Any]:
    """Return the first line of a poses file as a JSON object."""
    return {
        "type": "header",
        "format": FORMAT,
        "version": VERSION,
        "unit": header.unit,
        "covariance": COVARIANCE,
        "session": header.session,
        "session_sha256": header.session_sha256,
        "mixpose": header.mixpose,
        "seed": header.seed,
        "symmetries": {name: plain(motions) for name, motions in header.symmetries.items()},
        **_if_any("objects", dict(header.objects) if len(header.labels) > 1 else {}),
        **_if_any("sources", dict(header.sources)),
        **_if_any("options", dict(header.options)),
        **_if_any("smoothed", dict(header.smoothed)),
    }


def pose_line(estimate: Estimate) -> dict[str, Any]:
    """Return the line of an estimate as a JSON object."""
    T = pose_of(estimate)
    points = {
        name: {"at": plain(point.at), "residual": _rounded(point.residual)}
        for name, point in estimate.points.items()
    }
    return {
        "type": "pose",
        "frame": int(estimate.frame),  # JSON cannot hold NumPy integers
        "time_s": plain(estimate.time_s),
        "object": estimate.object,
        **({} if estimate.instance is None else {"instance": int(estimate.instance)}),
        "status": estimate.status,
        **_if_any("why", estimate.doubt),
        "T_world_object": plain(T),
        "quaternion_xyzw": None if T is None else plain(rigid.quaternion_xyzw(T)),
        "covariance": None if T is None else plain(estimate.covariance),
        "confidence": plain(estimate.confidence),
        "score": plain(1.0 if estimate.score is None else estimate.score),
        "sensors": {
            name: {
                "used": bool(report.used),
                "explained": plain(report.explained),
                "rms": plain(report.rms),
                **_if_any("why", report.why),
                **_if_any("residuals", {k: _rounded(r) for k, r in report.residuals.items()}),
                **_if_any("labels", {k: _label(label) for k, label in report.labels.items()}),
            }
            for name, report in estimate.sensors.items()
        },
        **_if_any("points", points),
        "hypotheses": [
            {"T_world_object": plain(rival.T_world_object), "weight": plain(rival.weight)}
            for rival in estimate.hypotheses
        ],
        "latency_ms": plain(estimate.latency_ms or 0.0),
        **_tip_of(estimate),
        **_if_any("filled", estimate.filled),
        **_if_any("ahead_s", estimate.ahead_s),
    }


def _if_any(key: str, value: Any) -> dict[str, Any]:
    return {key: value} if value else {}


def _tip_of(estimate: Estimate) -> dict[str, Any]:
    if estimate.tip_object is None:
        return {}
    if estimate.status == "lost":
        return {"tip": None, "tip_covariance": None}
    return {"tip": plain(estimate.tip), "tip_covariance": plain(estimate.tip_covariance)}


def _rounded(residual: float | None) -> float | None:
    return None if residual is None else float(f"{residual:.4g}")


def _label(label: Label) -> dict[str, Any]:
    place = {"at": plain(label.at)}
    return place if label.detection is None else {**place, "detection": label.detection}


@dataclass(frozen=True)
class PoseFile:
    """A poses or truth file."""

    path: Path
    header: Mapping[str, Any]  # the header line; empty without one
    poses: tuple[PoseLine, ...]  # in the order of the file
    unit: str | None = None  # unit of all lengths; None if no header states it
    symmetries: Mapping[str, Floats] = field(default_factory=dict)  # in the unit of the file

    @property
    def sources(self) -> Mapping[str, str]:
        """Recordings that the run read in place of the session's, by name of the sensor."""
        sources: Mapping[str, str] = self.header.get("sources", {})
        return sources

    def require_unit(self, unit: str, error: type[MixposeError], option: str = "--poses") -> None:
        """Raise an error if poses that an option names are in another unit."""
        if self.unit not in (None, unit):
            raise error(
                f"{option} {self.path}: found the unit {self.unit}; allowed: that of the session, "
                f"{unit}"
            )


def read_poses(path: str | Path) -> PoseFile:
    """Read a poses or truth file.

    A line needs `frame`, `object` and `T_world_object`; all else is optional, also the header, and
    unknown keys are ignored. Raises RecordingError with file and line if a line is not in the
    format, also if the last one was cut off by an interruption.
    """
    path = Path(path)
    return _parse(path, _read_bytes(path))


def read_unfinished_poses(path: str | Path) -> tuple[PoseFile, bool]:
    """Read poses that may still be written, without a last line that is cut; tell if one was."""
    path = Path(path)
    data = _read_bytes(path)
    whole = data.rfind(b"\n") + 1
    cut = False
    try:
        json.loads(data[whole:].strip() or b"{}")
    except (ValueError, RecursionError):
        cut = whole > 0
    return _parse(path, data[:whole] if cut else data), cut


@dataclass(frozen=True)
class ResumePoint:
    """The end of the last whole frame of an interrupted run."""

    frame: int  # its frame
    lines: int  # number of lines of this frame
    size: int  # bytes of the file up to its end
    checksum: int  # CRC-32 of these bytes
    first: int  # frame of the first line


def resume_point(path: str | Path, header: Header) -> ResumePoint | None:
    """Find the last whole frame of an interrupted run, from which a run with this header goes on.

    What follows it is incomplete, to be cut off. Returns None without a whole frame or a file.
    Raises SessionError if the file is of another session, seed, unit, recording, options or version
    of mixpose, and RecordingError if it is not a poses file.
    """
    path = Path(path)
    if not path.exists():
        return None
    data = _read_bytes(path)
    whole = data.rfind(b"\n") + 1
    beginning = b'{"type": "header"'
    if not whole and data[: len(beginning)] != beginning[: len(data)]:
        raise RecordingError(f"{path}: not a poses file, so no run can go on in it")
    so_far = _parse(path, data[:whole])
    if so_far.header or so_far.poses:
        _check_same_run(path, so_far.header, header)
    if not so_far.poses:
        return None
    frame, whole = _last_whole_frame(so_far, data[:whole], len(header.labels))
    if frame is None:
        return None
    lines = sum(line.frame == frame for line in so_far.poses)
    return ResumePoint(frame, lines, whole, zlib.crc32(data[:whole]), so_far.poses[0].frame)


def _last_whole_frame(file: PoseFile, data: bytes, bodies: int) -> tuple[int | None, int]:
    """Return the last frame with a line for each body, and the length of the file up to its end."""
    poses, whole = file.poses, len(data)
    last_lines = [pose for pose in poses if pose.frame == poses[-1].frame]
    if len(last_lines) >= bodies:
        return poses[-1].frame, whole
    lines = data.split(b"\n")
    previous = poses[-len(last_lines) - 1].frame if len(poses) > len(last_lines) else None
    return previous, sum(len(line) + 1 for line in lines[: last_lines[0].line - 1])


def _check_same_run(path: Path, earlier: Mapping[str, Any], wanted: Header) -> None:
    line = header_line(wanted)
    # a session that is gone was moved with its recording and poses
    session = Path(str(earlier.get("session", "")))
    if session.is_file() and session.resolve() != Path(wanted.session or "").resolve():
        raise SessionError(
            f"--resume: {path} has poses of {session}, this run is of {wanted.session}; name "
            "another file with -o"
        )
    if earlier.get("session_sha256") != line["session_sha256"]:
        raise SessionError(
            f"--resume: the session has changed since {path} was written; leave out --resume to "
            "replace these poses, or name another file with -o"
        )
    for key in ("unit", "seed", "mixpose"):
        if earlier.get(key) != line[key]:
            raise SessionError(
                f"--resume: {path} was written with {key} = {earlier.get(key)!r}, this run has "
                f"{line[key]!r}; leave out --resume to start afresh, or name another file with -o"
            )
    before, now = (_options_text(header) for header in (earlier, line))
    if before != now:
        raise SessionError(
            f"--resume: {path} was written with {before}, this run has {now}; give the same, or "
            "leave out --resume to start afresh, or name another file with -o"
        )


def _options_text(header: Mapping[str, Any]) -> str:
    """Return the options of a run as on the command line."""
    items = (header.get(key) for key in ("sources", "options"))
    sources, options = (sorted(value.items()) if isinstance(value, dict) else [] for value in items)
    words = [f"--source {name}={path}" for name, path in sources]
    words += [f"--{name}" if value is True else f"--{name} {value}" for name, value in options]
    return " ".join(words) or "no --source, --step or --labels"


def _read_bytes(path: Path) -> bytes:
    lines: list[bytes] = []
    with reporting(RecordingError, f"{path}: cannot be read"), path.open("rb") as file:
        # lines of a device or a sparse file may be endless
        for line in iter(partial(file.readline, MOST_BYTES + 1), b""):
            lines.append(line)
            if len(line) > MOST_BYTES:
                raise RecordingError(
                    f"{path}:{len(lines)}: found more than {MOST_BYTES} bytes in a line, as "
                    "many are allowed; a poses file holds one JSON object per line (.jsonl)"
                )
    return b"".join(lines)


def _parse(path: Path, data: bytes) -> PoseFile:
    header: Mapping[str, Any] = {}
    unit: str | None = None
    symmetries: Mapping[str, Floats] = {}
    poses: list[PoseLine] = []
    for number, values in _lines(path, data):
        where = f"{path}:{number}"
        kind = values.get("type", "pose")
        if kind == "header":
            if header or poses:
                raise RecordingError(f"{where}: a header after the first line; one file, one run")
            header = values
            unit, symmetries = parse_header(values, where)
        elif kind == "pose":
            poses.append(parse_pose(values, where, number))
        else:
            raise RecordingError(f"{where}: type is {kind!r}; allowed are 'header' and 'pose'")
    return PoseFile(path, header, tuple(poses), unit, symmetries)


def _lines(path: Path, data: bytes) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the JSON objects of a file with line numbers, from 1; empty lines are skipped."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        number = data.count(b"\n", 0, error.start) + 1
        raise RecordingError(f"{path}:{number}: not UTF-8 text, so not a poses file") from error
    lines = text.split("\n")
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            values = json.loads(line, parse_constant=_refuse_constant)
        except (ValueError, RecursionError) as error:
            what = f"{_kind_of(line)}; a poses file holds one JSON object per line (.jsonl)"
            if isinstance(error, _NotFiniteError):
                what = str(error)
            elif number == len(lines):
                what = "the last line is cut off; finish the run with --resume or delete the line"
            raise RecordingError(f"{path}:{number}: {what}") from error
        if not isinstance(values, dict):
            raise RecordingError(f"{path}:{number}: not a JSON object; a line is {{...}}")
        yield number, values


def _kind_of(line: str) -> str:
    """Describe a line that is not JSON: it may be of another format of poses files."""
    trajectory = "found a .tum trajectory, which is not read back"
    kinds = {
        "frame,time_s,": "found a .csv table of poses, which is not read back",
        "scene_id,im_id,": "found a .bop.csv table, which is not read back",
        "# time ": trajectory,
    }
    if _NUMBERS.fullmatch(line.strip()):
        return trajectory
    return next((kind for start, kind in kinds.items() if line.startswith(start)), "not JSON")


class _NotFiniteError(ValueError):
    """A number that JSON cannot hold."""


def _refuse_constant(name: str) -> NoReturn:
    raise _NotFiniteError(f"{name} is not allowed; every number must be finite")
