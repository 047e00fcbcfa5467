"""Parse and check the lines of a poses file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mixpose import rigid
from mixpose.errors import RecordingError
from mixpose.poses.header import FORMAT, VERSION
from mixpose.records import Estimate, Floats, Hypothesis, Label, MeasuredPoint, SensorReport, Status
from mixpose.units import UNITS_PER_METRE

RIGID_TOLERANCE = 1e-3  # other programs round rotations to a few digits
_LARGEST = 1e100  # squares of larger lengths would overflow


@dataclass(frozen=True)
class PoseLine(Estimate):
    """A pose line as read; without a score, as in a truth file, it counts as certain."""

    line: int = 0  # line number in the file, from 1


_Row4 = Annotated[list[float], Field(min_length=4, max_length=4)]
_Matrix4 = Annotated[list[_Row4], Field(min_length=4, max_length=4)]
_Row6 = Annotated[list[float], Field(min_length=6, max_length=6)]
_Matrix6 = Annotated[list[_Row6], Field(min_length=6, max_length=6)]


class _Line(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)


class _Hypothesis(_Line):
    T_world_object: _Matrix4
    weight: float


class _Label(_Line):
    at: Annotated[list[float], Field(min_length=1, max_length=3)]
    detection: Annotated[int, Field(ge=0)] | None = None


class _Point(_Line):
    at: Annotated[list[float], Field(min_length=3, max_length=3)]
    residual: Annotated[float, Field(ge=0)]


class _Sensor(_Line):
    used: bool = True
    explained: float | None = None
    rms: float | None = None
    why: str | None = None
    residuals: dict[str, Annotated[float, Field(ge=0)] | None] = {}
    labels: dict[str, _Label] = {}


class _Pose(_Line):
    frame: int
    object: str
    instance: Annotated[int, Field(ge=0)] | None = None
    time_s: float | None = None
    status: Status = "ok"
    why: str = ""
    T_world_object: _Matrix4 | None = None
    covariance: _Matrix6 | None = None
    score: float | None = None
    sensors: dict[str, _Sensor] = {}
    hypotheses: list[_Hypothesis] = []
    latency_ms: float | None = None
    confidence: Annotated[float, Field(ge=0, le=1)] | None = None
    points: dict[str, _Point] = {}
    tip: Annotated[list[float], Field(min_length=3, max_length=3)] | None = None
    filled: bool = False
    ahead_s: Annotated[float, Field(ge=0)] = 0.0


class _Header(_Line):
    format: str = FORMAT
    version: int = VERSION
    unit: str | None = None
    symmetries: dict[str, list[_Matrix4]] = {}
    objects: dict[str, Annotated[int, Field(ge=1, le=10**6)]] = {}
    sources: dict[str, str] = {}
    options: dict[str, bool | int] = {}
    smoothed: dict[str, dict[str, Any]] = {}


_Checked = TypeVar("_Checked", bound=_Line)


def parse_pose(values: Mapping[str, Any], where: str, line: int) -> PoseLine:
    """Parse the JSON object of a pose line; a RecordingError begins with `where`, file and line."""
    pose = _checked(_Pose, values, where)
    matrix = pose.T_world_object
    T = None if matrix is None else _motion(matrix, f"{where}: T_world_object")
    if (T is None) != (pose.status == "lost"):
        given = "null or missing" if T is None else "given"
        raise RecordingError(
            f"{where}: T_world_object is {given} while status is {pose.status!r}; it is null "
            "where the status is 'lost' and a 4x4 matrix otherwise"
        )
    fields = dict(pose)
    fields |= {
        "line": line,
        "T_world_object": T,
        "covariance": _covariance(pose.covariance, where),
        "sensors": {name: _report(report) for name, report in pose.sensors.items()},
        "hypotheses": tuple(
            Hypothesis(_motion(rival.T_world_object, f"{where}: hypotheses"), rival.weight)
            for rival in pose.hypotheses
        ),
        "points": {
            name: MeasuredPoint(np.array(point.at), point.residual)
            for name, point in pose.points.items()
        },
        "tip_object": _in_object(T, fields.pop("tip"), has_tip="tip" in values),
        "doubt": fields.pop("why"),
    }
    return PoseLine(**fields)


def _in_object(T: Floats | None, tip: list[float] | None, *, has_tip: bool) -> Floats | None:
    """Return the tip in object coordinates (3,); NaN if the line is lost."""
    if T is None:
        return np.full(3, np.nan) if has_tip else None
    return None if tip is None else np.asarray(T[:3, :3].T @ (tip - T[:3, 3]))


def _report(sensor: _Sensor) -> SensorReport:
    labels = {name: Label(np.array(raw.at), raw.detection) for name, raw in sensor.labels.items()}
    return SensorReport(**{**dict(sensor), "labels": labels})


def parse_header(values: Mapping[str, Any], where: str) -> tuple[str | None, dict[str, Floats]]:
    """Return the unit and symmetries of a header line, or raise a RecordingError."""
    header = _checked(_Header, values, where)
    if header.format != FORMAT:
        raise RecordingError(f"{where}: format is {header.format!r}; allowed is {FORMAT!r}")
    if header.version != VERSION:
        raise RecordingError(
            f"{where}: version {header.version} of {FORMAT}; this mixpose reads version {VERSION}"
        )
    if header.unit is not None and header.unit not in UNITS_PER_METRE:
        allowed = ", ".join(map(repr, UNITS_PER_METRE))
        raise RecordingError(f"{where}: unit is {header.unit!r}; allowed are {allowed}")
    symmetries = {}
    for name, matrices in header.symmetries.items():
        motions = [_motion(matrix, f"{where}: symmetries.{name}") for matrix in matrices]
        symmetries[name] = np.stack([*motions]) if motions else np.eye(4)[None]
    return header.unit, symmetries


def _checked(model: type[_Checked], values: Mapping[str, Any], where: str) -> _Checked:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(repr(str(part))[1:-1] for part in first["loc"])  # names of any characters
        if first["type"] == "missing":
            raise RecordingError(f"{where}: {key} is missing") from error
        text = repr(first["input"])
        text = text if len(text) <= 60 else text[:57] + "..."
        raise RecordingError(f"{where}: {key} is {text}; {first['msg'].lower()}") from error
    except OverflowError as error:
        raise RecordingError(f"{where}: a number is too large") from error


def _motion(matrix: list[list[float]], what: str) -> Floats:
    T = np.array(matrix, dtype=np.float64)
    with np.errstate(all="ignore"):  # huge numbers overflow, and are refused then
        is_motion = rigid.is_rigid(T, RIGID_TOLERANCE)
    if not is_motion:
        raise RecordingError(f"{what} is not a rotation and a translation within {RIGID_TOLERANCE}")
    if np.abs(T).max() > _LARGEST:
        raise RecordingError(f"{what} holds {np.abs(T).max():g}; allowed is at most {_LARGEST:g}")
    return T


def _covariance(matrix: list[list[float]] | None, where: str) -> Floats | None:
    if matrix is None:
        return None
    covariance = np.array(matrix, dtype=np.float64)
    variances = np.diag(covariance)
    if np.all(variances >= 0):
        # lengths and angles have different scales, so check the correlations
        scale = np.sqrt(np.where(variances > 0, variances, 1.0))
        correlation = covariance / scale[:, None] / scale
        if (
            np.all(np.abs(correlation) < 1 + 1e-6)
            and np.allclose(correlation, correlation.T, atol=1e-6)
            and np.linalg.eigvalsh(correlation)[0] > -1e-6
        ):
            return covariance
    raise RecordingError(f"{where}: covariance is not symmetric and positive semi-definite")
