"""Draw a study: deviations of systems side by side, and errors over the volume."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mixpose.design.study import Study
from mixpose.errors import SessionError, require_plots
from mixpose.records import Floats
from mixpose.rigid import TWIST_NAMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SUFFIXES = (".png", ".svg", ".pdf")


def require_picture(path: Path) -> None:
    """Raise a SessionError if matplotlib is not installed, or does not write such files."""
    if path.suffix.lower() not in _SUFFIXES:
        raise SessionError(f"--plot {path}: found {path.suffix!r}; allowed: {', '.join(_SUFFIXES)}")
    require_plots("design: --plot needs")


def draw_study(study: Study, path: Path) -> None:
    """Write a picture of a study."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - heavy, and an extra

    count = len(study.systems)
    figure = Figure(figsize=(11, 3.2 * (1 + count)), layout="constrained")
    rows: Any = figure.subfigures(1 + count, 1)
    _bars(list(rows[0].subplots(1, 2)), study)
    tips = [system.summary.tip for system in study.systems]
    largest = max(float(tip[np.isfinite(tip)].max(initial=0.0)) for tip in tips)
    for row, system, tip in zip(rows[1:], study.systems, tips, strict=True):
        row.suptitle(f"{system.name}: error of the tip over the volume", parse_math=False)
        _maps(list(row.subplots(1, 3)), study, tip, largest)
    figure.savefig(path)


def _bars(axes: list[Axes], study: Study) -> None:
    width = 0.8 / len(study.systems)
    for axis, directions, scale, unit in (
        (axes[0], range(3), 1.0, study.unit),
        (axes[1], range(3, 6), 180 / np.pi, "deg"),
    ):
        for k, system in enumerate(study.systems):
            values = system.summary.deviations[:, list(directions)] * scale
            values = np.where(np.isfinite(values), values, np.nan)
            if np.isnan(values).all():
                continue
            positions = np.arange(3) + (k - (len(study.systems) - 1) / 2) * width
            medians = np.nanmedian(values, axis=0)
            axis.bar(positions, medians, width, label=system.name, color=f"C{k}")
            axis.plot(positions, np.nanmax(values, axis=0), "_", color="black", markersize=12)
        axis.set_xticks(range(3), [TWIST_NAMES[d] for d in directions])
        axis.set_ylabel(f"deviation, {unit}: median, worst")
    for name in axes[0].legend().get_texts():
        name.set_parse_math(False)


def _maps(axes: list[Axes], study: Study, errors: Floats, largest: float) -> None:
    positions = study.request.poses[:, :3, 3]
    known = np.isfinite(errors)
    for axis, (i, j) in zip(axes, ((0, 1), (0, 2), (1, 2)), strict=True):
        axis.plot(positions[~known, i], positions[~known, j], "x", color="0.5")
        x, y = positions[known][:, [i, j]].T
        points = axis.scatter(x, y, c=errors[known], vmin=0, vmax=largest or 1.0)
        axis.set(xlabel=f"{TWIST_NAMES[i]}, {study.unit}", ylabel=f"{TWIST_NAMES[j]}, {study.unit}")
        axis.set_aspect("equal", adjustable="datalim")
    axes[0].figure.colorbar(points, ax=axes, label=study.unit)
