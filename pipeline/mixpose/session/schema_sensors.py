"""The tables ``[[sensor]]`` of a session file, one for each kind of sensor.

How keys are described is said in `schema`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BeforeValidator, Field

from mixpose.records import Floats
from mixpose.session import schema_common as common
from mixpose.session import values
from mixpose.session.intrinsics import MATRIX_FORM
from mixpose.units import Unit

SPAN_ALLOWED = "seconds, from 0 to 1"


class CalibrationTable(common.Table):
    """A calibration file, and what to read in it. `calibration = "cam.yml"` is short for
    `calibration = { file = "cam.yml" }`.
    """

    file: common.Text
    """A file of OpenCV (YAML, XML or JSON), Kalibr, ROS, caliscope, aniposelib, pycalib or COLMAP,
    told apart by content. Where it says how cameras stand to each other, and `T_sensor_world` is
    left out, that is taken over; the world is then the one of the file.
    Example: `file = "stereo.yml"`"""
    camera_matrix: str | None = Field(
        None, min_length=1, description="the name of a node of an OpenCV file"
    )
    """Node of the camera matrix, where a file holds several cameras.
    Example: `camera_matrix = "M2"`"""
    distortion: str | None = Field(
        None, min_length=1, description="the name of a node of an OpenCV file"
    )
    """Node of the distortion coefficients.
    Example: `distortion = "D2"`"""
    camera: str | None = Field(None, min_length=1, description='a camera of the file, like "cam0"')
    """Camera to take where a file holds several.
    Example: `camera = "cam1"`"""
    unit: Unit | None = None
    """Unit of the file's translations, where its format does not fix it (Kalibr and caliscope work
    in metres).
    Example: `unit = "mm"`"""


class CalibrationErrorTable(common.Table):
    """How far off a calibration may be, as standard deviations. Poses stay as they are; their
    covariances know of it, to first order. `mixpose calibrate` prints such numbers; where a rig was
    bumped or a lens refocused, they are yours to guess (`docs/sensors-in-time.md`).
    """

    focal: float = Field(0.0, ge=0, le=0.5, description="a share, from 0 to 0.5")
    """Of the focal length, as a share of it; with parallel beams of `pixel_size`.
    Example: `focal = 0.001`"""
    principal_point: common.NotNegative = Field(0.0, description="px, at least 0")
    """Of the principal point along each axis, in px.
    Example: `principal_point = 0.5`"""
    rotation_deg: float = Field(0.0, ge=0, le=45, description="degrees, from 0 to 45")
    """Of the orientation about each axis.
    Example: `rotation_deg = 0.05`"""
    position: common.NotNegative = Field(0.0, description="a length, at least 0")
    """Of where the sensor stands along each axis, in `unit`.
    Example: `position = 0.5`"""
    range_bias: common.NotNegative = Field(0.0, description="a length, at least 0")
    """Of `range_bias`, with `model = "lateration"`.
    Example: `range_bias = 0.02`"""


class SensorTable(common.Table):
    """What every `[[sensor]]` has, whatever its `model`."""

    name: values.SensorName
    """Name of the sensor, a different one for each.
    Example: `name = "left"`"""
    source: values.Source = ()
    """The recording, relative to the session file: images, a video, a table of detections
    (`frame` or `time_s`, then `u,v`, `range` or `x,y,z`, and optionally `weight`), or range
    profiles (`.npy` or `.csv`, a row per frame); or what is live: the number of a camera, the
    address of a stream, a named pipe.  Tables with `time_s` alone are paired by nearest times.
    Example: `source = "left*.png"`"""
    times: str | None = Field(None, min_length=1, description="a CSV file: frame,time_s")
    """When frames were taken, in seconds: a table with a row for each frame, beside the session
    file or relative to it.  Times must not go back from frame to frame.
    Example: `times = "times.csv"`"""
    fps: common.Positive | None = Field(None, description="frames per second, greater than 0")
    """Frames per second, in place of `times`: frame n is taken at n / fps seconds.
    Example: `fps = 25`"""
    delay: values.Delay = 0.0
    """Seconds by which this sensor's frames are taken later than their times say; negative where
    they are earlier. `"estimate"`: found from how a moving body is seen, relative to sensors whose
    delay is known (`docs/sensors-in-time.md`).
    Example: `delay = 0.006`"""
    calibration_error: CalibrationErrorTable | None = Field(
        None, description="a table like { rotation_deg = 0.05 }"
    )
    """How far off the calibration may be: standard deviations that covariances are to know of. Left
    out: what residuals show of it.
    Example: `calibration_error = { focal = 0.001, principal_point = 0.5, rotation_deg = 0.05 }`"""
    extract: common.ExtractTable | None = Field(None, description="a table [sensor.extract]")
    """Keys of `[extract]` that differ for this sensor.
    Example: `extract = { polarity = "dark" }`"""


class PlacedTable(SensorTable, common.Placement):
    """A sensor that stands somewhere and looks somewhere."""

    T_sensor_world: common.Motion = None
    """Maps coordinates of the world to those of the sensor, which looks along +z with x to the
    right and y down; in place of a rotation with `translation`. Left out: the sensor stands at
    the origin of the world.
    Example: `T_sensor_world = [[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 900], [0, 0, 0, 1]]`"""
    resolution: values.Resolution = None
    """Size of the images in px. Left out: that of the calibration file, else of the first image.
    Example: `resolution = [640, 512]`"""
    readout: float = Field(0.0, ge=0, le=1, description=SPAN_ALLOWED)
    """Rolling shutter: seconds from when the first row of an image is read to when the last is. A
    frame's time is when its middle row is read. Left out: all rows at once.
    Example: `readout = 0.020`"""
    exposure: float = Field(0.0, ge=0, le=1, description=SPAN_ALLOWED)
    """Seconds for which a row collects light. A frame's time is the middle of it, where a moving
    marker's streak has its middle; it matters to `check` and `simulate`, not to poses.
    Example: `exposure = 0.004`"""


class CameraTable(PlacedTable):
    """A camera with perspective. It needs `camera_matrix` or `calibration`."""

    model: Literal["pinhole", "fisheye"]
    """The lens: OpenCV's pinhole model, or its fisheye model. The latter sees beyond 90° from its
    axis, too, as far as the image goes.
    Example: `model = "pinhole"`"""
    camera_matrix: Annotated[Floats | None, values.array_of((3, 3), MATRIX_FORM)] = None
    """Focal lengths and principal point in px; pixel centres have integer coordinates.
    Example: `camera_matrix = [[812.4, 0, 322.7], [0, 811.9, 251.3], [0, 0, 1]]`"""
    distortion: Any = Field(None, description="a list of 4, 5, 8, 12 or 14 numbers (fisheye: 4)")
    """OpenCV's distortion coefficients, in OpenCV's order. Left out: none.
    Example: `distortion = [-0.12, 0.05, 0.0004, -0.0003, 0.0]`"""
    calibration: Annotated[
        CalibrationTable | None, BeforeValidator(values.read_calibration_key)
    ] = Field(None, description='a file, or a table { file = "...", ... }')
    """A calibration file in place of `camera_matrix` and `distortion`.
    Example: `calibration = "left.yml"`"""


class ParallelTable(PlacedTable):
    """A camera without perspective: pixel = (x, y) / pixel_size + principal_point."""

    model: Literal["parallel"]
    """Parallel beams.
    Example: `model = "parallel"`"""
    pixel_size: common.Positive = Field(description="length per px, a number greater than 0")
    """Length in the world, in `unit`, that one px shows.
    Example: `pixel_size = 0.5`"""
    principal_point: Annotated[
        Floats, values.array_of((2,), "[u, v], the px where the sensor's origin projects")
    ]
    """Where the sensor's origin is in the image, in px.
    Example: `principal_point = [150, 160]`"""


class LaterationTable(SensorTable):
    """A sensor of distances: range = distance from `position` + `range_bias`."""

    model: Literal["lateration"]
    """Ranges, in `unit`.
    Example: `model = "lateration"`"""
    position: Annotated[Floats, values.array_of((3,), "[x, y, z], the sensor's place in the world")]
    """Where ranges are measured from, in `unit`.
    Example: `position = [0, -1000, 0]`"""
    range_bias: common.Number = Field(0.0, description="a length")
    """What every reading is too long by, in `unit`.
    Example: `range_bias = 0.15`"""
    range_min: common.Number | None = Field(
        None, description="a length: range of a profile's first bin"
    )
    """For range profiles: the range that their first bin stands for, in `unit`.
    Example: `range_min = 700`"""
    bin_size: common.Positive | None = Field(
        None, description="a length greater than 0: from bin to bin"
    )
    """For range profiles: length from one bin to the next, in `unit`.
    Example: `bin_size = 1.0`"""


class CloudTable(SensorTable, common.Placement):
    """Points in space that nobody has labelled, from a system that triangulates by itself. The
    source is a table with columns `x,y,z`, in `unit`.
    """

    model: Literal["cloud"]
    """Points in space.
    Example: `model = "cloud"`"""
    T_sensor_world: common.Motion = None
    """Maps coordinates of the world to the axes that the points are in; in place of a rotation with
    `translation`. Left out: the points are in the world's axes.
    Example: `T_sensor_world = [[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 900], [0, 0, 0, 1]]`"""


AnySensorTable: TypeAlias = Annotated[
    CameraTable | ParallelTable | LaterationTable | CloudTable, Field(discriminator="model")
]
