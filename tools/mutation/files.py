"""Mutants of what is read from and written to files: `session` and `poses`."""

from __future__ import annotations

from mutation.mutant import Mutant

_RELATIVE = "test_poses_relative.py"

_PLACES = (
    Mutant(
        "units-centimetres-are-millimetres",
        "units.py",
        '"cm": 100.0',
        '"cm": 1000.0',
        "lengths of a session in cm are ten times too short",
    ),
    Mutant(
        "session-pose-inverted",
        "session/geometry.py",
        "from_parts(rotation.as_matrix(), table.translation)",
        "from_parts(rotation.inv().as_matrix(), table.translation)",
        "sensors look the other way round than the file says",
    ),
    Mutant(
        "session-matrix-keeps-its-rounding",
        "session/geometry.py",
        "return nearest_rigid(matrix)",
        "return matrix",
        "a matrix of four decimals stretches the world",
    ),
    Mutant(
        "session-euler-about-turned-axes",
        "session/geometry.py",
        'Rotation.from_euler("xyz", values, degrees=True)',
        'Rotation.from_euler("XYZ", values, degrees=True)',
        "three angles are another rotation than the paper's",
    ),
    Mutant(
        "session-quaternion-real-part-first",
        "session/geometry.py",
        "return Rotation.from_quat(values)",
        "return Rotation.from_quat(values, scalar_first=True)",
        "quaternions are read as (w, x, y, z)",
    ),
    Mutant(
        "session-start-widths-swapped",
        "session/reader.py",
        "Start(T_world_object, table.rotation_deg, table.distance)",
        "Start(T_world_object, table.distance, table.rotation_deg)",
        "the search is as wide in degrees as it should be in lengths",
    ),
    Mutant(
        "session-free-in-order-of-the-file",
        "session/values.py",
        "return tuple(name for name in TWIST_NAMES if name in value)",
        "return tuple(value)",
        "free directions do not have the order of the twist",
    ),
)

_BODIES = (
    Mutant(
        "session-variance-for-deviation",
        "session/features.py",
        "return np.diag(deviations**2)",
        "return np.diag(deviations)",
        "sigma = 3 spreads features by 1.7",
    ),
    Mutant(
        "session-normals-of-any-length",
        "session/features.py",
        "return np.asarray(normals / lengths)",
        "return np.asarray(normals)",
        "normals are not unit vectors",
    ),
    Mutant(
        "session-segments-come-first",
        "session/features.py",
        "for (a, b), C in zip(segments, spreads[len(points) :]):",
        "for (a, b), C in zip(segments, spreads):",
        "segments have the spread of the points",
    ),
    Mutant(
        "session-two-features-are-enough",
        "session/features.py",
        "FEWEST_FEATURES = 3",
        "FEWEST_FEATURES = 2",
        "a body without an orientation is taken",
    ),
)

_SETUPS = (
    Mutant(
        "session-common-keys-win",
        "session/sensor_setups.py",
        "[defaults, overrides]",
        "[overrides, defaults]",
        "[sensor.extract] changes nothing",
    ),
    Mutant(
        "session-bias-by-default",
        "session/schema_sensors.py",
        'range_bias: Number = Field(0.0, description="a length")',
        'range_bias: Number = Field(1.0, description="a length")',
        "ranges are off by a length that nobody wrote",
    ),
    Mutant(
        "session-bias-left-out",
        "session/sensor_setups.py",
        "sensor = sensors.RangeSensor(table.position, table.range_bias)",
        "sensor = sensors.RangeSensor(table.position)",
        "the range bias of the file is ignored",
    ),
    Mutant(
        "session-few-samples-by-default",
        "session/schema.py",
        "        1000, ge=2, le=1_000_000",
        "        100, ge=2, le=1_000_000",
        "poses of blurred bodies scatter three times as much",
    ),
    Mutant(
        "session-camera-without-distortion",
        "session/sensor_setups.py",
        "return kind(intrinsics.camera_matrix, intrinsics.distortion, resolution,",
        "return kind(intrinsics.camera_matrix, 0 * intrinsics.distortion, resolution,",
        "the distortion of the calibration is ignored",
    ),
    Mutant(
        "session-times-beside-the-caller",
        "session/sensor_setups.py",
        "times=None if table.times is None else folder / table.times,",
        "times=None if table.times is None else Path(table.times),",
        "a table of times is looked for in the working directory",
    ),
)

