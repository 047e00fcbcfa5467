"""Report a calibration on one page: residuals in images, coverage, the rig, numbers."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from mixpose.calibration import Calibration
from mixpose.calibration.result import residuals_by
from mixpose.calibration.rig import centre_of
from mixpose.calibration.telling import lines_of
from mixpose.report.figures import POSE, TRUTH, Chart, blank, svg_of
from mixpose.report.page import page_templates

MARK = '<meta name="generator" content="mixpose calibration'
_TEMPLATE = "calibration.html.j2"
_MOST_NAMED = 20  # features whose names have room below a chart
_LONG = 0.05  # of an image's width: length of the arrow of a residual of three standard deviations


def render_calibration(calibration: Calibration, name: str, unit: str, version: str) -> str:
    """Render the calibration of the session of a name as one self-contained HTML page.

    `unit` is of lengths, `version` of mixpose. Raises a `SessionError` if a library is missing.
    """
    template = page_templates().get_template(_TEMPLATE)
    charts = [_sensor_chart(calibration, k, unit) for k in range(len(calibration.after.names))]
    residuals = [_residuals(calibration, "frame"), _residuals(calibration, "feature")]
    return template.render(
        mark=MARK,
        version=version,
        name=name,
        lines="\n".join(lines_of(calibration, unit)),
        refused=calibration.refused,
        unlinked=[calibration.after.names[k] for k in calibration.unlinked],
        images=[chart for chart in charts if chart is not None],
        others=[_rig_chart(calibration, unit), *residuals],
    )


def _sensor_chart(calibration: Calibration, index: int, unit: str) -> Chart | None:
    """Draw the residuals of one sensor at its detections; None if it has none."""
    detections = calibration.met[index]
    sensor: Any = calibration.after.sensors[index]
    if not len(detections.y):
        return None
    if sensor.dimension == 1:
        figure, axes = blank()
        axes.plot(detections.y[:, 0], detections.offset[:, 0], ".", markersize=2.5, **POSE)
        axes.set(xlabel=f"range, {unit}", ylabel=f"residual, {unit}")
    else:
        figure, axes = blank(height=3.2)
        low, high = detections.y.min(axis=0), detections.y.max(axis=0)
        if getattr(sensor, "resolution", None) is not None:
            low, high = np.zeros(2), np.array(sensor.resolution, dtype=float)
        axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), aspect="equal")
        width = float(np.ptp(axes.get_xlim()))
        scale = max(3 * calibration.noise[index] / (_LONG * width), 1e-12)
        style: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "width": 0.003, **POSE}
        axes.quiver(*detections.y.T, *detections.offset.T, scale=scale, **style)
        axes.set_xlabel(f"px; residuals are drawn {1 / scale:.2g} times as long")
    rms = float(np.sqrt((detections.offset**2).sum(axis=1).mean()))
    title = f"{calibration.after.names[index]}: what was met, and by how much it is off"
    alt = f"{len(detections.y)} detections, residual {rms:.3g} RMS"
    return Chart(title, alt, svg_of(figure))


def _rig_chart(calibration: Calibration, unit: str) -> Chart:
    """Draw sensors and body in the coordinate plane in which they extend farthest."""
    before = np.array([centre_of(s) for s in calibration.before.sensors])
    after = np.array([centre_of(s) for s in calibration.after.sensors])
    middle = calibration.after.points.mean(axis=0)
    body = np.array([T[:3, :3] @ middle + T[:3, 3] for T in calibration.poses.values()])
    everything = np.concatenate([after, body])
    a, b = np.sort(np.argsort(-np.ptp(everything, axis=0), kind="stable")[:2])
    figure, axes = blank(height=3.6)
    axes.plot(body[:, a], body[:, b], ".", markersize=3, **POSE)
    axes.plot(before[:, a], before[:, b], **{**TRUTH, "linestyle": "none", "marker": "x"})
    axes.plot(after[:, a], after[:, b], "o", markersize=5, fillstyle="none", **POSE)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{'xyz'[a]}, {unit}", ylabel=f"{'xyz'[b]}, {unit}")
    title = "Sensors before (crosses) and after (circles), and the body (dots)"
    return Chart(title, f"{len(after)} sensors, {len(body)} frames", svg_of(figure))


def _residuals(calibration: Calibration, kind: Literal["frame", "feature"]) -> Chart:
    """Draw the residuals of frames, as dots, or of features, as bars."""
    numbers, values = residuals_by(calibration, kind)
    figure, axes = blank()
    if kind == "frame":
        axes.plot(numbers, values, ".", markersize=4, **POSE)
        axes.set(xlabel="frame", ylim=(0, None))
    else:
        labels = [calibration.after.body.labels[k] for k in numbers]
        numbers = numbers + 1
        axes.bar(numbers, values, **POSE)
        if len(numbers) <= _MOST_NAMED:
            axes.set_xticks(numbers, labels, parse_math=False)
        axes.set_xlabel("feature of the body")
    axes.set_ylabel("residual, standard deviations")
    alt = "nothing was met"
    if len(values):
        alt = f"worst: {kind} {numbers[int(np.argmax(values))]}, {values.max():.3g}"
    return Chart(f"Residual of each {kind}", alt, svg_of(figure))
