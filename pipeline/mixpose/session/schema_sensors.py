"""The tables ``[[sensor]]`` of a session file, one per kind of sensor, and ``[extract]``.

`mixpose.session.schema` says how keys are described.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from mixpose.records import Floats
from mixpose.session import values
from mixpose.session.values import array_of
from mixpose.units import Unit

SPAN_ALLOWED = "seconds, from 0 to 1"

Text: TypeAlias = Annotated[str, Field(min_length=1, description="text that is not empty")]
Number: TypeAlias = Annotated[float, Field(ge=-values.LARGEST, le=values.LARGEST)]
NotNegative: TypeAlias = Annotated[float, Field(ge=0, le=values.LARGEST)]
Positive: TypeAlias = Annotated[float, Field(ge=values.SMALLEST, le=values.LARGEST)]

Motion: TypeAlias = Annotated[
    Floats | None, array_of((4, 4), "a 4x4 matrix, four rows of four numbers")
]


class Table(BaseModel):
    """A TOML table without other keys, text for numbers, NaN and infinity."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class Placement(Table):
    """The forms of a rigid motion other than the 4x4 matrix."""

    rotation_vector: Annotated[
        Floats | None, array_of((3,), "three numbers: axis times angle in radians")
    ] = None
    """The rotation, in place of the matrix and together with `translation`.
    Example: `rotation_vector = [0.1, -0.2, 1.0]`"""
    quaternion_xyzw: Annotated[Floats | None, array_of((4,), "four numbers: x, y, z, w")] = None
    """The same rotation as a quaternion of length 1, the real part last.
    Example: `quaternion_xyzw = [0.0, 0.0, 0.7071068, 0.7071068]`"""
    translation: Annotated[Floats | None, array_of((3,), "three numbers: x, y, z")] = None
    """The last column of the matrix, in `unit`; beside a rotation.
    Example: `translation = [20, 10, 900]`"""


class ExtractTable(Table):
    """How features are found in images. `[extract]` holds for all sensors; `[sensor.extract]`
    below a `[[sensor]]` changes single keys for that sensor. In a table of detections features
    are found already, and of these keys only `sigma` counts.
    """

    method: values.Method = None
    """Centres of spots and disks (`"blobs"`), corners of a chessboard, the grey values themselves,
    centres of unsharp or faint spots by the Laplacian of Gaussian (`"log"`, which needs
    `spot_sigma`: about how wide they are), or a function of your own in a module beside the session
    file.
    Example: `method = "corners"`"""
    polarity: Literal["bright", "dark"] | None = None
    """Whether features are brighter or darker than what surrounds them.
    Example: `polarity = "dark"`"""
    threshold: values.Threshold = None
    """Grey level that parts features from the background. `"auto"` goes by the noise of the image
    and the brightest feature. `"triangle"` and `"li"` go by the histogram: they keep what is dim
    beside something much brighter, and more of what is no feature. `"otsu"` parts two classes of
    about the same size, whatever they are. `"local"` and `"sauvola"` compare each pixel with its
    surroundings, `"sauvola"` also with how much these vary. A number is a level in grey values of
    the image: all that is above it counts. `"corners"` and `"log"` take `"auto"` or a number: the
    least step between fields, or height of a spot.
    Example: `threshold = 120`"""
    min_area: Number | None = Field(None, ge=0, description="an area in px, at least 0")
    """Blobs smaller than this, in px, are no features.
    Example: `min_area = 20`"""
    max_area: Positive | None = Field(None, description="an area in px, greater than min_area")
    """Blobs larger than this, in px, are no features; left out: there is no limit.
    Example: `max_area = 500`"""
    sigma: Positive | None = Field(
        None, description="greater than 0: px for cameras, a length for lateration and clouds"
    )
    """σ_ε, the width that each feature is given: up to about this far apart, in px or in `unit`,
    a predicted and a found feature draw each other in the final fit. For ranges set it to what they
    err by.
    Example: `sigma = 2.0`"""
    spot_sigma: Number | None = Field(
        None, ge=0, description="at least 0: px for cameras, a length for lateration and clouds"
    )
    """Width (standard deviation) that features have already in grey values
    (`method = "intensity"`) and in range profiles, in px or in `unit`; with `method = "log"` that
    of the spots to look for, from 0.7 to 1.5 times the true one, 3 px if it is left out.
    Example: `spot_sigma = 5.0`"""


class CalibrationTable(Table):
    """A calibration file, and what to read in it. `calibration = "cam.yml"` is short for
    `calibration = { file = "cam.yml" }`.
    """

    file: Text
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


class CalibrationErrorTable(Table):
    """How far off a calibration may be, as standard deviations. Poses do not change; their
    covariances include it, to first order. `mixpose calibrate` prints such numbers; for a rig that
    was bumped or a lens that was refocused, guess them (`docs/sensors-in-time.md`).
    """

    focal: float = Field(0.0, ge=0, le=0.5, description="a share, from 0 to 0.5")
    """Of the focal length, as a share of it; with parallel beams of `pixel_size`.
    Example: `focal = 0.001`"""
    principal_point: NotNegative = Field(0.0, description="px, at least 0")
    """Of the principal point along each axis, in px.
    Example: `principal_point = 0.5`"""
    rotation_deg: float = Field(0.0, ge=0, le=45, description="degrees, from 0 to 45")
    """Of the orientation about each axis.
    Example: `rotation_deg = 0.05`"""
    position: NotNegative = Field(0.0, description="a length, at least 0")
    """Of where the sensor stands along each axis, in `unit`.
    Example: `position = 0.5`"""
    range_bias: NotNegative = Field(0.0, description="a length, at least 0")
    """Of `range_bias`, with `model = "lateration"`.
    Example: `range_bias = 0.02`"""


