"""A calibration on one page: residuals in every image, coverage, the rig from above, numbers."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from mixpose.calibration import Calibration
from mixpose.calibration.result import residuals_by
from mixpose.calibration.rig import centre_of
from mixpose.calibration.telling import lines_of
from mixpose.report.figures import BARS, POSE, TRUTH, Chart, blank, drawn
from mixpose.report.page import page_templates

MARK = '<meta name="generator" content="mixpose calibration'
_TEMPLATE = "calibration.html.j2"
_MOST_NAMED = 20  # features whose names have room below a chart
_LONG = 0.05  # of an image's width: the arrow of a residual of three standard deviations


def render_calibration(found: Calibration, name: str, unit: str, version: str) -> str:
    """The page of a calibration of a session by its name, without anything outside it.

    `unit` is of lengths, `version` of mixpose. A `SessionError` where a library is missing.
    """
    template = page_templates().get_template(_TEMPLATE)
    charts = [_sensor_chart(found, index, unit) for index in range(len(found.after.names))]
    return template.render(
        mark=MARK,
        version=version,
        name=name,
        lines="\n".join(lines_of(found, unit)),
        refused=found.refused,
        unlinked=[found.after.names[k] for k in found.unlinked],
        images=[chart for chart in charts if chart is not None],
        others=[_above(found, unit), _residuals(found, "frame"), _residuals(found, "feature")],
    )


def _sensor_chart(found: Calibration, index: int, unit: str) -> Chart | None:
    met = found.met[index]
    eye: Any = found.after.sensors[index]
    if not len(met.y):
        return None
    if eye.dimension == 1:
        figure, axes = blank()
        axes.plot(met.y[:, 0], met.offset[:, 0], ".", markersize=2.5, **POSE)
        axes.set(xlabel=f"range, {unit}", ylabel=f"residual, {unit}")
    else:
        figure, axes = blank(height=3.2)
        low, high = met.y.min(axis=0), met.y.max(axis=0)
        if getattr(eye, "resolution", None) is not None:
            low, high = np.zeros(2), np.array(eye.resolution, dtype=float)
        axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), aspect="equal")
        width = float(np.ptp(axes.get_xlim()))
        scale = max(3 * found.noise[index] / (_LONG * width), 1e-12)
        look: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "width": 0.003, **POSE}
        axes.quiver(*met.y.T, *met.offset.T, scale=scale, **look)
        axes.set_xlabel(f"px; residuals are drawn {1 / scale:.2g} times as long")
    rms = float(np.sqrt((met.offset**2).sum(axis=1).mean()))
    title = f"{found.after.names[index]}: what was met, and by how much it is off"
    alt = f"{len(met.y)} detections, residual {rms:.3g} RMS"
    return Chart(title, alt, drawn(figure))


def _above(found: Calibration, unit: str) -> Chart:
    """Sensors and body in the plane in which the rig is widest."""
    before = np.array([centre_of(s) for s in found.before.sensors])
    after = np.array([centre_of(s) for s in found.after.sensors])
    middle = found.after.points.mean(axis=0)
    body = np.array([T[:3, :3] @ middle + T[:3, 3] for T in found.poses.values()])
    everything = np.concatenate([after, body])
    a, b = np.sort(np.argsort(-np.ptp(everything, axis=0), kind="stable")[:2])
    figure, axes = blank(height=3.6)
    axes.plot(body[:, a], body[:, b], ".", markersize=3, **BARS)
    axes.plot(before[:, a], before[:, b], **{**TRUTH, "linestyle": "none", "marker": "x"})
    axes.plot(after[:, a], after[:, b], "o", markersize=5, fillstyle="none", **POSE)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{'xyz'[a]}, {unit}", ylabel=f"{'xyz'[b]}, {unit}")
    title = "Sensors before (crosses) and after (circles), and the body (dots)"
    return Chart(title, f"{len(after)} sensors, {len(body)} frames", drawn(figure))


def _residuals(found: Calibration, kind: Literal["frame", "feature"]) -> Chart:
    """Residuals of each frame, as dots, or of each feature, as bars."""
    numbers, values = residuals_by(found, kind)
    figure, axes = blank()
    if kind == "frame":
        axes.plot(numbers, values, ".", markersize=4, **POSE)
        axes.set(xlabel="frame", ylim=(0, None))
    else:
        labels = [found.after.body.labels[k] for k in numbers]
        numbers = numbers + 1
        axes.bar(numbers, values, **BARS)
        if len(numbers) <= _MOST_NAMED:
            axes.set_xticks(numbers, labels, parse_math=False)
        axes.set_xlabel("feature of the body")
    axes.set_ylabel("residual, standard deviations")
    alt = "nothing was met"
    if len(values):
        alt = f"worst: {kind} {numbers[int(np.argmax(values))]}, {values.max():.3g}"
    return Chart(f"Residual of each {kind}", alt, drawn(figure))
