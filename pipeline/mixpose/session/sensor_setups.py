"""Build the sensors of a session from its ``[[sensor]]`` tables."""

from __future__ import annotations

import math
from dataclasses import astuple
from pathlib import Path

import numpy as np

from mixpose import sensors
from mixpose.errors import SessionError
from mixpose.extraction import ExtractOptions, check_options
from mixpose.records import Floats
from mixpose.rigid import from_parts
from mixpose.sensors import CalibrationError, FisheyeCamera, PinholeCamera, Sensor
from mixpose.session import schema_sensors
from mixpose.session.calibration import CalibratedCamera, read_calibration
from mixpose.session.geometry import Intrinsics, read_camera_matrix, read_distortion, read_motion
from mixpose.session.messages import BadKeyError, under
from mixpose.session.schema_sensors import (
    AnySensorTable,
    CameraTable,
    CloudTable,
    ExtractTable,
    LaterationTable,
)
from mixpose.session.setup import SensorSetup
from mixpose.session.values import MATRIX_FORM
from mixpose.units import Unit, length_ratio

_WIDEST_PX = 1000
_WIDEST_BINS = 100_000
_NARROWEST = 1000  # widths are at least a 1000th of a bin
# keys that are copied unchanged from tables that have them
_KEPT = {"name", "model", "source", "fps", "range_min", "bin_size", "delay", "readout", "exposure"}


def build_sensors(
    tables: list[AnySensorTable], defaults: ExtractTable, folder: Path, unit: Unit
) -> tuple[SensorSetup, ...]:
    """Build all sensors; `defaults` is ``[extract]``, paths are of `folder`, lengths in `unit`."""
    with under("extract"):
        merge_extract(defaults, None)
    setups: list[SensorSetup] = []
    for i, table in enumerate(tables):
        with under("sensor", i):
            namesakes = [j for j, setup in enumerate(setups) if setup.name == table.name]
            if namesakes:
                raise BadKeyError(
                    f'found "{table.name}", the name of sensor[{namesakes[0]}] too; allowed: a '
                    "name of its own for each sensor",
                    "name",
                )
            setups.append(_build_sensor(table, defaults, folder, unit))
    if all(setup.delay == "estimate" for setup in setups):
        with under("sensor", len(setups) - 1):
            raise BadKeyError(
                'found "estimate" for every sensor; allowed: for all but one, as delays are known '
                "against another sensor only",
                "delay",
            )
    return tuple(setups)


def merge_extract(defaults: ExtractTable, overrides: ExtractTable | None) -> ExtractOptions:
    """Return the extraction options of a sensor whose keys override those of all sensors."""
    tables = [defaults] if overrides is None else [defaults, overrides]
    merged = {k: v for table in tables for k, v in table.model_dump(exclude_unset=True).items()}
    options = ExtractOptions(**merged)
    if options.max_area is not None and options.max_area <= options.min_area:
        raise BadKeyError(
            f"found {options.max_area:g}; allowed: more than min_area, which is "
            f"{options.min_area:g}",
            "max_area",
        )
    return options


def _build_sensor(
    table: AnySensorTable, defaults: ExtractTable, folder: Path, unit: Unit
) -> SensorSetup:
    if table.times is not None and table.fps is not None:
        raise BadKeyError("stands beside times; allowed: one of the two", "fps")
    sensor: Sensor
    match table:
        case CameraTable():
            sensor = _camera(table, folder, unit)
        case schema_sensors.ParallelTable():
            sensor = sensors.ParallelBeam(
                table.pixel_size, table.principal_point, table.resolution, _T_sensor_world(table)
            )
        case LaterationTable():
            if (table.range_min is None) != (table.bin_size is None):
                missing = "range_min" if table.range_min is None else "bin_size"
                raise BadKeyError("missing; a profile needs range_min and bin_size", missing)
            # the last range of a profile is unknown until its bins are counted
            sensor = sensors.RangeSensor(table.position, table.range_bias)
        case CloudTable():
            if table.delay == "estimate":
                raise BadKeyError(
                    'found "estimate" with model = "cloud"; allowed: seconds', "delay"
                )
            sensor = sensors.CloudSensor(_T_sensor_world(table))
    resolution = getattr(sensor, "resolution", None)
    if getattr(table, "readout", 0.0) and resolution is None:
        raise BadKeyError("stands without resolution; allowed: with [width, height]", "readout")
    with under("extract"):
        extract = merge_extract(defaults, table.extract)
        _check_widths(extract, table)
        if not isinstance(table, LaterationTable | CloudTable):
            try:  # refuse now what would fail on the first image
                check_options(extract)  # without a folder: reading a session runs no user code
            except SessionError as error:
                key, _, text = str(error).partition(": ")
                raise BadKeyError(text, key.removeprefix("extract.")) from error
    copied = type(table).model_fields.keys() & _KEPT
    return SensorSetup(
        **{key: getattr(table, key) for key in copied},
        sensor=sensor,
        times=None if table.times is None else folder / table.times,
        extract=extract,
        resolution=resolution,
        calibration_error=_calibration_error(table),
        overridden=frozenset(table.extract.model_fields_set if table.extract else ()),
    )