class SensorTable(Table):
    """Keys of every `[[sensor]]`, whatever its `model`."""

    name: values.SensorName
    """Name of the sensor, a different one for each.
    Example: `name = "left"`"""
    source: values.Source = ()
    """The recording, relative to the session file: images, a video, a table of detections
    (`frame` or `time_s`, then `u,v`, `range` or `x,y,z`, and optionally `weight`), or range
    profiles (`.npy` or `.csv`, a row per frame); or what is live: the number of a camera, the
    address of a stream, a named pipe.  Tables with `time_s` alone are paired by nearest times.
    Photographs are turned as their EXIF orientation says, as OpenCV and most calibration tools do.
    Example: `source = "left*.png"`"""
    times: str | None = Field(None, min_length=1, description="a CSV file: frame,time_s")
    """When frames were taken, in seconds: a table with a row for each frame, beside the session
    file or relative to it.  Times must not go back from frame to frame.
    Example: `times = "times.csv"`"""
    fps: Positive | None = Field(None, description="frames per second, greater than 0")
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
    """How far off the calibration may be: standard deviations that covariances include. Left out:
    what residuals show of it.
    Example: `calibration_error = { focal = 0.001, principal_point = 0.5, rotation_deg = 0.05 }`"""
    extract: ExtractTable | None = Field(None, description="a table [sensor.extract]")
    """Keys of `[extract]` that differ for this sensor.
    Example: `extract = { polarity = "dark" }`"""


class PlacedTable(SensorTable, Placement):
    """A sensor with a position and an orientation."""

    T_sensor_world: Motion = None
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
    camera_matrix: Annotated[Floats | None, array_of((3, 3), values.MATRIX_FORM)] = None
    """Focal lengths and principal point in px; pixel centres have integer coordinates.
    Example: `camera_matrix = [[812.4, 0, 322.7], [0, 811.9, 251.3], [0, 0, 1]]`"""
    distortion: Any = Field(None, description="a list of 4, 5, 8, 12 or 14 numbers (fisheye: 4)")
    """OpenCV's distortion coefficients, in OpenCV's order. Left out: none.
    Example: `distortion = [-0.12, 0.05, 0.0004, -0.0003, 0.0]`"""
    calibration: Annotated[
        CalibrationTable | None,
        BeforeValidator(lambda item: {"file": item} if isinstance(item, str) else item),
    ] = Field(None, description='a file, or a table { file = "...", ... }')
    """A calibration file in place of `camera_matrix` and `distortion`.
    Example: `calibration = "left.yml"`"""


class ParallelTable(PlacedTable):
    """A camera without perspective: pixel = (x, y) / pixel_size + principal_point."""

    model: Literal["parallel"]
    """Parallel beams.
    Example: `model = "parallel"`"""
    pixel_size: Positive = Field(description="length per px, a number greater than 0")
    """Length in the world, in `unit`, that one px shows.
    Example: `pixel_size = 0.5`"""
    principal_point: Annotated[
        Floats, array_of((2,), "[u, v], the px where the sensor's origin projects")
    ]
    """Where the sensor's origin is in the image, in px.
    Example: `principal_point = [150, 160]`"""


class LaterationTable(SensorTable):
    """A sensor of distances: range = distance from `position` + `range_bias`."""

    model: Literal["lateration"]
    """Ranges, in `unit`.
    Example: `model = "lateration"`"""
    position: Annotated[Floats, array_of((3,), "[x, y, z], the sensor's place in the world")]
    """Where ranges are measured from, in `unit`.
    Example: `position = [0, -1000, 0]`"""
    range_bias: Number = Field(0.0, description="a length")
    """Length by which every reading is too long, in `unit`.
    Example: `range_bias = 0.15`"""
    range_min: Number | None = Field(None, description="a length: range of a profile's first bin")
    """For range profiles: the range that their first bin stands for, in `unit`.
    Example: `range_min = 700`"""
    bin_size: Positive | None = Field(None, description="a length greater than 0: from bin to bin")
    """For range profiles: length from one bin to the next, in `unit`.
    Example: `bin_size = 1.0`"""


class CloudTable(SensorTable, Placement):
    """Unlabelled points in space, from a system that triangulates by itself. The source is a table
    with columns `x,y,z`, in `unit`.
    """

    model: Literal["cloud"]
    """Points in space.
    Example: `model = "cloud"`"""
    T_sensor_world: Motion = None
    """Maps coordinates of the world to the axes that the points are in; in place of a rotation with
    `translation`. Left out: the points are in the world's axes.
    Example: `T_sensor_world = [[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 900], [0, 0, 0, 1]]`"""


AnySensorTable: TypeAlias = Annotated[
    CameraTable | ParallelTable | LaterationTable | CloudTable, Field(discriminator="model")
]
