"""The tables and keys of a session file.

Each key's description is what an error message says is allowed, so it is written for the user.
What depends on several keys at once is checked where they are put together.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    PlainValidator,
)
from pydantic_core import core_schema

from mixpose.body import Spread
from mixpose.objective import ObjectiveName
from mixpose.rigid import TWIST_NAMES, Floats
from mixpose.session.arrays import LARGEST, RESOLUTION_FORM, is_number, numbers
from mixpose.session.arrays import resolution as resolution_of
from mixpose.session.intrinsics import MATRIX_FORM
from mixpose.session.messages import BadKeyError, did_you_mean, found, one_of
from mixpose.session.setup import Unit

EXTRACT_METHODS = ("blobs", "corners", "intensity")
THRESHOLDS = ("auto", "otsu", "local")

_FUNCTION = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*(\.[^\W\d]\w*)*")
_METHOD_ALLOWED = f'{one_of(EXTRACT_METHODS)} or "module:function"'
_THRESHOLD_ALLOWED = f"{one_of(THRESHOLDS)} or a grey level"


@dataclass(frozen=True)
class ArrayOf:
    """Annotation of a key that holds nested lists of numbers, see `arrays.numbers`."""

    shape: tuple[int | None, ...]
    description: str

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return core_schema.no_info_plain_validator_function(self.read)

    def read(self, value: Any) -> Floats:
        """Read what the file holds."""
        return numbers(value, self.shape, self.description)


def _sensor_name(name: str) -> str:
    if not name.strip() or name != name.strip() or re.search(r"[=/\\\x00-\x1f\x7f]", name):
        raise BadKeyError(
            found(name, 'text without "=", "/" or "\\", not empty, no blanks around it')
        )
    return name


def _method(value: Any) -> str:
    if isinstance(value, str) and (value in EXTRACT_METHODS or _FUNCTION.fullmatch(value)):
        return value
    raise BadKeyError(found(value, _METHOD_ALLOWED) + did_you_mean(value, EXTRACT_METHODS))


def _threshold(value: Any) -> str | float:
    if isinstance(value, str) and value in THRESHOLDS:
        return value
    if is_number(value):
        return float(value)
    raise BadKeyError(found(value, _THRESHOLD_ALLOWED) + did_you_mean(value, THRESHOLDS))


def _source(value: Any) -> str | tuple[str, ...]:
    allowed = "a glob, a folder or a file as text, or a list of files"
    texts = value if isinstance(value, list) else [value]
    if not texts or not all(isinstance(text, str) and text.strip() for text in texts):
        raise BadKeyError(found(value, allowed))
    return tuple(texts) if isinstance(value, list) else str(value)


def _free(value: Any) -> tuple[str, ...]:
    allowed = f"a list of at least one of {one_of(TWIST_NAMES)}, each once"
    if not isinstance(value, list) or not value:
        raise BadKeyError(found(value, allowed))
    for i, name in enumerate(value):
        if name not in TWIST_NAMES:
            raise BadKeyError(found(name, one_of(TWIST_NAMES)), i)
        if name in value[:i]:
            raise BadKeyError(found(value, allowed) + f'; "{name}" stands there twice')
    return tuple(name for name in TWIST_NAMES if name in value)


def _calibration(value: Any) -> Any:
    return {"file": value} if isinstance(value, str) else value


Text: TypeAlias = Annotated[str, Field(min_length=1, description="text that is not empty")]
Number: TypeAlias = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]


class Table(BaseModel):
    """A TOML table: no keys but these, no text for numbers, no NaN and no infinity."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        frozen=True,
        allow_inf_nan=False,
        arbitrary_types_allowed=True,
        str_strip_whitespace=False,
    )


class Placement(Table):
    """The forms of a rigid motion beside the 4x4 matrix."""

    rotation_vector: Annotated[
        Floats | None, ArrayOf((3,), "three numbers: axis times angle in radians")
    ] = None
    quaternion_xyzw: Annotated[Floats | None, ArrayOf((4,), "four numbers: x, y, z, w")] = None
    translation: Annotated[Floats | None, ArrayOf((3,), "three numbers: x, y, z")] = None


class GravityTable(Table):
    """``[object.gravity]``: displacement along a direction of the world."""

    direction: Annotated[Floats, ArrayOf((3,), "a direction [x, y, z] in the world")]
    sigma: Annotated[Number, Field(gt=0, description="a length greater than 0")]


class ObjectTable(Table):
    """``[object]``."""

    name: Text
    points: Annotated[Floats | None, ArrayOf((None, 3), "a list of points [x, y, z]")] = None
    file: Annotated[
        str | None, Field(min_length=1, description="a CSV file: name,x,y,z[,sigma...]")
    ] = None
    sigma: Any = None
    segments: Annotated[
        Floats | None, ArrayOf((None, 2, 3), "a list of segments [[x, y, z], [x, y, z]]")
    ] = None
    normals: Annotated[
        Floats | None, ArrayOf((None, 3), "a list of normals [x, y, z], one per point")
    ] = None
    spread: Annotated[Spread, Field(description=one_of(get_args(Spread)))] = "gaussian"
    gravity: Annotated[
        GravityTable | None, Field(description="a table with direction and sigma")
    ] = None