def _calibration_error(table: AnySensorTable) -> CalibrationError | None:
    """Return the calibration errors of a sensor; refuse those that its model does not have."""
    if table.calibration_error is None:
        return None
    if isinstance(table, CloudTable):
        raise BadKeyError('stands with model = "cloud"; allowed: with others', "calibration_error")
    error = CalibrationError(**table.calibration_error.model_dump())
    is_range = isinstance(table, LaterationTable)
    for key in ("focal", "principal_point", "rotation_deg") if is_range else ("range_bias",):
        if getattr(error, key):
            allowed = "position, range_bias" if is_range else "all but range_bias"
            raise BadKeyError(
                f'stands with model = "{table.model}"; allowed: {allowed}', "calibration_error", key
            )
    return error if any(astuple(error)) else None


def _camera(table: CameraTable, folder: Path, unit: Unit) -> PinholeCamera | FisheyeCamera:
    camera = _calibrated(table, folder)
    intrinsics = camera.intrinsics
    resolution = table.resolution or intrinsics.resolution
    if resolution and intrinsics.resolution and resolution != intrinsics.resolution:
        raise BadKeyError(
            f"found {list(resolution)}, but the calibration says "
            f"{list(intrinsics.resolution)}; allowed: the same, or leave it out",
            "resolution",
        )
    kind = PinholeCamera if table.model == "pinhole" else FisheyeCamera
    T = read_motion(table, "T_sensor_world")
    if T is None:
        T = _pose_in_file(camera, table.calibration, unit)
    return kind(intrinsics.camera_matrix, intrinsics.distortion, resolution, T)


def _pose_in_file(
    camera: CalibratedCamera, wanted: schema_sensors.CalibrationTable | None, unit: Unit
) -> Floats:
    """Return T_sensor_world of a calibration file, in `unit`; the identity if it has none."""
    T = camera.T_camera_rig
    if T is None or wanted is None:
        return np.eye(4)
    stated = camera.unit or wanted.unit
    if stated is None and T[:3, 3].any():
        raise BadKeyError(
            f"{wanted.file} says where the camera stands, but not in which unit; add it as "
            'calibration = { file = "...", unit = "mm" }, or give T_sensor_world',
            "calibration",
            "unit",
        )
    return from_parts(T[:3, :3], T[:3, 3] * length_ratio(stated or unit, unit))


def _calibrated(table: CameraTable, folder: Path) -> CalibratedCamera:
    if table.calibration is not None:
        for key in ("camera_matrix", "distortion"):
            if getattr(table, key) is not None:
                raise BadKeyError("stands beside calibration; allowed: one of the two", key)
        with under("calibration"):
            return read_calibration(table.calibration, folder, table.model)
    if table.camera_matrix is None:
        raise BadKeyError(f"missing; allowed: {MATRIX_FORM}, or calibration", "camera_matrix")
    with under("camera_matrix"):
        K = read_camera_matrix(table.camera_matrix.tolist())
    with under("distortion"):
        D = read_distortion(table.distortion, table.model)
    return CalibratedCamera(table.name, Intrinsics(K, D))


def _check_widths(extract: ExtractOptions, table: AnySensorTable) -> None:
    """Refuse widths, too large or far below a bin, whose density would not fit into memory."""
    if isinstance(table, CloudTable):
        return
    if not isinstance(table, LaterationTable):
        most, text = float(_WIDEST_PX), f"at most {_WIDEST_PX} px"
    elif table.bin_size is not None:
        most, text = _WIDEST_BINS * table.bin_size, f"at most {_WIDEST_BINS} times bin_size"
        width = math.hypot(extract.sigma, extract.spot_sigma)
        if width < table.bin_size / _NARROWEST:
            raise BadKeyError(
                f"found {extract.sigma:g} with bin_size = {table.bin_size:g}; allowed: at least a "
                f"{_NARROWEST}th of bin_size",
                "sigma",
            )
    else:
        return
    for key in ("sigma", "spot_sigma"):
        if getattr(extract, key) > most:
            raise BadKeyError(f"found {getattr(extract, key):g}; allowed: {text}", key)


def _T_sensor_world(table: schema_sensors.PlacedTable | CloudTable) -> Floats:
    T = read_motion(table, "T_sensor_world")
    return np.eye(4) if T is None else T
