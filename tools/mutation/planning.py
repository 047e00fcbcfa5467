"""Mutants of `design` and `importing`, and of the formats that these read."""

from __future__ import annotations

from mutation.mutant import Mutant

_IMPORTS = ("test_import.py",)

_FORMATS = (
    Mutant(
        "session-kalibr-chain-from-the-wrong-end",
        "session/calibration/mappings.py",
        "T = step @ T",
        "T = T @ step",
        "the third camera of a chain stands elsewhere",
        _IMPORTS,
    ),
    Mutant(
        "session-kalibr-imu-the-wrong-way-round",
        "session/calibration/mappings.py",
        "return None if T_imu_cam is None else inverse(T_imu_cam)",
        "return T_imu_cam",
        "cameras of OpenVINS stand elsewhere",
        _IMPORTS,
    ),
    Mutant(
        "session-colmap-pixels-from-their-corner",
        "session/calibration/colmap.py",
        "_CENTRE = 0.5 ",
        "_CENTRE = 0.0 ",
        "every pose from COLMAP is half a pixel off",
        _IMPORTS,
    ),
    Mutant(
        "session-mc-calib-poses-not-inverted",
        "session/calibration/opencv.py",
        'return inverse(rigid(values.reshape(4, 4), "camera_pose_matrix"))',
        'return rigid(values.reshape(4, 4), "camera_pose_matrix")',
        "the second camera stands on the wrong side",
        _IMPORTS,
    ),
    Mutant(
        "session-poses-in-files-keep-their-unit",
        "session/sensor_setups.py",
        "T[:3, 3] * length_ratio(stated or unit, unit)",
        "T[:3, 3]",
        "Kalibr's metres are taken for the session's millimetres",
        _IMPORTS,
    ),
    Mutant(
        "session-bodies-keep-their-unit",
        "session/marker_files.py",
        "points=markers.points * length_ratio(stated, unit)",
        "points=markers.points",
        "an .obj in metres is a thousandth as large",
        ("test_session_bodies.py",),
    ),
    Mutant(
        "session-damaged-rom-passes",
        "session/marker_files.py",
        "sum(content[_SUMMED_FROM:]) & 0xFFFF != stated",
        "False",
        "markers of a damaged file are believed",
        ("test_session_bodies.py",),
    ),
)

_IMPORTING = (
    Mutant(
        "cli-import-translations-keep-their-unit",
        "cli/importing.py",
        "from_parts(T[:3, :3], factor * T[:3, 3])",
        "from_parts(T[:3, :3], T[:3, 3])",
        "a rig in metres is written as millimetres",
        ("test_import.py", "test_import_command.py"),
    ),
    Mutant(
        "cli-import-copies-pass",
        "cli/importing.py",
        "if _are_same(a, b):",
        "if False:",
        "a camera that was copied by mistake is not noticed",
        ("test_import.py", "test_import_command.py"),
    ),
    Mutant(
        "cli-import-worlds-mixed",
        "cli/importing.py",
        "if len(placed) > 1:",
        "if len(placed) > 2:",
        "cameras of two rigs are put into one world",
        ("test_import.py", "test_import_command.py"),
    ),
)

_DESIGN = (
    Mutant(
        "design-marker-errors-apart-in-each-sensor",
        "design/prediction.py",
        "        G += JW @ A\n",
        "        V += (JW @ A @ spread @ (JW @ A).swapaxes(-1, -2)).sum(axis=1)\n",
        "markers seem to err less than they do where several sensors see them",
    ),
    Mutant(
        "design-weighed-by-what-features-err-by",
        "design/prediction.py",
        "all(sensor.dimension == 1 for sensor in self.sensors)",
        "False",
        "the prediction of ranges is better than a run, which weighs them by sigma",
    ),
    Mutant(
        "design-weighed-by-sigma-alone",
        "design/prediction.py",
        "NoiseModel().errors.counted(ratios)",
        "1 + 0 * ratios",
        "the prediction is worse than a run that has seen the noise of its sensors",
    ),
    Mutant(
        "design-tip-turned-the-other-way",
        "design/prediction.py",
        "(len(arms), 3, 3)), arms)",
        "(len(arms), 3, 3)), -arms)",
        "errors of the tip along x add up wrongly with those of the position",
    ),
    Mutant(
        "design-averted-features-count",
        "design/prediction.py",
        "visible = visible & facing(sensor, poses, world, plan.body.normals, plan.body.edge_on)",
        "visible = visible & True",
        "markers on the back are counted",
    ),
    Mutant(
        "body-mirror-images-are-alike",
        "body/symmetry.py",
        "R = (U * proper[:, None]) @ Vt",
        "R = U @ Vt",
        "bodies that are each other's mirror image are called alike",
    ),
    Mutant(
        "design-new-camera-looks-away",
        "design/advice.py",
        "seen_at = np.array([0.0, 0.0, abs(depth)])",
        "seen_at = np.array([0.0, 0.0, -abs(depth)])",
        "the advice is to put a camera with its back to the body",
    ),
    Mutant(
        "cli-design-noise-of-all-last",
        "cli/design.py",
        'sorted(texts, key=lambda text: ("*" not in text, ":" in text))',
        "texts",
        "what is said of all sensors, and last, takes the place of what is said of one",
        ("test_design_command.py",),
    ),
    Mutant(
        "cli-design-without-the-tip-of-the-session",
        "cli/design.py",
        "tip=sessions[0].body.tip if request.tip is None",
        "tip=None if request.tip is None",
        "a tool is judged at its origin, although its tip is known",
        ("test_design_command.py",),
    ),
    Mutant(
        "cli-evaluate-takes-units-in-silence",
        "cli/report.py",
        "if file.unit is None and errors.unit is not None:",
        "if file.unit is not None and errors.unit is None:",
        "a truth in metres without a header is compared as millimetres, and nothing says so",
        ("test_poses_relative.py",),
    ),
)

MUTANTS = (*_FORMATS, *_IMPORTING, *_DESIGN)