class StartTable(Placement):
    """``[start]``."""

    T_world_object: Annotated[
        Floats | None, ArrayOf((4, 4), "a 4x4 matrix, four rows of four numbers")
    ] = None
    euler_xyz_deg: Annotated[
        Floats | None, ArrayOf((3,), "three angles in degrees, R = Rz(c) Ry(b) Rx(a)")
    ] = None
    rotation_deg: Annotated[
        Number | None,
        Field(gt=0, le=180, description="half-width in degrees, greater than 0, at most 180"),
    ] = None
    distance: Annotated[
        Number | None, Field(gt=0, description="half-width, a length greater than 0")
    ] = None


class EstimatorTable(Table):
    """``[estimator]``."""

    objective: Annotated[ObjectiveName, Field(description=one_of(get_args(ObjectiveName)))] = (
        "matched"
    )
    free: Annotated[tuple[str, ...], PlainValidator(_free)] = TWIST_NAMES
    samples: Annotated[int, Field(ge=2, description="an integer of at least 2")] = 1000
    seed: Annotated[int, Field(ge=0, description="an integer of at least 0")] = 0
    fuse: Annotated[bool, Field(description="true or false")] = True


class ExtractTable(Table):
    """``[extract]`` and ``[sensor.extract]``; what is left out has the defaults of extraction."""

    method: Annotated[str | None, PlainValidator(_method)] = None
    polarity: Annotated[Literal["bright", "dark"] | None, Field(description='"bright", "dark"')] = (
        None
    )
    threshold: Annotated[str | Number | None, PlainValidator(_threshold)] = None
    min_area: Annotated[Number | None, Field(ge=0, description="an area in px, at least 0")] = None
    max_area: Annotated[
        Number | None, Field(gt=0, description="an area in px, greater than min_area")
    ] = None
    sigma: Annotated[
        Number | None,
        Field(gt=0, description="greater than 0: px for cameras, a length for lateration"),
    ] = None
    spot_sigma: Annotated[
        Number | None,
        Field(ge=0, description="at least 0: px for cameras, a length for lateration"),
    ] = None


class CalibrationTable(Table):
    """``calibration``: a file, and what to read in it."""

    file: Text
    camera_matrix: Annotated[
        str | None, Field(min_length=1, description="the name of a node of an OpenCV file")
    ] = None
    distortion: Annotated[
        str | None, Field(min_length=1, description="the name of a node of an OpenCV file")
    ] = None
    camera: Annotated[
        str | None, Field(min_length=1, description='a camera of a Kalibr file, like "cam0"')
    ] = None


class SensorTable(Table):
    """What every ``[[sensor]]`` has."""

    name: Annotated[
        str, AfterValidator(_sensor_name), Field(description="a name for the sensor, as text")
    ]
    source: Annotated[str | tuple[str, ...], PlainValidator(_source)] = ()
    times: Annotated[str | None, Field(min_length=1, description="a CSV file: frame,time_s")] = None
    fps: Annotated[Number | None, Field(gt=0, description="frames per second, greater than 0")] = (
        None
    )
    extract: Annotated[ExtractTable | None, Field(description="a table [sensor.extract]")] = None


class PlacedTable(SensorTable, Placement):
    """A sensor that stands somewhere and looks somewhere."""

    T_sensor_world: Annotated[
        Floats | None, ArrayOf((4, 4), "a 4x4 matrix, four rows of four numbers")
    ] = None
    resolution: Annotated[
        tuple[int, int] | None, PlainValidator(resolution_of), Field(description=RESOLUTION_FORM)
    ] = None


class CameraTable(PlacedTable):
    """``model = "pinhole"`` and ``model = "fisheye"``."""

    model: Literal["pinhole", "fisheye"]
    camera_matrix: Annotated[Floats | None, ArrayOf((3, 3), MATRIX_FORM)] = None
    distortion: Annotated[Any, Field(description="a list of 4, 5, 8, 12 or 14 numbers")] = None
    calibration: Annotated[
        CalibrationTable | None,
        BeforeValidator(_calibration),
        Field(description='a file, or a table { file = "...", ... }'),
    ] = None


class ParallelTable(PlacedTable):
    """``model = "parallel"``."""

    model: Literal["parallel"]
    pixel_size: Annotated[Number, Field(gt=0, description="length per px, a number greater than 0")]
    principal_point: Annotated[
        Floats, ArrayOf((2,), "[u, v], the px where the sensor's origin projects")
    ]


class LaterationTable(SensorTable):
    """``model = "lateration"``."""

    model: Literal["lateration"]
    position: Annotated[Floats, ArrayOf((3,), "[x, y, z], the sensor's place in the world")]
    range_bias: Annotated[Number, Field(description="a length")] = 0.0
    range_min: Annotated[
        Number | None, Field(description="a length: range of a profile's first bin")
    ] = None
    bin_size: Annotated[
        Number | None, Field(gt=0, description="a length greater than 0: from bin to bin")
    ] = None


AnySensorTable: TypeAlias = Annotated[
    CameraTable | ParallelTable | LaterationTable, Field(discriminator="model")
]


class SessionTable(Table):
    """The whole file."""

    unit: Annotated[Unit, Field(description=one_of(get_args(Unit)))]
    object: Annotated[ObjectTable, Field(description="a table [object]")]
    start: Annotated[StartTable | None, Field(description="a table [start]")] = None
    estimator: Annotated[EstimatorTable, Field(description="a table [estimator]")] = (
        EstimatorTable()
    )
    extract: Annotated[ExtractTable, Field(description="a table [extract]")] = ExtractTable()
    sensor: Annotated[
        list[AnySensorTable],
        Field(min_length=1, description="at least one table [[sensor]], in double brackets"),
    ]