_CALIBRATIONS = (
    Mutant(
        "session-kalibr-order",
        "session/calibration/mappings.py",
        "fu, fv, pu, pv = intrinsics",
        "fu, pu, fv, pv = intrinsics",
        "focal lengths and principal points of Kalibr are mixed up",
    ),
    Mutant(
        "session-equidistant-is-pinhole",
        "session/geometry.py",
        '"equidistant": "fisheye"',
        '"equidistant": "pinhole"',
        "a fisheye calibration is used for a pinhole camera",
    ),
    Mutant(
        "session-ros-height-by-width",
        "session/calibration/mappings.py",
        "size_of([width, height])",
        "size_of([height, width])",
        "features at the sides of the image are not seen",
    ),
    Mutant(
        "session-binned-images-pass",
        "session/calibration/mappings.py",
        "if table.get(key, 0) not in whole:",
        'if kind == "cropped" and table.get(key, 0) not in whole:',
        "the camera matrix of the whole image is used for binned ones",
    ),
    Mutant(
        "session-opencv-fisheye-flag-turned-round",
        "session/calibration/opencv.py",
        'return "fisheye" if flag.real() else "pinhole"',
        'return "pinhole" if flag.real() else "fisheye"',
        "a fisheye calibration is used for a pinhole camera",
    ),
    Mutant(
        "session-opencv-first-camera-for-all",
        "session/calibration/opencv.py",
        "for name in common if named is None else (named,):",
        "for name in (*common, named):",
        "both cameras of a stereo file are the same",
    ),
)

_EVALUATION = (
    Mutant(
        "poses-symmetry-in-world-axes",
        "poses/evaluate.py",
        "(np.stack([*truths])[:, None] @ motions)",
        "(motions @ np.stack([*truths])[:, None])",
        "a symmetric pose counts as wrong",
    ),
    Mutant(
        "poses-symmetries-without-identity",
        "poses/evaluate.py",
        "motions = np.concatenate([motions, symmetries])",
        "motions = symmetries",
        "the truth itself counts as wrong where a file names the half-turn only",
    ),
    Mutant(
        "poses-symmetries-of-the-poses-first",
        "poses/evaluate.py",
        "symmetries = {**poses.symmetries, **truth.symmetries}\n    answers",
        "symmetries = {**truth.symmetries, **poses.symmetries}\n    answers",
        "poses excuse themselves by symmetries that the truth denies",
    ),
    Mutant(
        "poses-no-ties",
        "poses/evaluate.py",
        "angle_deg <= angle_deg.min() + TIE_DEG",
        "angle_deg <= angle_deg.min()",
        "of answers alike in rotation a far one is taken",
    ),
    Mutant(
        "units-truth-the-other-way",
        "units.py",
        "UNITS_PER_METRE[to_unit] / UNITS_PER_METRE[from_unit]",
        "UNITS_PER_METRE[from_unit] / UNITS_PER_METRE[to_unit]",
        "a truth in m is a million times off from poses in mm",
    ),
    Mutant(
        "poses-symmetries-keep-their-unit",
        "poses/estimates.py",
        "symmetries = {name: scaled(motions) for name, motions in file.symmetries.items()}",
        "symmetries = dict(file.symmetries)",
        "symmetries of a truth in another unit are far off",
    ),
    Mutant(
        "poses-error-per-six-dimensions",
        "poses/consistency.py",
        "np.mean(nees / dimensions)",
        "np.mean(nees / 6)",
        "covariances of held directions look too careful",
    ),
    Mutant(
        "poses-ellipsoid-of-five-per-cent",
        "poses/consistency.py",
        "chdtri(dimensions, 1.0 - CONFIDENCE)",
        "chdtri(dimensions, CONFIDENCE)",
        "right covariances look far too small",
    ),
    Mutant(
        "poses-ambiguous-covariances-count",
        "poses/evaluate.py",
        "for e in trusted if e.nees is not None",
        "for e in with_pose if e.nees is not None",
        "covariances are judged by frames that say themselves that they may be wrong",
    ),
    Mutant(
        "poses-held-directions-count",
        "poses/consistency.py",
        "free = np.flatnonzero(variance > 1e-12 * kind)",
        "free = np.flatnonzero(variance >= 0 * kind)",
        "a direction without variance makes the squared error infinite",
    ),
    Mutant(
        "poses-axes-in-radians",
        "poses/evaluate.py",
        "rms[3:] = np.degrees(rms[3:])",
        "rms[3:] = rms[3:] + 0.0",
        "errors about the axes are radians under the name of degrees",
    ),
    Mutant(
        "poses-best-is-the-first",
        "poses/evaluate.py",
        "rivals = [line.T_world_object, *(rival.T_world_object for rival in line.hypotheses)]",
        "rivals = [line.T_world_object]",
        "the right answer among the hypotheses is not seen",
    ),
    Mutant(
        "poses-worst-frame-by-its-place",
        "poses/evaluate.py",
        "worst_frame=frames[int(np.argmax(values))]",
        "worst_frame=int(np.argmax(values))",
        "the frame to look at is another where numbers do not begin at 0",
    ),
)

