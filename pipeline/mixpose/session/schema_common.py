"""What several tables of a session file share: their rules, placements, and ``[extract]``.

How keys are described is said in `schema`.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field

from mixpose.records import Floats
from mixpose.session.values import LARGEST, SMALLEST, Method, Threshold, array_of

Text: TypeAlias = Annotated[str, Field(min_length=1, description="text that is not empty")]
Number: TypeAlias = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
NotNegative: TypeAlias = Annotated[float, Field(ge=0, le=LARGEST)]
Positive: TypeAlias = Annotated[float, Field(ge=SMALLEST, le=LARGEST)]

Motion: TypeAlias = Annotated[
    Floats | None, array_of((4, 4), "a 4x4 matrix, four rows of four numbers")
]


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

    method: Method = None
    """Centres of spots and disks (`"blobs"`), corners of a chessboard, the grey values themselves,
    centres of unsharp or faint spots by the Laplacian of Gaussian (`"log"`, which needs
    `spot_sigma`: about how wide they are), or a function of your own in a module beside the session
    file.
    Example: `method = "corners"`"""
    polarity: Literal["bright", "dark"] | None = None
    """Whether features are brighter or darker than what surrounds them.
    Example: `polarity = "dark"`"""
    threshold: Threshold = None
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
