"""The paper's figures: simulated signals and objective maps, and the matched maps beside them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from paper.maps import (
    PHI,
    SAMPLES,
    TRUTH,
    W,
    image_box,
    mapped_scenarios,
    mapped_systems,
    matched_map,
    measured,
    paper_map,
    peak_of,
)
from paper.systems import IMAGE_U, IMAGE_V, RANGE_LIMITS, Scenario, System

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats: TypeAlias = NDArray[np.float64]
Map: TypeAlias = Callable[[System, Scenario, int], Floats]

DPI = 80
TRUTH_MARK: dict[str, Any] = {"color": "magenta", "marker": "x", "markersize": 9}


def draw_figures(folder: Path, seed: int) -> list[Path]:
    """Write signals.png, maps-paper.png and maps-matched.png; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    figures = {
        "signals.png": signals_figure(seed),
        "maps-paper.png": maps_figure(paper_map, "formula (4)", seed, sampled=True),
        "maps-matched.png": maps_figure(matched_map, "matched objective", seed, sampled=False),
    }
    for name, figure in figures.items():
        figure.savefig(folder / name, dpi=DPI, pil_kwargs={"optimize": True})
    return [folder / name for name in figures]


def new_figure(width: float, height: float) -> Figure:
    """A figure without a window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def signals_figure(seed: int) -> Figure:
    """A row per scenario: two cameras, then three range profiles."""
    _, cameras, ranges = mapped_systems()
    scenarios = mapped_scenarios()
    figure = new_figure(11, 10)
    axes = figure.subplots(len(scenarios), 3, width_ratios=(1, 1, 1.2))
    u0, u1, v0, v1 = image_box(measured(cameras, scenarios[1], seed))
    extent = (u0 + IMAGE_U[0], u1 + IMAGE_U[0], v0 + IMAGE_V[0], v1 + IMAGE_V[0])
    for row, scenario in zip(axes, scenarios, strict=True):
        for k, image in enumerate(measured(cameras, scenario, seed)):
            values = image.values[v0 : v1 + 1, u0 : u1 + 1]
            row[k].imshow(values, origin="lower", cmap="gray", extent=extent)
            row[k].set_title(f"{scenario.name}: camera {k + 1}", fontsize=9)
        bins = np.arange(RANGE_LIMITS[0], RANGE_LIMITS[1] + 1)
        for k, profile in enumerate(measured(ranges, scenario, seed)):
            row[2].plot(bins, profile.values[0], linewidth=0.9, label=f"range sensor {k + 1}")
        row[2].set_title(f"{scenario.name}: range profiles", fontsize=9)
        row[2].set_xlim(RANGE_LIMITS)
        row[2].set_yticks([])
    axes[0, 2].legend(fontsize=7)
    return figure


def maps_figure(of: Map, title: str, seed: int, *, sampled: bool) -> Figure:
    """A row per scenario, a column per system; the truth and the largest value are marked."""
    scenarios, columns = mapped_scenarios(), mapped_systems()
    figure = new_figure(10, 12)
    axes = figure.subplots(len(scenarios), len(columns), sharex=True, sharey=True)
    extent = (np.degrees(PHI[0]), np.degrees(PHI[-1]), W[0], W[-1])
    for row, scenario in zip(axes, scenarios, strict=True):
        for cell, system in zip(row, columns, strict=True):
            values = of(system, scenario, seed)
            phi, w = peak_of(values)
            cell.imshow(values, origin="lower", extent=extent, aspect="auto", cmap="viridis")
            cell.plot(np.degrees(TRUTH[0]), TRUTH[1], **TRUTH_MARK)
            cell.plot(np.degrees(phi), w, "o", mfc="none", mec="white", markersize=9)
            count = f", R = {SAMPLES[system.name]}" if sampled and system.spread else ""
            cell.set_title(f"system {system.name}, {scenario.name}{count}", fontsize=9)
    for cell in axes[-1]:
        cell.set_xlabel("φ in degrees")
    for cell in axes[:, 0]:
        cell.set_ylabel("w")
    figure.suptitle(f"{title}: magenta cross = truth, white circle = largest value", fontsize=11)
    return figure
