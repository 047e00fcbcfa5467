"""The tables and keys of a session file, from which `docs/session.md` is generated.

The description of a key says what is allowed, in the reference and in error messages, if its type
does not; the docstring below says what the key means, with unit and example.  Both are written for
the user.  Rules about several keys are checked by the functions that use their values.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from mixpose.body import Shape, Spread
from mixpose.fit import SearchName
from mixpose.objective import ObjectiveName
from mixpose.records import Floats
from mixpose.rigid import TWIST_NAMES
from mixpose.session import schema_sensors as sensors
from mixpose.session.schema_sensors import ExtractTable, Motion, Placement, Positive, Table, Text
from mixpose.session.values import RADIUS_ALLOWED, SIGMA_ALLOWED, Free, array_of
from mixpose.units import Unit

MOST_ALIKE = 1000  # most identical bodies in a session


class GravityTable(Table):
    """Features sag, each by itself, along one direction of the world, however the body is turned.
    It counts as `sigma` does: in what a pose is worth and how far off features may be met. The
    sampled objectives (`"paper"`, `"independent"`) integrate over it.
    """

    direction: Annotated[Floats, array_of((3,), "a direction [x, y, z] in the world")]
    """Where gravity points in the world; its length does not matter.
    Example: `direction = [0, 0, -1]`"""
    sigma: Positive = Field(description="a length greater than 0")
    """Standard deviation of a feature's displacement along it, in `unit`.
    Example: `sigma = 2.0`"""


class StartTable(Placement):
    """About where the body is in the first frame that is estimated. Without it the first pose is
    searched for in all orientations. It needs `T_world_object`, or a rotation and `translation`.
    """

    T_world_object: Motion = None
    """The pose: maps coordinates of the body to coordinates of the world.
    Example: `T_world_object = [[1, 0, 0, 20], [0, 1, 0, 10], [0, 0, 1, 900], [0, 0, 0, 1]]`"""
    euler_xyz_deg: Annotated[
        Floats | None, array_of((3,), "three angles in degrees, R = Rz(c) Ry(b) Rx(a)")
    ] = None
    """The rotation as turns about the fixed axes, x first.
    Example: `euler_xyz_deg = [0, 0, 45]`"""
    rotation_deg: Positive | None = Field(
        None, le=180, description="half-width in degrees, greater than 0, at most 180"
    )
    """How far the orientation may be off; where it is left out, 5 degrees.
    Example: `rotation_deg = 10`"""
    distance: Positive | None = Field(None, description="half-width, a length greater than 0")
    """How far the position may be off, in `unit`; where it is left out, a tenth of the body's
    radius.
    Example: `distance = 10`"""


class ObjectTable(Table):
    """The rigid body: where its features are. It needs `points`, `file` or `segments`, of points
    and segments together at least three. Several bodies in one scene are tables `[[object]]`, in
    double brackets, one for each; see `docs/several-bodies.md`.
    """

    name: Text
    """Name of the body, written into every pose.
    Example: `name = "tracker"`"""
    points: Annotated[Floats | None, array_of((None, 3), "a list of points [x, y, z]")] = None
    """Features in the body's own coordinates, in `unit`, in any order.
    Example: `points = [[0, -25, -43.3], [100, -25, -43.3], [0, 61.6, -93.3]]`"""
    names: list[Text] | None = Field(None, description="a list of names, one per point")
    """Names of the points, all different; not together with `file`, which has names. Left out:
    their numbers from 1.
    Example: `names = ["base", "tip", "mast"]`"""
    file: str | None = Field(
        None, min_length=1, description="a CSV file: name,x,y,z[,sigma...]; .rom, .vsk or .obj"
    )
    """A table of points in place of `points`: a row per point under the header `name,x,y,z`, with
    one, three or nine more columns for the spread of each. Or a body of another program: NDI's
    `.rom` and Vicon's `.vsk` (both in mm), AsterTrack's `.obj` (in m), converted to `unit`.
    Example: `file = "markers.csv"`"""
    sigma: Any = Field(None, description=SIGMA_ALLOWED)
    """How far features may be off their places now and then, as markers on skin or cloth: standard
    deviation in `unit`, or covariance in `unit`². Left out, or 0: exact.
    Example: `sigma = 0.5`"""
    segments: Annotated[
        Floats | None, array_of((None, 2, 3), "a list of segments [[x, y, z], [x, y, z]]")
    ] = None
    """Straight lines as features, from end to end in `unit`; they may stand beside points.
    Example: `segments = [[[0, 0, 0], [50, 0, 0]]]`"""
    normals: Annotated[
        Floats | None, array_of((None, 3), "a list of normals [x, y, z], one per point")
    ] = None
    """Outward directions, one per feature (points first, then segments): a feature is seen only
    by sensors that it faces, by cameras at up to 80° from its normal, where it is a sixth as high
    as wide; a sphere at up to 90°.
    Example: `normals = [[0, 0, 1], [0, 0, 1], [1, 0, 0]]`"""
    shape: Shape = "point"
    """Shape of the markers: points, or spheres or flat disks of a `radius`, whose centres are not
    projected to the centres of their images. Disks are perpendicular to their `normals`.
    Example: `shape = "sphere"`"""
    radius: Any = Field(None, description=RADIUS_ALLOWED)
    """Radius of the spheres or disks, in `unit`, to the edge of what shines or is dark.
    Example: `radius = 7.0`"""
    spread: Spread = "gaussian"
    """Density of the displacements that `sigma` states.
    Example: `spread = "uniform"`"""
    tip: Annotated[Floats | None, array_of((3,), "a point [x, y, z] of the body")] = None
    """A point of the body whose place in the world each pose line has, as `tip`, with its
    covariance: the tip of a tool. It need not be a feature; `mixpose pivot` finds it.
    Example: `tip = [0.2, -1.4, -148.6]`"""
    gravity: GravityTable | None = Field(None, description="a table with direction and sigma")
    """See `[object.gravity]`.
    Example: `gravity = { direction = [0, 0, -1], sigma = 2.0 }`"""
    count: int = Field(1, ge=1, le=MOST_ALIKE, description=f"an integer from 1 to {MOST_ALIKE}")
    """How many identical ones there are. Their poses carry the key `instance`, from 0; which one
    is which is kept while they are tracked.
    Example: `count = 4`"""
    start: StartTable | None = Field(None, description="a table [object.start]")
    """See `[start]`, which this replaces where there are several bodies; of identical ones the
    first is there.
    Example: `start = { rotation_vector = [0, 0, 1], translation = [20, 10, 900] }`"""


class EstimatorTable(Table):
    """How poses are estimated."""

    objective: ObjectiveName = "matched"
    """What is maximised: the normalised objective, the paper's product of the sensors inside the
    integral, or the product of one objective per sensor.
    Example: `objective = "paper"`"""
    free: Free = TWIST_NAMES
    """Directions of the world that are estimated; the others stay where `[start]` has them.
    Example: `free = ["x", "y", "rz"]`"""
    samples: int = Field(
        1000, ge=2, le=1_000_000, description="an integer of at least 2, at most 1000000"
    )
    """Samples per feature where its density is integrated by sampling; an exact body needs none.
    Example: `samples = 4000`"""
    seed: int = Field(0, ge=0, description="an integer of at least 0")
    """Same seed, same poses.
    Example: `seed = 1`"""
    fuse: bool = True
    """Whether frames of single ranges without labels take the pose before them as a prior.
    Example: `fuse = false`"""
    search: SearchName | None = None
    """How a frame is searched in which no prediction convinces: to the end, or with a budget of
    guesses per frame (counted, so that results repeat), going on in the next frame from where it
    stopped.  Left out, recordings are searched thoroughly, cameras and streams live.
    Example: `search = "live"`"""
    confidence: float | None = Field(
        None, ge=0.5, lt=1, description="a number of at least 0.5, below 1"
    )
    """Probability of a pose, printed as `confidence`, from which its frame is `ok`.  Left out,
    0.999: one of a thousand may be wrong.
    Example: `confidence = 0.99`"""
    mirrors: bool = False
    """Whether windows, polished tables or screens show the body as in a mirror.  A flat body whose
    `normals` do not say which side is seen looks the same there, and is not `ok` until it is seen
    beside its image; of others the mirror image is as likely as the body.
    Example: `mirrors = true`"""


class SessionTable(Table):
    """The keys before the first table."""

    unit: Unit
    """Unit of every length in this file, in the files of markers and recordings that it names,
    and in the poses.
    Example: `unit = "mm"`"""
    object: Annotated[
        list[ObjectTable], BeforeValidator(lambda item: [item] if isinstance(item, dict) else item)
    ] = Field(min_length=1, description="a table [object], or [[object]] for each of several")
    """See `[object]`; of several bodies `[[object]]`, one for each."""
    start: StartTable | None = Field(None, description="a table [start]")
    """See `[start]`."""
    estimator: EstimatorTable = Field(
        EstimatorTable.model_validate({}), description="a table [estimator]"
    )
    """See `[estimator]`."""
    extract: ExtractTable = Field(ExtractTable.model_validate({}), description="a table [extract]")
    """See `[extract]`."""
    sensor: list[sensors.AnySensorTable] = Field(
        min_length=1, description="at least one table [[sensor]], in double brackets"
    )
    """See `[[sensor]]`; one for each sensor."""