_FORMATS = (
    Mutant(
        "poses-tum-in-the-unit-of-the-file",
        "poses/writers.py",
        "T[:3, 3] / UNITS_PER_METRE[self._header.unit]",
        "T[:3, 3]",
        "trajectories in mm are read as metres",
    ),
    Mutant(
        "poses-bop-in-metres",
        "poses/writers.py",
        "1000.0 / UNITS_PER_METRE[header.unit]",
        "1.0 / UNITS_PER_METRE[header.unit]",
        "BOP results are a thousand times too near",
    ),
    Mutant(
        "poses-bop-rotation-by-columns",
        "poses/writers.py",
        "plain(T[:3, :3].ravel())",
        "plain(T[:3, :3].T.ravel())",
        "BOP results are turned by the inverse rotation",
    ),
    Mutant(
        "poses-bop-time-in-milliseconds",
        "poses/writers.py",
        "latency_ms / 1000.0 if",
        "latency_ms if",
        "BOP takes an estimate for a thousand times slower than it is",
    ),
    Mutant(
        "poses-ros-covariance-in-the-unit-of-the-file",
        "poses/writers.py",
        "scale = np.array([1 / per_metre] * 3 + [1.0] * 3)",
        "scale = np.ones(6)",
        "variances in mm² are read as m²",
    ),
    Mutant(
        "poses-csv-lower-triangle",
        "poses/writers.py",
        "plain(estimate.covariance[np.triu_indices(6)])",
        "plain(estimate.covariance[np.tril_indices(6)])",
        "covariances stand under the names of others",
    ),
    Mutant(
        "poses-negative-zeros",
        "poses/writing.py",
        "(np.asarray(values, dtype=np.float64) + 0.0).tolist()",
        "np.asarray(values, dtype=np.float64).tolist()",
        "equal poses are unequal bytes",
    ),
    Mutant(
        "poses-covariance-stays-in-world-axes",
        "poses/estimates.py",
        "else by_twist @ covariance @ by_twist.T",
        "else covariance",
        "poses relative to a sensor have the covariance of other axes",
    ),
    Mutant(
        "poses-beside-a-body-that-errs-in-nothing",
        "poses/estimates.py",
        "C = line.covariance + rigid.covariance_at(reference.covariance, arm)",
        "C = line.covariance",
        "a tool on a patient is told surer than it is",
        (_RELATIVE,),
    ),
    Mutant(
        "poses-beside-a-body-that-does-not-turn-them",
        "poses/estimates.py",
        "rigid.covariance_at(reference.covariance, arm)",
        "reference.covariance",
        "what a turn of the patient moves at the tool is not in the covariance",
        (_RELATIVE,),
    ),
    Mutant(
        "poses-beside-a-body-that-is-in-doubt",
        "poses/estimates.py",
        'status="ok" if line.status == reference.status == "ok" else "ambiguous"',
        "status=line.status",
        "a tool is ok on a patient that may be turned another way",
        (_RELATIVE,),
    ),
    Mutant(
        "cli-poses-table-without-tips",
        "cli/run.py",
        "tips=any(setup.body.tip is not None for setup in session.objects)",
        "tips=False",
        "tables leave out the one point that a tool is for",
        (_RELATIVE,),
    ),
    Mutant(
        "poses-indefinite-covariance-passes",
        "poses/poseline.py",
        "np.linalg.eigvalsh(correlation)[0] > -1e-6",
        "np.linalg.eigvalsh(correlation)[-1] > -1e-6",
        "a covariance that cannot be one is judged",
    ),
    Mutant(
        "poses-cut-line-is-kept",
        "poses/jsonl.py",
        "return _parse(path, data[:whole] if cut else data), cut",
        "return _parse(path, data), cut",
        "an interrupted run cannot go on",
    ),
)

MUTANTS = (*_PLACES, *_BODIES, *_SETUPS, *_CALIBRATIONS, *_EVALUATION, *_FORMATS)
